"""View geometry against hand-written layouts, haversine arcs and the definition of a view-at
pose.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nextview.geometry.viewsphere import (
    ViewSphere,
    great_circle,
    level_pose,
    look_at_origin,
)

spheres = st.builds(
    ViewSphere,
    elevations=st.lists(st.floats(-90, 90), min_size=1, max_size=5).map(tuple),
    azimuths=st.integers(3, 12),
    distance=st.floats(1.1, 10),
)


def test_forty_views_whose_azimuth_runs_from_x_to_y_and_elevation_upwards():
    sphere = ViewSphere.named("40")
    assert len(sphere) == 40
    for view, direction in {
        0: (1, 0, 0),
        2: (0, 1, 0),
        4: (-1, 0, 0),
        6: (0, -1, 0),
    }.items():
        np.testing.assert_allclose(sphere.directions[view], direction, atol=1e-15)
    for view in range(40):
        ring, k = divmod(view, 8)
        assert sphere.angles(view) == (18 * ring, 45 * k)
        assert (sphere.ring[view], sphere.azimuth_index[view]) == (ring, k)
        elevation, azimuth = np.radians(sphere.angles(view))
        x, y, z = sphere.directions[view]
        assert np.arctan2(z, np.hypot(x, y)) == pytest.approx(elevation)
        assert np.exp(1j * np.arctan2(y, x)) == pytest.approx(np.exp(1j * azimuth))


@given(spheres)
def test_a_window_holds_all_rings_and_the_azimuths_beside(sphere):
    assert sphere.windows.shape == (len(sphere), sphere.rings, 3)
    for view in range(len(sphere)):
        window = sphere.windows[view]
        assert len(np.unique(window)) == 3 * sphere.rings
        assert window[sphere.ring[view], 1] == view
        for row, ring in enumerate(window):
            steps = (
                sphere.azimuth_index[ring] - sphere.azimuth_index[view] + 1
            ) % sphere.azimuths
            assert steps.tolist() == [0, 1, 2]
            assert (sphere.ring[ring] == row).all()


@given(st.floats(-np.pi / 2, np.pi / 2), st.floats(-10, 10), st.floats(0.1, 100))
def test_poses_look_at_the_origin_with_a_level_horizon(elevation, azimuth, distance):
    pose = look_at_origin(elevation, azimuth, distance)
    rotation, position = pose[:3, :3], pose[:3, 3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])
    # z is forward
    np.testing.assert_allclose(
        position + distance * rotation[:, 2], 0, atol=1e-12 * distance
    )
    assert np.linalg.norm(position) == pytest.approx(distance)
    assert rotation[2, 0] == 0  # x has no vertical part: the horizon is level
    assert rotation[2, 1] <= 1e-12  # y is down
    np.testing.assert_allclose(
        np.cross(rotation[:, 0], rotation[:, 1]), rotation[:, 2], atol=1e-12
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_level_pose_stands_in_its_direction_and_a_great_circle_joins_its_ends(seed):
    rng = np.random.default_rng(seed)
    a, b = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
    pose = level_pose(a, 1.7)
    np.testing.assert_allclose(pose[:3, 3], 1.7 * a, atol=1e-12)
    np.testing.assert_allclose(pose[:3, 2], -a, atol=1e-12)
    assert pose[2, 0] == 0  # its right is level
    arc = great_circle(a, b, 9)
    np.testing.assert_allclose(np.linalg.norm(arc, axis=1), 1)
    # all in the plane through both
    np.testing.assert_allclose(arc @ np.cross(a, b), 0, atol=1e-12)
    np.testing.assert_allclose(arc[[0, -1]], [a, b], atol=1e-12)
    np.testing.assert_allclose(arc[4], (a + b) / np.linalg.norm(a + b), atol=1e-12)
