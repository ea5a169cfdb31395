"""Frames: units, axes and pixel centres, and the mistakes that are refused."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import INTRINSICS, SHAPE, TABLE, box, cast, pose_at
from scipy.spatial.transform import Rotation

from nextview.errors import ObservationError, UsageError
from nextview.sensing import Box, Frame, ObjectFrame, ObservedObject
from nextview.sensing.object_frame import upright_axes
from nextview.sensing.segmentation import on_ground

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


def test_a_changed_frame_is_not_converted_again():
    pose = POSE.copy()
    pose[:3, 1:3] *= -1
    frame = Frame(DEPTH, INTRINSICS, pose, axes="opengl", pixel_centre=0.0)
    again = replace(frame, mask=DEPTH > 0, axes="opencv", pixel_centre=0.5)
    np.testing.assert_array_equal(again.pose, frame.pose)
    np.testing.assert_array_equal(again.intrinsics, frame.intrinsics)


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


def scaled(matrix, scale):
    changed = matrix.copy()
    changed[:3, :3] = changed[:3, :3] * scale
    return changed


def with_focal(x, y=500.0):
    return np.array([[x, 0, 320], [0, y, 240], [0, 0, 1.0]])


LEFT_HANDED = POSE @ np.diag([1, -1, 1, 1.0])
WRONG = {
    "millimetres?": {"depth": DEPTH * 1000},
    "scaled to 0 .. 1": {"depth": DEPTH / 1000},
    "nothing is seen": {"depth": np.full(SHAPE, np.nan)},
    "nothing is seen: no pixel": {"depth": np.zeros(SHAPE, np.uint16)},
    "(H, W), not": {"depth": DEPTH[..., None]},
    "not int64": {"depth": (DEPTH * 1000).astype(np.int64)},
    "a (3, 3) matrix": {"intrinsics": np.eye(4)},
    "transposed, or with a skew": {"intrinsics": INTRINSICS.T},
    "have to be positive": {"intrinsics": with_focal(-500.0)},
    "in pixels, not in millimetres": {"intrinsics": with_focal(3.6, 3.6)},
    "a focal length of 1e-30 is too short": {"intrinsics": with_focal(500.0, 1e-30)},
    "another resolution": {"intrinsics": np.array([[520, 0, 1500], [0, 520, 900], [0, 0, 1.0]])},
    "a (4, 4) matrix": {"pose": POSE[:3]},
    "finite numbers": {"pose": np.full((4, 4), np.nan)},
    "transposed?": {"pose": POSE.T},
    "scaled by 2": {"pose": scaled(POSE, 2)},
    "no rotation matrix": {"pose": POSE @ np.diag([1, 0.5, 1, 1.0])},
    "left-handed": {"pose": LEFT_HANDED},
    "not 'unity'": {"pose": POSE, "axes": "unity"},
    "a mask is (H, W) bool": {"mask": DEPTH},
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


NO_NUMBERS = ["x", None, [[1, 2], [3]], {"a": 1}, np.ones((4, 4), complex), np.full((4, 4), "1"), [10**400] * 4, object]


@pytest.mark.parametrize("junk", NO_NUMBERS, ids=lambda junk: type(junk).__name__)
@pytest.mark.parametrize("name", ["depth", "intrinsics", "pose", "mask", "image"])
def test_what_is_no_array_of_numbers_is_refused_in_one_sentence(name, junk):
    if junk is None and name in ("pose", "mask", "image"):
        return
    arguments = {"depth": DEPTH, "intrinsics": INTRINSICS, "pose": POSE} | {name: junk}
    with pytest.raises(ObservationError, match=r"^[^\n]+$"):
        Frame(**arguments)


@pytest.mark.parametrize("name", ["intrinsics", "pose"])
def test_numbers_that_no_camera_has_are_refused_without_a_warning(name):
    for number in (1e300, -1e154, np.nan, np.inf):
        for place in np.ndindex(3, 3):
            arguments = {"intrinsics": INTRINSICS.copy(), "pose": POSE.copy()}
            arguments[name][place] = number
            with pytest.raises(ObservationError):
                Frame(DEPTH, **arguments)


@pytest.mark.parametrize("junk", [[1, [2]], "x", np.zeros(18), 1j, [np.nan, 0, 0], [1e300, 0, 0], b"x", []])
def test_places_that_are_none_are_refused_in_one_sentence(junk):
    corner = np.full(3, 2e9) if isinstance(junk, list) and junk and junk[0] == 1e300 else np.ones(3)
    for make in (
        lambda: Box(junk, corner),
        lambda: Box(np.zeros(3), np.ones(3), axes=junk),
        lambda: ObjectFrame(junk, 1.0, np.eye(3)),
        lambda: ObjectFrame(np.zeros(3), 1.0, junk),
        lambda: ObjectFrame(np.zeros(3), junk, np.eye(3)),
        lambda: ObservedObject(point=junk),
        lambda: upright_axes(junk),
    ):
        with pytest.raises(UsageError, match=r"^[^\n]+$"):
            make()


def test_up_may_be_as_short_as_numbers_are():
    np.testing.assert_allclose(upright_axes([0, 0, 1e-300]), np.eye(3))


def test_a_frame_from_another_place_takes_no_memory_and_is_not_the_object():
    """A pose in millimetres: the cells of both frames in one grid would take terabytes."""
    thing = box((0.2, 0.16, 0.1), (0, 0, 0.05))
    depth = cast([TABLE, thing], POSE)[0]
    seen = ObservedObject()
    seen.add(Frame(depth, INTRINSICS, POSE, pixel_centre=0.5))
    far = POSE.copy()
    far[:2, 3] += 1e5
    with pytest.raises(ObservationError, match="shows nothing of the object known so far"):
        seen.add(Frame(depth, INTRINSICS, far, pixel_centre=0.5))
    seen.add(Frame(depth, INTRINSICS, POSE, pixel_centre=0.5))


def test_no_plane_is_no_reason_to_leave_points_out():
    points = np.random.default_rng(0).normal(size=(5, 2))
    for plane in (np.zeros((0, 2)), np.ones((2, 2))):
        assert on_ground(points, plane).all()
