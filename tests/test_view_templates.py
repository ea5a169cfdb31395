"""Things in any orientation: pictures from all around, and what is proposed and found by them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_verification import (
    VIEWS,
    even_belief,
    l_block,
    mesh_of,
    off_by,
    standing_view,
    verifier_of,
)

from nextview.errors import ObservationError
from nextview.geometry.mesh import Mesh
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import look_at_origin
from nextview.simulation.simulated import SimulatedCamera
from nextview.things.depth_view import MetricImage
from nextview.things.view_templates import (
    TEMPLATE_SIDE,
    TURNS,
    Pictures,
    looking_from,
    mismatch,
    seen,
    spread_directions,
)

MUG = mesh_of(((0.08, 0.08, 0.1), (0, 0, 0)), ((0.05, 0.015, 0.06), (0.06, 0, 0.015)))
BRACKET = mesh_of(((0.12, 0.06, 0.02), (0, 0, 0)), ((0.02, 0.02, 0.1), 3 * (0.02,)))
THINGS = (l_block(), MUG, BRACKET)


@pytest.fixture(scope="module")
def verifier():
    return verifier_of(*THINGS)


@pytest.fixture(scope="module")
def templates(verifier):
    return verifier.templates


def turned_views(mesh: Mesh, turn: np.ndarray):
    """Exact views of a mesh that hangs in the air, turned about all axes, and its pose."""
    shown = rotated(mesh, turn)
    camera = SimulatedCamera(shown)
    observations = [
        camera.observe(look_at_origin(np.radians(up), np.radians(around)))
        for up, around in VIEWS
    ]
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = -(turn @ mesh.centre + shown.centre)
    return observations, pose


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("thing", range(len(THINGS)))
def test_a_thing_that_is_turned_about_all_axes_is_named_and_placed(
    verifier,
    thing,
    seed,
):
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    observations, true = turned_views(THINGS[thing], turn)
    found = verifier.in_any_orientation(observations[:2])
    assert found.belief.argmax() == thing
    assert found.belief.max() > 0.9
    assert found.belief.sum() == pytest.approx(1)
    degrees, millimetres = off_by(found.poses[0], true, THINGS[thing].centre)
    assert degrees < 1
    assert millimetres < 1


@pytest.mark.parametrize("seed", range(6))
def test_one_of_the_first_proposals_is_near_the_truth(templates, seed):
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    observations, _ = turned_views(THINGS[0], turn)
    proposals = templates.propose(MetricImage.of(observations[0]), 8)
    own = proposals.rotations[proposals.things == 0]
    off = Rotation.from_matrix(own @ turn.T).magnitude()
    assert np.degrees(off.min()) < 20
    assert proposals.log_belief.argmax() == 0


def test_images_of_a_rolled_camera_are_rotated_back(templates):
    observations, _ = turned_views(THINGS[0], np.eye(3))
    image = MetricImage.of(observations[0])
    upright, look = seen(image)
    roll = np.eye(4)
    roll[:3, :3] = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    # The camera turns clockwise by a quarter: rows become columns.
    rolled = replace(
        image,
        depth=np.rot90(image.depth),
        kind=np.rot90(image.kind),
        pose=image.pose @ roll,
    )
    other, other_look = seen(rolled)
    quarter = TURNS // 4
    assert np.mean(other.outline[0] == upright.outline[quarter]) > 0.98
    np.testing.assert_allclose(other.size, upright.size, rtol=1e-3)
    np.testing.assert_allclose(other_look @ roll[:3, :3].T, look, atol=1e-2)


def test_the_mismatch_follows_its_definition():
    rng = np.random.default_rng(0)
    made = []
    for count in (3, 5):
        outline = (rng.random((count, TEMPLATE_SIDE**2)) < 0.5).astype(np.float32)
        depth = outline * rng.normal(size=outline.shape).astype(np.float32)
        made.append(Pictures(outline, depth, rng.uniform(0.05, 0.1, count)))
    costs = mismatch(*made)

    one, other = made
    both = (one.outline[1] > 0) & (other.outline[2] > 0)
    either = (one.outline[1] > 0) | (other.outline[2] > 0)
    apart = (one.depth[1] - other.depth[2])[both].std()
    ratio = np.log(one.size[1] / other.size[2])
    expected = (
        8 * (1 - both.sum() / either.sum())
        + 4 * apart
        + 3 * min((ratio / 0.1) ** 2 / 2, 3)
    )
    assert costs[1, 2] == pytest.approx(expected, rel=1e-4)


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


def test_almost_empty_views_give_no_proposals(verifier, templates):
    observations, _ = turned_views(THINGS[0], np.eye(3))
    depth = np.zeros_like(observations[0].depth)
    depth[64:66, 64:67] = 3
    speck = replace(observations[0], depth=depth, scene=None)
    assert not len(templates.propose(MetricImage.of(speck), 8).things)
    with pytest.raises(ObservationError, match="enough of the thing"):
        verifier.in_any_orientation([speck])


def standing_in(mesh: Mesh, turn: np.ndarray):
    """A view of a turned mesh on a level table, and its pose."""
    shown = rotated(mesh, turn)
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = -(turn @ mesh.centre + shown.centre)
    return standing_view(shown, np.eye(3), noise=0.002), pose


# standing on their heads, on a side, and on an edge against nothing
UNUSUAL_TURNS = (
    Rotation.from_euler("x", 180, degrees=True),
    Rotation.from_euler("xz", (90, 40), degrees=True),
    Rotation.from_euler("yz", (-55, 100), degrees=True),
)


@pytest.mark.parametrize("turn", UNUSUAL_TURNS)
@pytest.mark.parametrize("thing", [1, 2])
def test_a_thing_that_stands_as_it_was_not_taught_is_found_by_the_whole_search(
    verifier,
    thing,
    turn,
):
    mesh = THINGS[thing]
    observation, true = standing_in(mesh, turn.as_matrix())
    resting = verifier([observation], even_belief(len(THINGS)))
    before = off_by(resting.poses[0], true, mesh.centre)[0]
    assert before > 15 or resting.things[0] != thing

    found = verifier.whole_search([observation], resting)
    assert found.belief.argmax() == found.things[0] == thing
    degrees, millimetres = off_by(found.poses[0], true, mesh.centre)
    assert degrees < 3
    assert millimetres < 3
    np.testing.assert_allclose([found.belief.sum(), found.probabilities.sum()], 1)
    assert (np.diff(found.probabilities) <= 0).all()


def test_a_thing_that_rests_as_it_was_taught_stays_where_it_was_found(verifier):
    observation, true = standing_in(THINGS[1], np.eye(3))
    resting = verifier([observation], even_belief(len(THINGS)))
    found = verifier.whole_search([observation], resting)
    assert found.things[0] == 1
    assert off_by(found.poses[0], true, THINGS[1].centre)[0] < 2
    assert found.probabilities[0] > 0.5
