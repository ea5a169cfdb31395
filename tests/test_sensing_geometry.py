"""Object frames, support planes, noise and facets against closed forms and brute force."""

import time
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import INTRINSICS, SHAPE, TABLE, box, cast, pose_at
from scipy.spatial.transform import Rotation

from nextview.errors import ObservationError, UsageError
from nextview.mesh import make_mesh
from nextview.sensing import Box, Frame, ObjectFrame
from nextview.sensing.facets import Facets, drop_flying, fit_facets
from nextview.sensing.noise import Noise, estimate_noise
from nextview.sensing.object_frame import enclose, smallest_circle, upright_axes
from nextview.sensing.support_plane import Plane, Samples, find_plane, mistake_in_pose, refine_plane, sample
from nextview.sensing.virtual_view import look_again

UP = np.array([0, 0, 1.0])
CORNERS = np.array(np.meshgrid([0, 1.0], [0, 1.0], [0, 1.0])).reshape(3, -1).T


def rng(seed=0):
    return np.random.default_rng(seed)


# The smallest circle, and the object frame


def circle_through(points) -> tuple[np.ndarray, float]:
    if len(points) == 2:
        return points.mean(0), np.linalg.norm(points[0] - points[1]) / 2
    a, b, c = points
    d = 2 * (a[0] * (b[1] - c[1]) + b[0] * (c[1] - a[1]) + c[0] * (a[1] - b[1]))
    if abs(d) < 1e-12:
        return np.zeros(2), np.inf
    squares = (points**2).sum(1)
    x = squares @ np.array([b[1] - c[1], c[1] - a[1], a[1] - b[1]]) / d
    y = squares @ np.array([c[0] - b[0], a[0] - c[0], b[0] - a[0]]) / d
    return np.array([x, y]), np.linalg.norm(a - [x, y])


@given(st.lists(st.tuples(st.integers(-20, 20), st.integers(-20, 20)), min_size=2, max_size=12, unique=True))
def test_the_smallest_circle_is_that_of_brute_force(corners):
    points = np.array(corners, float)
    holding = []
    for count in (2, 3):
        for chosen in combinations(points, count):
            centre, radius = circle_through(np.array(chosen))
            if np.isfinite(radius) and (np.linalg.norm(points - centre, axis=1) <= radius + 1e-9).all():
                holding.append(radius)
    centre, radius = smallest_circle(points)
    assert radius == pytest.approx(min(holding), abs=1e-6)
    assert (np.linalg.norm(points - centre, axis=1) <= radius + 1e-6).all()


def test_a_box_is_enclosed_as_its_mesh_would_be():
    points = CORNERS * [0.4, 0.3, 0.2] + [1, 2, 3]
    frame = enclose(points, np.eye(3), None)
    mesh = make_mesh(points, box((1, 1, 1)).faces)
    np.testing.assert_allclose(frame.centre, mesh.centre, atol=1e-9)
    assert frame.radius == pytest.approx(mesh.radius)


def test_two_walls_that_meet_give_the_middle_of_the_box():
    """The wall x = 0 and the wall y = 0, seen from the corner that they share."""
    seen = CORNERS[(CORNERS[:, 0] == 0) | (CORNERS[:, 1] == 0)] * [0.4, 0.3, 0.2]
    frame = enclose(seen, np.eye(3), None)
    np.testing.assert_allclose(frame.centre, [0.2, 0.15, 0.1], atol=1e-9)
    assert frame.radius == pytest.approx(np.sqrt(0.4**2 + 0.3**2 + 0.2**2) / 2)


def test_the_object_reaches_down_to_what_it_stands_on():
    top = CORNERS[CORNERS[:, 2] == 1] * [0.4, 0.3, 0.2] + [0, 0, 1]  # a box between z = 1 and 1.2, its top is seen
    frame = enclose(top, np.eye(3), 1.0)
    np.testing.assert_allclose(frame.centre, [0.2, 0.15, 1.1], atol=1e-9)
    assert frame.radius == pytest.approx(np.sqrt(0.4**2 + 0.3**2 + 0.2**2) / 2)


def test_a_point_has_no_size():
    with pytest.raises(ObservationError, match="no size"):
        enclose(np.ones((10, 3)), np.eye(3), None)


def test_poses_go_to_the_object_frame_and_back():
    frame = ObjectFrame(np.array([1.0, -2, 0.5]), 0.2, upright_axes([0.1, 0.2, 1.0]))
    pose = pose_at(33, 80, 1.7, (0.9, -2.1, 0.4), (4, 5, 6))
    there = frame.pose_in_object(pose)
    np.testing.assert_allclose(frame.pose_in_world(there), pose, atol=1e-12)
    point = np.array([1.1, -1.9, 0.6])  # the camera sees the same in either frame, but for the scale
    seen = pose[:3, :3].T @ (point - pose[:3, 3])
    again = there[:3, :3].T @ (frame.axes @ (point - frame.centre) / frame.radius - there[:3, 3])
    np.testing.assert_allclose(again, seen / 0.2, atol=1e-12)


def test_candidate_poses_stand_off_as_far_as_asked():
    frame = ObjectFrame(np.array([1.0, -2, 0.5]), 0.2, upright_axes([0.1, 0.2, 1.0]))
    poses = frame.pose_in_world(np.stack([pose_at(e, a, 3.0) for e, a in ((0, 0), (40, 200))]), distance=0.6)
    toward = frame.centre - poses[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(toward, axis=1), 0.6)
    np.testing.assert_allclose(poses[:, :3, 2] * 0.6, toward, atol=1e-12)


def test_a_box_knows_its_object_frame():
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    corners = CORNERS * [0.4, 0.3, 0.2]
    frame = Box(corners.min(0), corners.max(0), turn).object_frame
    world = corners @ turn  # turn @ world = corners
    np.testing.assert_allclose(frame.centre, world.mean(0), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(world - frame.centre, axis=1), frame.radius)


@pytest.mark.parametrize("axes", [np.eye(3)[:2], np.diag([1.0, 1, -1]), 2 * np.eye(3)])
def test_axes_have_to_be_a_rotation(axes):
    with pytest.raises(UsageError, match="rotation"):
        ObjectFrame(np.zeros(3), 1.0, axes)


def test_a_box_has_an_inside_and_up_is_a_direction():
    with pytest.raises(UsageError, match="low and a high corner"):
        Box([0, 0, 1], [1, 1, 1])
    with pytest.raises(UsageError, match="direction"):
        upright_axes([0, 0, 0])


@pytest.mark.parametrize("up", [(0, 0, 2.0), (1, 0, 0), (0.3, -0.2, 0.9), (0, -1.0, 0)])
def test_upright_axes_are_a_rotation_with_z_up(up):
    axes = upright_axes(up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(axes[2], np.array(up) / np.linalg.norm(up), atol=1e-12)


# Support planes


def samples(points, tolerance=0.005, camera=(0, 0, 1.0), rows=None, columns=None) -> Samples:
    n = len(points)
    rows, columns = (np.arange(n) if v is None else v for v in (rows, columns))
    return Samples(np.asarray(points, float), np.full(n, tolerance), rows, columns, np.array(camera))


def level(n, z, half=1.0, seed=0):
    xy = rng(seed).uniform(-half, half, (n, 2))
    return np.column_stack([xy, np.full(n, z)])


def test_the_plane_is_that_of_least_squares_through_what_lies_on_it():
    points = level(500, 0.0)
    points[:, 2] = 0.05 * points[:, 0] - 0.02 * points[:, 1] + 0.001 * rng(1).normal(size=500)
    clutter = rng(2).uniform([-1, -1, 0.05], [1, 1, 0.6], (300, 3))
    plane = find_plane(samples(np.vstack([points, clutter])), rng(), UP)
    a, b, c = np.linalg.lstsq(np.column_stack([points[:, :2], np.ones(500)]), points[:, 2], rcond=None)[0]
    np.testing.assert_allclose(plane.normal, np.array([-a, -b, 1]) / np.sqrt(a * a + b * b + 1), atol=1e-3)
    assert plane.offset == pytest.approx(-c, abs=1e-3)


def test_gravity_tells_a_table_from_a_wall():
    table, wall = level(200, 0.0), level(600, 0.0, seed=1)[:, [2, 0, 1]] - [1, 0, 0]
    both = samples(np.vstack([table, wall]))
    assert find_plane(both, rng(), UP).normal == pytest.approx(UP, abs=1e-3)
    assert find_plane(both, rng()).normal == pytest.approx([1, 0, 0], abs=1e-3)


def test_the_plane_lies_below_the_camera_and_below_the_object():
    floor, shelf, ceiling = level(200, 0.0), level(300, 0.5, seed=1), level(900, 2.0, seed=2)
    everything = samples(np.vstack([floor, shelf, ceiling]))
    assert find_plane(everything, rng(), UP).offset == pytest.approx(-0.5, abs=1e-6)
    assert find_plane(everything, rng(), UP, above=np.array([0, 0, 0.3])).offset == pytest.approx(0, abs=1e-6)
    assert find_plane(samples(ceiling), rng(), UP) is None


def test_no_plane_is_made_up():
    assert find_plane(samples(rng().uniform(-1, 1, (800, 3)), camera=(0, 0, 2)), rng(), UP) is None
    assert find_plane(samples(level(5, 0)), rng(), UP) is None


def test_a_known_plane_is_found_again_nearby():
    plane = refine_plane(Plane(UP, -0.004), samples(level(300, 0.0)), loose=2)
    assert plane.offset == pytest.approx(0, abs=1e-9)
    far = Plane(UP, -0.5)
    assert refine_plane(far, samples(level(300, 0.0))) is far


def test_a_strip_at_the_same_height_does_not_belong_to_the_table():
    rows, columns = (v.ravel() for v in np.mgrid[:20, :30])
    points = np.column_stack([columns / 30, -rows / 20, np.full(600, 0.3)])
    on = (rows >= 10) | (rows == 3)  # the table below, a strip of a wall above it in the picture
    points[on, 2] = 0
    extent = Plane(UP, 0.0).extent(samples(points, rows=rows, columns=columns))
    assert len(extent) == 300
    assert extent[:, 1].max() == pytest.approx(-0.5)


@pytest.mark.parametrize(
    ("said", "mistake"),
    {
        "OpenGL": lambda r: r @ np.diag([1, -1, -1.0]),
        "ROS": lambda r: r @ np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]).T,
        "inverse": lambda r: r.T,
    }.items(),
)
def test_a_wrong_pose_is_named_by_the_table_that_is_not_level(said, mistake):
    pose = pose_at(50, 20, 0.8)
    wrong = pose.copy()
    wrong[:3, :3] = mistake(pose[:3, :3])
    seen = pose[:3, :3].T @ UP  # the table's normal in the camera's frame
    assert mistake_in_pose(Plane(UP, 0.0), pose, UP) is None
    assert said in mistake_in_pose(Plane(wrong[:3, :3] @ seen, 0.0), wrong, UP)


# Noise


def table_depth(shape=SHAPE):
    pose = pose_at(50, 20, 0.8)
    return cast([TABLE.copy().apply_scale([4, 4, 1])], pose, shape=shape)[0].astype(np.float64)


def test_a_plane_has_no_noise():
    """Inverse depth is linear in the picture: only the rounding of float32 is left."""
    depth = table_depth().astype(np.float32)
    assert estimate_noise(depth, depth > 0).sigmas.max() < 1e-6


@pytest.mark.parametrize("sigma", [0.0005, 0.002, 0.01])
def test_noise_is_measured_at_every_depth(sigma):
    depth = table_depth()
    noisy = (1 / (1 / depth + sigma * depth * rng().normal(size=depth.shape))).astype(np.float32)  # grows with depth
    noise = estimate_noise(noisy, noisy > 0)
    at = np.quantile(depth, [0.15, 0.5, 0.85])
    np.testing.assert_allclose(noise.at(at), sigma * at, rtol=0.1)
    assert noise.grain == 1


def test_pixels_that_err_together_are_noticed():
    depth = table_depth()
    coarse = np.repeat(rng().normal(size=(480, 160)), 4, axis=1)
    noisy = (1 / (1 / depth + 0.005 * coarse)).astype(np.float32)
    noise = estimate_noise(noisy, noisy > 0)
    assert noise.grain in (2, 4)
    np.testing.assert_allclose(noise.sigmas, 0.005, rtol=0.1)


def test_nothing_measured_is_no_noise():
    depth = np.ones((5, 4), np.float32)
    assert estimate_noise(depth, depth > 2).at(1.0) == 0


# Facets


def facet_depth(facets, shape=SHAPE):
    depth = np.zeros(shape)
    depth[facets.rows, facets.columns] = facets.points[:, 2]
    return depth


def test_the_facets_of_a_plane_are_that_plane():
    pose = pose_at(50, 20, 0.8)
    depth = cast([TABLE.copy().apply_scale([4, 4, 1])], pose)[0]
    # z = 0 in the world: up @ (R P + t) = 0, so n . P = 1 with n = -R^T up / up @ t.
    n = -(pose[:3, :3].T @ UP) / pose[2, 3]
    for denoise in (False, True):
        facets = fit_facets(depth, depth > 0, INTRINSICS, denoise=denoise)
        assert len(facets.planes) == depth.size
        np.testing.assert_allclose(np.median(facets.planes, 0), n, atol=1e-3)
        np.testing.assert_allclose(facets.points[:, 2], depth[facets.rows, facets.columns], rtol=1e-5)


def test_smoothing_takes_noise_away_and_leaves_the_edge():
    """A box on a table: most of the noise goes, and hardly a pixel ends up between the box and the table."""
    pose = pose_at(60, 30, 0.7)
    clean = cast([TABLE, box((0.2, 0.15, 0.1), (0, 0, 0.05))], pose)[0]
    part = slice(90, 390), slice(170, 450)
    sigma = 0.003
    noisy = np.where(clean > 0, clean + sigma * rng().normal(size=SHAPE), 0).astype(np.float32)
    facets = fit_facets(noisy[part], clean[part] > 0, INTRINSICS, (part[0].start, part[1].start))
    off = (facet_depth(facets) - clean)[part]
    assert np.sqrt(np.mean(off**2)) < sigma / 2.5
    assert (np.abs(off) > 5 * sigma).mean() < 0.002


def test_raw_facets_keep_every_depth():
    clean = cast([TABLE, box((0.2, 0.15, 0.1), (0, 0, 0.05))], pose_at(60, 30, 0.7))[0]
    noisy = np.where(clean > 0, clean + 0.003 * rng().normal(size=SHAPE), 0).astype(np.float32)
    facets = fit_facets(noisy, noisy > 0, INTRINSICS, denoise=False)
    np.testing.assert_allclose(facet_depth(facets), noisy, rtol=1e-5)


def test_holes_are_filled_but_what_lies_behind_is_not():
    clean, seen = cast([TABLE, box((0.2, 0.15, 0.1), (0, 0, 0.05))], pose_at(60, 30, 0.7))
    holed = np.where(rng().random(SHAPE) < 0.2, 0, clean)
    facets = fit_facets(holed, (holed > 0) & (seen == 1), INTRINSICS)
    filled = facet_depth(facets)
    of_box = seen == 1
    assert (filled[of_box] > 0).mean() > 0.99
    assert (filled[~of_box & (holed > 0)] == 0).all()
    np.testing.assert_allclose(filled[of_box & (filled > 0)], clean[of_box & (filled > 0)], atol=0.01)


def test_flying_pixels_are_dropped():
    """Two planes at 0.6 and 0.8 m with a rim of pixels between them, as sensors that average make."""
    depth = np.full((40, 60), 0.6, np.float32)
    depth[:, 30:] = 0.8
    depth[:, 30] = np.linspace(0.63, 0.77, 40)
    kept = drop_flying(depth, depth > 0, noise=0.0005, pitch=1 / 520)
    assert not kept[:, 30].any()
    assert kept[1:-1, 1:29].all()
    assert kept[1:-1, 32:-1].all()


def test_a_coarse_grid_has_a_facet_for_each_square():
    depth = table_depth().astype(np.float32)
    facets = fit_facets(depth, depth > 0, INTRINSICS, coarse=4)
    assert len(facets.planes) == depth.size // 16
    np.testing.assert_allclose(facets.pitch, 4 / INTRINSICS[[0, 1], [0, 1]])
    middle = depth.reshape(120, 4, 160, 4)[:, 1:3, :, 1:3].mean((1, 3))
    np.testing.assert_allclose(facets.points[:, 2], middle.ravel(), rtol=1e-3)


def test_samples_are_spread_over_the_picture():
    depth = table_depth().astype(np.float32)
    frame = Frame(depth, INTRINSICS, pose_at(50, 20, 0.8), pixel_centre=0.5)
    found = sample(frame, frame.depth > 0, Noise(np.ones(1), np.zeros(1)))
    assert 1000 < len(found.points) < 3000
    np.testing.assert_allclose(found.points[:, 2], 0, atol=1e-4)


def test_a_pixel_that_is_wider_than_the_image_takes_no_time():
    """Of a sensor with a focal length of a pixel, say: drawn pixel by pixel it took minutes."""
    n = 50
    rays = np.column_stack([rng().uniform(-0.1, 0.1, (n, 2)), np.ones(n)])
    where = np.zeros(n, int)
    wide = Facets(np.tile([0.0, 0.0, 1.0], (n, 1)), rays, where, where, np.array([1e3, 1e3]))
    began = time.process_time()
    depth, _ = look_again(wide, pose_at(30, 20, 1.0), 0.5, 224)
    assert time.process_time() - began < 5
    assert np.isfinite(depth).all()
    assert depth.any()
