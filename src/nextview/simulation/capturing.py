"""Write captured views of a mesh in BOP's layout, from a camera that casts rays: what ``captured`` reads."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from nextview.checks import number
from nextview.errors import UsageError
from nextview.files import new_folder
from nextview.geometry.mesh import Mesh
from nextview.geometry.ray_caster import RayCaster, pixel_rays
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.simulation.captured import NOTHING, Float, pinhole_of
from nextview.simulation.scene import square

PINHOLE = pinhole_of(525.0, 525.0, 319.5, 239.5)  # a Kinect's as ROS has it by default; first pixel's centre at 0
SHAPE = 480, 640
TABLE = 2.0  # half the side of the table, object radii
STEP = 0.0001  # metres that one step of the depth images stands for


@dataclass(frozen=True)
class Setting:
    """How a mesh is captured: z up, the axes of the mesh, the origin below the object at its lowest point."""

    radius: float  # of the object, metres
    distance: float = 3.0  # of the camera from the object's centre, object radii
    table: bool = False  # the object stands on a table that is seen too
    masks: bool = True  # write masks of the object
    jitter: float = 0.0  # standard deviation of the camera's direction from the candidate viewpoint's, degrees

    def __post_init__(self) -> None:
        number(self.radius, "the object radius, in metres,", above=0)
        number(self.distance, "the distance of the camera, in object radii,", above=1)
        number(self.jitter, "the jitter, in degrees,", 0, 45)
        if (farthest := self.radius * (self.distance + max(1.0, 1.5 * TABLE * self.table))) > STEP * NOTHING:
            raise UsageError(f"the camera sees {farthest:.3g} m far, the depth images end at {STEP * NOTHING:.3g} m")


def write_capture(
    mesh: Mesh, folder: Path, sphere: ViewSphere, setting: Setting, rng: np.random.Generator, overwrite: bool = False
) -> Iterator[int]:
    """Write a folder of captured views, and box.json, the object's upright box, whole; yields how many are done."""
    height = -setting.radius * float(mesh.vertices[:, 2].min())
    vertices = setting.radius * mesh.vertices + np.array([0, 0, height])
    things = [(vertices, mesh.faces)]
    if setting.table:
        things.append(square(TABLE * setting.radius, 0.0))
    caster, rays = RayCaster(things), pixel_rays(pinhole_of(525.0, 525.0, 320.0, 240.0), SHAPE).reshape(-1, 3)
    # The box has an inside, even that of a flat mesh.
    low, high = vertices.min(0) - 1e-6 * setting.radius, vertices.max(0) + 1e-6 * setting.radius
    # The object is number 1, its model the mesh as in its file but in mm.
    model = [0, 0, height] - setting.radius / mesh.radius * mesh.centre
    cameras, objects = {}, {}
    with new_folder(folder, overwrite) as new:
        (new / "box.json").write_text(json.dumps({"low": low.tolist(), "high": high.tolist()}) + "\n")
        for name in ("depth", "mask_visib")[: 1 + setting.masks]:
            (new / name).mkdir()
        for i, pose in enumerate(_camera_poses(sphere, setting, height, rng)):
            rotation = pose[:3, :3].T
            translation, flat = -rotation @ pose[:3, 3], rotation.ravel().tolist()
            there = {"cam_R_w2c": flat, "cam_t_w2c": (1000 * translation).tolist()}
            cameras[str(i)] = {"cam_K": PINHOLE.ravel().tolist(), "depth_scale": 1000 * STEP, **there}
            placed = 1000 * (rotation @ model + translation)
            objects[str(i)] = [{"obj_id": 1, "cam_R_m2c": flat, "cam_t_m2c": placed.tolist()}]
            depth, which = caster.cast(pose[:3, 3], rays @ np.ascontiguousarray(rotation, np.float32))
            steps = np.rint(np.where(which < 0, np.float32(0), depth) / STEP).astype(np.uint16).reshape(SHAPE)
            Image.fromarray(steps).save(new / f"depth/{i:06d}.png")
            if setting.masks:
                mask = np.where(which == 0, 255, 0).astype(np.uint8).reshape(SHAPE)
                Image.fromarray(mask).save(new / f"mask_visib/{i:06d}_000000.png")
            yield i + 1
        for name, values in (("scene_camera", cameras), ("scene_gt", objects)):
            (new / f"{name}.json").write_text(json.dumps(values, indent=1) + "\n")


def _camera_poses(sphere: ViewSphere, setting: Setting, height: float, rng: np.random.Generator) -> Float:
    """At every candidate viewpoint, or near it: camera-to-world, (V, 4, 4), metres; ``height`` is the object's."""
    x, y, z = sphere.directions.T
    off = np.radians(setting.jitter) * rng.standard_normal((2, len(sphere)))
    elevation = np.arcsin(np.clip(z, -1, 1))
    azimuth = np.arctan2(y, x) + off[1] / np.maximum(np.cos(elevation), 0.1)
    lowest = 0.0 if setting.table else -np.pi / 2
    poses = look_at_origin(np.clip(elevation + off[0], lowest, np.pi / 2), azimuth, setting.distance * setting.radius)
    poses[:, 2, 3] += height
    return poses
