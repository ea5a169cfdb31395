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

from nextview.sensing.view import View
from nextview.things.point_pairs import (
    ANGLE_STEP,
    DISTANCE_STEP,
    TURNS,
    frames,
    keys_of,
    oriented,
    rank_within,
    spread,
    turns_of,
)
from nextview.things.propose import PROPOSED, PROPOSED_OF_ONE
from nextview.things.target import view_of
from nextview.things.visible_points import looking_from, spread_directions

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


def test_a_motion_changes_no_key_and_no_turn():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(30, 3))
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    one, two = np.nonzero(~np.eye(30, dtype=bool))
    motion = Rotation.random(rng=rng).as_matrix()
    moved = points @ motion.T + (1, 2, 3), normals @ motion.T
    keys = keys_of(points, normals, one, two)
    # rounding may differ where a number lies between two steps
    assert np.mean(keys_of(*moved, one, two) == keys) > 0.99
    # the turns of all partners of a point change by the same angle
    change = turns_of(*moved, one, two) - turns_of(points, normals, one, two)
    for first in range(30):
        angles = np.exp(2j * np.pi / TURNS * change[one == first])
        np.testing.assert_allclose(angles, angles[0], atol=1e-5)


def test_a_key_tells_pairs_of_another_distance_or_angle_apart():
    points = np.array([[0, 0, 0], [0.05, 0, 0], [0.05 + 1.5 * DISTANCE_STEP, 0, 0]])
    normals = np.array([[0, 0, 1.0], [0, 0, 1], [0, 0, 1]])
    near, far = keys_of(points, normals, np.array([0, 0]), np.array([1, 2]))
    assert near != far
    tilted = Rotation.from_euler("x", 1.5 * ANGLE_STEP).apply(normals[0])
    other = keys_of(
        points, np.stack([normals[0], tilted, tilted]), np.array([0]), np.array([1])
    )
    assert other != near


def test_frames_turn_normals_to_the_first_axis():
    normals = spread_directions(50)
    turned = frames(normals)
    np.testing.assert_allclose(
        turned @ turned.swapaxes(1, 2), [np.eye(3)] * 50, atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(turned), 1)
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", turned, normals), [[1, 0, 0]] * 50, atol=1e-9
    )


def test_points_are_spread_far_from_each_other():
    line = np.linspace(0, 1, 101)[:, None] * (1.0, 0, 0)
    chosen = spread(np.stack([line, line[::-1]]), 5)
    np.testing.assert_allclose(np.sort(line[chosen[0], 0]), [0, 0.25, 0.5, 0.75, 1])
    np.testing.assert_array_equal(chosen[0], chosen[1])
    assert spread(line[None, :3], 5).shape == (1, 3)


def test_ranks_count_earlier_equals():
    np.testing.assert_array_equal(
        rank_within(np.array([3, 1, 3, 3, 1])), [0, 0, 1, 2, 1]
    )


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
    speck = replace(observations[0], depth=depth, scene=None)
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
