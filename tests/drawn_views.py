"""Views of posed things on a plane, drawn without noise and segmented as they are."""

import numpy as np
import trimesh

from nextview.geometry.pinhole import pinhole_matrix
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.viewsphere import look_at_origin
from nextview.segmentation.instances import Instances
from nextview.sensing.frame import Frame
from nextview.sensing.view import View
from nextview.things.library import Library
from nextview.things.surface import Surface

SHAPE = 240, 320
INTRINSICS = pinhole_matrix(300.0, 300.0, 160.0, 120.0)
LARGE = 1.0  # metres, of the largest thing
UP = np.array([0.0, 0, 1])


def surface(name: str, mesh: trimesh.Trimesh) -> Surface:
    """A mesh in metres as the surface of a thing."""
    return Surface(
        name, mesh.vertices.astype(np.float32), np.asarray(mesh.faces, np.int32)
    )


def library() -> Library:
    """A tall box, a flat box, a cylinder, and the tall box a quarter larger."""
    return Library(
        [
            surface("box", trimesh.creation.box((0.06, 0.09, 0.14))),
            surface("slab", trimesh.creation.box((0.12, 0.08, 0.03))),
            surface("can", trimesh.creation.cylinder(0.035, 0.1)),
            surface("large box", trimesh.creation.box((0.075, 0.1125, 0.175))),
        ]
    )


def camera(azimuth: float, elevation: float = 40.0, away: float = 0.6):
    """Pose of a camera that looks at the origin, degrees and metres."""
    return look_at_origin(
        np.radians(np.array([elevation])), np.radians(np.array([azimuth])), away
    )[0]


def standing(one: Surface, x: float, y: float, turn: float = 0.0):
    """Pose of a thing that stands on the plane z = 0, turned by some degrees."""
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    pose = np.eye(4)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = x, y, -float(one.vertices[:, 2].min())
    return pose


def drawn(things, pose, told=None, left_out=()) -> View:
    """A view of things, (surface, pose) each, on the plane z = 0.

    Args:
        things: that are there.
        pose: of the camera.
        told: pose of the camera that is told; the true one by default.
        left_out: numbers of the things that the segmentation takes for nothing.
    """
    plane = (
        np.array([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    placed = [
        ((one.vertices @ at[:3, :3].T + at[:3, 3]).astype(np.float32), one.faces)
        for one, at in things
    ]
    rows, columns = np.indices(SHAPE)
    rays = np.stack(
        [
            (columns + 0.5 - INTRINSICS[0, 2]) / INTRINSICS[0, 0],
            (rows + 0.5 - INTRINSICS[1, 2]) / INTRINSICS[1, 1],
            np.ones(SHAPE),
        ],
        -1,
    ).reshape(-1, 3)
    depth, owner = RayCaster([plane, *placed]).cast(pose[:3, 3], rays @ pose[:3, :3].T)
    depth = np.where(np.isfinite(depth), depth, 0).reshape(SHAPE)
    owner = owner.reshape(SHAPE)
    frame = Frame(depth, INTRINSICS, pose if told is None else told, pixel_centre=0.5)
    masks = tuple(
        owner == k + 1
        for k in range(len(things))
        if k not in left_out and (owner == k + 1).any()
    )
    none = np.zeros(SHAPE, bool)
    instances = Instances(masks, owner == 0, none)
    height = np.where(owner == 0, 0, np.inf).astype(np.float32)
    return View.of(frame, instances, depth > 0, height, UP, LARGE)
