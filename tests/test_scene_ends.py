"""When a scene is empty, and when it is done."""

from copy import copy

import numpy as np
import pytest
from factories import camera_over, meshes_of, view

import nextview
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import Box

K = [[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]
FROM_ABOVE = np.diag([1.0, -1, -1, 1])
FROM_ABOVE[2, 3] = 0.8
HOLE = (slice(160, 320), slice(240, 420))  # rows and columns of a bin in the plane


def from_above(depth: np.ndarray) -> Frame:
    """A frame of a camera that looks straight down on the plane z = 0 from 0.8 m."""
    noise = np.random.default_rng(1).normal(0, 0.0008, depth.shape)
    return Frame((depth + noise).astype(np.float32), K, FROM_ABOVE)


def sunk_bin(parts: bool) -> Frame:
    """A chute whose bottom slopes down below the plane around it, with or without parts in it."""
    depth = np.full((480, 640), 0.8)
    depth[HOLE] = np.linspace(0.84, 0.95, 180)
    for row in (190, 250) if parts else ():
        for column in (265, 330, 380):
            depth[row : row + 30, column : column + 25] -= 0.02
    return from_above(depth)


def names(look) -> list[str]:
    return [warning.name for warning in look.warnings]


def around(depth: float) -> Box:
    """The place of the bin, from a depth below the plane to a little above it."""
    return Box([-0.12, -0.12, -depth], [0.15, 0.12, 0.03])


@pytest.mark.parametrize("parts", [True, False])
def test_a_bin_below_the_plane_is_not_empty(ycb, parts):
    """What lies in the region, below what is taken for the ground, is no object yet."""
    scene = nextview.Scene(ycb, region=around(0.15))
    for _ in range(2):
        frame = sunk_bin(parts)
        depth = frame.depth + 1e-5 * len(scene.frames)
        look = scene.update(Frame(depth, K, FROM_ABOVE))
    assert "unexplained" in names(look)
    assert "empty" not in names(look)
    assert not scene.done
    assert scene.open
    assert any("neither ground nor an object" in one.why for one in scene.open)
    assert scene.target is not None


def test_what_the_empty_place_shows_is_known(ycb):
    empty = sunk_bin(False)
    scene = nextview.Scene(ycb, region=around(0.15), background=empty)
    look = scene.update(Frame(empty.depth + 1e-5, K, FROM_ABOVE))
    assert scene.objects == ()
    assert "unexplained" not in names(look)
    look = scene.update(sunk_bin(True))
    assert scene.objects or "unexplained" in names(look)


@pytest.fixture(scope="module")
def first_look(ycb):
    """A camera over a box and a plate, and a scene that has taken one low frame of it."""
    camera = camera_over(list(meshes_of(["cracker_box", "plate"]).values()), seed=1)
    scene = nextview.Scene(ycb, segmentation=lambda frame: camera.owner + 1)
    assert scene.open == ()
    scene.update(camera.frame(view(20, elevation=25)))
    return camera, scene


def test_what_is_open_is_told_with_its_place_until_it_is_settled(first_look):
    camera, scene = first_look[0], copy(first_look[1])
    hidden = [one for one in scene.open if "hidden" in one.why]
    assert len(hidden) == 1
    box = next(thing for thing in camera.table.things if thing.name == "cracker_box")
    assert abs(hidden[0].place[2]) < 0.01
    # behind the box, as seen from the camera
    sight = box.placed.mean(0)[:2] - view(20, elevation=25)[:2, 3]
    assert (hidden[0].place[:2] - box.placed.mean(0)[:2]) @ sight > 0
    assert not scene.done

    for degrees in (140, 260):
        scene.update(camera.frame(view(degrees, elevation=60)))
    assert scene.open == ()
    assert scene.done


def test_what_no_view_that_is_left_shows_does_not_keep_a_scene_open(first_look):
    scene = copy(first_look[1])
    assert any("hidden" in one.why and one.in_sight for one in scene.open)
    assert not scene.done

    scene.reachable = lambda pose: False
    assert scene.open
    assert not any(one.in_sight for one in scene.open)
    assert "no view is left" in repr(scene.open[0])
    assert scene.target is None
    assert scene.done


def test_small_steps_side_by_side_are_not_empty(ycb):
    rows, columns = np.mgrid[:480, :640]
    higher = (rows // 12 + columns // 12) % 2 == 0
    inner = (abs(rows - 240) < 200) & (abs(columns - 320) < 260)
    scene = nextview.Scene(ycb)
    look = scene.update(from_above(0.8 - 0.04 * (higher & inner)))
    assert "empty" not in names(look)
    assert not scene.done
    # where nothing is found, the unit may be wrong
    assert scene.objects == ()
    assert "unit" in names(look)


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        ([-0.2, -0.2, -0.02], [0.2, 0.2, 0.3], "empty"),
        ([-0.2, -0.2, 0.01], [0.2, 0.2, 0.3], "empty"),
        ([0.3, -0.2, -0.02], [2.0, 0.2, 0.3], "ground unseen"),
    ],
)
def test_a_region_is_empty_where_its_ground_is_seen(ycb, low, high, said):
    scene = nextview.Scene(ycb, region=Box(low, high))
    look = scene.update(from_above(np.full((480, 640), 0.8)))
    assert names(look) == [said]
    assert scene.done == (said == "empty")
    assert scene.target is not None
