"""A segmentation that tells surfaces: which of them carries what, in scenes and sessions.

Truths are of the worlds that are looked at: the true pixels of things and of surfaces, and the
true heights of these.
"""

import numpy as np
import pytest
from labelled_worlds import FLOOR, LabelledCamera, drawn

from nextview.scene.scene import Scene
from nextview.segmentation.instances import instances_of
from nextview.sensing import ObservedObject
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


def middle_of(solids, number):
    """Of the box around a thing, (3,), world, metres."""
    (vertices,) = (solid[0] for solid, label in solids if label == number)
    return (vertices.min(0) + vertices.max(0)) / 2


def test_an_object_without_support_is_not_confident(ycb, table_and_distant_box):
    camera = LabelledCamera(table_and_distant_box)
    pose = looking_at((0, 0, TABLE + 0.03), 0, elevation=25, distance=0.9)
    point = middle_of(table_and_distant_box, 4)
    thing = ObservedObject(point=point, segmentation=camera.truth)
    session = ycb.session(object=thing)
    view = session.update(camera.frame(pose))
    assert "support" in [warning.name for warning in view.warnings]
    assert not session.result.confident
