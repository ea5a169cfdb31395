"""Frames: units, axes and pixel centres, and the mistakes that are refused."""

import numpy as np
import pytest
from pipeline import INTRINSICS, SHAPE, TABLE, cast, pose_at
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
        np.testing.assert_allclose(Frame(DEPTH, INTRINSICS, pose, axes=axes).pose, POSE, atol=1e-9)


def test_the_first_pixel_may_have_its_centre_at_zero():
    k = INTRINSICS.copy()
    k[:2, 2] -= 0.5
    np.testing.assert_array_equal(Frame(DEPTH, k).intrinsics, Frame(DEPTH, INTRINSICS, pixel_centre=0.5).intrinsics)
    np.testing.assert_array_equal(Frame(DEPTH, INTRINSICS, pixel_centre=0.5).intrinsics, INTRINSICS)


def test_positions_lie_on_what_is_seen():
    """The table's top is the plane z = 0."""
    frame = Frame(DEPTH, INTRINSICS, POSE, pixel_centre=0.5)
    rows, columns = np.nonzero(frame.depth)
    np.testing.assert_allclose(frame.positions(rows, columns)[:, 2], 0, atol=1e-5)
    np.testing.assert_allclose(frame.along(np.array([0, 0, 2.0]), 0.5)[frame.depth > 0], 0.5, atol=1e-5)


def test_colour_becomes_grey():
    colour = np.zeros((*SHAPE, 3), np.uint8)
    colour[0, 0] = 255, 255, 255
    colour[0, 1] = 0, 255, 0
    assert Frame(DEPTH, INTRINSICS, image=colour).image[0, :3].tolist() == [255, 150, 0]


WRONG = {
    "millimetres?": {"depth": DEPTH * 1000},
    "inches": {"depth": DEPTH * 39.37},
    "scaled to 0 .. 1": {"depth": DEPTH / 1000},
    "nothing is seen": {"depth": np.full(SHAPE, np.nan)},
    "transposed, or with a skew": {"intrinsics": INTRINSICS.T},
    "in pixels, not in millimetres": {"intrinsics": np.diag([3.6, 3.6, 1])},
    "another resolution": {"intrinsics": np.array([[520, 0, 1500], [0, 520, 900], [0, 0, 1.0]])},
    "intrinsics of another resolution": {"intrinsics": np.diag([0.75, 0.75, 1]) @ INTRINSICS},
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
