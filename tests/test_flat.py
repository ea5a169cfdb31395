"""Planes explain walls and tables, and pay for the edges of boxes; noise chooses no pixel."""

import numpy as np
import pytest

from nextview.segmentation.instances import Instances
from nextview.sensing.frame import Frame
from nextview.sensing.view import View
from nextview.things.flat import SHADOW, planes
from nextview.things.score import BLOCK, LEFT_OVER, PIXEL_GAIN, evened

SHAPE = 120, 160
INTRINSICS = np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]])
FRONT = np.s_[40:80, 60:100]  # of a box, in the middle of the image
WALL = 1.0
UP = np.array([0.0, 0, 1])


def view_of(depth, *masks) -> View:
    """A view of a depth image, metres, with what may be one thing each."""
    noise = np.random.default_rng(0).normal(0, 0.0005, SHAPE)
    measured = np.where(depth > 0, depth + noise, 0).astype(np.float32)
    frame = Frame(measured, INTRINSICS, np.eye(4), pixel_centre=0.5)
    none = np.zeros(SHAPE, bool)
    instances = Instances(masks, none, none)
    height = np.full(SHAPE, np.inf, np.float32)
    return View.of(frame, instances, measured > 0, height, UP, np.inf)


def box_before_a_wall(depth: float, shadow: int = 0):
    """Depth of a wall and of the front of a box, with a shadow to its left; and the two masks."""
    image = np.full(SHAPE, WALL)
    rows, columns = FRONT
    image[rows, columns.start - shadow : columns.start] = 0
    image[FRONT] = depth
    front = np.zeros(SHAPE, bool)
    front[FRONT] = True
    return image, front, ~front & (image > 0)


def test_a_wall_behind_a_box_is_explained_by_a_plane():
    image, front, wall = box_before_a_wall(0.8)
    found = max(planes(view_of(image, front, wall)), key=lambda one: len(one.cells))
    shown = np.zeros(SHAPE, bool)
    shown.ravel()[found.cells] = True
    assert shown[wall].mean() > 0.99
    assert not shown[front].any()
    assert found.gain.mean() == pytest.approx(PIXEL_GAIN, abs=0.2)
    assert found.paid == 0  # nothing lies behind it


def of_front(found, front):
    """What the plane of the front of the box pays, in pixels of its edge."""
    (own,) = [one for one in found if front.ravel()[one.cells].mean() > 0.9]
    return own.paid / LEFT_OVER


@pytest.mark.parametrize("shadow", [0, 6])
def test_the_front_of_a_box_pays_for_its_edge_also_beside_a_shadow(shadow):
    image, front, wall = box_before_a_wall(0.8, shadow)
    around = 2 * 2 * (40 + 40)  # two pixels wide
    assert of_front(planes(view_of(image, front, wall)), front) == pytest.approx(
        around, rel=0.1
    )


def test_beside_a_wide_shadow_nothing_is_known_of_an_edge():
    image, front, wall = box_before_a_wall(0.8, 40)
    # of the left edge only what is near its ends
    around = 2 * (40 + 40 + 40) + 2 * 2 * SHADOW
    assert of_front(planes(view_of(image, front, wall)), front) == pytest.approx(
        around, rel=0.1
    )


def test_a_plane_that_continues_pays_for_no_edge():
    """The segmentation cut a piece out of a wall."""
    image, front, wall = box_before_a_wall(WALL)
    assert [one.paid for one in planes(view_of(image, front, wall))] == [0.0]


def test_noise_chooses_no_pixel():
    """Of two explanations that are as good, none takes the pixels in which noise favours it."""
    rng = np.random.default_rng(0)
    columns = 8 * BLOCK
    cells = np.arange(columns * 8 * BLOCK)
    on = rng.random(len(cells)) < 0.9
    one, other = rng.normal(1, 1, (2, len(cells))).astype(np.float32)
    taken = np.maximum(other - one, 0)[on].sum()
    even = [evened(gain, cells, on, columns) for gain in (one, other)]
    assert np.maximum(even[1] - even[0], 0).sum() < 0.4 * taken
    for gain, mean in zip((one, other), even, strict=True):
        assert mean.sum() == pytest.approx(gain[on].sum(), rel=1e-5)
        assert not mean[~on].any()
        # the same in each block of the grid
        block = mean.reshape(8, BLOCK, 8, BLOCK).max((1, 3))
        spread = np.where(on, mean, np.inf).reshape(8, BLOCK, 8, BLOCK).min((1, 3))
        np.testing.assert_array_equal(block, spread)
