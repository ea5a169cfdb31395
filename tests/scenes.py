"""Small scenes for tests of sensing: meshes in a world in metres, and a pinhole camera that casts rays at them."""

from collections.abc import Sequence

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.spatial.transform import Rotation

from nextview.cameras.simulated import SimulatedCamera
from nextview.measures.measured_view import MeasuredView
from nextview.measures.surface import Surface
from nextview.mesh import Mesh
from nextview.observation import pinhole
from nextview.viewsphere import look_at_origin

INTRINSICS = np.array([[520.0, 0, 310.5], [0, 530.0, 246.5], [0, 0, 1]])
"""First pixel's centre at 0.5."""
SHAPE = 480, 640


def box(size, middle=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation(middle)


TABLE = box((1.4, 1.4, 0.04), (0, 0, -0.02))
"""Its top is at z = 0."""


def cast(meshes: Sequence[trimesh.Trimesh], pose, intrinsics=INTRINSICS, shape=SHAPE) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) float32, 0 = nothing, and which mesh is seen, -1 for none."""
    scene = EmbreeScene()
    for mesh in meshes:
        TriangleMesh(scene, mesh.vertices.astype(np.float32), np.ascontiguousarray(mesh.faces, np.int32))
    row, column = np.mgrid[: shape[0], : shape[1]] + 0.5
    rays = np.stack([column, row, np.ones_like(row)], -1) @ np.linalg.inv(intrinsics).T
    directions = (rays.reshape(-1, 3) @ pose[:3, :3].T).astype(np.float32)
    origins = np.tile(np.asarray(pose)[:3, 3].astype(np.float32), (len(directions), 1))
    hits = scene.run(origins, directions, output=1)
    hit = hits["primID"] >= 0
    return (
        np.where(hit, hits["tfar"], 0).reshape(shape).astype(np.float32),
        np.where(hit, hits["geomID"], -1).reshape(shape),
    )


def pose_at(elevation, azimuth, distance, target=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0)) -> np.ndarray:
    """A camera (degrees, metres) that looks at a target and is then turned about its own axes, degrees."""
    pose = look_at_origin(np.radians(elevation), np.radians(azimuth), distance)
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    pose[:3, 3] += target
    return pose


def of_depth(depth, distance=3.0) -> MeasuredView:
    """What a measure is handed where the depth alone is known, from straight ahead."""
    depth = np.asarray(depth)
    return MeasuredView(depth, look_at_origin(0, 0, distance), pinhole(max(depth.shape), distance))


def view_of(mesh: Mesh, pose, size=224, distance=3.0) -> MeasuredView:
    """What a measure is handed of a mesh that is seen from a pose."""
    camera = SimulatedCamera(mesh, size, distance)
    seen = camera.observe(pose)
    return MeasuredView(seen.depth, pose, seen.intrinsics, Surface(mesh.vertices, mesh.faces), camera.face_ids(pose))
