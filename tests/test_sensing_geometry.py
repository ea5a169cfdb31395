"""Object frames, support planes, noise and facets against closed forms and brute force."""

from itertools import combinations

import numpy as np
import pytest
from factories import INTRINSICS, SHAPE, TABLE, box, cast, pose_at
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import binary_dilation

from nextview.geometry.axes import upright_axes
from nextview.geometry.mesh import make_mesh
from nextview.sensing import ObjectFrame
from nextview.sensing.facets import fit_facets
from nextview.sensing.mask_edges import trimmed
from nextview.sensing.noise import Noise, estimate_noise
from nextview.sensing.object_frame import enclose, smallest_circle
from nextview.sensing.planes import Samples, find_plane

UP = np.array([0, 0, 1.0])
EXACT = Noise(np.ones(1), np.zeros(1))
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


@given(
    st.lists(
        st.tuples(st.integers(-20, 20), st.integers(-20, 20)),
        min_size=2,
        max_size=12,
        unique=True,
    )
)
def test_the_smallest_circle_is_that_of_brute_force(corners):
    points = np.array(corners, float)
    holding = []
    for count in (2, 3):
        for chosen in combinations(points, count):
            centre, radius = circle_through(np.array(chosen))
            if (
                np.isfinite(radius)
                and (np.linalg.norm(points - centre, axis=1) <= radius + 1e-9).all()
            ):
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


def test_poses_go_to_the_object_frame_and_back():
    frame = ObjectFrame(np.array([1.0, -2, 0.5]), 0.2, upright_axes([0.1, 0.2, 1.0]))
    pose = pose_at(33, 80, 1.7, (0.9, -2.1, 0.4), (4, 5, 6))
    there = frame.pose_in_object(pose)
    np.testing.assert_allclose(frame.pose_in_world(there), pose, atol=1e-12)
    # the camera sees the same in either frame, but for the scale
    point = np.array([1.1, -1.9, 0.6])
    seen = pose[:3, :3].T @ (point - pose[:3, 3])
    again = there[:3, :3].T @ (
        frame.axes @ (point - frame.centre) / frame.radius - there[:3, 3]
    )
    np.testing.assert_allclose(again, seen / 0.2, atol=1e-12)


# Support planes


def test_the_plane_is_that_of_least_squares_through_what_lies_on_it():
    points = np.column_stack([rng().uniform(-1, 1, (500, 2)), np.zeros(500)])
    points[:, 2] = (
        0.05 * points[:, 0] - 0.02 * points[:, 1] + 0.001 * rng(1).normal(size=500)
    )
    clutter = rng(2).uniform([-1, -1, 0.05], [1, 1, 0.6], (300, 3))
    order, camera = np.arange(800), np.array([0, 0, 1.0])
    seen = Samples(
        np.vstack([points, clutter]),
        np.full(800, 0.005),
        order,
        order,
        camera,
    )
    plane = find_plane(seen, rng(), UP)
    a, b, c = np.linalg.lstsq(
        np.column_stack([points[:, :2], np.ones(500)]),
        points[:, 2],
        rcond=None,
    )[0]
    np.testing.assert_allclose(
        plane.normal,
        np.array([-a, -b, 1]) / np.sqrt(a * a + b * b + 1),
        atol=1e-3,
    )
    assert plane.offset == pytest.approx(-c, abs=1e-3)


# Noise


ABOVE = pose_at(50, 20, 0.8)


def table_depth():
    return cast([TABLE.copy().apply_scale([4, 4, 1])], ABOVE)[0].astype(np.float64)


@pytest.mark.parametrize("sigma", [0.0005, 0.002, 0.01])
def test_noise_is_measured_at_every_depth(sigma):
    depth = table_depth()
    # grows with depth
    noisy = (1 / (1 / depth + sigma * depth * rng().normal(size=depth.shape))).astype(
        np.float32
    )
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


# Facets


def facet_depth(facets, shape=SHAPE):
    depth = np.zeros(shape)
    depth[facets.rows, facets.columns] = facets.points[:, 2]
    return depth


def test_the_facets_of_a_plane_are_that_plane():
    depth = table_depth().astype(np.float32)
    # z = 0 in the world: up @ (R P + t) = 0, so n . P = 1 with n = -R^T up / up @ t.
    n = -(ABOVE[:3, :3].T @ UP) / ABOVE[2, 3]
    for denoise in (False, True):
        facets = fit_facets(depth, depth > 0, INTRINSICS, denoise=denoise)
        assert len(facets.planes) == depth.size
        np.testing.assert_allclose(np.median(facets.planes, 0), n, atol=1e-3)
        np.testing.assert_allclose(
            facets.points[:, 2],
            depth[facets.rows, facets.columns],
            rtol=1e-5,
        )


def test_smoothing_takes_noise_away_and_leaves_the_edge():
    """A box on a table: most of the noise goes, and hardly a pixel ends up between the box and
    the table.
    """
    pose = pose_at(60, 30, 0.7)
    clean = cast([TABLE, box((0.2, 0.15, 0.1), (0, 0, 0.05))], pose)[0]
    part = slice(90, 390), slice(170, 450)
    sigma = 0.003
    noisy = np.where(clean > 0, clean + sigma * rng().normal(size=SHAPE), 0).astype(
        np.float32
    )
    facets = fit_facets(
        noisy[part],
        clean[part] > 0,
        INTRINSICS,
        (part[0].start, part[1].start),
    )
    off = (facet_depth(facets) - clean)[part]
    assert np.sqrt(np.mean(off**2)) < sigma / 2.5
    assert (np.abs(off) > 5 * sigma).mean() < 0.002


def test_holes_are_filled_but_what_lies_behind_is_not():
    clean, seen = cast(
        [TABLE, box((0.2, 0.15, 0.1), (0, 0, 0.05))],
        pose_at(60, 30, 0.7),
    )
    holed = np.where(rng().random(SHAPE) < 0.2, 0, clean)
    facets = fit_facets(holed, (holed > 0) & (seen == 1), INTRINSICS)
    filled = facet_depth(facets)
    of_box = seen == 1
    assert (filled[of_box] > 0).mean() > 0.99
    assert (filled[~of_box & (holed > 0)] == 0).all()
    np.testing.assert_allclose(
        filled[of_box & (filled > 0)],
        clean[of_box & (filled > 0)],
        atol=0.01,
    )


def test_a_mask_that_is_too_wide_loses_what_is_behind_and_keeps_what_is_thin():
    depth = np.full((120, 160), 0.8, np.float32)
    true = np.zeros(depth.shape, bool)
    true[30:80, 40:100] = True
    true[45:60, 60:80] = False  # a hole, through which the background is seen
    slope = np.linspace(0, 0.05, 60, dtype=np.float32)
    depth[30:80, 40:100] = np.where(true[30:80, 40:100], 0.5 + slope, 0.8)
    depth[80, 40:100] = 0.65  # pixels that hang between object and background
    wide = binary_dilation(true, iterations=4)
    np.testing.assert_array_equal(trimmed(depth, wide, EXACT), true)
    np.testing.assert_array_equal(trimmed(depth, true, EXACT), true)
    rod = np.zeros(depth.shape, bool)
    rod[100:103, 20:140] = True
    depth[rod] = 0.5
    np.testing.assert_array_equal(trimmed(depth, rod, EXACT), rod)
