"""Things in any orientation: pictures from all around, and what is proposed and found by them."""

from dataclasses import replace

import numpy as np
import pytest
from nextview.things.depth_view import ELSEWHERE, THING, MetricImage
from scipy.spatial.transform import Rotation
from test_verification import (
    VIEWS,
    l_block,
    mesh_of,
    off_by,
    standing_view,
    verifier_of,
)

from nextview.errors import ObservationError
from nextview.geometry.mesh import Mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import look_at_origin
from nextview.simulation.simulated import SimulatedCamera
from nextview.things import view_templates
from nextview.things.view_templates import (
    MOST_ORIENTATIONS,
    RENDERING_PIXELS,
    TEMPLATE_DIRECTIONS,
    TEMPLATE_DISTANCE,
    TEMPLATE_SIDE,
    Pictures,
    SeenOutline,
    SeenPictures,
    looking_from,
    mismatch,
    spread_directions,
    turned_grid,
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


def test_a_template_is_what_a_camera_that_looks_from_there_sees(verifier, templates):
    """By the code that computes the outline of a single view."""
    looks = looking_from(spread_directions(TEMPLATE_DIRECTIONS))
    camera = PinholeCamera.centred(
        RENDERING_PIXELS / 2 * np.sqrt(TEMPLATE_DISTANCE**2 - 1),
        (RENDERING_PIXELS, RENDERING_PIXELS),
    )
    caster = verifier.caster
    own = np.flatnonzero(templates.things == 1)
    assert len(own) == len(looks)  # something shows from everywhere
    away = TEMPLATE_DISTANCE * float(caster.radii[1])
    for at in (0, 70, 161):
        origin = caster.centres[1] - away * looks[at, 2]
        rays = camera.rays.reshape(-1, 3) @ looks[at]
        depth, _ = caster.cast(
            np.array([1]),
            origin[None].astype(np.float32),
            rays[None].astype(np.float32),
        )
        image = depth.reshape(RENDERING_PIXELS, RENDERING_PIXELS)
        shown = np.isfinite(image)
        seen = SeenOutline.of_depth(image, shown, shown | True, camera, np.eye(4))
        pictures = seen.pictures(seen.size, np.zeros(2), turned_grid(np.zeros(1)))

        row = own[at]
        assert templates.sizes[row] == pytest.approx(seen.size)
        np.testing.assert_array_equal(
            templates.pictures.outline[row], pictures.outline[0]
        )
        np.testing.assert_allclose(
            templates.pictures.depth[row], pictures.depth[0], atol=1e-5
        )
        np.testing.assert_allclose(templates.rotations[row], seen.axes.T @ looks[at])
        middle = np.array([0, 0, away]) - seen.middle * seen.ahead
        np.testing.assert_allclose(
            templates.offsets[row], seen.axes.T @ middle, atol=1e-9
        )


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
    found = verifier(observations[:2], any_orientation=True)
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
    proposals = templates.propose([MetricImage.of(observations[0])])
    own = proposals.rotations[proposals.things == 0]
    off = Rotation.from_matrix(own @ turn.T).magnitude()
    assert np.degrees(off.min()) < 20
    assert proposals.log_belief.argmax() == 0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("side", [-1, 1])
def test_a_thing_of_which_a_part_is_hidden_is_proposed_near_the_truth(
    templates,
    seed,
    side,
):
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    observations, true = turned_views(THINGS[0], turn)
    image = MetricImage.of(observations[0])
    columns = np.nonzero(image.kind == THING)[1]
    beyond = side * (np.arange(image.kind.shape[1]) - np.quantile(columns, 0.5))
    before = np.broadcast_to(beyond > 0.1 * np.ptp(columns), image.kind.shape)
    nearest = image.depth[image.kind == THING].min()
    board = replace(
        image,
        depth=np.where(before, 0.8 * nearest, image.depth),
        kind=np.where(before, ELSEWHERE, image.kind),
    )
    proposals = templates.propose([replace(board, hiding=board.find_hiding())])
    own = np.flatnonzero(proposals.things == 0)
    off = Rotation.from_matrix(proposals.rotations[own] @ turn.T).magnitude()
    centre = turn @ THINGS[0].centre + true[:3, 3]
    apart = np.linalg.norm(proposals.centres[own] - centre, axis=1)
    assert ((np.degrees(off) < 30) & (apart < 0.03)).any()  # of a thing of 20 cm


def test_what_lies_before_a_thing_hides_it_and_the_ground_does_not():
    observation, _ = standing_in(THINGS[1], np.eye(3))
    image = MetricImage.of(observation)
    assert image.ground is not None
    assert not image.hiding.any()
    held = image.depth.copy()
    rows = np.nonzero(image.kind == THING)[0]
    held[rows.max() - 5 : rows.max() + 20] = (
        0.5 * image.depth[image.kind == THING].min()
    )
    kind = np.where(held != image.depth, ELSEWHERE, image.kind)
    hiding = replace(image, depth=held, kind=kind).find_hiding()
    assert hiding[rows.max()].any()
    assert not hiding[: rows.max() - 5].any()


def test_what_a_camera_that_is_rolled_sees_is_turned_back(templates):
    observations, _ = turned_views(THINGS[0], np.eye(3))
    image = MetricImage.of(observations[0])
    roll = np.eye(4)
    roll[:3, :3] = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    # The camera turns clockwise by a quarter: rows become columns.
    rolled = replace(
        image,
        depth=np.rot90(image.depth),
        kind=np.rot90(image.kind),
        hiding=np.rot90(image.hiding),
        pose=image.pose @ roll,
    )
    one, other = SeenOutline.of(image), SeenOutline.of(rolled)
    assert other.size == pytest.approx(one.size, rel=1e-3)
    np.testing.assert_allclose(roll[:3, :3] @ other.ahead, one.ahead, atol=1e-2)
    middle = np.zeros(2)
    upright = one.pictures(one.size, middle, turned_grid(np.array([np.pi / 2])))
    turned = other.pictures(one.size, middle, turned_grid(np.zeros(1)))
    assert np.mean(turned.outline == upright.outline) > 0.98


def test_the_mismatch_follows_its_definition():
    rng = np.random.default_rng(0)
    made = []
    for count in (3, 5):
        outline = (rng.random((count, TEMPLATE_SIDE**2)) < 0.5).astype(np.float32)
        depth = outline * rng.normal(size=outline.shape).astype(np.float32)
        made.append(Pictures(outline, depth))
    seen, other = made
    free = (rng.random(seen.outline.shape) < 0.8).astype(np.float32)
    known = np.maximum(free, seen.outline)
    area = float(seen.outline[1].sum())
    costs, behind = mismatch(SeenPictures(seen.outline, known, seen.depth, area), other)

    both = (seen.outline[1] > 0) & (other.outline[2] > 0)
    either = (seen.outline[1] > 0) | ((other.outline[2] > 0) & (known[1] > 0))
    apart = (seen.depth[1] - other.depth[2])[both]
    expected = 8 * (1 - both.sum() / either.sum()) + 4 * apart.std()
    assert costs[1, 2] == pytest.approx(expected, rel=1e-4)
    assert behind[1, 2] == pytest.approx(apart.mean(), abs=1e-5)


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
    assert not len(templates.propose([MetricImage.of(speck)]).things)
    with pytest.raises(ObservationError, match="enough of the thing"):
        verifier([speck])


def standing_in(mesh: Mesh, turn: np.ndarray):
    """A view of a turned mesh on a level table, and its pose."""
    shown = rotated(mesh, turn)
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = -(turn @ mesh.centre + shown.centre)
    return standing_view(shown, np.eye(3), noise=0.002), pose


# upright, on their heads, on a side, and on an edge against nothing
TURNS_ON_TABLE = (
    Rotation.identity(),
    Rotation.from_euler("x", 180, degrees=True),
    Rotation.from_euler("xz", (90, 40), degrees=True),
    Rotation.from_euler("yz", (-55, 100), degrees=True),
)


@pytest.mark.parametrize("turn", TURNS_ON_TABLE)
@pytest.mark.parametrize("thing", [1, 2])
def test_a_thing_is_found_however_it_stands(
    verifier,
    thing,
    turn,
):
    mesh = THINGS[thing]
    observation, true = standing_in(mesh, turn.as_matrix())
    found = verifier([observation])
    assert found.belief.argmax() == found.things[0] == thing
    degrees, millimetres = off_by(found.poses[0], true, mesh.centre)
    assert degrees < 3
    assert millimetres < 3
    np.testing.assert_allclose([found.belief.sum(), found.probabilities.sum()], 1)
    assert (np.diff(found.probabilities) <= 0).all()


def test_several_views_share_the_orientations_of_a_thing(templates):
    observations, _ = turned_views(THINGS[1], np.eye(3))
    images = [MetricImage.of(each) for each in observations]
    found = templates.propose(images)
    assert set(found.things.tolist()) == {0, 1, 2}
    assert np.bincount(found.things).max() <= MOST_ORIENTATIONS
    assert np.bincount(found.things[found.ranks == 0]).tolist() == [len(images)] * 3


def test_a_view_that_no_likely_thing_fits_proposes_nothing(monkeypatch):
    small = mesh_of(((0.03, 0.02, 0.01), (0, 0, 0)))
    large = mesh_of(((0.3, 0.2, 0.1), (0, 0, 0)))
    monkeypatch.setattr(view_templates, "THINGS_PROPOSED", 1)
    images = [
        MetricImage.of(turned_views(one, np.eye(3))[0][0]) for one in (small, large)
    ]
    known = verifier_of(small, large)
    found = known.templates.propose(images)
    assert len(set(found.things.tolist())) == 1
    assert len(found.rotations) == len(found.centres) == len(found.things) > 0
