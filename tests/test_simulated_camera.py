"""The simulated camera against closed forms, and against casting every ray."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from hypothesis import given, settings
from hypothesis import strategies as st

from nextview.geometry.mesh import Mesh, load_mesh, make_mesh
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.simulation.simulated import AMBIENT, SimulatedCamera

SPHERE = ViewSphere.named("40")


def meshed(*parts: trimesh.Trimesh) -> Mesh:
    whole = trimesh.util.concatenate(parts)
    return make_mesh(whole.vertices, whole.faces)


def box(size, centre=(0, 0, 0)) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation(centre)


BALL = meshed(trimesh.creation.icosphere(subdivisions=6))
TABLE = meshed(box((4, 3, 0.2), (0, 0, 2)), *(box((0.2, 0.2, 2), (x, y, 1)) for x in (-1.8, 1.8) for y in (-1.3, 1.3)))
CHAIR = meshed(box((1, 1, 0.1), (0, 0, 0.5)), box((0.1, 1, 1), (-0.45, 0, 1)), box((0.2, 0.2, 0.5), (0.3, 0.2, 0.25)))


def rays(size: int, intrinsics: np.ndarray) -> np.ndarray:
    """Directions with z = 1 through the centres of all pixels, in the camera's frame, (size, size, 3)."""
    row, column = np.mgrid[:size, :size] + 0.5
    return np.stack([column, row, np.ones_like(row)], -1) @ np.linalg.inv(intrinsics).T


def cast_all(mesh: Mesh, pose: np.ndarray, size: int, intrinsics: np.ndarray) -> np.ndarray:
    """Depth by casting a ray through every pixel."""
    scene = EmbreeScene()
    TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces)
    directions = (rays(size, intrinsics) @ pose[:3, :3].T).reshape(-1, 3).astype(np.float32)
    origins = np.tile(pose[:3, 3].astype(np.float32), (len(directions), 1))
    hits = scene.run(origins, directions, output=1)
    return np.where(hits["primID"] >= 0, hits["tfar"], 0).reshape(size, size)


def ball_depth(size: int, intrinsics: np.ndarray, distance: float) -> np.ndarray:
    """|t d - c| = 1 with c on the optical axis: the nearer root, 0 where there is none."""
    d = rays(size, intrinsics)
    a, b, c = (d**2).sum(-1), distance * d[..., 2], distance**2 - 1
    root = b**2 - a * c
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0)


def assert_same_but_at_edges(depth: np.ndarray, other: np.ndarray) -> None:
    """Equal, except where rounding decides whether a ray just touches an edge."""
    differs = np.abs(depth - other) > 1e-4
    assert differs.mean() < 2e-3
    assert np.abs((depth > 0).sum(0) - (other > 0).sum(0)).max() <= 3


@pytest.mark.parametrize("distance", [2.0, 3.0, 6.0])
@pytest.mark.parametrize("view", [0, 13, 38])
def test_depth_of_a_ball_is_that_of_the_equation(distance, view):
    elevation, azimuth = np.radians(SPHERE.angles(view))
    observation = SimulatedCamera(BALL, 224, distance).observe(look_at_origin(elevation, azimuth, distance))
    expected = ball_depth(224, observation.intrinsics, distance)
    inside = expected > 0
    assert (inside != (observation.depth > 0)).mean() < 0.002
    rim = np.abs(rays(224, observation.intrinsics)[..., :2]).max()
    steep = (rays(224, observation.intrinsics)[..., :2] ** 2).sum(-1) > (0.95 * rim) ** 2
    np.testing.assert_allclose(observation.depth[~steep], expected[~steep], atol=1e-3)


def test_the_ball_just_fills_the_image():
    depth = SimulatedCamera(BALL, 224).observe(SPHERE.poses[20]).depth
    rows, columns = np.nonzero(depth)
    for seen in (rows, columns):
        assert seen.min() <= 1
        assert seen.max() >= 222
    assert not depth[0, 0]
    assert np.count_nonzero(depth) / depth.size == pytest.approx(np.pi / 4, rel=0.005)


def test_a_ball_is_lit_by_a_headlight():
    observation = SimulatedCamera(BALL, 224).observe(SPHERE.poses[9])
    d = rays(224, observation.intrinsics)
    inside = ball_depth(224, observation.intrinsics, 3.0) > 0
    normal = d * ball_depth(224, observation.intrinsics, 3.0)[..., None] - (0, 0, 3)
    cosine = np.abs((normal * d).sum(-1)) / np.linalg.norm(d, axis=-1)
    gap = np.abs(observation.image - 255 * (AMBIENT + (1 - AMBIENT) * cosine))[inside & (observation.depth > 0)]
    assert np.median(gap) < 2
    assert gap.max() < 30  # facets that are seen at a graze
    assert (observation.image[observation.depth == 0] == 0).all()
    assert (observation.image[observation.depth > 0] >= 255 * AMBIENT - 1).all()


@pytest.mark.parametrize("mesh", [BALL, TABLE, CHAIR], ids=["ball", "table", "chair"])
def test_casting_only_inside_the_bound_loses_nothing(mesh):
    camera = SimulatedCamera(mesh, 96)
    for pose in SPHERE.poses[::3]:
        assert_same_but_at_edges(camera.observe(pose).depth, cast_all(mesh, pose, 96, camera.intrinsics))


@settings(deadline=None, max_examples=60)
@given(
    st.tuples(*[st.floats(-2.5, 2.5)] * 3),
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
)
def test_any_pose_sees_what_casting_every_ray_sees(position, quaternion):
    pose = trimesh.transformations.quaternion_matrix(quaternion)
    pose[:3, 3] = position
    camera = SimulatedCamera(CHAIR, 64)
    assert_same_but_at_edges(camera.observe(pose).depth, cast_all(CHAIR, pose, 64, camera.intrinsics))


def test_a_wall_that_runs_past_the_camera_is_seen_to_the_border():
    # It begins a little to the left, ahead, and ends behind: where its ends project says nothing of where it is seen.
    corners = np.array([[-0.1, -0.05, 1], [-0.1, 0.05, 1], [0.3, 0.05, -1], [0.3, -0.05, -1]])
    wall = make_mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    pose = np.eye(4)
    pose[:3, 3] = -wall.centre / wall.radius
    camera = SimulatedCamera(wall, 64)
    depth = camera.observe(pose).depth
    assert depth[32, -1] > 0
    assert_same_but_at_edges(depth, cast_all(wall, pose, 64, camera.intrinsics))


def middle(seen: np.ndarray) -> tuple[float, float]:
    """Mean (row, column) of the pixels, from the middle of the image, in image azimuth bins."""
    return tuple(np.mean(np.nonzero(seen), axis=1) / len(seen) - 0.5)


@pytest.mark.parametrize(
    ("view", "towards", "row", "column"),
    [
        # From +x the camera looks along -x; its right is +y.
        (0, (0, 1, 0), 0, 1),
        (0, (0, -1, 0), 0, -1),
        (0, (0, 0, 1), -1, 0),
        # From +y it looks along -y; its right is -x.
        (2, (1, 0, 0), 0, -1),
        (4, (0, 1, 0), 0, -1),
        (6, (1, 0, 0), 0, 1),
        # From 72 degrees above +x, what lies towards the camera is low in the image, what lies beyond is high.
        (32, (1, 0, 0), 1, 0),
        (32, (-1, 0, 0), -1, 0),
    ],
)
def test_a_bump_appears_on_the_side_derived_by_hand(view, towards, row, column):
    stay = trimesh.creation.icosphere(radius=0.1)  # keeps the bounding box around the origin
    ends = [stay.copy().apply_translation(p) for p in np.vstack([np.eye(3), -np.eye(3)]) * 1.5]
    body = trimesh.creation.icosphere(subdivisions=3, radius=0.8)
    bump = trimesh.creation.icosphere(subdivisions=3, radius=0.5).apply_translation(np.array(towards) * 0.8)
    pose = SPHERE.poses[view]
    with_bump = SimulatedCamera(meshed(body, *ends, bump), 96).observe(pose).depth
    without = SimulatedCamera(meshed(body, *ends), 96).observe(pose).depth
    found = middle(np.abs(with_bump - without) > 1e-3)
    for place, expected in zip(found, (row, column), strict=True):
        assert np.sign(place) == expected if expected else abs(place) < 0.01
    assert np.hypot(*found) > 0.05


@pytest.mark.parametrize("view", [0, 5, 19, 33])
@pytest.mark.parametrize("mesh", [TABLE, CHAIR], ids=["table", "chair"])
def test_points_lie_on_the_surface_and_are_visible(mesh, view):
    observation = SimulatedCamera(mesh, 128).observe(SPHERE.poses[view])
    assert observation.points.shape == (1024, 3)
    assert observation.points.dtype == np.float32
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    _, distance, _ = trimesh.proximity.closest_point_naive(solid, observation.points[::16].astype(float))
    np.testing.assert_allclose(distance, 0, atol=2e-5)
    in_camera = (observation.points - observation.pose[:3, 3]) @ observation.pose[:3, :3]
    projected = in_camera @ observation.intrinsics.T
    column, row = np.floor(projected[:, :2] / projected[:, 2:]).astype(int).T
    np.testing.assert_allclose(observation.depth[row, column], in_camera[:, 2], atol=1e-4)


def test_a_plate_seen_edge_on_is_an_empty_view():
    plate = make_mesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    camera = SimulatedCamera(plate)
    observation = camera.observe(SPHERE.poses[0])
    for values in (observation.image, observation.depth, observation.points):
        assert (values == 0).all()
    assert camera.observe(SPHERE.poses[8]).depth.any()


@pytest.mark.skipif("NEXTVIEW_DATA" not in os.environ, reason="NEXTVIEW_DATA names no folder of real meshes")
def test_real_meshes_seen_as_by_casting_every_ray():
    paths = sorted(Path(os.environ["NEXTVIEW_DATA"]).glob("ModelNet10/*/test/*_[0-9]*.off"))
    assert paths
    for path in paths[:: max(1, len(paths) // 7)]:
        mesh = load_mesh(path)
        camera = SimulatedCamera(mesh, 96)
        for pose in SPHERE.poses[::13]:
            assert_same_but_at_edges(camera.observe(pose).depth, cast_all(mesh, pose, 96, camera.intrinsics))
