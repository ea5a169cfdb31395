"""The object of a session among others: its pixels are parted from theirs as in a scene."""

import numpy as np
import pytest
from factories import PlacedThing, SimulatedTable, camera_over, meshes_of, view

import nextview
from nextview.errors import ObservationError
from nextview.geometry.mesh import Mesh
from nextview.segmentation.instances import Segmentation
from nextview.sensing import ObservedObject
from nextview.simulation.boxes import upright_boxes


def standing(mesh: Mesh, place) -> PlacedThing:
    """A thing on the table at (x, y), metres, as it stands in its file."""
    metres = mesh.vertices * mesh.radius + mesh.centre
    pose = np.eye(4)
    middle = (metres.min(0) + metres.max(0)) / 2
    pose[:3, 3] = place[0] - middle[0], place[1] - middle[1], -metres[:, 2].min()
    return PlacedThing(mesh.name, metres, mesh.faces, pose)


def box(sides, place) -> PlacedThing:
    """An untaught box on the table at (x, y), metres."""
    mesh = upright_boxes(np.array([sides]), np.zeros(1), np.zeros((1, 2)), 0.0)
    pose = np.eye(4)
    pose[:3, 3] = (*place, 0.0)
    return PlacedThing("box", mesh.vertices, mesh.faces, pose)


class Instances:
    """A segmentation by the truth, in which some objects are joined, and others are missed."""

    def __init__(self, camera):
        self.camera = camera
        self.joined: tuple[int, ...] = ()
        self.missed: tuple[int, ...] = ()
        self.strips = 1

    def __call__(self, frame):
        owner = self.camera.owner
        labels = np.where(np.isin(owner, self.missed), -1, owner) + 1
        columns = np.nonzero(owner == 0)[1]
        edges = np.linspace(columns.min(), columns.max() + 1, self.strips + 1)
        strip = np.digitize(np.arange(owner.shape[1]), edges[1:-1])
        labels = np.where(labels == 1, 1 + 10 * strip, labels)
        pieces = labels.copy()
        labels[np.isin(owner, self.joined)] = 1 + min(self.joined, default=0)
        return Segmentation(
            labels, surface=(owner < 0) & (frame.depth > 0), pieces=pieces
        )


def over(*things: PlacedThing):
    """A camera over things on a table, and a segmentation of its frames."""
    camera = camera_over([], seed=4)
    camera.change(SimulatedTable(tuple(things)))
    return camera, Instances(camera)


def point_on(camera, frame, number):
    """The measured point of an object that is nearest to their median."""
    own = (camera.owner == number) & (frame.depth > 0)
    points = frame.positions(*np.nonzero(own))
    away = np.linalg.norm(points - np.median(points, 0), axis=1)
    return points[away.argmin()]


def begun(system, camera, instances, number, degrees=60):
    """A session with a first frame, asked for the object of the table at a point on it."""
    frame = camera.frame(view(degrees))
    thing = ObservedObject(
        point=point_on(camera, frame, number), segmentation=instances
    )
    session = system.session(object=thing, distance=0.5)
    session.update(frame)
    return session


def share_of(session, camera, number):
    """Share of an object's pixels in the last frame that show a thing of the table."""
    mask = session.object.sightings[-1].mask
    return np.mean(camera.owner[mask] == number)


@pytest.fixture(scope="module")
def block_and_box():
    block = meshes_of(("wood_block",))["wood_block"]
    return standing(block, (0, 0)), box((0.05, 0.05, 0.06), (0.07, 0.0))


@pytest.fixture(scope="module")
def never_sure():
    """A system whose sessions do not end with a first confident view."""
    return nextview.load("ycb", threads=1, threshold=1.0)


def test_a_stranger_is_not_named_as_the_taught_thing_that_it_touches(
    ycb, block_and_box
):
    camera, instances = over(*block_and_box)
    session = begun(ycb, camera, instances, 1)
    assert share_of(session, camera, 1) > 0.9
    assert session.result.answer != "wood_block"


def test_a_known_object_keeps_its_pixels_where_a_later_frame_joins_it_with_another(
    never_sure, block_and_box
):
    camera, instances = over(*block_and_box)
    session = begun(never_sure, camera, instances, 0)
    assert session.result.answer == "wood_block"
    instances.joined = (0, 1)
    session.update(camera.frame(view(20)))
    assert share_of(session, camera, 0) > 0.95


def test_another_object_is_not_taken_for_the_known_one_that_it_hides(
    never_sure, block_and_box
):
    camera, instances = over(*block_and_box)
    session = begun(never_sure, camera, instances, 0)
    instances.missed = (0,)
    with pytest.raises(ObservationError, match="nothing of the object known so far"):
        session.update(camera.frame(view(110)))
    assert len(session.views) == 1


@pytest.mark.long
def test_a_thing_that_is_cut_into_seven_strips_is_found_whole(ycb, block_and_box):
    block, _ = block_and_box
    camera, instances = over(block)
    instances.strips = 7
    session = begun(ycb, camera, instances, 0)
    sighting = session.object.sightings[0]
    scene = nextview.Scene(ycb, segmentation=instances)
    scene.update(sighting.frame_as_given)
    assert session.result.answer == "wood_block"
    assert [one.name for one in scene.objects] == ["wood_block"]
    whole = np.count_nonzero(camera.owner == 0)
    assert np.count_nonzero(sighting.mask) > 0.9 * whole


def test_a_point_on_a_thing_that_is_joined_with_a_large_one_finds_the_thing(
    ycb, block_and_box
):
    block, _ = block_and_box
    camera, instances = over(block, box((0.02, 0.03, 0.04), (0.065, 0.0)))
    instances.joined = (0, 1)
    session = begun(ycb, camera, instances, 1, degrees=20)
    assert share_of(session, camera, 1) > 0.8
    assert session.result.answer != "wood_block"
