"""What moves, goes or stands still between the frames of a scene."""

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import pytest
from factories import SimulatedTable, TableCamera, camera_over, meshes_of, view

import nextview
from nextview.data.samples import sample_mesh
from nextview.simulation.sensor import SENSORS

NAMES = ("cracker_box", "mustard_bottle", "tuna_fish_can", "scissors", "foam_brick")


@pytest.fixture(scope="module")
def meshes():
    return meshes_of(NAMES)


@pytest.fixture(scope="module")
def three(meshes):
    """Some of them: each is compared with a frame beside all others."""
    return {name: meshes[name] for name in ("cracker_box", "tuna_fish_can", "scissors")}


@dataclass
class TrueMasks:
    """A segmentation: which thing each pixel of the last frame shows."""

    camera: TableCamera

    def __call__(self, frame):
        return self.camera.owner + 1


def seen_once(ycb, meshes, **errors):
    """A camera over the things, and a scene with true masks after one frame."""
    camera = camera_over(list(meshes.values()), seed=8)
    camera.sensor = replace(SENSORS["stereo"], **errors)
    scene = nextview.Scene(ycb, segmentation=TrueMasks(camera))
    scene.update(camera.frame(view(20)))
    return camera, scene


@pytest.fixture(scope="module")
def first_look(ycb, meshes):
    """The camera and a scene after the first frame, in which nothing errs."""
    return seen_once(ycb, meshes)


@pytest.fixture
def watched(first_look):
    """The camera, the scene after the first frame for one test, and the numbers of the things.

    A thing has a number with a name or without: scissors are hardly seen.
    """
    camera, scene = first_look[0].again(), copy(first_look[1])
    scene.segmentation = TrueMasks(camera)
    numbers = {}
    for one in scene.objects:
        shown = np.bincount(camera.owner[one.pixels[0]] + 1, minlength=len(NAMES) + 1)
        numbers[NAMES[shown[1:].argmax()]] = one.number
        assert one.name in (NAMES[shown[1:].argmax()], "unknown")
    assert set(numbers) == set(NAMES)
    return camera, scene, numbers


def shifted(table, name, shift):
    """The same table after a thing was moved by a shift along it, (2,), metres."""
    motion = np.eye(4)
    motion[:2, 3] = shift
    return SimulatedTable(
        tuple(
            replace(thing, pose=motion @ thing.pose) if thing.name == name else thing
            for thing in table.things
        )
    )


def outwards(table, name):
    """Direction from the middle of the table to a thing, (2,)."""
    middle = next(one for one in table.things if one.name == name).placed.mean(0)[:2]
    return middle / np.linalg.norm(middle)


def test_a_moved_thing_has_both_poses_and_none_between(watched):
    camera, scene, numbers = watched
    before = {thing.name: thing for thing in scene.objects}["tuna_fish_can"]
    shift = 0.008 * outwards(camera.table, "tuna_fish_can")
    camera.change(shifted(camera.table, "tuna_fish_can", shift))
    look = scene.update(camera.frame(view(60)))
    assert [move.number for move in look.moved] == [numbers["tuna_fish_can"]]
    assert look.gone == look.appeared == ()
    (move,) = look.moved
    after = {thing.name: thing for thing in scene.objects}["tuna_fish_can"]
    assert np.array_equal(move.before, before.pose)
    assert np.array_equal(move.after, after.pose)
    assert np.allclose((after.place - before.place)[:2], shift, atol=0.005)
    assert set(after.pixels) == {1}
    assert len(scene.objects) == len(NAMES)


def test_what_stands_still_is_not_said_to_move_because_of_an_arms_errors(ycb, three):
    camera, scene = seen_once(ycb, three, moved=0.003, turned=0.3)
    # thin scissors are unknown after one view
    assert len(scene.objects) == len(three)
    assert {one.name for one in scene.objects} <= {*three, "unknown"}
    for degrees in (20, 80):
        look = scene.update(camera.frame(view(degrees)))
        assert look.taken
        assert look.moved == look.gone == look.appeared == ()


def test_a_camera_that_stands_still_needs_no_encoder_of_the_belt(ycb, three):
    camera = camera_over(list(three.values()), seed=8)
    camera.sensor = SENSORS["stereo"]
    scene = nextview.Scene(ycb, segmentation=lambda frame: camera.owner + 1)
    start = camera.table
    belt = np.eye(4)
    for number in range(3):
        belt[0, 3] = number * 0.05
        things = [replace(one, pose=belt @ one.pose) for one in start.things]
        camera.change(SimulatedTable(tuple(things)))
        frame = camera.frame(view(20))
        look = scene.update(replace(frame, camera="belt"))
        assert look.taken
        assert look.gone == ()
        if number:
            assert len(look.moved) == len(three)
            assert look.appeared == ()
    for one in scene.objects:
        true = next(thing for thing in camera.table.things if thing.name == one.name)
        middle = np.append(true.vertices.mean(0), 1)
        assert np.linalg.norm((one.pose - true.pose) @ middle) < 0.003
    assert {one.name for one in scene.objects} == set(three)


def test_a_thing_without_a_name_that_moved_keeps_its_number(ycb, three):
    chair = replace(
        sample_mesh("chair"), radius=0.09, centre=np.zeros(3), name="chair", unit="m"
    )
    camera = camera_over([*three.values(), chair], seed=8)
    camera.sensor = SENSORS["stereo"]
    scene = nextview.Scene(ycb, segmentation=lambda frame: camera.owner + 1)

    def look():
        frame = camera.frame(view(20))
        return scene.update(replace(frame, camera="fixed"))

    def shown():
        """The object that shows most of the chair."""
        last = len(scene.frames) - 1
        row = [thing.name for thing in camera.table.things].index("chair")
        return max(
            (one for one in scene.objects if last in one.pixels),
            key=lambda one: np.count_nonzero(one.pixels[last] & (camera.owner == row)),
        )

    look()
    before = shown()
    assert before.pose is None
    shift = 0.03 * outwards(camera.table, "chair")
    camera.change(shifted(camera.table, "chair", shift))
    moved = look()
    assert [(one.number, one.before) for one in moved.moved] == [(before.number, None)]
    assert moved.gone == moved.appeared == ()
    after = shown()
    assert after.number == before.number
    assert np.allclose((after.place - before.place)[:2], shift, atol=0.005)


def test_a_frame_with_nothing_new_is_not_segmented(watched):
    _, scene, _ = watched
    asked = []
    true_masks = scene.segmentation

    def counted(frame):
        asked.append(frame)
        return true_masks(frame)

    scene.segmentation = counted
    before = scene.objects
    first = scene.frames[0]
    noise = np.random.default_rng(0).normal(1, 1e-4, first.shape)
    again = first.with_depth((first.depth * noise).astype(np.float32))
    look = scene.update(again)
    assert look.taken
    assert look.appeared == look.moved == look.gone == ()
    assert not asked
    assert scene.objects is before
    assert len(scene.frames) == 1

    # but a mask asks for what is in it
    scene.update(replace(again, depth=again.depth + 1e-4, mask=again.depth > 0))
    assert len(asked) == 1
