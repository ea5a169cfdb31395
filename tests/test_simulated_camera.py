"""The simulated camera against closed forms, and against casting every ray."""

import numpy as np
import pytest
import trimesh
from factories import ball_depth, box, meshed, rays

from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.simulation.simulated import AMBIENT, SimulatedCamera

SPHERE = ViewSphere.named("40")


BALL = meshed(trimesh.creation.icosphere(subdivisions=6))
TABLE = meshed(
    box((4, 3, 0.2), (0, 0, 2)),
    *(box((0.2, 0.2, 2), (x, y, 1)) for x in (-1.8, 1.8) for y in (-1.3, 1.3)),
)
CHAIR = meshed(
    box((1, 1, 0.1), (0, 0, 0.5)),
    box((0.1, 1, 1), (-0.45, 0, 1)),
    box((0.2, 0.2, 0.5), (0.3, 0.2, 0.25)),
)


@pytest.mark.parametrize("distance", [2.0, 3.0, 6.0])
@pytest.mark.parametrize("view", [0, 13, 38])
def test_depth_of_a_ball_is_that_of_the_equation(distance, view):
    elevation, azimuth = np.radians(SPHERE.angles(view))
    observation = SimulatedCamera(BALL, 224, distance).observe(
        look_at_origin(elevation, azimuth, distance)
    )
    expected = ball_depth(observation.pose, observation.intrinsics, 224)
    assert ((expected > 0) != (observation.depth > 0)).mean() < 0.002
    aside = rays(observation.intrinsics, (224, 224))[..., :2]
    steep = (aside**2).sum(-1) > (0.95 * np.abs(aside).max()) ** 2
    np.testing.assert_allclose(observation.depth[~steep], expected[~steep], atol=1e-3)


def test_a_ball_is_lit_by_a_headlight():
    observation = SimulatedCamera(BALL, 224).observe(SPHERE.poses[9])
    d = rays(observation.intrinsics, (224, 224))
    depth = ball_depth(observation.pose, observation.intrinsics, 224)
    normal = d * depth[..., None] - (0, 0, 3)
    cosine = np.abs((normal * d).sum(-1)) / np.linalg.norm(d, axis=-1)
    gap = np.abs(observation.image - 255 * (AMBIENT + (1 - AMBIENT) * cosine))[
        (depth > 0) & (observation.depth > 0)
    ]
    assert np.median(gap) < 2
    assert gap.max() < 30  # facets that are seen at a graze
    assert (observation.image[observation.depth == 0] == 0).all()
    assert (observation.image[observation.depth > 0] >= 255 * AMBIENT - 1).all()


@pytest.mark.parametrize("view", [0, 5, 19, 33])
@pytest.mark.parametrize("mesh", [TABLE, CHAIR], ids=["table", "chair"])
def test_points_lie_on_the_surface_and_are_visible(mesh, view):
    observation = SimulatedCamera(mesh, 128).observe(SPHERE.poses[view])
    assert observation.points.shape == (1024, 3)
    assert observation.points.dtype == np.float32
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    _, distance, _ = trimesh.proximity.closest_point_naive(
        solid, observation.points[::16].astype(float)
    )
    np.testing.assert_allclose(distance, 0, atol=2e-5)
    in_camera = (observation.points - observation.pose[:3, 3]) @ observation.pose[
        :3, :3
    ]
    projected = in_camera @ observation.intrinsics.T
    column, row = np.floor(projected[:, :2] / projected[:, 2:]).astype(int).T
    np.testing.assert_allclose(
        observation.depth[row, column], in_camera[:, 2], atol=1e-4
    )
