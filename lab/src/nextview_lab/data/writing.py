"""Write simulated views of a mesh in BOP's layout."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from nextview.captured.frames import NO_DEPTH
from nextview.checks import number
from nextview.errors import UsageError
from nextview.files import new_folder
from nextview.geometry.mesh import Mesh
from nextview.geometry.pinhole import PinholeCamera, pinhole_matrix
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.viewsphere import CAMERA_DISTANCE, ViewSphere, look_at_origin
from nextview.types import Float32
from nextview_lab.worlds.worlds import slab

# default intrinsics of a Kinect in ROS; first pixel's centre at 0
PINHOLE = pinhole_matrix(525.0, 525.0, 319.5, 239.5)
SHAPE = 480, 640
TABLE_HALF_SIDE = 2.0  # half the side of the table, object radii
TABLE_THICKNESS = 0.01  # metres
DEPTH_STEP = 0.0001  # metres per unit of the depth images


def write_capture(
    mesh: Mesh,
    folder: Path,
    sphere: ViewSphere,
    radius: float,
    table: bool = False,
    masks: bool = True,
    overwrite: bool = False,
) -> Iterator[int]:
    """Write a folder of captured views and box.json, the object's upright bounding box.

    The world frame, in metres, has z up and the axes of the mesh. Its origin is below the object's
    centre, at the height of its lowest point.

    Args:
        mesh: the object.
        folder: to write.
        sphere: viewpoints of the views.
        radius: of the object, metres.
        table: whether the object stands on a visible table.
        masks: whether to write masks of the object.
        overwrite: whether to replace an earlier capture.

    Yields:
        Number of finished views.
    """
    number(radius, "the object radius, in metres,", above=0)
    if (
        farthest := radius * (CAMERA_DISTANCE + max(1.0, 1.5 * TABLE_HALF_SIDE * table))
    ) > DEPTH_STEP * NO_DEPTH:
        raise UsageError(
            f"the camera sees {farthest:.3g} m far, the depth images end at"
            f" {DEPTH_STEP * NO_DEPTH:.3g} m"
        )
    height = -radius * float(mesh.vertices[:, 2].min())
    vertices = radius * mesh.vertices + np.array([0, 0, height])
    side = 2 * TABLE_HALF_SIDE * radius
    things = [(vertices, mesh.faces)] + [
        slab((side, side, TABLE_THICKNESS), (0, 0), 0)
    ] * table
    caster = RayCaster(things)
    rays = PinholeCamera.of(
        pinhole_matrix(525.0, 525.0, 320.0, 240.0),
        SHAPE,
    ).rays.reshape(-1, 3)
    # The margin gives the box a volume, even for a flat mesh.
    low = vertices.min(0) - 1e-6 * radius
    high = vertices.max(0) + 1e-6 * radius
    # The object has number 1; its model is the mesh of the file in millimetres.
    model = [0, 0, height] - radius / mesh.radius * mesh.centre
    x, y, z = sphere.directions.T
    # not below the table
    elevation = np.clip(
        np.arcsin(np.clip(z, -1, 1)),
        0.0 if table else -np.pi / 2,
        np.pi / 2,
    )
    poses = look_at_origin(elevation, np.arctan2(y, x), CAMERA_DISTANCE * radius)
    poses[:, 2, 3] += height
    cameras = {}
    objects = {}
    # This file is written last. Without it the folder is not a capture, so an interrupted run
    # leaves no mixture of two objects' views.
    with new_folder(folder, overwrite, last="scene_camera.json", withdraw=True) as new:
        (new / "box.json").write_text(
            json.dumps({"low": low.tolist(), "high": high.tolist()}) + "\n"
        )
        for name in ("depth", "mask_visib")[: 1 + masks]:
            (new / name).mkdir()
        for i, pose in enumerate(poses):
            rotation = pose[:3, :3].T
            translation = -rotation @ pose[:3, 3]
            flat = rotation.ravel().tolist()
            there = {"cam_R_w2c": flat, "cam_t_w2c": (1000 * translation).tolist()}
            cameras[str(i)] = {
                "cam_K": PINHOLE.ravel().tolist(),
                "depth_scale": 1000 * DEPTH_STEP,
                **there,
            }
            placed = 1000 * (rotation @ model + translation)
            objects[str(i)] = [
                {"obj_id": 1, "cam_R_m2c": flat, "cam_t_m2c": placed.tolist()}
            ]
            seen = caster.cast(
                pose[:3, 3],
                rays @ np.ascontiguousarray(rotation, np.float32),
            )
            _write_images(new, i, *seen, masks)
            yield i + 1
        for name, values in (("scene_camera", cameras), ("scene_gt", objects)):
            (new / f"{name}.json").write_text(json.dumps(values, indent=1) + "\n")


def _write_images(
    folder: Path,
    index: int,
    depth: Float32,
    which: NDArray[np.integer],
    masks: bool,
) -> None:
    """Write the depth of each ray, and the mask of the object, from the index of the hit mesh."""
    steps = np.rint(np.where(which < 0, np.float32(0), depth) / DEPTH_STEP).astype(
        np.uint16
    )
    Image.fromarray(steps.reshape(SHAPE)).save(folder / f"depth/{index:06d}.png")
    if masks:
        mask = np.where(which == 0, 255, 0).astype(np.uint8).reshape(SHAPE)
        Image.fromarray(mask).save(folder / f"mask_visib/{index:06d}_000000.png")
