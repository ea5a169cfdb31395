"""All things on a table: found, named and placed in one frame or several, and what goes wrong."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

import nextview
from nextview.errors import ObservationError
from nextview.geometry.mesh import make_mesh
from nextview.sensing.frame import Frame
from nextview.simulation.sensor import SENSORS
from nextview.simulation.tables import SimulatedTable, TableCamera, poses_around
from nextview.things.memory import open_memory

NAMES = ("cracker_box", "mug", "banana", "tomato_soup_can")
CENTRE = np.array([0, 0, 0.03])


@pytest.fixture(scope="module")
def system():
    return nextview.load("ycb", threads=1)


@pytest.fixture(scope="module")
def meshes():
    card, memory = open_memory("ycb")
    names = [thing.name for thing in card.memory.things]

    def mesh(name):
        surface = memory.surfaces.surface(names.index(name), name)
        return make_mesh(surface.vertices.astype(float), surface.faces, name, "m")

    return {name: mesh(name) for name in NAMES}


def camera_over(meshes, seed=5, sensor="stereo", gap=0.08) -> TableCamera:
    rng = np.random.default_rng(seed)
    return TableCamera(SimulatedTable.draw(meshes, rng, gap), SENSORS[sensor], rng)


def view(degrees, elevation=50.0, distance=0.65) -> np.ndarray:
    return poses_around(np.radians([degrees]), np.radians(elevation), distance, CENTRE)[0]


def by_name(scene) -> dict:
    return {thing.name: thing for thing in scene.objects}


def without(table: SimulatedTable, name: str) -> SimulatedTable:
    return SimulatedTable(tuple(thing for thing in table.things if thing.name != name))


def test_all_things_are_found_named_and_placed_in_one_frame(system, meshes):
    camera = camera_over(list(meshes.values()))
    scene = nextview.Scene(system)
    look = scene.update(camera.frame(view(20)))
    assert look.taken
    assert len(look.appeared) == len(NAMES)

    found = by_name(scene)
    assert set(found) == set(NAMES)
    for number, thing in enumerate(camera.table.things):
        true = camera.owner == number
        mask = found[thing.name].pixels[0]
        assert (mask & true).sum() > 0.75 * (mask | true).sum()

        pose = found[thing.name].pose
        placed = thing.vertices @ pose[:3, :3].T + pose[:3, 3]
        diameter = np.linalg.norm(np.ptp(thing.placed, axis=0))
        add_s = cKDTree(placed).query(thing.placed)[0].mean()
        assert add_s < 0.1 * diameter


def test_objects_keep_their_numbers_from_frame_to_frame(system, meshes):
    camera = camera_over(list(meshes.values()), sensor="wrist")
    scene = nextview.Scene(system)
    scene.update(camera.frame(view(20)))
    before = {name: thing.number for name, thing in by_name(scene).items()}
    look = scene.update(camera.frame(view(110)))
    assert look.appeared == look.moved == look.gone == ()
    assert {name: thing.number for name, thing in by_name(scene).items()} == before
    for thing, shown in zip(camera.table.things, camera.shown, strict=True):
        if shown > 500:
            assert set(by_name(scene)[thing.name].pixels) == {0, 1}


def test_an_empty_table_is_said_to_be_empty(system):
    camera = camera_over([])
    scene = nextview.Scene(system)
    look = scene.update(camera.frame(view(20)))
    assert scene.objects == ()
    assert [warning.name for warning in look.warnings] == ["empty"]


def test_a_frame_without_a_plane_is_refused(system):
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.4, 3.0, (240, 320)).astype(np.float32)
    scene = nextview.Scene(system)
    with pytest.raises(ObservationError, match="no support plane"):
        scene.update(Frame(depth, [[300, 0, 160], [0, 300, 120], [0, 0, 1]], view(20)))
    assert scene.frames == ()


def test_a_second_frame_needs_a_pose(system, meshes):
    camera = camera_over([meshes["mug"]])
    scene = nextview.Scene(system)
    frame = camera.frame(view(20))
    scene.update(replace(frame, pose=None, pixel_centre=0.5))
    assert by_name(scene)["mug"].result.pose_frame == "camera"
    with pytest.raises(ObservationError, match="needs a pose"):
        scene.update(frame)


def test_strangers_are_unknown_and_their_size_is_told(system):
    ring = trimesh.creation.torus(0.06, 0.022)
    stranger = make_mesh(ring.vertices, ring.faces, "ring", "m")
    camera = camera_over([stranger])
    scene = nextview.Scene(system)
    for degrees in (20, 110):
        scene.update(camera.frame(view(degrees)))
    (thing,) = scene.objects
    assert thing.name == "unknown"
    assert thing.pose is None
    true = np.ptp(camera.table.things[0].placed, axis=0)
    assert thing.size[2] == pytest.approx(true[2], abs=0.01)
    assert np.linalg.norm(thing.place[:2] - camera.table.things[0].placed.mean(0)[:2]) < 0.02


def test_a_thing_that_was_taken_away_is_gone(system, meshes):
    camera = camera_over(list(meshes.values()))
    scene = nextview.Scene(system)
    scene.update(camera.frame(view(20)))
    mug = by_name(scene)["mug"].number
    camera.change(without(camera.table, "mug"))
    look = scene.update(camera.frame(view(80)))
    assert look.gone == (mug,)
    assert set(by_name(scene)) == set(NAMES) - {"mug"}


def test_a_thing_that_was_moved_stays_itself(system, meshes):
    camera = camera_over([meshes["cracker_box"], meshes["mug"]])
    scene = nextview.Scene(system)
    scene.update(camera.frame(view(20)))
    before = by_name(scene)["mug"]
    shift = np.eye(4)
    middle = camera.table.things[1].placed.mean(0)
    shift[:2, 3] = 0.15 * middle[:2] / np.linalg.norm(middle[:2])
    moved = [
        replace(thing, pose=shift @ thing.pose) if thing.name == "mug" else thing
        for thing in camera.table.things
    ]
    camera.change(SimulatedTable(tuple(moved)))
    look = scene.update(camera.frame(view(50)))
    assert look.moved == (before.number,)
    after = by_name(scene)["mug"]
    assert after.number == before.number
    assert np.allclose(after.place - before.place, shift[:3, 3], atol=0.01)


@pytest.mark.parametrize("wrong", ["shifted", "turned"])
def test_a_frame_with_a_wrong_pose_is_left_out(system, meshes, wrong):
    camera = camera_over(list(meshes.values()))
    scene = nextview.Scene(system)
    scene.update(camera.frame(view(20)))
    before = {thing.number: thing.place for thing in scene.objects}
    frame = camera.frame(view(80))
    pose = frame.pose.copy()
    if wrong == "shifted":
        pose[:2, 3] += 0.15
    else:
        pose = view(130) @ np.linalg.inv(view(80)) @ pose
    look = scene.update(replace(frame, pose=pose, pixel_centre=0.5))
    assert not look.taken
    assert [warning.name for warning in look.warnings] == ["pose"]
    assert {thing.number: thing.place for thing in scene.objects}.keys() == before.keys()

    assert scene.update(frame).taken
    assert set(by_name(scene)) == set(NAMES)
