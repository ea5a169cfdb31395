"""What is wrong with a frame is refused or told by a session and by a scene alike."""

import pickle
from copy import copy, deepcopy
from dataclasses import replace

import numpy as np
import pytest
from factories import camera_over, view

import nextview
from nextview.errors import NextviewError
from nextview.segmentation.instances import LearnedSegmenter
from nextview.sensing.frame import Frame


def posed(frame: Frame, pose: np.ndarray) -> Frame:
    return replace(frame, pose=pose)


def moved(frame: Frame, shift) -> Frame:
    pose = frame.pose.copy()
    pose[:3, 3] += shift
    return posed(frame, pose)


def in_millimetres(frame: Frame) -> Frame:
    pose = frame.pose.copy()
    pose[:3, 3] *= 1000
    return posed(frame, pose)


def deeper(frame: Frame, times: float) -> Frame:
    return Frame(times * frame.depth, frame.intrinsics, frame.pose, pixel_centre=0.5)


def ranged(frame: Frame) -> Frame:
    x, y = frame.rays
    return frame.with_depth(frame.depth * np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2))


def counted(frame: Frame, times: float) -> Frame:
    steps = np.rint(1000 * times * frame.depth).astype(np.uint16)
    return Frame(steps, frame.intrinsics, frame.pose, pixel_centre=0.5)


MISTAKES = {
    "a first pose in millimetres": (
        lambda first, second: [in_millimetres(first)],
        "refused: scale",
    ),
    "a first pose that is inverse": (
        lambda first, second: [posed(first, np.linalg.inv(first.pose))],
        "refused: inverse pose",
    ),
    "a first pose with OpenGL's axes": (
        lambda first, second: [replace(first, axes="opengl")],
        "refused: opengl axes",
    ),
    "first steps of a fifth of a millimetre": (
        lambda first, second: [counted(first, 5)],
        "unit",
    ),
    "range instead of depth": (lambda first, second: [ranged(first)], "refused: range"),
    "a second pose in millimetres": (
        lambda first, second: [first, in_millimetres(second)],
        "refused: scale",
    ),
    "a second pose that is inverse": (
        lambda first, second: [first, posed(second, np.linalg.inv(second.pose))],
        "refused: inverse pose",
    ),
    "a second pose with the axes of ROS": (
        lambda first, second: [first, replace(second, axes="ros")],
        "refused",
    ),
    "no second pose": (
        lambda first, second: [
            first,
            replace(second, pose=None),
        ],
        "refused",
    ),
    "a second pose that is too high": (
        lambda first, second: [first, moved(second, [0, 0, 0.15])],
        "refused",
    ),
    "depth that is five times as large": (
        lambda first, second: [first, deeper(second, 5)],
        "refused",
    ),
    "a pose that stays what it was": (
        lambda first, second: [first, posed(second, first.pose)],
        "stale pose",
    ),
    "one frame again and again": (
        lambda first, second: [first, first, first, first],
        "repeated",
    ),
    "one picture with another pose": (
        lambda first, second: [first, posed(first, second.pose)],
        "repeated",
    ),
    "a world far away": (
        lambda first, second: [
            moved(first, [700, 0, 0]),
            moved(second, [700, 0, 0]),
        ],
        "far origin",
    ),
    "no mistake": (lambda first, second: [first, second], None),
}


@pytest.fixture(scope="module")
def two_frames(ycb_meshes):
    camera = camera_over([ycb_meshes["mug"]])
    return camera.frame(view(20)), camera.frame(view(60))


def through_session(ycb):
    """A session that goes on after it could answer."""
    system = replace(ycb, stopping=nextview.Stopping(1.0, 8))
    return system.session(distance=0.6)


DOORS = {"session": through_session, "scene": nextview.Scene}


@pytest.fixture(scope="module")
def after_one(ycb, two_frames):
    """Each of ``DOORS`` after the first frame."""
    takers = {name: door(ycb) for name, door in DOORS.items()}
    for taker in takers.values():
        taker.update(two_frames[0])
    return takers


def stands(taker):
    """What a scene or a session holds."""
    if isinstance(taker, nextview.Session):
        return len(taker.views)
    return [
        (thing.number, thing.name, thing.confident, len(thing.pixels))
        for thing in taker.objects
    ]


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_refused_or_told_whatever_takes_it_in(
    ycb,
    two_frames,
    after_one,
    mistake,
    door,
):
    make, outcome = MISTAKES[mistake]
    *earlier, last = make(*two_frames)
    if earlier and earlier[0] is two_frames[0]:
        taker = deepcopy(after_one[door])
        earlier = earlier[1:]
    else:
        taker = DOORS[door](ycb)
    for frame in earlier:
        taker.update(frame)
    before = stands(taker)

    if (outcome or "").startswith("refused"):
        with pytest.raises(NextviewError) as refused:
            taker.update(last)
        assert refused.value.kind == outcome.partition(": ")[2]
        assert "\n" not in str(refused.value)
        assert stands(taker) == before
    else:
        said = [warning.name for warning in taker.update(last).warnings]
        assert outcome in said if outcome else not said


def test_an_object_tells_what_is_wrong_with_its_frames_and_is_not_confident(
    ycb, ycb_meshes
):
    camera = camera_over([ycb_meshes["cracker_box"]])
    frames = camera.frame(view(20)), camera.frame(view(60))
    right = nextview.Scene(ycb)
    right.update(frames[0])
    stale = copy(right)
    right.update(frames[1])
    (box,) = right.objects
    assert (box.name, box.confident, box.warnings) == ("cracker_box", True, ())

    stale.update(posed(frames[1], frames[0].pose))
    far = nextview.Scene(ycb)
    far.update(moved(frames[0], [700, 0, 0]))
    for scene, name in ((stale, "stale pose"), (far, "far origin")):
        assert scene.objects
        for thing in scene.objects:
            assert name in [warning.name for warning in thing.warnings]
            assert not thing.confident


def test_a_frame_that_was_handed_in_before_counts_once(after_one, two_frames):
    scene = copy(after_one["scene"])
    once = stands(scene)
    looks = [scene.update(two_frames[0]) for _ in range(3)]
    assert not any(look.taken for look in looks)
    assert stands(scene) == once
    assert {views for *_, views in once} == {1}
    masked = replace(two_frames[0], mask=scene.objects[0].pixels[0])
    assert scene.update(masked).taken  # another part of the picture is asked for


def test_a_frame_that_raises_leaves_no_trace(ycb, ycb_meshes):
    """Neither where it fails at once nor where it fails last, when the names are ruled out."""
    camera = camera_over([ycb_meshes["mug"], ycb_meshes["banana"]])
    first, second = camera.frame(view(20)), camera.frame(view(110))
    failing = []

    def segmented(frame):
        if "segmentation" in failing:
            raise RuntimeError("it fails")
        return LearnedSegmenter()(frame)

    def rule(objects):
        if "rule" in failing:
            raise RuntimeError("it fails")
        return {}

    scene = nextview.Scene(ycb, segmentation=segmented, rule=rule)
    scene.update(first)
    before = stands(scene)
    look = copy(scene).update(second)
    assert look.taken

    for what in ("segmentation", "rule"):
        failing[:] = [what]
        with pytest.raises(NextviewError):
            scene.update(second)
        assert stands(scene) == before
        assert len(scene.frames) == 1
    failing.clear()
    assert scene.update(second) == look


def test_a_scene_can_be_pickled_and_goes_on_alike_and_apart(after_one, two_frames):
    scene = copy(after_one["scene"])
    other = pickle.loads(pickle.dumps(scene))
    scene.update(two_frames[1])
    assert len(other.frames) == 1
    other.update(two_frames[1])
    (ours,), (theirs,) = scene.objects, other.objects
    assert (ours.name, ours.number) == (theirs.name, theirs.number)
    np.testing.assert_allclose(ours.pose, theirs.pose)
