"""Things in any orientation: pictures from all around, and what is proposed and found by them."""

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

from nextview.geometry.observation import Observation
from nextview.geometry.pinhole import PinholeCamera
from nextview.sensing.view import View
from nextview.things.propose import HIDING_MARGIN
from nextview.things.target import view_of
from nextview.things.view_templates import (
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
def library():
    return library_of(*THINGS)


def outline_of(seen: View | Observation) -> SeenOutline | None:
    """The outline of the one thing in a view."""
    view = seen if isinstance(seen, View) else view_of(seen)
    mask = view.labels > 0
    return SeenOutline.of(
        view.depth,
        mask,
        np.zeros(mask.shape, bool),
        view.hiding(mask, HIDING_MARGIN),
        PinholeCamera.of(view.frame.intrinsics, mask.shape),
        view.camera,
    )


def proposed(library, seen: View | Observation):
    every = np.ones(len(library), bool)
    return library.templates.propose(outline_of(seen), every)


def test_a_template_is_what_a_camera_that_looks_from_there_sees(library):
    """By the code that computes the outline of a single view."""
    looks = looking_from(spread_directions(TEMPLATE_DIRECTIONS))
    camera = PinholeCamera.centred(
        RENDERING_PIXELS / 2 * np.sqrt(TEMPLATE_DISTANCE**2 - 1),
        (RENDERING_PIXELS, RENDERING_PIXELS),
    )
    caster, templates = library.caster, library.templates
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
        pictures = seen.pictures(seen.size, np.zeros((1, 2)), turned_grid(np.zeros(1)))

        row = own[np.abs(templates.sizes[own] - seen.size).argmin()]
        assert templates.sizes[row] == pytest.approx(seen.size)
        np.testing.assert_array_equal(
            templates.pictures.outline[row], pictures.outline[0]
        )
        np.testing.assert_allclose(
            templates.pictures.depth[row], pictures.depth[0], atol=1e-5
        )
        # the camera looks at the centre of the outline, by the smallest turn
        towards = seen.ahead / np.linalg.norm(seen.ahead)
        across = np.cross([0, 0, 1], towards)
        angle = np.arccos(towards[2]) / np.linalg.norm(across)
        axes = Rotation.from_rotvec(angle * across).as_matrix()
        np.testing.assert_allclose(
            templates.rotations[row], axes.T @ looks[at], atol=1e-6
        )
        middle = np.array([0, 0, away]) - seen.middle * seen.ahead
        np.testing.assert_allclose(templates.offsets[row], axes.T @ middle, atol=1e-6)


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
    proposals = proposed(library, observations[0])
    own = proposals.rotations[proposals.things == 0]
    off = Rotation.from_matrix(own @ turn.T).magnitude()
    assert np.degrees(off.min()) < 20
    assert proposals.of_things.argmin() == 0


def before(view: View, hidden: np.ndarray) -> View:
    """A view with a board before some of its pixels."""
    nearest = view.depth[view.labels > 0].min()
    depth = np.where(hidden, np.float32(0.8 * nearest), view.depth)
    labels = np.where(hidden, 0, view.labels)
    return replace(view, frame=view.frame.with_depth(depth), labels=labels)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("side", [-1, 1])
def test_a_thing_of_which_a_part_is_hidden_is_proposed_near_the_truth(
    library, seed, side
):
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    observations, true = turned_views(THINGS[0], turn)
    view = view_of(before_a_wall(observations[0]))
    columns = np.nonzero(view.labels)[1]
    beyond = side * (np.arange(view.labels.shape[1]) - np.quantile(columns, 0.5))
    hidden = np.broadcast_to(beyond > 0.1 * np.ptp(columns), view.labels.shape)
    proposals = proposed(library, before(view, hidden))
    own = np.flatnonzero(proposals.things == 0)
    off = Rotation.from_matrix(proposals.rotations[own] @ turn.T).magnitude()
    centre = turn @ THINGS[0].centre + true[:3, 3]
    apart = np.linalg.norm(proposals.centres[own] - centre, axis=1)
    assert ((np.degrees(off) < 30) & (apart < 0.03)).any()  # of a thing of 20 cm


def test_what_lies_before_a_thing_hides_it_and_the_ground_does_not():
    view = view_of(standing_view(THINGS[1], np.eye(3))[0])
    mask = view.labels > 0
    view = replace(view, surface=~mask)
    assert not view.hiding(mask, HIDING_MARGIN).any()
    last = np.nonzero(mask)[0].max()
    hidden = np.zeros(mask.shape, bool)
    hidden[last - 5 : last + 20] = True
    held = before(view, hidden)
    held = replace(held, surface=held.surface & ~hidden)
    hiding = held.hiding(held.labels > 0, HIDING_MARGIN)
    assert hiding[last].any()
    assert not hiding[: last - 5].any()


def test_what_a_camera_that_is_rolled_sees_is_turned_back():
    observation = turned_views(THINGS[0], np.eye(3))[0][0]
    one = outline_of(observation)
    roll = np.eye(4)
    roll[:3, :3] = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    # The camera turns clockwise by a quarter: rows become columns.
    depth, shown, known = (
        np.rot90(image) for image in (one.depth, one.shown, one.known)
    )
    other = SeenOutline.of_depth(depth, shown, known, one.camera, one.pose @ roll)
    assert other.size == pytest.approx(one.size, rel=1e-3)
    np.testing.assert_allclose(roll[:3, :3] @ other.ahead, one.ahead, atol=1e-2)
    middle = np.zeros((1, 2))
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


def test_almost_empty_views_give_no_proposals(library):
    observations, _ = turned_views(THINGS[0], np.eye(3))
    depth = np.zeros_like(observations[0].depth)
    depth[64:66, 64:67] = 3
    speck = replace(observations[0], depth=depth, scene=None)
    assert outline_of(speck) is None
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
