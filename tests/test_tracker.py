"""Things are followed from frame to frame: moved, hidden, taken away and found again."""

from copy import copy

import numpy as np
import pytest
from factories import (
    PlacedThing,
    SimulatedTable,
    camera_over,
    meshes_of,
    view,
    without,
)
from scipy.spatial.transform import Rotation
from test_scene_changes import shifted

import nextview
from nextview.errors import SessionError, UsageError
from nextview.sensing.frame import Frame

NAMES = ("mustard_bottle", "tuna_fish_can", "banana")
STEP = np.array([0.004, -0.003])  # metres a frame, 0.15 m/s at 30 Hz


@pytest.fixture(scope="module")
def meshes():
    return list(meshes_of(NAMES).values())


@pytest.fixture(scope="module")
def first_look(ycb, meshes):
    """A camera over the things, and a scene after two frames, in which all names are confident."""
    camera = camera_over(meshes, seed=8)
    scene = nextview.Scene(ycb, segmentation=lambda frame: camera.owner + 1)
    for degrees in (65, 155):
        scene.update(camera.frame(view(degrees)))
    return camera, scene


@pytest.fixture
def watched(first_look):
    """The camera and the scene for one test."""
    camera, scene = first_look[0].again(), copy(first_look[1])
    scene.segmentation = lambda frame: camera.owner + 1
    assert {thing.name for thing in scene.objects if thing.confident} == set(NAMES)
    return camera, scene


def off(camera, tracked):
    """Distance of each thing's pose from the truth, metres, at the middle of its scan."""
    apart = {}
    for one in tracked:
        true = next(thing for thing in camera.table.things if thing.name == one.name)
        middle = (true.vertices.min(0) + true.vertices.max(0)) / 2
        difference = one.pose - true.pose
        apart[one.name] = np.linalg.norm(
            difference[:3, :3] @ middle + difference[:3, 3]
        )
    return apart


def place_of(camera, name, share=1.0):
    """The part of the last frame around a thing, or the left share of it."""
    row = [thing.name for thing in camera.table.things].index(name)
    rows, columns = np.nonzero(camera.owner == row)
    right = columns.min() + share * np.ptp(columns)
    return np.s_[
        max(0, rows.min() - 8) : rows.max() + 8,
        max(0, columns.min() - 8) : int(right) + 8 * (share == 1),
    ]


def covered(frame, part, distance=0.3):
    """A frame in which something near the camera hides a part."""
    depth = frame.depth.copy()
    depth[part] = distance
    return Frame(depth, frame.intrinsics, frame.pose, pixel_centre=0.5)


def hidden(camera, frame, name):
    """A frame in which something close to the camera hides a thing."""
    return covered(frame, place_of(camera, name))


def test_a_thing_that_moves_is_followed_and_the_others_stand(watched):
    camera, scene = watched
    tracker = nextview.Tracker(scene)
    for _ in range(10):
        camera.change(shifted(camera.table, "banana", STEP))
        tracked = tracker.update(camera.frame(view(155)))
        assert not any(one.lost for one in tracked)
        assert max(off(camera, tracked).values()) < 0.004
    banana = next(one for one in tracked if one.name == "banana")
    assert np.allclose(banana.velocity[3:5], 30 * STEP, atol=0.06)
    assert banana.visible > 0.7


def test_a_thing_that_stands_is_expected_to_stay_while_it_is_hidden(watched):
    camera, scene = watched
    tracker = nextview.Tracker(scene)
    for _ in range(8):
        frame = camera.frame(view(155))
        tracked = tracker.update(hidden(camera, frame, "banana"))
        banana = next(one for one in tracked if one.name == "banana")
        assert banana.visible < 0.05
        assert not banana.lost
        assert off(camera, tracked)["banana"] < 0.004
    assert np.array_equal(banana.velocity, np.zeros(6))


def test_what_passes_before_an_empty_place_does_not_bring_the_thing_back(watched):
    name, distance = "banana", 0.3
    camera, scene = watched
    tracker = nextview.Tracker(scene)
    camera.frame(view(155))
    full, part = camera.table, place_of(camera, name)
    camera.change(without(full, name))

    def lost():
        return {one.name for one in tracker.things if one.lost}

    for _ in range(2):
        tracker.update(camera.frame(view(155)))
    assert lost() == {name}
    for number in range(8):  # for four seconds, at the rate of a slow camera
        frame = camera.frame(view(155))
        tracker.update(covered(frame, part, distance), 0.1 + 0.5 * number)
        assert lost() == {name}

    camera.change(full)
    for _ in range(2):
        tracked = tracker.update(camera.frame(view(155)))
    assert not lost()
    assert off(camera, tracked)[name] < 0.004


def test_a_thing_that_is_partly_hidden_keeps_its_pose(watched):
    camera, scene = watched
    tracker = nextview.Tracker(scene)
    for share in (0.3, 0.5, 0.7, 0.5, 0.3):
        frame = camera.frame(view(155))
        part = place_of(camera, "mustard_bottle", share)
        tracked = tracker.update(covered(frame, part))
        bottle = next(one for one in tracked if one.name == "mustard_bottle")
        assert 0.1 < bottle.visible < 1.1 - share
        assert not bottle.lost
        assert off(camera, tracked)["mustard_bottle"] < 0.004


def test_a_thing_that_moves_behind_something_is_lost_until_the_scene_finds_it(watched):
    camera, scene = watched
    tracker = nextview.Tracker(scene)
    for number in range(22):
        camera.change(shifted(camera.table, "banana", STEP))
        frame = camera.frame(view(155))
        if number > 4:
            frame = hidden(camera, frame, "banana")
        tracked = tracker.update(frame)
        banana = next(one for one in tracked if one.name == "banana")
        assert banana.lost or off(camera, tracked)["banana"] < 0.05
    assert banana.lost
    frame = camera.frame(view(155))
    scene.update(frame)
    tracker.follow(scene)
    tracked = tracker.update(frame)
    assert not any(one.lost for one in tracked)
    assert max(off(camera, tracked).values()) < 0.004


def test_a_thing_that_was_taken_away_is_lost_and_followed_again_after_the_scene(
    watched,
):
    camera, scene = watched
    tracker = nextview.Tracker(scene)
    full = camera.table
    camera.change(without(full, "banana"))
    for _ in range(3):
        tracked = tracker.update(camera.frame(view(155)))
    assert {one.name for one in tracked if one.lost} == {"banana"}
    scene.update(camera.frame(view(155)))
    tracker.follow(scene)
    assert {one.name for one in tracker.things} == set(NAMES) - {"banana"}

    camera.change(full)
    frame = camera.frame(view(155))
    scene.update(frame)
    tracker.follow(scene)
    assert off(camera, tracker.update(frame))["banana"] < 0.004


def exchanged(table, name, other):
    """The same table with another thing around the middle of one."""
    (mesh,) = meshes_of([other]).values()
    metres = mesh.vertices * mesh.radius + mesh.centre
    things = list(table.things)
    row = [thing.name for thing in things].index(name)
    pose = things[row].pose.copy()
    pose[:3, 3] = things[row].placed.mean(0) - pose[:3, :3] @ metres.mean(0)
    things[row] = PlacedThing(other, metres, mesh.faces, pose)
    return SimulatedTable(tuple(things))


def test_a_thing_that_is_exchanged_for_one_that_looks_alike_loses_its_name(watched):
    camera, scene = watched
    tracker = nextview.Tracker(scene)
    seconds = iter(range(100))
    for _ in NAMES:
        tracked = tracker.update(camera.frame(view(155)), next(seconds))
        assert all(one.name_probability > 0.9 for one in tracked)

    camera.change(exchanged(camera.table, "tuna_fish_can", "gelatin_box"))
    for _ in NAMES:
        tracked = tracker.update(camera.frame(view(155)), next(seconds))
    unlikely = {one.name for one in tracked if one.name_probability < 0.5}
    assert unlikely == {"tuna_fish_can"}


def test_what_is_out_of_view_keeps_its_place(watched):
    camera, scene = watched
    tracker = nextview.Tracker(scene)
    frame = camera.frame(view(155))
    aside = frame.camera_to_world.copy()
    aside[:3, :3] = (
        aside[:3, :3] @ Rotation.from_euler("y", 120, degrees=True).as_matrix()
    )
    tracked = tracker.update(
        Frame(frame.depth, frame.intrinsics, aside, pixel_centre=0.5)
    )
    assert max(off(camera, tracked).values()) < 0.004
    assert all(one.visible == 0 and not one.lost for one in tracked)


def test_wrong_use_is_refused(ycb, watched):
    camera, scene = watched
    with pytest.raises(SessionError):
        nextview.Tracker(nextview.Scene(ycb))
    tracker = nextview.Tracker(scene)
    frame = camera.frame(view(155))
    tracker.update(frame, 2.0)
    with pytest.raises(UsageError):
        tracker.update(frame, 1.0)
    with pytest.raises(UsageError):
        nextview.Tracker(scene).update(frame, 1.7e18)
    with pytest.raises(UsageError):
        tracker.update(frame, 2.0 + 1e9 / 30)
    tracker.update(frame, 2.0 + 1 / 30)
