"""Write captured views of a mesh: what ``captured`` reads, from a camera that casts rays."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from nextview.arguments import takes_paths
from nextview.cameras import captured_seven_scenes, captured_tum
from nextview.cameras.captured import INTRINSICS
from nextview.cameras.captured_frame import NOTHING, pinhole_of
from nextview.errors import UsageError
from nextview.mesh import Mesh
from nextview.outputs import check_new_folder, written_whole
from nextview.viewsphere import ViewSphere, look_at_origin

Float = NDArray[np.float64]

PINHOLE = pinhole_of(525.0, 525.0, 319.5, 239.5)
"""A Kinect's as ROS has it by default; first pixel's centre at 0."""
SHAPE = 480, 640
TABLE = 2.0
"""Half the side of the table, object radii."""
SCALES = {"bop": 0.0001, "tum": 1 / captured_tum.PER_METRE, "7scenes": captured_seven_scenes.MILLIMETRES}
"""Metres that one step of the depth images stands for, by layout; BOP's is written into its files."""


@dataclass(frozen=True)
class Setting:
    """How a mesh is captured.

    The world is z up and has the axes of the mesh; its origin is below the object's centre, at the height of the
    object's lowest point, where the table is if there is one.

    Attributes:
        radius: of the object, metres.
        distance: of the camera from the object's centre, object radii.
        table: the object stands on a table that is seen too.
        masks: write masks of the object.
        jitter: standard deviation of the camera's direction from the candidate viewpoint's, degrees.

    Raises:
        UsageError: numbers that make no sense.
    """

    radius: float
    distance: float = 3.0
    table: bool = False
    masks: bool = True
    jitter: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.radius < np.inf:
            raise UsageError(f"the object radius is a positive number of metres, not {self.radius}")
        if not 1 < self.distance < np.inf:
            raise UsageError(f"the camera stands more than one object radius from the centre, not {self.distance}")
        if not 0 <= self.jitter <= 45:
            raise UsageError(f"the jitter is 0 to 45 degrees, not {self.jitter}")


def camera_poses(sphere: ViewSphere, setting: Setting, height: float, rng: np.random.Generator) -> Float:
    """Where the camera stands: at every candidate viewpoint, or near it.

    Args:
        sphere: the viewpoints, V of them.
        setting: how far from the object, and how near to the viewpoints.
        height: of the object's centre, metres.
        rng: draws the jitter.

    Returns:
        Camera-to-world, (V, 4, 4), metres.
    """
    x, y, z = sphere.directions.T
    off = np.radians(setting.jitter) * rng.standard_normal((2, len(sphere)))
    elevation = np.arcsin(np.clip(z, -1, 1))
    azimuth = np.arctan2(y, x) + off[1] / np.maximum(np.cos(elevation), 0.1)
    lowest = 0.0 if setting.table else -np.pi / 2
    poses = look_at_origin(np.clip(elevation + off[0], lowest, np.pi / 2), azimuth, setting.distance * setting.radius)
    poses[:, 2, 3] += height
    return poses


@takes_paths("folder")
def write_capture(
    mesh: Mesh, folder: Path, layout: str, sphere: ViewSphere, setting: Setting, rng: np.random.Generator
) -> Iterator[int]:
    """Write a folder of captured views, whole or not at all; yields how many views are done.

    Beside the files of the layout there is box.json, the upright box that just holds the object.

    Args:
        mesh: the object.
        folder: not there yet, or empty.
        layout: "bop", "tum" or "7scenes".
        sphere: where the camera stands.
        setting: and all else.
        rng: draws the jitter.

    Raises:
        ResultsError: the folder cannot be written, or holds something.
        UsageError: there is no such layout, or the scene is too large for its depth images.
    """
    if layout not in SCALES:
        raise UsageError(f"no layout is called {layout!r}; there are {', '.join(SCALES)}")
    scale = SCALES[layout]
    farthest = (setting.distance + max(1.0, 1.5 * TABLE * setting.table)) * setting.radius
    if farthest > scale * NOTHING:
        raise UsageError(
            f"the camera sees as far as {farthest:.3g} m, and the depth images of the layout {layout} end at "
            f"{scale * NOTHING:.3g} m; take a smaller object or distance, or another layout"
        )
    check_new_folder(folder)
    height = -setting.radius * float(mesh.vertices[:, 2].min())
    vertices = setting.radius * mesh.vertices + np.array([0, 0, height])
    poses = camera_poses(sphere, setting, height, rng)
    cast = _Caster(vertices, mesh.faces, TABLE * setting.radius if setting.table else None)
    # The box has an inside, even that of a flat mesh.
    low, high = vertices.min(0) - 1e-6 * setting.radius, vertices.max(0) + 1e-6 * setting.radius
    with written_whole(folder) as new:
        new.mkdir()
        (new / "box.json").write_text(json.dumps({"low": low.tolist(), "high": high.tolist()}) + "\n")
        if layout == "bop":
            _write_bop(new, poses, scale, mesh, setting, height)
            names = [f"depth/{i:06d}.png" for i in range(len(poses))]
            masks = [f"mask_visib/{i:06d}_000000.png" for i in range(len(poses))]
        elif layout == "tum":
            times = [f"{1 + i / 30:.6f}" for i in range(len(poses))]
            names, masks = [f"depth/{time}.png" for time in times], [f"mask/{time}.png" for time in times]
            _write_tum(new, poses, times, names)
        else:
            names = [f"frame-{i:06d}.depth.png" for i in range(len(poses))]
            masks = [f"frame-{i:06d}.mask.png" for i in range(len(poses))]
            for i, pose in enumerate(poses):
                np.savetxt(new / f"frame-{i:06d}.pose.txt", pose, "%.10e")
        if layout != "bop":
            np.savetxt(new / INTRINSICS, PINHOLE, "%.6f")
        for name in [names[0], *masks[: setting.masks]]:
            (new / name).parent.mkdir(exist_ok=True)
        for i, pose in enumerate(poses):
            depth, is_object = cast(pose)
            Image.fromarray(np.rint(depth / scale).astype(np.uint16)).save(new / names[i])
            if setting.masks:
                Image.fromarray(np.where(is_object, 255, 0).astype(np.uint8)).save(new / masks[i])
            yield i + 1


class _Caster:
    """A pinhole camera over an object and maybe a table."""

    def __init__(self, vertices: Float, faces: NDArray[np.int32], table: float | None) -> None:
        from embreex.mesh_construction import TriangleMesh  # only who simulates a camera pays for the import
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene()
        TriangleMesh(self._scene, vertices.astype(np.float32), np.ascontiguousarray(faces, np.int32))
        if table is not None:
            square = table * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
            TriangleMesh(self._scene, square, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
        row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
        rays = np.stack([column, row, np.ones_like(row)], -1).reshape(-1, 3) @ np.linalg.inv(PINHOLE).T
        self._rays = rays.astype(np.float32)  # z = 1, so that Embree's distance is the depth
        self._origins = np.empty_like(self._rays)

    def __call__(self, pose: Float) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Depth, (H, W), metres, 0 = nothing; and where the object is seen."""
        self._origins[:] = pose[:3, 3]
        directions = self._rays @ np.ascontiguousarray(pose[:3, :3].T, np.float32)
        hits = self._scene.run(self._origins, directions, output=1)
        hit = hits["primID"] >= 0
        depth = np.where(hit, hits["tfar"], 0).astype(np.float32).reshape(SHAPE)
        return depth, (hit & (hits["geomID"] == 0)).reshape(SHAPE)


def _write_bop(folder: Path, poses: Float, scale: float, mesh: Mesh, setting: Setting, height: float) -> None:
    """scene_camera.json and scene_gt.json: the object is number 1, its model the mesh as in its file but in mm."""
    metres = setting.radius / mesh.radius  # of the file's unit
    cameras, objects = {}, {}
    for i, pose in enumerate(poses):
        rotation = pose[:3, :3].T
        translation = -rotation @ pose[:3, 3]
        placed = rotation @ ([0, 0, height] - metres * mesh.centre) + translation
        cameras[str(i)] = {
            "cam_K": PINHOLE.ravel().tolist(),
            "depth_scale": 1000 * scale,
            "cam_R_w2c": rotation.ravel().tolist(),
            "cam_t_w2c": (1000 * translation).tolist(),
        }
        objects[str(i)] = [{"obj_id": 1, "cam_R_m2c": rotation.ravel().tolist(), "cam_t_m2c": (1000 * placed).tolist()}]
    for name, values in (("scene_camera", cameras), ("scene_gt", objects)):
        (folder / f"{name}.json").write_text(json.dumps(values, indent=1) + "\n")


def _write_tum(folder: Path, poses: Float, times: list[str], names: list[str]) -> None:
    lines = ["# timestamp filename", *(f"{time} {name}" for time, name in zip(times, names, strict=True))]
    (folder / "depth.txt").write_text("\n".join(lines) + "\n")
    values = np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    lines += [" ".join([time, *(f"{v:.10f}" for v in row)]) for time, row in zip(times, values, strict=True)]
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")
