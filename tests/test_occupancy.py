"""The occupancy grid against closed forms: what a ball and a wall hide, and what always holds."""

from itertools import pairwise

import numpy as np
from factories import ball_depth
from hypothesis import given, settings
from hypothesis import strategies as st

from nextview.geometry.camera import pinhole
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.views.expected_visibility import (
    FREE,
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
