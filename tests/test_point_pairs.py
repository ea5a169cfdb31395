"""Things in any orientation: pairs of points, and what is proposed and found by them."""

from dataclasses import replace

import numpy as np
import pytest
from exact_views import (
    before_a_wall,
    explained,
    l_block,
    library_of,
    mesh_of,
    off_by,
    standing_view,
    turned_views,
)
from scipy.spatial.transform import Rotation

from nextview.geometry.axes import looking_from
from nextview.sensing.view import View
from nextview.session.target import view_of
from nextview.things.library import Hypotheses
from nextview.things.point_pairs import (
    oriented,
)
from nextview.things.propose import PROPOSED, PROPOSED_OF_ONE
from nextview.things.visible_points import spread_directions

MUG = mesh_of(((0.08, 0.08, 0.1), (0, 0, 0)), ((0.05, 0.015, 0.06), (0.06, 0, 0.015)))
BRACKET = mesh_of(((0.12, 0.06, 0.02), (0, 0, 0)), ((0.02, 0.02, 0.1), 3 * (0.02,)))
THINGS = (l_block(), MUG, BRACKET)


@pytest.fixture(scope="module")
def library():
    return library_of(*THINGS)


def proposed(library, view: View):
    among = np.ones(len(library), bool)
    pairs = library.visible.pairs
    return pairs.propose(view, view.labels > 0, among, PROPOSED, PROPOSED_OF_ONE)


@pytest.mark.parametrize("seed", range(3))
def test_normals_are_those_of_the_surface(seed):
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    observations, true = turned_views(BRACKET, turn)
    view = view_of(before_a_wall(observations[0]))
    points, normals = oriented(view, view.labels > 0)
    assert (((view.camera[:3, 3] - points) * normals).sum(1) > 0).all()
    # all faces of the bracket are parallel to its axes
    own = np.abs(normals @ true[:3, :3])
    assert np.median(own.max(1)) > np.cos(np.radians(5))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("thing", range(len(THINGS)))
def test_a_thing_that_is_turned_about_all_axes_is_named_and_placed(
    library, thing, seed
):
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    observations, true = turned_views(THINGS[thing], turn)
    found = explained(library, observations[:2])
    assert found.thing == thing
    assert found.right > 0.9
    degrees, millimetres = off_by(found.pose, true, THINGS[thing].centre)
    assert degrees < 1
    assert millimetres < 1.5


@pytest.mark.parametrize("seed", range(6))
def test_one_of_the_first_proposals_is_near_the_truth(library, seed):
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    observations, _ = turned_views(THINGS[0], turn)
    things, rotations, _ = proposed(library, view_of(before_a_wall(observations[0])))
    off = Rotation.from_matrix(rotations[things == 0] @ turn.T).magnitude()
    assert np.degrees(off.min()) < 20


def before(view: View, hidden: np.ndarray) -> View:
    """A view with a board before some of its pixels."""
    nearest = view.depth[view.labels > 0].min()
    depth = np.where(hidden, np.float32(0.8 * nearest), view.depth)
    labels = np.where(hidden, 0, view.labels)
    return replace(view, frame=view.frame.with_depth(depth), labels=labels)


def test_a_thing_of_which_a_part_is_hidden_is_proposed_near_the_truth(library):
    found = []
    for seed in range(4):
        turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
        observations, true = turned_views(THINGS[0], turn)
        view = view_of(before_a_wall(observations[0]))
        columns = np.nonzero(view.labels)[1]
        centre = turn @ THINGS[0].centre + true[:3, 3]
        for side in (-1, 1):
            beyond = side * (
                np.arange(view.labels.shape[1]) - np.quantile(columns, 0.5)
            )
            hidden = np.broadcast_to(beyond > 0.1 * np.ptp(columns), view.labels.shape)
            things, rotations, centres = proposed(library, before(view, hidden))
            own = np.flatnonzero(things == 0)
            off = Rotation.from_matrix(rotations[own] @ turn.T).magnitude()
            apart = np.linalg.norm(centres[own] - centre, axis=1)
            # of a thing of 20 cm
            found.append(((np.degrees(off) < 30) & (apart < 0.03)).any())
    # one of eight views may show a single face, of which there are many
    assert np.count_nonzero(found) >= 7


def test_moments_propose_a_whole_thing_near_its_pose(library):
    for turn in Rotation.random(4, rng=0).as_matrix():
        observations, true = turned_views(THINGS[0], turn)
        view = view_of(observations[0])
        among = np.ones(len(library), bool)
        things, rotations, centres = library.visible.moments.propose(
            view, view.labels > 0, among, 150, 6
        )
        own = np.flatnonzero(things == 0)
        assert 0 < len(own) <= 6
        off = Rotation.from_matrix(rotations[own] @ turn.T).magnitude()
        centre = turn @ THINGS[0].centre + true[:3, 3]
        apart = np.linalg.norm(centres[own] - centre, axis=1)
        assert ((np.degrees(off) < 30) & (apart < 0.03)).any()

        # what is ruled out is not proposed
        among[0] = False
        things, _, _ = library.visible.moments.propose(
            view, view.labels > 0, among, 150, 6
        )
        assert 0 not in things
        assert len(things)


def test_directions_are_spread_evenly_and_cameras_look_along_them():
    directions = spread_directions(162)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    alike = directions @ directions.T - 2 * np.eye(162)
    nearest = np.degrees(np.arccos(alike.max(1)))
    assert nearest.min() > 10
    assert nearest.max() < 20
    looks = looking_from(directions)
    np.testing.assert_allclose(
        looks @ looks.swapaxes(1, 2),
        np.tile(np.eye(3), (162, 1, 1)),
        atol=1e-12,
    )
    np.testing.assert_allclose(np.linalg.det(looks), 1)
    np.testing.assert_allclose(looks[:, 2], -directions)


def test_almost_empty_views_give_no_proposals(library):
    observations, _ = turned_views(THINGS[0], np.eye(3))
    depth = np.zeros_like(observations[0].depth)
    depth[64:66, 64:67] = 3
    speck = replace(observations[0], depth=depth, sighting=None)
    assert not len(proposed(library, view_of(speck))[0])
    assert explained(library, [speck]) is None


# upright, on their heads, on a side, and on an edge against nothing
TURNS_ON_TABLE = (
    Rotation.identity(),
    Rotation.from_euler("x", 180, degrees=True),
    Rotation.from_euler("xz", (90, 40), degrees=True),
    Rotation.from_euler("yz", (-55, 100), degrees=True),
)


@pytest.mark.parametrize("turn", TURNS_ON_TABLE)
@pytest.mark.parametrize("thing", [1, 2])
def test_a_thing_is_found_however_it_stands(library, thing, turn):
    mesh = THINGS[thing]
    observation, true = standing_view(mesh, turn.as_matrix(), noise=0.002)
    found = explained(library, [observation])
    assert found.thing == thing
    degrees, millimetres = off_by(found.pose, true, mesh.centre)
    assert degrees < 3
    assert millimetres < 3


def test_what_looks_alike_is_as_large_and_not_ruled_out():
    """A box, one a tenth larger, one twice as large, and one that is ruled out."""
    boxes = [
        mesh_of((size * np.array([0.06, 0.09, 0.14]), (0, 0, 0)))
        for size in (1, 1.1, 2, 1)
    ]
    library = library_of(*boxes)
    one = Hypotheses.of(np.array([0]), np.eye(3)[None], np.zeros((1, 3)))
    among = np.array([True, True, True, False])
    (found,) = one.lookalikes(library, among)
    assert np.unique(found.things).tolist() == [0, 1]
    # four poses of the other one; all turn the box into itself
    assert np.sum(found.things == 1) == 4
    turned = np.abs(found.rotations)
    np.testing.assert_allclose(turned, [np.eye(3)] * len(turned), atol=0.05)
    # none is where the box was
    own = found.rotations[found.things == 0]
    assert not np.isclose(own, np.eye(3), atol=0.05).all((1, 2)).any()
