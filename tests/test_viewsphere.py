"""View geometry against hand-written layouts, haversine arcs and the definition of a view-at pose."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from nextview.viewsphere import LAYOUTS, ViewSphere, great_circle, level_pose, look_at_origin

SPHERES = [
    ViewSphere.named("40"),
    ViewSphere.named("12"),
    ViewSphere(elevations=(-90.0, -30.0, 90.0), azimuths=5, distance=2.0),
    ViewSphere(elevations=(10.0,), azimuths=3),
]
spheres = st.builds(
    ViewSphere,
    elevations=st.lists(st.floats(-90, 90), min_size=1, max_size=5).map(tuple),
    azimuths=st.integers(3, 12),
    distance=st.floats(1.1, 10),
)


def haversine(sphere: ViewSphere, a: int, b: int) -> float:
    """Great-circle angle from latitudes and longitudes (Sinnott 1984)."""
    (lat1, lon1), (lat2, lon2) = (np.radians(sphere.angles(v)) for v in (a, b))
    h = np.sin((lat2 - lat1) / 2) ** 2 + np.cos(lat1) * np.cos(lat2) * np.sin((lon2 - lon1) / 2) ** 2
    return 2 * np.arcsin(np.sqrt(min(h, 1)))


def test_forty_views():
    sphere = ViewSphere.named("40")
    assert len(sphere) == 40
    for ring, elevation in enumerate([0, 18, 36, 54, 72]):
        for k in range(8):
            view = ring * 8 + k
            assert sphere.angles(view) == (elevation, 45 * k)
            assert (sphere.ring[view], sphere.azimuth_index[view]) == (ring, k)


def test_twelve_views():
    sphere = ViewSphere.named("12")
    assert [sphere.angles(view) for view in range(len(sphere))] == [(45, 30 * k) for k in range(12)]


def test_azimuth_runs_from_x_to_y_and_elevation_upwards():
    sphere = ViewSphere.named("40")
    for view, direction in {0: (1, 0, 0), 2: (0, 1, 0), 4: (-1, 0, 0), 6: (0, -1, 0)}.items():
        np.testing.assert_allclose(sphere.directions[view], direction, atol=1e-15)
    for view in range(40):
        elevation, azimuth = np.radians(sphere.angles(view))
        x, y, z = sphere.directions[view]
        assert np.arctan2(z, np.hypot(x, y)) == pytest.approx(elevation)
        assert np.exp(1j * np.arctan2(y, x)) == pytest.approx(np.exp(1j * azimuth))


def test_windows_by_hand():
    sphere = ViewSphere.named("40")
    assert sphere.window(11).tolist() == [[2, 3, 4], [10, 11, 12], [18, 19, 20], [26, 27, 28], [34, 35, 36]]
    assert sphere.window(0).tolist() == [[7, 0, 1], [15, 8, 9], [23, 16, 17], [31, 24, 25], [39, 32, 33]]
    assert sphere.window(39).tolist() == [[6, 7, 0], [14, 15, 8], [22, 23, 16], [30, 31, 24], [38, 39, 32]]
    assert ViewSphere.named("12").window(0).tolist() == [[11, 0, 1]]
    assert ViewSphere.named("12").window(11).tolist() == [[10, 11, 0]]


@given(spheres)
def test_a_window_holds_all_rings_and_the_azimuths_beside(sphere):
    assert sphere.windows.shape == (len(sphere), sphere.rings, 3)
    for view in range(len(sphere)):
        window = sphere.window(view)
        assert len(np.unique(window)) == 3 * sphere.rings
        assert window[sphere.ring[view], 1] == view
        for row, ring in enumerate(window):
            steps = (sphere.azimuth_index[ring] - sphere.azimuth_index[view] + 1) % sphere.azimuths
            assert steps.tolist() == [0, 1, 2]
            assert (sphere.ring[ring] == row).all()


def test_travel_by_hand():
    travel = ViewSphere.named("40").travel
    assert travel[0, 7] == 1  # round the back
    assert travel[0, 4] == 4  # half way round
    assert travel[0, 5] == 3
    assert travel[3, 35] == 4  # from the lowest ring to the highest
    assert travel[0, 12] == pytest.approx(np.sqrt(1 + 16))
    assert travel[7, 32] == pytest.approx(np.sqrt(16 + 1))
    assert ViewSphere.named("12").travel[1, 11] == 2


@given(spheres)
def test_travel_is_the_shortest_way_over_the_unrolled_grid(sphere):
    n = sphere.azimuths
    for a in range(len(sphere)):
        for b in range(len(sphere)):
            (ra, ca), (rb, cb) = divmod(a, n), divmod(b, n)
            ways = [np.hypot(ra - rb, ca - cb + turn * n) for turn in (-1, 0, 1)]
            assert sphere.travel[a, b] == pytest.approx(min(ways))


@settings(deadline=None)
@given(spheres)
def test_arcs_are_the_haversine_formula(sphere):
    views = range(len(sphere))
    expected = np.array([[haversine(sphere, a, b) for b in views] for a in views])
    # Haversine itself is only this exact near opposite points.
    np.testing.assert_allclose(sphere.arc, expected, atol=5e-8)


@settings(deadline=None)
@given(spheres)
def test_travel_and_arc_are_distances(sphere):
    for distance in (sphere.travel, sphere.arc):
        np.testing.assert_allclose(np.diag(distance), 0, atol=1e-12)
        np.testing.assert_array_equal(distance, distance.T)
        through = (distance[:, :, None] + distance[None, :, :]).min(1)
        assert (distance <= through + 1e-9).all()
    assert sphere.arc.max() <= np.pi


@given(st.floats(-np.pi / 2, np.pi / 2), st.floats(-10, 10), st.floats(0.1, 100))
def test_poses_look_at_the_origin_with_a_level_horizon(elevation, azimuth, distance):
    pose = look_at_origin(elevation, azimuth, distance)
    rotation, position = pose[:3, :3], pose[:3, 3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])
    np.testing.assert_allclose(position + distance * rotation[:, 2], 0, atol=1e-12 * distance)  # z is forward
    assert np.linalg.norm(position) == pytest.approx(distance)
    assert rotation[2, 0] == 0  # x has no vertical part: the horizon is level
    assert rotation[2, 1] <= 1e-12  # y is down
    np.testing.assert_allclose(np.cross(rotation[:, 0], rotation[:, 1]), rotation[:, 2], atol=1e-12)


@given(st.floats(-1.5, 1.5), st.floats(-np.pi, np.pi))
def test_poses_against_the_usual_look_at_matrix(elevation, azimuth):
    assume(abs(np.cos(elevation)) > 1e-3)
    pose = look_at_origin(elevation, azimuth)
    forward = -pose[:3, 3] / np.linalg.norm(pose[:3, 3])
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    np.testing.assert_allclose(pose[:3, :3], np.stack([right, np.cross(forward, right), forward], 1), atol=1e-9)


def test_a_pose_by_hand():
    # From +x, looking along -x: +y is on the right, the world's up is the image's -y.
    expected = [[0, 0, -1, 3], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(ViewSphere.named("40").poses[0], expected, atol=1e-15)


@pytest.mark.parametrize("sphere", SPHERES, ids=str)
def test_poses_stand_in_their_directions(sphere):
    for view in range(len(sphere)):
        elevation, azimuth = np.radians(sphere.angles(view))
        np.testing.assert_allclose(sphere.poses[view], look_at_origin(elevation, azimuth, sphere.distance), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(sphere.directions, axis=1), 1)
    np.testing.assert_allclose(sphere.directions * sphere.distance, sphere.poses[:, :3, 3])


def test_look_at_origin_takes_arrays_of_any_shape():
    elevation, azimuth = np.linspace(-1, 1, 4)[:, None], np.linspace(0, 6, 5)[None, :]
    poses = look_at_origin(elevation, azimuth)
    assert poses.shape == (4, 5, 4, 4)
    np.testing.assert_array_equal(poses[2, 3], look_at_origin(elevation[2, 0], azimuth[0, 3]))


@pytest.mark.parametrize(
    ("elevations", "azimuths", "reason"),
    [
        ((), 8, "at least one ring"),
        ((0.0,), 2, "at least three"),
        ((0.0, 91.0), 8, "between -90 and 90"),
        ((np.nan,), 8, "between -90 and 90"),
    ],
)
def test_impossible_spheres(elevations, azimuths, reason):
    with pytest.raises(ValueError, match=reason):
        ViewSphere(elevations, azimuths)


@pytest.mark.parametrize("distance", [0.0, -1.0, np.nan, np.inf])
def test_a_sphere_without_size(distance):
    with pytest.raises(ValueError, match="distance"):
        ViewSphere((0.0,), 8, distance)


@pytest.mark.parametrize("name", ["ring", "azimuth_index", "poses", "directions", "windows", "travel", "arc"])
def test_nobody_can_move_the_shared_viewpoints(name):
    with pytest.raises(ValueError, match="read-only"):
        getattr(ViewSphere.named("40"), name)[0] *= 2


def test_an_unknown_layout():
    with pytest.raises(ValueError, match=r"'41'.*40, 12"):
        ViewSphere.named("41")
    assert set(LAYOUTS) == {"40", "12"}


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
    np.testing.assert_allclose(arc @ np.cross(a, b), 0, atol=1e-12)  # all in the plane through both
    np.testing.assert_allclose(arc[[0, -1]], [a, b], atol=1e-12)
    np.testing.assert_allclose(arc[4], (a + b) / np.linalg.norm(a + b), atol=1e-12)
