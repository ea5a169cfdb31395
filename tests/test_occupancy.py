"""The occupancy grid against closed forms: what a ball and a wall hide, and what always holds."""

from itertools import pairwise

import numpy as np
from factories import ball_depth, rays
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nextview.geometry.observation import pinhole
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.sensing.expected_visibility import (
    FREE,
    OBJECT,
    OCCLUDER,
    UNSEEN,
    Occupancy,
    VoxelGrid,
)

GRID = VoxelGrid(64)
BALL = GRID.within(1.0)
SMALL = VoxelGrid(24)
K = pinhole(224, 3.0)
EYE = np.array([3.0, 0, 0])
SPHERE = ViewSphere.named("40")


def wall_depth(pose, x, half):
    """Depth image of a square wall in the plane of a given x, -half to half in y and z."""
    d, o = rays(K, (224, 224)) @ pose[:3, :3].T, pose[:3, 3]
    t = (x - o[0]) / d[..., 0]
    at = o + t[..., None] * d
    return np.where((t > 0) & (np.abs(at[..., 1:]) < half).all(-1), t, 0)


def hidden_by_ball(points, eye, radius):
    """Whether the sphere is crossed on the way from points (P, 3) to an eye."""
    d = eye - points
    a, b, c = (d * d).sum(1), (points * d).sum(1), (points * points).sum(1) - radius**2
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b * b - a * c)  # NaN for never
    t = np.stack([-b - root, -b + root], 1) / a[:, None]
    return ((t > 0) & (t < 1)).any(1)


def after(*poses, radius=0.6, grid=GRID):
    found = Occupancy.unseen(grid)
    for pose in poses:
        found = found.seen(ball_depth(pose, K, 224, radius), pose, K)
    return found


# One view


def test_a_ball_leaves_unseen_what_lies_behind_its_face():
    radius, pose = 0.6, look_at_origin(0, 0)
    cells = after(pose, radius=radius).cells[BALL]
    middles = GRID.middles[:, BALL.ravel()].T.astype(float)
    hidden, slack = hidden_by_ball(middles, EYE, radius), GRID.pitch * np.sqrt(3) / 2
    # Exact but for voxels that the surface, or the border of the shadow, passes through.
    near = hidden_by_ball(middles, EYE, radius + slack) & ~hidden_by_ball(
        middles, EYE, radius - slack
    )
    near |= np.abs(np.linalg.norm(middles, axis=1) - radius) < slack
    assert near.mean() < 0.15
    np.testing.assert_array_equal(cells[~near] == UNSEEN, hidden[~near])
    np.testing.assert_array_equal(cells[~near] == FREE, ~hidden[~near])


def test_occupied_are_the_voxels_that_the_visible_cap_passes_through():
    radius = 0.6
    occupied = after(look_at_origin(0, 0), radius=radius).cells == OBJECT
    x, y, z = (m.reshape(occupied.shape) for m in GRID.middles)
    distance = np.sqrt(x * x + y * y + z * z)
    assert (
        np.abs(distance - radius)[occupied].max() <= GRID.pitch * np.sqrt(3) / 2 + 1e-6
    )
    rim = radius**2 / 3  # the tangents from the eye touch the ball there
    assert x[occupied].min() > rim - GRID.pitch
    # Where the surface passes the very middle of a voxel and is not seen at too low an angle, that
    # voxel is found.
    through = (np.abs(distance - radius) < 0.2 * GRID.pitch) & (x > rim + 0.2)
    assert through.sum() > 100
    assert occupied[through].all()


def test_object_and_occluder_are_kept_apart():
    pose = look_at_origin(0, 0)
    ball, wall = ball_depth(pose, K, 224, 0.4), wall_depth(pose, 0.8, 0.2)
    depth = np.where(wall > 0, wall, ball)
    cells = (
        Occupancy.unseen(GRID)
        .seen(depth, pose, K, object_mask=(wall == 0) & (ball > 0))
        .cells
    )
    x = GRID.middles[0].reshape(cells.shape)
    assert (cells == OCCLUDER).any()
    assert (cells == OBJECT).any()
    assert np.abs(x[cells == OCCLUDER] - 0.8).max() < GRID.pitch
    assert x[cells == OBJECT].max() < 0.4 + GRID.pitch


# What always holds


@settings(deadline=None, max_examples=25)
@given(st.lists(st.integers(0, 39), min_size=2, max_size=4), st.permutations(range(4)))
def test_more_views_never_make_seen_space_unseen_and_their_order_counts_for_nothing(
    views, order
):
    small = pinhole(32, 3.0)
    frames = [
        (ball_depth(SPHERE.poses[v], small, 32, 0.5, (0.2, 0, 0.1)), SPHERE.poses[v])
        for v in views
    ]

    def seen(frames):
        found = [Occupancy.unseen(SMALL)]
        for depth, pose in frames:
            found.append(found[-1].seen(depth, pose, small))
        return found

    steps = seen(frames)
    for before, now in pairwise(steps):
        assert not ((before.cells != UNSEEN) & (now.cells == UNSEEN)).any()
        assert (now.cells >= before.cells).all()
    shuffled = seen([frames[i] for i in order if i < len(frames)] + frames[:1])
    np.testing.assert_array_equal(shuffled[-1].cells, steps[-1].cells)
    together = seen(frames[:1])[-1].and_also(seen(frames[1:])[-1])
    np.testing.assert_array_equal(together.cells, steps[-1].cells)


@settings(deadline=None, max_examples=20)
@given(
    st.integers(0, 39),
    st.integers(0, 3),
    st.tuples(*[st.floats(-5, 5)] * 3),
    st.sampled_from([0.25, 1.0, 10.0]),
)
def test_nothing_changes_if_all_moves_or_is_measured_in_another_unit(
    view, quarters, shift, unit
):
    """The scene, the cameras and the grid turned by quarters about z, moved, and in another
    unit.
    """
    pose, centre = SPHERE.poses[view], np.array([0.15, -0.2, 0.1])
    depth = ball_depth(pose, K, 224, 0.5, centre)
    here = Occupancy.unseen(SMALL).seen(depth, pose, K)
    turn = Rotation.from_euler("z", 90 * quarters, degrees=True).as_matrix()

    def moved(poses):
        found = np.array(poses)
        found[..., :3, :3] = turn @ found[..., :3, :3]
        found[..., :3, 3] = (found[..., :3, 3] @ turn.T) * unit + shift
        return found

    grid = VoxelGrid(SMALL.n, unit, tuple(shift))
    there = Occupancy.unseen(grid).seen(depth * unit, moved(pose), K)
    same = np.rot90(here.cells, quarters, (0, 1)) == there.cells
    # a voxel whose middle lies on the edge of a pixel may fall to either side
    assert same.mean() > 0.999
