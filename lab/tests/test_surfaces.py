"""A segmentation that tells surfaces: which of them carries what, in scenes and sessions.

Truths are of the worlds that are looked at: the true pixels of things and of surfaces, and the
true heights of these.
"""

import numpy as np
import pytest
from labelled_worlds import FLOOR, LabelledCamera, box_bin, drawn

from nextview.errors import ObservationError, UsageError
from nextview.scene.scene import Scene
from nextview.segmentation.instances import Segmentation, instances_of
from nextview.sensing import Box, Frame, ObservedObject
from nextview.sensing.segmented_frame import segmented_frame
from nextview_lab.worlds.tables import poses_around
from nextview_lab.worlds.worlds import SURFACE, slab

UP = np.array([0.0, 0.0, 1.0])
TABLE = 0.75  # metres, height of its top


def looking_at(place, degrees=20.0, elevation=40.0, distance=0.8):
    """A camera-to-world pose, (4, 4)."""
    azimuth = np.radians([degrees])
    return poses_around(azimuth, np.radians(elevation), distance, np.array(place))[0]


def height_of(plane):
    """Of a nearly level plane over the world's origin, metres."""
    return -plane.offset / plane.normal[2]


def supports_of(camera, frame, up=UP):
    """What a frame of a labelled camera truly shows of surfaces."""
    truth = instances_of(camera.truth, frame)
    return segmented_frame(frame, truth, up)


@pytest.fixture(scope="module")
def small_table(ycb_meshes):
    """Three things on a table of 34 cm, far above a floor that fills the picture."""
    meshes = [ycb_meshes[name] for name in ("cracker_box", "mug", "banana")]
    top = (slab((0.34, 0.34, 0.03), (0, 0), 0.45), SURFACE)
    return [FLOOR, top, *drawn(meshes, 3, 0.03, (0, 0, 0.45))]


@pytest.fixture(scope="module")
def bin_of_things(ycb_meshes):
    """Three things in a bin on a table above a floor."""
    meshes = [ycb_meshes[name] for name in ("mug", "banana", "tomato_soup_can")]
    top = (slab((1.2, 1.0, 0.03), (0, 0), TABLE), SURFACE)
    things = drawn(meshes, 5, 0.02, (0, 0, TABLE + 0.006))
    return [FLOOR, top, *box_bin(0.17, 0.12, TABLE), *things]


@pytest.fixture(scope="module")
def table_and_distant_box(ycb_meshes):
    """Four things on a table, and a box that nothing holds, as high, behind it."""
    meshes = [ycb_meshes[name] for name in sorted(ycb_meshes)]
    box = ycb_meshes["cracker_box"]
    far = box.vertices * box.radius + np.array([-1.1, 0.0, TABLE + 0.15])
    top = (slab((1.2, 1.0, 0.03), (0, 0), TABLE), SURFACE)
    return [top, *drawn(meshes, 5, 0.05, (0, 0, TABLE)), ((far, box.faces), 4)]


def true_owner(camera, thing):
    """Which thing most pixels of an object of a scene truly show."""
    (mask,) = thing.pixels.values()
    values, counts = np.unique(camera.owner[mask], return_counts=True)
    return int(values[counts.argmax()])


@pytest.mark.parametrize("posed", [True, False])
def test_a_small_table_carries_things_though_the_floor_has_more_pixels(
    ycb, small_table, posed
):
    camera = LabelledCamera(small_table)
    frame = camera.frame(looking_at((0, 0, 0.45), distance=0.9), posed)
    assert (camera.owner == SURFACE).mean() > 0.8

    scene = Scene(ycb, segmentation=camera.truth)
    scene.update(frame)
    assert len(scene.objects) == 3
    named = {true_owner(camera, thing): thing for thing in scene.objects}
    assert named[0].name == "cracker_box"
    assert named[0].confidence > 0.9
    if posed:
        assert height_of(scene.tops[0].plane) == pytest.approx(0.45, abs=0.01)


def test_all_levels_are_found_and_each_carries_its_own(small_table, ycb_meshes):
    below = drawn([ycb_meshes["tomato_soup_can"]], 1, base=(0.45, 0.35, 0), first=3)
    camera = LabelledCamera([*small_table, *below])
    frame = camera.frame(looking_at((0.1, 0.1, 0.3), distance=1.3))
    supports = supports_of(camera, frame)
    heights = sorted(height_of(level.plane) for level in supports.levels)
    assert heights == pytest.approx([0, 0.45], abs=0.01)

    numbers = np.unique(camera.owner[camera.owner >= 0])
    carried = dict(zip(numbers, supports.carriers, strict=True))
    assert height_of(carried[3].plane) == pytest.approx(0, abs=0.01)
    for number in (0, 1, 2):
        assert height_of(carried[number].plane) == pytest.approx(0.45, abs=0.01)


@pytest.mark.parametrize("posed", [True, False])
def test_a_bin_does_not_swallow_its_parts(ycb, bin_of_things, posed):
    camera = LabelledCamera(bin_of_things)
    frame = camera.frame(looking_at((0, 0, TABLE + 0.03), elevation=60), posed)
    scene = Scene(ycb, segmentation=camera.truth)
    scene.update(frame)
    names = {true_owner(camera, thing): thing.name for thing in scene.objects}
    assert names == {0: "mug", 1: "banana", 2: "tomato_soup_can"}


def test_objects_without_a_visible_support_are_ignored(ycb, table_and_distant_box):
    camera = LabelledCamera(table_and_distant_box)
    frame = camera.frame(
        looking_at((0, 0, TABLE + 0.03), 0, elevation=25, distance=0.9)
    )
    assert (camera.owner == 4).sum() > 1000

    scene = Scene(ycb, segmentation=camera.truth)
    look = scene.update(frame)
    owners = sorted(true_owner(camera, thing) for thing in scene.objects)
    assert owners == [0, 1, 2, 3]
    assert [one.name for one in scene.remarks] == ["left out"]
    assert "1 thing" in look.warnings[-1].message
    assert all(warning.name != "unexplained" for warning in look.warnings)

    scene = Scene(ycb, segmentation=lambda _: (camera.owner == 4)[None])
    look = scene.update(frame)
    assert not scene.objects
    assert "empty" not in [warning.name for warning in look.warnings]


def test_further_views_keep_to_the_ground(ycb, small_table):
    camera = LabelledCamera(small_table)
    scene = Scene(ycb, segmentation=camera.truth)
    for degrees in (20, 140):
        pose = looking_at((0, 0, 0.45), degrees, distance=1.0)
        look = scene.update(camera.frame(pose))
        assert look.taken
        assert height_of(scene.tops[-1].plane) == pytest.approx(0.45, abs=0.01)
    names = [thing.name for thing in scene.objects]
    assert sorted(names) == ["banana", "cracker_box", "mug"]


def test_depth_along_the_rays_is_refused(ycb, bin_of_things):
    camera = LabelledCamera(bin_of_things, sensor="none")
    frame = camera.frame(looking_at((0, 0, TABLE), elevation=60))
    x, y = frame.rays
    along = frame.depth * np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)
    scene = Scene(ycb, segmentation=camera.truth)
    with pytest.raises(ObservationError, match=r"range"):
        scene.update(frame.with_depth(along.astype(np.float32)))


@pytest.mark.parametrize("surface", [np.ones((4, 4), bool), np.ones((48, 64), int)])
def test_a_surface_of_another_form_is_refused(surface):
    intrinsics = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    frame = Frame(np.ones((48, 64), np.float32), intrinsics)
    given = Segmentation(np.zeros((48, 64), int), surface)
    with pytest.raises(ObservationError, match=r"surface"):
        instances_of(lambda frame: given, frame)


def test_a_thing_is_no_surface():
    intrinsics = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    frame = Frame(np.ones((48, 64), np.float32), intrinsics)
    labels = np.zeros((48, 64), int)
    labels[:10] = 1
    given = Segmentation(labels, np.ones((48, 64), bool))
    found = instances_of(lambda frame: given, frame)
    np.testing.assert_array_equal(found.surface, ~found.masks[0])


def middle_of(solids, number):
    """Of the box around a thing, (3,), world, metres."""
    (vertices,) = (solid[0] for solid, label in solids if label == number)
    return (vertices.min(0) + vertices.max(0)) / 2


@pytest.mark.parametrize(("number", "name"), [(0, "mug"), (2, "tomato_soup_can")])
def test_a_point_chooses_an_instance(ycb, bin_of_things, number, name):
    camera = LabelledCamera(bin_of_things)
    point = middle_of(bin_of_things, number)
    session = ycb.session(
        object=ObservedObject(point=point, segmentation=camera.truth), distance=0.6
    )
    session.update(camera.frame(looking_at((0, 0, TABLE), elevation=60)))
    (sighting,) = session.object.sightings
    own = camera.owner == number
    assert not (sighting.mask & ~own).any()
    assert sighting.mask.sum() > 0.8 * own.sum()
    assert height_of(sighting.plane) == pytest.approx(TABLE + 0.003, abs=0.006)
    if not session.done:
        session.update(camera.frame(looking_at((0, 0, TABLE), 110, elevation=60)))
    assert session.result.answer == name


def test_a_box_and_the_aim_choose_an_instance(ycb, small_table):
    camera = LabelledCamera(small_table)
    vertices = small_table[2][0][0]
    box = Box(vertices.min(0) - 0.005, vertices.max(0) + 0.005)
    pose = looking_at(middle_of(small_table, 0), distance=1.0)
    for chosen in ({"box": box}, {}):
        thing = ObservedObject(segmentation=camera.truth, **chosen)
        session = ycb.session(object=thing)
        session.update(camera.frame(pose))
        (sighting,) = session.object.sightings
        assert (camera.owner[sighting.mask] == 0).mean() > 0.95
        assert height_of(sighting.plane) == pytest.approx(0.45, abs=0.01)
        assert session.result.answer == "cracker_box"


def test_an_object_without_support_is_not_confident(ycb, table_and_distant_box):
    camera = LabelledCamera(table_and_distant_box)
    pose = looking_at((0, 0, TABLE + 0.03), 0, elevation=25, distance=0.9)
    point = middle_of(table_and_distant_box, 4)
    thing = ObservedObject(point=point, segmentation=camera.truth)
    session = ycb.session(object=thing)
    view = session.update(camera.frame(pose))
    assert "support" in [warning.name for warning in view.warnings]
    assert not session.result.confident


def test_an_object_has_its_own_segmentation(ycb):
    with pytest.raises(UsageError, match=r"its own segmentation"):
        ycb.session(object=ObservedObject(), segmentation=lambda frame: None)
