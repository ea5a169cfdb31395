"""Contours tell where things are, and that each view has an error of its own camera."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from drawn_views import camera, drawn, library, standing
from scipy.spatial.transform import Rotation

from nextview.things.contour import contour_equations
from nextview.things.library import Hypotheses, closed
from nextview.things.register import normal_equations, seen_by_camera
from nextview.things.world import World, aligned

EVERY = np.ones(4, bool)
FRONT = camera(0, 10)


@pytest.fixture(scope="module")
def things():
    return library()


def placed(things, number: int, pose) -> Hypotheses:
    """One hypothesis of a thing in a pose."""
    centre = pose[:3, :3] @ things.centres[number] + pose[:3, 3]
    return Hypotheses.of(np.array([number]), pose[None, :3, :3], centre[None])


def shifted(some: Hypotheses, *shift: float) -> Hypotheses:
    return replace(some, centres=some.centres + np.array(shift))


def told(left, right):
    """Shift that the equations ask for if the thing does not turn, metres."""
    return np.linalg.solve(left[0, 3:, 3:] + 1e-9 * np.eye(3), right[0, 3:])


def test_a_contour_tells_a_shift_along_a_plate(things):
    box = things.caster.surfaces[0]
    pose = standing(box, 0, 0)
    view = drawn([(box, pose)], FRONT)
    # one face of the box is all that shows: its points do not tell a shift along it
    off = shifted(placed(things, 0, pose), 0.0, 0.006, 0.0)
    points = normal_equations(things, view, off, 0.3, 96)
    assert abs(points[1][0, 4]) < 1e-3
    reach = np.array([0.015])
    assert told(*contour_equations(things, view, off, reach))[1] == pytest.approx(
        -0.006, abs=0.001
    )


def test_a_contour_ends_where_nothing_is_measured(things):
    box = things.caster.surfaces[0]
    pose = standing(box, 0, 0)
    view = drawn([(box, pose)], FRONT)
    far = replace(view.frame, depth=np.where(view.surface, 0, view.depth))
    view = replace(view, frame=far, surface=np.zeros_like(view.surface))
    off = shifted(placed(things, 0, pose), 0.0, 0.006, 0.0)
    equations = contour_equations(things, view, off, np.array([0.015]), alone=True)
    assert told(*equations)[1] == pytest.approx(-0.006, abs=0.001)


def test_turns_and_their_products_leave_the_middle_where_it_is(things):
    quarters, half = (
        Rotation.from_rotvec(np.pi * np.array(vectors)).as_matrix()
        for vectors in (
            [[0, 0, 0.5], [0, 0, 1], [0, 0, -0.5]],
            [[1, 0, 0]],
        )
    )
    turns = closed(np.concatenate([quarters, half]))
    assert len(turns) == 7  # of the eight of a square prism, without the identity
    turning = copy(things)
    turning.turns = {"box": turns}
    pose = standing(things.caster.surfaces[0], 0.1, 0.2, 30)
    some = Hypotheses.joined([placed(things, number, pose) for number in (1, 0)])
    alike, row = some.turned_alike(turning)
    assert (row == 1).all()
    for one in range(7):
        turn = alike.rotations[one].T @ some.rotations[1]
        assert min(np.abs(turn - other).max() for other in turns) < 1e-9
    middle = things.principal.middles[0]
    np.testing.assert_allclose(
        alike.rotations @ middle + alike.centres,
        np.tile(some.rotations[1] @ middle + some.centres[1], (7, 1)),
        atol=1e-9,
    )


def test_a_contour_that_something_hides_tells_nothing(things):
    box, _, can, _ = things.caster.surfaces
    pose = standing(box, -0.15, 0)
    hidden = drawn([(box, pose), (can, standing(can, 0.05, 0))], FRONT)
    alone = drawn([(box, pose)], FRONT)
    some, reach = placed(things, 0, pose), np.array([0.01])
    shown, whole = (
        contour_equations(things, view, some, reach)[0][0, 3:, 3:]
        for view in (hidden, alone)
    )
    # the can hides the lower part of both sides
    assert shown[1, 1] < 0.7 * whole[1, 1]
    behind = shifted(placed(things, 2, standing(can, -0.3, 0)), 0, 0, -0.02)
    assert not contour_equations(things, hidden, behind, reach)[0].any()


def test_a_thing_is_found_where_an_error_of_the_camera_puts_it(things):
    slab = things.caster.surfaces[1]
    pose = standing(slab, 0.0, 0.0, 20)
    true = camera(30)
    wrong = true.copy()
    wrong[:3, 3] += [0.006, -0.007, 0.004]
    some = placed(things, 1, pose)
    view = drawn([(slab, pose)], true, wrong)
    found = seen_by_camera(things, view, some)
    np.testing.assert_allclose(
        found.centres[0] - some.centres[0], [0.006, -0.007, 0.004], atol=0.002
    )


def test_views_of_one_thing_agree_in_spite_of_errors_of_their_cameras(things):
    can = things.caster.surfaces[2]
    pose = standing(can, 0.0, 0.0)
    world = World(things, alone=True)
    errors = ([0.0, 0.0, 0.0], [0.008, -0.006, 0.003], [-0.007, 0.007, -0.004])
    for azimuth, error in zip((0, 70, 200), errors, strict=True):
        wrong = camera(azimuth)
        wrong[:3, 3] += error
        view = drawn([(can, pose)], camera(azimuth), wrong)
        world = aligned(world.with_view(view))
        world = aligned(world.searched(EVERY)).numbered()
    (thing,) = (one for one in world.things if one.row >= 0)
    assert things.names[world.hypotheses.things[thing.row]] == "can"
    assert min(one.share for one in thing.scores) > 0.8
