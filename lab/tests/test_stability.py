"""Whether a thing stands where it is found: on the ground, on others, against them, or not."""

import numpy as np
import pytest
from factories import pose_at
from labelled_worlds import FLOOR, LabelledCamera
from nextview.things.depth_view import MetricImage
from nextview.things.stability import is_stable
from scipy.spatial.transform import Rotation
from test_verification import mesh_of, verifier_of

from nextview.sensing import ObservedObject
from nextview_lab.worlds.worlds import BACKGROUND, slab

SIZE = (0.16, 0.06, 0.04)
THING = mesh_of((SIZE, (0, 0, 0)), ((0.03, 0.03, 0.03), (0.05, 0, 0.035)))
FLAT = np.eye(3)
LEANS = Rotation.from_euler("y", -60, degrees=True).as_matrix()
# half the height of the thing where it leans, and where its upper end touches a wall at the left
LOW = (SIZE[0] * np.sin(np.pi / 3) + SIZE[2] * np.cos(np.pi / 3)) / 2
LEFT = -(SIZE[0] * np.cos(np.pi / 3) + SIZE[2] * np.sin(np.pi / 3)) / 2
BLOCK = slab((0.1, 0.1, 0.08), (0, 0), 0.08)
WALL = slab((0.02, 0.3, 0.3), (LEFT - 0.01, 0), 0.3)
PLACES = {
    "on the ground": (FLAT, (0, 0, 0.02), None, True),
    "on a block": (FLAT, (0, 0, 0.1), BLOCK, True),
    "far over the edge of a block": (FLAT, (0.075, 0, 0.1), BLOCK, False),
    "in the air": (FLAT, (0, 0, 0.1), None, False),
    "above a block": (FLAT, (0, 0, 0.14), BLOCK, False),
    "against a wall": (LEANS, (0, 0, LOW), WALL, True),
    "on its end without a wall": (LEANS, (0, 0, LOW), None, False),
}


def found_from(place, *around):
    """What is found of the thing in a place, by views from some azimuths, degrees."""
    turn, at, other, _ = PLACES[place]
    vertices = (THING.vertices * THING.radius + THING.centre) @ turn.T + at
    others = [] if other is None else [(other, BACKGROUND)]
    camera = LabelledCamera([FLOOR, ((vertices, THING.faces), 1), *others])
    known = ObservedObject()
    for degrees in around:
        frame = camera.frame(pose_at(40.0, degrees, 0.5, at))
        known.add(frame.with_mask(camera.owner == 1))
    return verifier_of(THING)(known.observations)


@pytest.mark.parametrize("place", PLACES)
def test_a_thing_stands_where_something_carries_it(place):
    turn, _, _, stands = PLACES[place]
    found = found_from(place, 60.0, -60.0)
    np.testing.assert_allclose(found.poses[0, 2, :3], turn[2], atol=0.05)
    assert (found.stands[0] or found.carried[0]) == stands


def test_what_no_view_sees_may_carry_a_thing_that_touches_others():
    assert found_from("far over the edge of a block", 60.0).carried[0]
    assert not found_from("in the air", 60.0).carried[0]


def test_a_body_stands_where_its_centroid_lies_above_what_it_touches():
    bottom = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
    assert is_stable(bottom.T)
    on_an_edge = bottom[:2] - (0, 0.02)
    assert not is_stable(on_an_edge.T)
    off_centre = bottom - (0.08, 0)  # its weight is far out on one side
    assert not is_stable(off_centre.T)


def test_a_thing_reaches_below_the_top_of_what_hides_its_lower_part():
    upright = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    at = np.array([-0.09, 0, SIZE[0] / 2])
    vertices = (THING.vertices * THING.radius + THING.centre) @ upright.T + at
    camera = LabelledCamera(
        [FLOOR, ((vertices, THING.faces), 1), (BLOCK, BACKGROUND)],
    )
    known = ObservedObject()
    frame = camera.frame(pose_at(40.0, 0.0, 0.5, at))
    known.add(frame.with_mask(camera.owner == 1))
    image = MetricImage.of(known.observations[0])
    top = image.ground.height - image.floor.height
    assert top == pytest.approx(0.08, abs=0.003)  # the ground beside it is the block's

    found = verifier_of(THING)(known.observations)
    np.testing.assert_allclose(found.poses[0, 2, :3], upright[2], atol=0.05)
    assert found.below[0] == 0
    assert found.stands[0]
