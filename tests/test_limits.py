"""Candidate views to which no camera is sent: too low, too high, too near to what the frames
show, behind it.
"""

import pickle

import numpy as np
import pytest
from factories import TABLE, box, cast, pose_at

import nextview
from nextview import Session, Stopping, ViewSphere
from nextview.errors import UsageError
from nextview.policies.registry import make_policy
from nextview.sensing import Frame, ObservedObject
from nextview.session.limits import (
    BEHIND_SOMETHING,
    BEHIND_WALL,
    TOO_HIGH,
    TOO_LOW,
    TOO_NEAR,
    Limits,
)

SPHERE = ViewSphere.named("40")
SHAPE = 240, 320
INTRINSICS = np.array([[260.0, 0, 160], [0, 260.0, 120], [0, 0, 1]])
BRICK = box((0.12, 0.08, 0.06), (0, 0, 0.03))
WARDROBE = box((0.8, 0.5, 1.9), (0, 0, 0.95))
FLOOR = box((12, 12, 0.04), (0, 0, -0.02))
FROM = pose_at(35, -90, 0.6, (0, 0, 0.05))


def begin(models, limits=None, distance=0.5, max_views=4, seed=0, **asked) -> Session:
    policy = make_policy("random-all", SPHERE)
    rng = np.random.default_rng(seed)
    thing = ObservedObject(**asked)
    session = Session(
        models, policy, SPHERE, 0, Stopping(1.0, max_views), rng, thing, distance
    )
    session.limits = limits or Limits()
    return session


def look(pose, *meshes, masked=False) -> Frame:
    """What a camera sees of things, the object first."""
    depth, which = cast(meshes, pose, INTRINSICS, SHAPE)
    return Frame(
        depth, INTRINSICS, pose, which == 0 if masked else None, pixel_centre=0.5
    )


def places(session) -> np.ndarray:
    return session.poses[:, :3, 3]


def outside(mesh, points) -> np.ndarray:
    """Distance of points from an upright box, (N,); 0 inside."""
    low, high = mesh.bounds
    return np.linalg.norm(points - np.clip(points, low, high), axis=1)


# Heights


@pytest.mark.parametrize("distance", [0.3, 0.5, 1.2])
def test_no_target_touches_the_table_or_grazes_it(tiny, distance):
    session = begin(tiny, distance=distance, max_views=6)
    pose = FROM
    while not session.done:
        session.update(look(pose, BRICK, TABLE))
        height = places(session)[:, 2]
        low = height < max(0.08, 0.1 * distance)
        assert low.sum() >= 8
        np.testing.assert_array_equal([why == TOO_LOW for why in session.left_out], low)
        if not session.done:
            assert not low[session.view]
            pose = session.target


def test_no_target_is_as_high_as_no_robot_reaches(tiny):
    first = pose_at(5, -90, 3.0, (0, 0, 0.95))
    for most, limits in (
        (2.0, Limits()),
        (1.3, Limits(max_height=1.3)),
        (np.inf, Limits(max_height=np.inf)),
    ):
        session = begin(tiny, limits, distance=2.5)
        session.update(look(first, WARDROBE, FLOOR))
        high = [why == TOO_HIGH for why in session.left_out]
        np.testing.assert_array_equal(high, places(session)[:, 2] > most)
        assert sum(high) >= 16 or most == np.inf


# What the frames show


BESIDE = box((0.1, 0.1, 0.3), (0.35, 0.1, 0.15))
NEIGHBOURS = {
    "a box beside it": BESIDE,
    "a tower behind it": box((0.15, 0.15, 0.5), (0.05, 0.4, 0.25)),
    "a rod": box((0.02, 0.02, 0.4), (-0.3, 0.2, 0.2)),
}


@pytest.mark.parametrize("name", NEIGHBOURS)
def test_no_target_is_in_or_beside_another_thing(tiny, name):
    neighbour, clearance = NEIGHBOURS[name], 0.1
    session = begin(tiny, point=(0, 0, 0.03))
    first = pose_at(20, -90, 1.0, (0, 0, 0.1))
    session.update(look(first, BRICK, neighbour, TABLE))
    away = outside(neighbour, places(session))
    assert (away < clearance).any()

    left_out = np.array(session.left_out) != ""
    # the back of a thing is not seen: nearer to it than to its front
    facing = away < 0.6 * clearance
    assert left_out[facing].all()
    clear = (
        (away > 2.5 * clearance)
        & (places(session)[:, 1] < 0.1)
        & (places(session)[:, 2] > 0.08)
    )
    assert clear.any()
    assert not left_out[clear].any()

    session.limits = Limits(clearance=0)
    assert set(session.left_out) == {"", TOO_LOW}


def test_what_another_thing_hides_is_left_out_until_a_frame_shows_that_it_is_free(tiny):
    board = box((0.3, 0.02, 0.35), (0, 0.25, 0.175))
    session = begin(tiny, distance=0.6, point=(0, 0, 0.03))
    session.update(look(pose_at(25, -90, 0.8, (0, 0, 0.1)), BRICK, board, TABLE))
    hidden = np.array(session.left_out) == BEHIND_SOMETHING
    assert hidden.any()
    assert (places(session)[hidden, 1] > 0.3).all()

    session.update(look(pose_at(20, 20, 1.2, (0, 0.2, 0.15)), BRICK, board, TABLE))
    assert (np.array(session.left_out)[hidden] == "").any()


@pytest.mark.parametrize("turn", [0, 25, -30])
def test_no_target_is_behind_a_wall(tiny, turn):
    wall = box((5, 0.1, 3), (0, 0.4, 1.0))
    session = begin(tiny, distance=0.7, point=(0, 0, 0.03))
    session.update(look(pose_at(30, -90 + turn, 0.8, (0, 0, 0.05)), BRICK, TABLE, wall))
    beyond = places(session)[:, 1] > 0.35 - 0.1 + 0.01
    left_out = np.array(session.left_out)
    assert (left_out[beyond] != "").all()
    assert (left_out[beyond] == BEHIND_WALL).any()
    assert (left_out[places(session)[:, 1] < 0.2] != BEHIND_WALL).all()

    session.limits = Limits(clearance=0)
    assert BEHIND_WALL not in session.left_out


def test_limits_hold_for_the_targets_of_a_scene_too(ycb):
    wall = box((5, 0.1, 3), (0, 0.4, 1.0))
    scene = nextview.Scene(ycb, distance=0.7)
    scene.update(look(pose_at(30, -90, 0.8, (0, 0, 0.05)), BRICK, TABLE, wall))
    assert len(scene.targets)
    assert (scene.targets[:, 1, 3] < 0.35).all()
    assert (scene.targets[:, 2, 3] >= 0.08).all()

    scene.limits = Limits(clearance=0, min_height=0.4)
    assert (scene.targets[:, 1, 3] > 0.35).any()
    assert (scene.targets[:, 2, 3] >= 0.4).all()
    with pytest.raises(UsageError):
        scene.limits = 0.4


def test_the_object_is_no_obstacle(tiny):
    """However near the camera is asked to be, and whatever it hides."""
    session = begin(tiny, Limits(0, np.inf), distance=1.2, point=(0, 0, 0.5))
    session.update(look(pose_at(20, -90, 2.5, (0, 0, 0.9)), WARDROBE, FLOOR))
    assert set(session.left_out) == {""}


# What follows


def test_where_no_candidate_is_left_the_session_ends_and_says_why(tiny):
    session = begin(tiny, Limits(min_height=3.0))
    view = session.update(look(FROM, BRICK, TABLE))
    assert session.done
    assert view.next_view is None
    assert session.target is None
    result = session.result
    assert result.stranded
    assert not result.confident
    assert result.why_stranded == "39 too low"
    assert "no other view in reach: 39 too low" in repr(result)


def test_a_session_for_a_robot_takes_the_limits_at_its_beginning():
    system = nextview.load(policy="spread", threshold=1.0)
    session = system.session(
        distance=0.5, min_height=0.2, max_height=0.4, clearance=0.05
    )
    assert session.limits == Limits(0.2, 0.4, 0.05)
    session.update(look(FROM, BRICK, TABLE))
    assert 0.2 <= session.target[2, 3] <= 0.4


@pytest.mark.parametrize(
    "wrong",
    [
        {"min_height": np.nan},
        {"min_height": "0.1"},
        {"max_height": 0.0},
        {"min_height": 0.5, "max_height": 0.4},
        {"clearance": -0.1},
        {"clearance": np.inf},
    ],
)
def test_limits_that_make_no_sense_are_refused(wrong):
    with pytest.raises(UsageError):
        Limits(**wrong)


def test_a_session_with_frames_can_be_pickled_and_goes_on_alike(tiny):
    session = begin(tiny, point=(0, 0, 0.03))
    session.update(look(pose_at(20, -90, 1.0, (0, 0, 0.1)), BRICK, BESIDE, TABLE))
    other = pickle.loads(pickle.dumps(session))
    assert other.left_out == session.left_out
    assert TOO_NEAR in session.left_out
    second = look(session.poses[12], BRICK, BESIDE, TABLE)
    for one in (session, other):
        one.update(second)
    assert other.left_out == session.left_out
