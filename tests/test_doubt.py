"""What is believed and still not confident: "this thing in this pose" is in doubt."""

import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from factories import (
    PlacedThing,
    SimulatedTable,
    TableCamera,
    camera_over,
    meshes_of,
    view,
)

import nextview
from nextview.data.samples import sample_mesh
from nextview.errors import ModelError, UsageError
from nextview.geometry.mesh import Mesh, make_mesh
from nextview.recognition.model_card import Symmetry
from nextview.recognition.protocol import JointBelief
from nextview.sensing import ObservedObject
from nextview.simulation.sensor import SENSORS
from nextview.simulation.simulated import SimulatedCamera
from nextview.things.doubt import unknown_turn

NAMES = ("chair", "table")


def stretched(name: str, *factors: float) -> Mesh:
    """A thing that no memory was taught: one of the bundled things, stretched along its axes."""
    known = meshes_of([name])[name]
    return make_mesh(known.vertices * known.radius * factors, known.faces, "new", "m")


def the_object(
    system,
    mesh,
    elevation=50.0,
    distance=0.65,
    degrees=20.0,
    sensor="stereo",
):
    """The largest object that a scene finds where a thing stands on a table."""
    scene = nextview.Scene(system)
    scene.update(
        camera_over([mesh], sensor=sensor).frame(view(degrees, elevation, distance))
    )
    return max(scene.objects, key=lambda thing: thing.pixels[0].sum())


@pytest.mark.parametrize(
    ("factors", "seen_from", "doubt"),
    [
        # A can that is a tenth lower: where its lid is, the known one would stand in the table.
        (("master_chef_can", 1, 1, 0.9), {}, r"reach 1\d mm below the ground"),
        # A box that is a seventh lower: the known one would stand in the table as well.
        (("cracker_box", 1, 1, 0.85), {}, r"reach 3\d mm below the ground"),
        # A can that is a seventh wider: no pose of the known one is as wide.
        (("master_chef_can", 1.15, 1.15, 1), {}, "fits better if it is stretched"),
        # A mug whose handle is behind it.
        (
            ("mug", 1, 1, 1),
            {"elevation": 30.0, "degrees": 40.0},
            r"orientation is known to ± [3-6]\d° only",
        ),
        # A ball far away looks like any small thing.
        (("golf_ball", 1, 1, 1), {"distance": 1.0}, r"only 2\d\d pixels show it"),
    ],
)
def test_a_name_is_not_confident_where_the_thing_in_its_pose_is_in_doubt(
    ycb,
    factors,
    seen_from,
    doubt,
):
    found = the_object(ycb, stretched(*factors), **seen_from)
    assert found.confidence > 0.8
    assert not found.confident
    assert re.search(doubt, found.result.doubt)
    assert found.result.doubt in repr(found.result)


def odds_of_stranger(ycb, found):
    """The log-odds behind the doubt, by the things that a scene compares with."""
    result = found.result
    observations = [view.observation for view in result.views]
    things = ycb.models.recogniser.things
    return things.log_odds_of_stranger(observations, result.views[-1].joint.found)


@pytest.mark.parametrize("sensor", ["none", "stereo", "kinect"])
@pytest.mark.parametrize(
    ("name", "wider"),
    [("master_chef_can", (1.15, 1.15, 1)), ("sugar_box", (1, 1.2, 1.1))],
)
def test_a_thing_of_another_size_is_a_stranger_however_noisy_the_camera(
    ycb,
    name,
    wider,
    sensor,
):
    itself = the_object(ycb, stretched(name, 1, 1, 1), sensor=sensor)
    assert (itself.name, itself.result.doubt) == (name, "")
    assert odds_of_stranger(ycb, itself) < -2  # seven times as likely as a stranger

    stranger = the_object(ycb, stretched(name, *wider), sensor=sensor)
    assert not stranger.confident
    assert odds_of_stranger(ycb, stranger) > 2


@pytest.mark.parametrize("height", [0.02, 0.05])
def test_an_object_on_another_thing_does_not_extend_to_the_ground(ycb, height):
    box = trimesh.creation.box([0.16, 0.2, height])
    corners = np.add(box.vertices, [0, 0, height / 2])
    tray = PlacedThing("tray", corners, box.faces.astype(np.int32), np.eye(4))
    can = SimulatedTable.draw(
        list(meshes_of(["master_chef_can"]).values()),
        np.random.default_rng(0),
    ).things[0]
    lifted = can.pose.copy()
    lifted[:3, 3] += [0, 0, height]
    table = SimulatedTable((tray, replace(can, pose=lifted)))
    camera = TableCamera(table, SENSORS["stereo"], np.random.default_rng(3))
    frame = camera.frame(view(20.0, 45.0, 0.65))

    observation = ObservedObject().add(frame.with_mask(camera.owner == 1))
    things = ycb.models.recogniser.things
    found = things([observation])
    assert things.names[found.belief.argmax()] == "master_chef_can"
    assert things.log_odds_of_stranger([observation], found) < -2


@pytest.mark.parametrize("name", ["master_chef_can", "cracker_box"])
def test_the_things_themselves_are_confident(ycb, name):
    found = the_object(ycb, stretched(name, 1, 1, 1))
    assert (found.name, found.confident, found.result.doubt) == (name, True, "")


def test_a_place_in_the_world_is_as_uncertain_as_the_place_of_the_camera(ycb):
    exact = nextview.load("ycb", threads=1, camera_accuracy=(0.5, 0.0))
    mesh = stretched("cracker_box", 1, 1, 1)
    usual = the_object(ycb, mesh, distance=0.65).pose_uncertainty.millimetres
    known = the_object(exact, mesh, distance=0.65).pose_uncertainty.millimetres
    # Along each of three axes 3 mm, and 0.34 degrees at 0.65 m; and 0.5 mm.
    aim = 650 * np.radians(0.344)
    assert usual**2 - known**2 == pytest.approx(3 * (3**2 + aim**2 - 0.5**2), rel=0.15)


@pytest.mark.parametrize("wrong", [3.0, (1.0,), (-1.0, 0.1), (1.0, np.nan), "ab"])
def test_the_accuracy_of_cameras_is_two_lengths_of_errors(wrong):
    with pytest.raises(UsageError, match="the accuracy of the cameras"):
        nextview.load("ycb", threads=1, camera_accuracy=wrong)


def test_the_accuracy_of_cameras_says_nothing_of_classes():
    with pytest.raises(ModelError, match="taught things of known geometry alone"):
        nextview.load(threads=1, camera_accuracy=(1.0, 0.1))


@pytest.mark.parametrize(
    ("order", "degrees"), [(1, 30), (2, 30), (4, 19.49), (6, 12.99)]
)
def test_an_orientation_is_unknown_from_a_share_of_what_it_can_be_off(order, degrees):
    # Spread evenly over +-180 degrees / order, it has that limit over the square root of three.
    symmetries = [Symmetry((0.0, 0.0, 1.0), order)] if order > 1 else []
    spread = np.linspace(-180 / order, 180 / order, 100_001)
    found = unknown_turn(symmetries)
    assert found == pytest.approx(degrees, abs=0.01)
    assert found == pytest.approx(min(30, 0.75 * spread.std()), abs=0.01)


class Doubtful:
    """Believes at once, and says why that is no reason to act."""

    classes = NAMES
    reason = "it is too dark"

    def belief(self, observations):
        return JointBelief(np.array([0.999, 0.001]), doubt=self.reason)


def test_a_doubt_of_ones_own_recogniser_holds_a_session_and_a_scene():
    system = nextview.load(recogniser=Doubtful(), threads=1, max_views=3)
    result = system.recognise(SimulatedCamera(sample_mesh("chair")))
    assert (len(result.views), result.confident) == (3, False)
    assert result.doubt == "it is too dark"
    found = the_object(system, stretched("mug", 1, 1, 1))
    assert (found.name, found.confident) == ("chair", False)

    sure = type("Sure", (Doubtful,), {"reason": ""})()
    system = replace(system, models=nextview.load(recogniser=sure).models)
    assert system.recognise(SimulatedCamera(sample_mesh("chair"))).confident
    assert the_object(system, stretched("mug", 1, 1, 1)).confident
