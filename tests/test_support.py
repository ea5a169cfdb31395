"""Whether things stand on the plane below them or on other things, and what that says of names."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_views import camera, drawn, library, standing

from nextview.things.library import Hypotheses
from nextview.things.naming import named, why_in_doubt
from nextview.things.support import supported
from nextview.things.world import World

BOX, SLAB = 0, 1
KNOWN = library()
RIGHT, WRONG = np.log(0.95 / 0.3), np.log(0.05 / 0.7)
NONE = np.zeros(0, np.int64)


def posed(thing, x=0.0, y=0.0, raised=0.0):
    """Surface and pose of a thing, by its number, that stands or is raised, metres."""
    one = KNOWN.caster.surfaces[thing]
    pose = standing(one, x, y)
    pose[2, 3] += raised
    return one, pose


def world_of(*things, shift=0.0, known=True):
    """A world whose first hypotheses are the things that its view shows, by number and place.

    Args:
        things: number of each and where it is.
        shift: of the plane below what its view is told, metres.
        known: whether there is a plane.
    """
    placed = [posed(thing, **where) for thing, where in things]
    view = drawn(placed, camera(30.0))
    height = view.frame.along(np.array([0.0, 0, 1])) + np.float32(shift)
    if not known:
        height = np.full(height.shape, np.inf, np.float32)
    view = replace(view, height=height, _grids={})
    poses = np.array([pose for _, pose in placed])
    numbers = np.array([thing for thing, _ in things])
    centres = np.einsum("mij,mj->mi", poses[:, :3, :3], KNOWN.centres[numbers])
    some = Hypotheses.of(numbers, poses[:, :3, :3], centres + poses[:, :3, 3])
    return World(KNOWN).with_view(view).with_hypotheses(some).chosen()


@pytest.mark.parametrize(
    ("shift", "nats"), [(0.0, RIGHT), (0.05, WRONG), (-0.05, WRONG)]
)
def test_a_thing_stands_or_floats_or_sinks(shift, nats):
    found = supported(world_of((BOX, {}), shift=shift), np.array([0]), NONE)
    assert found[0] == pytest.approx(nats, abs=0.05)


def test_where_no_plane_is_known_nothing_is_said():
    assert supported(world_of((BOX, {}), known=False), np.array([0]), NONE)[0] == 0


def test_a_thing_may_stand_on_another_one():
    world = world_of((BOX, {"raised": 0.03}), (SLAB, {}))
    assert supported(world, np.array([0]), NONE)[0] == pytest.approx(WRONG, abs=0.05)
    on = supported(world, np.array([0]), np.array([1]))
    assert on[0] == pytest.approx(RIGHT, abs=0.05)


@pytest.mark.parametrize("place", [{"x": 0.2}, {"raised": -0.04}])
def test_it_does_not_stand_on_what_is_beside_or_far_below_it(place):
    world = world_of((BOX, {"raised": 0.05}), (SLAB, place))
    found = supported(world, np.array([0]), np.array([1]))
    assert found[0] == pytest.approx(WRONG, abs=0.05)


def test_a_name_that_would_float_is_less_likely_and_says_so():
    stands, floats = (
        (world, named(world, world.things[0], ()))
        for world in (world_of((BOX, {})), world_of((BOX, {}), shift=0.05))
    )
    assert stands[1].right > floats[1].right
    lost = np.log(stands[1].right / (1 - stands[1].right))
    lost -= np.log(floats[1].right / (1 - floats[1].right))
    assert lost > 3 or stands[1].right == stands[1].most
    assert why_in_doubt(*floats) == "it would not stand in this pose"
