"""Which pixels are one thing: small pictures, planes, regions that are joined, edges, own masks."""

import numpy as np
import pytest
from factories import camera_over, view

from nextview.errors import ObservationError
from nextview.scene.scene import Scene
from nextview.segmentation.features import shrink
from nextview.segmentation.instances import LearnedSegmenter, instances_of
from nextview.segmentation.network import AFFINITY_STEPS as STEPS
from nextview.segmentation.parting import pair_slices, part
from nextview.sensing.frame import Frame

INTRINSICS = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def level_frame(depth):
    """A frame of a camera with the principal point in the middle."""
    height, width = depth.shape
    return Frame(
        depth, np.array([[500.0, 0, width / 2], [0, 500, height / 2], [0, 0, 1]])
    )


def output_of(labels, strength=6.0):
    """What a network without doubts would say of labelled pixels; 0 is a surface."""
    output = np.zeros((3 + len(STEPS), *labels.shape), np.float32)
    output[1] = np.where(labels == 0, strength, -strength)
    output[2] = -output[1]
    for channel, step in zip(output[3:], STEPS, strict=True):
        first, second = pair_slices(labels.shape, *step)
        same = (labels[first] == labels[second]) & (labels[first] > 0)
        channel[first] = np.where(same, strength, -strength)
    return output


def same_partition(one, other):
    """Whether two pictures part their pixels in the same way, whatever the numbers."""
    pairs = set(zip(one.ravel().tolist(), other.ravel().tolist(), strict=True))
    return len(pairs) == len(np.unique(one)) == len(np.unique(other))


def test_touching_things_are_parted():
    labels = np.zeros((40, 60), int)
    labels[5:20, 5:20] = 1
    labels[5:20, 20:40] = 2
    labels[25:35, 10:50] = 3
    found = part(output_of(labels), np.ones(labels.shape, bool))
    assert same_partition(found, labels)


def test_parts_of_one_thing_behind_another_are_joined():
    labels = np.zeros((40, 60), int)
    labels[10:30, 5:55] = 1
    labels[5:38, 27:33] = (
        2  # a bar of six columns before it: only far pairs reach over it
    )
    found = part(output_of(labels), np.ones(labels.shape, bool))
    assert same_partition(found, labels)


def test_masks_and_labels_say_the_same():
    frame = level_frame(np.ones((48, 64), np.float32))
    masks = np.zeros((2, 48, 64), bool)
    masks[0, :10] = True
    masks[1, 20:40, 5:60] = True
    for given in (masks, list(masks), masks[0] + 2 * masks[1].astype(np.int32)):
        np.testing.assert_array_equal(
            instances_of(lambda frame, given=given: given, frame).masks, masks
        )


@pytest.mark.parametrize(
    "given",
    [
        np.zeros((47, 64), int),
        np.zeros((2, 64, 48), bool),
        np.zeros((48, 64)),
        None,
        "cup",
    ],
)
def test_an_invalid_own_segmentation_is_rejected(given):
    frame = level_frame(np.ones((48, 64), np.float32))
    with pytest.raises(ObservationError):
        instances_of(lambda frame: given, frame)


def _labels_with(none, beside):
    labels = np.full((48, 64), none)
    labels[10:20, 10:20] = beside
    return labels


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (np.ones((1, 48, 64), bool), "covers the whole image"),
        (np.full((48, 64), 7), "covers the whole image"),
        (_labels_with(255, 3), "seem to be 255 there"),
        (_labels_with(-1, 0), "seem to be -1 there"),
    ],
)
def test_background_that_is_taken_for_a_thing_is_told(given, sentence):
    frame = level_frame(np.ones((48, 64), np.float32))
    with pytest.raises(ObservationError, match=sentence):
        instances_of(lambda frame: given, frame)


def test_a_learned_segmenter_separates_things_and_surfaces(monkeypatch):
    depth = np.full((480, 640), 1.0, np.float32)
    depth[101:303, 203:407] = 0.8  # no multiple of the factor
    frame = Frame(depth, INTRINSICS)
    thing = shrink(frame.depth, frame.rays).depth < 0.9
    output = np.full((3 + len(STEPS), *thing.shape), 3.0, np.float32)
    output[:3] = [np.zeros(thing.shape), ~thing, thing]

    name = "nextview.segmentation.instances._loaded"
    monkeypatch.setattr(name, lambda card: lambda features: output)
    found = LearnedSegmenter("any.json")(frame)
    np.testing.assert_array_equal(found.labels > 0, depth < 0.9)
    np.testing.assert_array_equal(found.surface, depth > 0.9)


def test_a_scene_takes_masks_of_your_own(ycb, ycb_meshes):
    names = ["cracker_box", "tomato_soup_can"]
    camera = camera_over([ycb_meshes[name] for name in names], gap=0.0)
    asked = []

    def true_masks(frame):
        asked.append(frame)
        return camera.owner + 1

    scene = Scene(ycb, segmentation=true_masks)
    frame = camera.frame(view(20))
    scene.update(frame)
    assert asked == [frame]
    assert sorted(thing.name for thing in scene.objects) == names
    for thing in scene.objects:
        own = camera.owner == names.index(thing.name)
        (mask,) = thing.pixels.values()
        other = (camera.owner >= 0) & ~own
        assert not (mask & other).any()  # nothing was joined with its neighbour
        assert (mask & ~own).sum() < 0.05 * own.sum()  # the table at its foot
        assert mask.sum() > 0.8 * own.sum()


def test_a_scene_refuses_masks_of_another_frame(ycb, ycb_meshes):
    camera = camera_over([ycb_meshes["mug"]])
    scene = Scene(ycb, segmentation=lambda frame: np.zeros((4, 4), int))
    with pytest.raises(ObservationError):
        scene.update(camera.frame(view(20)))
    assert scene.frames == ()


def test_the_bundled_network_parts_things_that_stand_apart(ycb_meshes):
    names = ["cracker_box", "tomato_soup_can", "mug"]
    camera = camera_over([ycb_meshes[name] for name in names])
    found = LearnedSegmenter()(camera.frame(view(20)))
    for number in range(len(names)):
        own = camera.owner == number
        there = found.labels[own]
        best = np.bincount(there[there > 0]).argmax()
        both = (found.labels == best) & own
        assert both.sum() > 0.8 * ((found.labels == best) | own).sum()
    ground = (camera.owner < 0) & (camera.frame(view(20)).depth > 0)
    assert found.surface[ground].mean() > 0.9
