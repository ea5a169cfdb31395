"""What a hypothesis explains of a view, and what it pays for."""

import numpy as np
import pytest
from drawn_views import camera, drawn, library, standing

from nextview.things.library import Hypotheses
from nextview.things.score import PIXEL_GAIN, score


@pytest.fixture(scope="module")
def things():
    return library()


def at(things, *placed) -> Hypotheses:
    """Hypotheses of things by their numbers and poses."""
    numbers = np.array([number for number, _ in placed])
    poses = np.stack([pose for _, pose in placed])
    centres = np.einsum("nij,nj->ni", poses[:, :3, :3], things.centres[numbers])
    return Hypotheses.of(numbers, poses[:, :3, :3], centres + poses[:, :3, 3])


def test_the_true_pose_explains_nearly_all_that_it_could(things):
    box = things.caster.surfaces[0]
    pose = standing(box, 0, 0, 20)
    (found,) = score(things, drawn([(box, pose)], camera(30)), at(things, (0, pose)))
    assert found.total > 0.8 * PIXEL_GAIN * found.seen
    assert found.through == found.hidden == 0


@pytest.mark.parametrize("number", [1, 2, 3])
def test_another_thing_explains_less(things, number):
    box = things.caster.surfaces[0]
    view = drawn([(box, standing(box, 0, 0, 20))], camera(30))
    other = things.caster.surfaces[number]
    some = at(things, (0, standing(box, 0, 0, 20)), (number, standing(other, 0, 0, 20)))
    right, wrong = score(things, view, some)
    assert wrong.total < 0.5 * right.total


def test_what_is_seen_through_is_paid_for(things):
    box = things.caster.surfaces[0]
    (found,) = score(
        things, drawn([], camera(30)), at(things, (0, standing(box, 0, 0)))
    )
    assert found.through > 0.9 * found.seen
    assert found.total < -2 * found.seen


def test_what_is_hidden_says_nothing(things):
    box, _, can, _ = things.caster.surfaces
    behind = standing(box, -0.12, 0)
    view = drawn([(box, behind), (can, standing(can, 0.1, 0))], camera(0, 20))
    alone = drawn([(box, behind)], camera(0, 20))
    hypothesis = at(things, (0, behind))
    (partly,), (whole,) = (
        score(things, view, hypothesis),
        score(things, alone, hypothesis),
    )
    assert partly.hidden > 20
    assert partly.seen < whole.seen
    assert partly.total > 0.7 * PIXEL_GAIN * partly.seen


def test_what_lies_beyond_the_border_says_nothing(things):
    box = things.caster.surfaces[0]
    pose = standing(box, 0.0, 0.26)
    view = drawn([(box, pose)], camera(0))
    (found,) = score(things, view, at(things, (0, pose)))
    assert found.total > 0.6 * PIXEL_GAIN * found.seen
    far = standing(box, 0.0, 2.0)
    assert score(things, view, at(things, (0, far))) == [None]


def test_a_coarser_grid_counts_for_the_pixels_that_it_leaves_out(things):
    box = things.caster.surfaces[0]
    pose = standing(box, 0, 0, 20)
    view = drawn([(box, pose)], camera(30))
    (fine,) = score(things, view, at(things, (0, pose)))
    (coarse,) = score(things, view, at(things, (0, pose)), coarser=2)
    assert coarse.total == pytest.approx(fine.total, rel=0.3)


def test_scores_do_not_depend_on_what_is_scored_beside(things):
    box, slab = things.caster.surfaces[:2]
    placed = [(0, standing(box, 0.05, 0, 20)), (1, standing(slab, -0.1, 0.05, 70))]
    view = drawn([(box, placed[0][1]), (slab, placed[1][1])], camera(30))
    together = score(things, view, at(things, *placed))
    alone = [score(things, view, at(things, one))[0] for one in placed]
    for one, other in zip(together, alone, strict=True):
        assert one.total == pytest.approx(other.total, rel=1e-4)
