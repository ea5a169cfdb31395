"""Frames: units, axes and pixel centres, and the mistakes that are refused."""

import numpy as np
import pytest
from factories import INTRINSICS, SHAPE, TABLE, cast, pose_at
from scipy.spatial.transform import Rotation

from nextview.errors import ObservationError
from nextview.sensing import Frame

POSE = pose_at(40, 30, 0.8, turn=(3, -4, 10))
DEPTH = cast([TABLE], POSE)[0]


def test_millimetres_and_metres_are_the_same_frame():
    millimetres = np.rint(DEPTH * 1000).astype(np.uint16)
    millimetres[0, :2] = 0, 65535
    metres = millimetres / 1000
    metres[0, :4] = np.nan, np.inf, -1, -np.inf
    millimetres[0, 2:4] = 0
    a, b = Frame(millimetres, INTRINSICS), Frame(metres, INTRINSICS)
    np.testing.assert_allclose(a.depth, b.depth, atol=1e-6)
    assert (a.depth[0, :4] == 0).all()
    assert a.depth.dtype == b.depth.dtype == np.float32


@pytest.mark.parametrize("kind", [">u2", "<u2", ">f4", ">f8", "<f8", "f2"])
@pytest.mark.parametrize("masked", [False, True])
def test_any_byte_order_and_masked_arrays_are_taken(kind, masked):
    """What a masked array hides was not measured, whatever number stands there."""
    millimetres = np.dtype(kind).kind == "u"
    values = (DEPTH * 1000 if millimetres else DEPTH).astype(kind)
    hidden = np.zeros(SHAPE, bool)
    if masked:
        hidden[100:200, ::3] = True
        values[hidden] = 7000 if millimetres else 7
        values = np.ma.array(values, mask=hidden)
    frame = Frame(values, INTRINSICS, mask=np.ma.array(DEPTH > 0, mask=hidden))
    assert frame.depth.dtype == np.dtype("float32")
    assert not frame.mask[hidden & (frame.depth == 0)].any()
    measured = (frame.depth > 0) & (DEPTH > 0)
    assert measured[~hidden & (DEPTH > 0)].all()
    np.testing.assert_allclose(frame.depth[measured], DEPTH[measured], rtol=0.01)


def two_surfaces():
    """A slanted wall and a slanted board before it, 1 / depth linear in the image, and which
    pixel shows which.
    """
    y, x = np.mgrid[:120, :160]
    wall = 1 / (0.8 + 0.0006 * x + 0.0004 * y)
    board = 1 / (1.3 - 0.0005 * x + 0.0003 * y)
    return (
        wall.astype(np.float32),
        board.astype(np.float32),
        (y > 40) & (y < 90) & (x > 50) & (x < 120),
    )


def kept(kind):
    """Which pixels are measured."""
    rows, columns = np.mgrid[:120, :160]
    # a low resolution aligned to a high one, a little turned
    turned = np.zeros((120, 160), bool)
    y, x = np.mgrid[:60, :80] * 2.25
    at = (
        np.rint(y + 0.02 * x).astype(int).ravel(),
        np.rint(x - 0.02 * y + 2).astype(int).ravel(),
    )
    inside = (at[0] < 120) & (at[1] >= 0) & (at[1] < 160)
    turned[at[0][inside], at[1][inside]] = True
    return {
        "every fourth row": rows % 4 > 0,
        "every second column": columns % 2 > 0,
        "a grid of single pixels": (rows % 4 > 0) | (columns % 4 > 0),
        "every second row and column": (rows % 2 == 0) & (columns % 2 == 0),
        "one of 16 pixels": (rows % 4 == 1) & (columns % 4 == 2),
        "a turned grid": turned,
        "rows, and a fifth of the others": (rows % 4 > 0)
        & (np.random.default_rng(0).random((120, 160)) > 0.2),
    }[kind]


GAPS = [
    "every fourth row",
    "every second column",
    "a grid of single pixels",
    "every second row and column",
]
GAPS += ["one of 16 pixels", "a turned grid", "rows, and a fifth of the others"]
K = np.array([[140.0, 0, 80], [0, 140, 60], [0, 0, 1]])


@pytest.mark.parametrize("gaps", GAPS)
def test_regular_gaps_are_filled_without_making_up_depth(gaps):
    wall, board, where = two_surfaces()
    # larger than the gaps
    hole = (np.mgrid[:120, :160] - np.array([20, 20])[:, None, None]).max(0) ** 2 < 100
    measured = kept(gaps) & ~hole
    depth = Frame(
        np.where(measured, np.where(where, board, wall), 0),
        K,
        pixel_centre=0.5,
    ).depth
    inner = np.s_[8:-8, 8:-8]
    assert (depth > 0)[inner][~hole[inner]].mean() > 0.97
    assert not depth[14:27, 14:27].any()
    on_wall, on_board = (np.abs(depth / true - 1) < 0.01 for true in (wall, board))
    assert (on_wall | on_board)[depth > 0].all()
    away = np.ones(where.shape, bool)  # from the edge, where either surface will do
    away[36:95, 46:125] = away[45:86, 55:116] = False
    away[45:86, 55:116] = True
    np.testing.assert_array_equal(
        on_board[away & (depth > 0)],
        where[away & (depth > 0)],
    )


@pytest.mark.parametrize("share", [0.0, 0.05, 0.2, 0.5])
def test_other_holes_stay_as_they_are(share):
    wall, board, where = two_surfaces()
    lost = np.random.default_rng(1).random(where.shape) < share
    lost[20:50, 30:90] = True
    depth = np.where(lost, 0, np.where(where, board, wall))
    np.testing.assert_array_equal(Frame(depth, K, pixel_centre=0.5).depth, depth)


def test_a_mask_with_the_same_gaps_is_filled_and_another_is_not():
    wall, board, where = two_surfaces()
    measured = kept("every fourth row")
    depth = np.where(measured, np.where(where, board, wall), 0)
    gappy = Frame(depth, K, mask=where & measured).mask
    assert gappy[44:88, 51:120].all()
    np.testing.assert_array_equal(Frame(depth, K, mask=where).mask, where)


def test_the_axes_of_a_pose_are_known_by_name():
    """The camera looks forward; where that is, is said in three ways."""
    right, down, forward = POSE[:3, :3].T
    for axes, columns in {
        "opencv": (right, down, forward),
        "opengl": (right, -down, -forward),
        "ros": (forward, -right, -down),
    }.items():
        pose = POSE.copy()
        pose[:3, :3] = np.stack(columns, 1)
        np.testing.assert_allclose(
            Frame(DEPTH, INTRINSICS, pose, axes=axes).pose,
            POSE,
            atol=1e-9,
        )


def test_the_first_pixel_may_have_its_centre_at_zero():
    k = INTRINSICS.copy()
    k[:2, 2] -= 0.5
    np.testing.assert_array_equal(
        Frame(DEPTH, k).intrinsics,
        Frame(DEPTH, INTRINSICS, pixel_centre=0.5).intrinsics,
    )
    np.testing.assert_array_equal(
        Frame(DEPTH, INTRINSICS, pixel_centre=0.5).intrinsics,
        INTRINSICS,
    )


def test_positions_lie_on_the_visible_surface():
    """The table's top is the plane z = 0."""
    frame = Frame(DEPTH, INTRINSICS, POSE, pixel_centre=0.5)
    rows, columns = np.nonzero(frame.depth)
    np.testing.assert_allclose(frame.positions(rows, columns)[:, 2], 0, atol=1e-5)
    np.testing.assert_allclose(
        frame.along(np.array([0, 0, 2.0]), 0.5)[frame.depth > 0],
        0.5,
        atol=1e-5,
    )


def test_colour_becomes_grey():
    colour = np.zeros((*SHAPE, 3), np.uint8)
    colour[0, 0] = 255, 255, 255
    colour[0, 1] = 0, 255, 0
    assert Frame(DEPTH, INTRINSICS, image=colour).image[0, :3].tolist() == [255, 150, 0]


WRONG = {
    "millimetres?": {"depth": DEPTH * 1000},
    "inches": {"depth": DEPTH * 39.37},
    "scaled to 0 .. 1": {"depth": DEPTH / 1000},
    "measures so near": {"depth": DEPTH / 20},
    "nothing is seen": {"depth": np.full(SHAPE, np.nan)},
    "transposed, or with a skew": {"intrinsics": INTRINSICS.T},
    "in pixels, not in millimetres": {"intrinsics": np.diag([3.6, 3.6, 1])},
    "another resolution": {
        "intrinsics": np.array([[520, 0, 1500], [0, 520, 900], [0, 0, 1.0]])
    },
    "intrinsics of another resolution": {
        "intrinsics": np.diag([0.75, 0.75, 1]) @ INTRINSICS
    },
    "of another resolution": {"intrinsics": np.diag([1.5, 1.5, 1]) @ INTRINSICS},
    "transposed?": {"pose": POSE.T},
    "scaled by 2": {"pose": POSE @ np.diag([2, 2, 2, 1.0])},
    "left-handed": {"pose": POSE @ np.diag([1, -1, 1, 1.0])},
    "not 'unity'": {"pose": POSE, "axes": "unity"},
    "no pixel of the mask": {"mask": np.zeros(SHAPE, bool)},
    "registered to the depth": {"image": np.zeros((10, 10, 3), np.uint8)},
}


@pytest.mark.parametrize(("said", "wrong"), WRONG.items(), ids=list(WRONG))
def test_mistakes_are_named(said, wrong):
    with pytest.raises(ObservationError) as refused:
        Frame(**({"depth": DEPTH, "intrinsics": INTRINSICS} | wrong))
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_pose_from_a_text_file_is_made_rigid():
    rounded = np.round(POSE, 4)
    rotation = Frame(DEPTH, INTRINSICS, rounded).pose[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert Rotation.from_matrix(rotation.T @ POSE[:3, :3]).magnitude() < 2e-4
