"""What learn fits to the surfaces of things: weights, usual residuals, and the accuracy that it
prints.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import nextview
from nextview.errors import UsageError
from nextview.recognition.model_card import Symmetry, read_card
from nextview.teaching import verification_fit
from nextview.teaching.verification_fit import (
    DEFAULT_THINGS,
    NeverConfident,
    Shown,
    as_stored,
    fit_verification,
    likely_excess,
    to_be_shown,
    with_new_things,
)
from nextview.things.memory import TaughtRecogniser
from nextview.things.taught import TaughtThings, residuals_of
from nextview.things.unknown import KnownResiduals
from nextview.things.weighing import EvidenceWeights, JudgedEpisode

DEFAULTS = EvidenceWeights()


def shown(thing, views, rng, things, gap=0.3, lie=0.0):
    """An episode in which the truth is explained better by a gap, but for a share of lies, and
    outlines say nothing.
    """
    mean = (
        -0.1
        - gap * (np.arange(things) != thing)[:, None]
        + rng.normal(0, 0.02, (things, views))
    )
    if rng.random() < lie:
        mean = np.roll(mean, 1, 0)
    numbers = np.arange(things)
    even = np.full(things, 1 / things)
    judged = JudgedEpisode(
        thing,
        numbers,
        mean,
        np.zeros((things, views)),
        np.log(even),
        even,
    )
    residual = 0.2 + 0.01 * thing + 0.005 * rng.normal()
    return Shown(thing, views, int(mean.sum(1).argmax()), residual, judged)


def episodes(things, draws=4, **how):
    rng = np.random.default_rng(5)
    return [
        shown(t, v, rng, things, **how)
        for t in range(things)
        for _ in range(draws)
        for v in (1, 2, 3)
    ]


def weights_of(fit):
    return EvidenceWeights(**fit.verification.weights)


@pytest.mark.parametrize("things", [1, 2, 3])
def test_few_things_that_are_told_apart_leave_the_weights_as_they_were(things):
    fit = fit_verification(episodes(things), np.arange(things))
    assert weights_of(fit) == DEFAULTS
    assert fit.accuracy == fit.accuracy[:1] * 3 == (1.0, 1.0, 1.0)
    assert fit.things == things


def test_many_confused_things_lower_the_weight_of_geometry_and_few_do_so_less():
    lies = {
        things: weights_of(
            fit_verification(episodes(things, lie=0.4), np.arange(things))
        )
        for things in (3, 12)
    }
    assert lies[12].geometry < lies[3].geometry < DEFAULTS.geometry
    share = 12 / (12 + DEFAULT_THINGS)
    # 5 is the least that is tried
    assert lies[12].geometry >= DEFAULTS.geometry ** (1 - share) * 5.0**share * 0.999


def test_the_accuracy_is_that_of_weights_that_were_fitted_to_other_things():
    things = 10
    fit = fit_verification(episodes(things, gap=0.0), np.arange(things))
    assert fit.accuracy[0] < 0.5
    assert fit.by_outline == (
        0.1,
        0.1,
        0.1,
    )  # outlines say nothing: the first thing is named
    a, b, share = fit.confused[0]
    assert 0 <= a < b < things
    assert 0 < share <= 1


def test_residuals_are_of_things_that_were_named_right_and_ascend():
    some = episodes(4)
    wrong = [replace(one, named=(one.thing + 1) % 4, residual=9.0) for one in some[:3]]
    fit = fit_verification(some + wrong, np.arange(4)).verification
    assert (np.diff(fit.usual) > 0.004).all()
    assert max(max(row) for row in fit.excess) < 1
    assert [len(row) for row in fit.excess] == [100, 100, 100]


@pytest.mark.parametrize("count", [4, 12, 60])
def test_few_residuals_tell_how_rare_larger_ones_are(count):
    rng = np.random.default_rng(count)
    rates = []
    for _ in range(300):
        excess = likely_excess(np.sort(0.3 * rng.normal(size=count)))
        known = KnownResiduals(np.ones(1), (excess,))
        further = np.exp(0.3 * rng.normal(size=10))  # times the usual residual
        rates.append([known.p_value(residual, 0, 1) < 0.05 for residual in further])
        assert known.p_value(1e6, 0, 1) < 0.05
    assert np.mean(rates) == pytest.approx(0.04, abs=0.025)


@pytest.mark.parametrize("count", [0, 1, 100, 300])
def test_one_residual_and_many_are_kept_as_they_are(count):
    values = np.linspace(0, 1, count)
    np.testing.assert_array_equal(likely_excess(values), values)


def test_nothing_right_leaves_no_residuals():
    wrong = [replace(one, named=(one.thing + 1) % 4) for one in episodes(4)]
    assert fit_verification(wrong, np.arange(4)).verification.usual == ()


def test_of_very_many_residuals_quantiles_are_kept():
    values = np.sort(np.random.default_rng(0).normal(size=5000))
    stored = as_stored(DEFAULTS, KnownResiduals(np.zeros(2), (values,)), 2)
    kept = residuals_of(stored, [0, 1])
    assert len(kept.excess[0]) == 400
    full = KnownResiduals(np.zeros(2), (values,))
    for residual in (-1.0, 0.5, 1.9):
        assert kept.p_value(residual, 0, 1) == pytest.approx(
            full.p_value(residual, 0, 1),
            abs=0.01,
        )


def ended(episode, doubt):
    """The results of a test, with the doubt after its last view."""
    return [*episode[:-1], replace(episode[-1], doubt=doubt)]


def test_a_thing_that_is_never_confident_is_told_with_the_reason():
    rng = np.random.default_rng(3)
    turn = (
        "its orientation is known to ± {}° only, because it looks the same after a turn"
    )
    doubts = {
        0: ["", "only 40 pixels show it"],  # confident once
        1: [turn.format(90), "only 40 pixels show it", turn.format(104)],
        2: ["", ""],
        3: ["", "only 40 pixels show it"],
    }
    results = []
    for thing, of_thing in doubts.items():
        for doubt in of_thing:
            views = [shown(thing, count, rng, 4, lie=thing == 2) for count in (1, 2, 3)]
            results += ended(views, doubt)
    assert fit_verification(results, np.arange(4)).never == (
        NeverConfident(1, 3, None, turn.format(90)),
        NeverConfident(2, 2, 3, ""),
    )
    # The things 2 and 3 are one class now: its members are tested as strangers.
    of_class = [one for one in results if one.thing < 3]
    before = as_stored(DEFAULTS, None, 4)
    labels, new = np.array([0, 1, 2, 2]), np.full(4, -1)
    never = with_new_things(before, of_class, labels, new).never
    assert [one.thing for one in never] == [1]


def test_added_things_leave_weights_and_what_was_known_and_get_residuals_of_their_own():
    before = as_stored(
        replace(DEFAULTS, geometry=22.0),
        KnownResiduals(np.array([0.3, 0.1]), (np.array([-0.1, 0.1]),) * 3),
        2,
    )
    rng = np.random.default_rng(2)
    new = [shown(1, views, rng, 3) for views in (1, 2, 3)]
    after = with_new_things(
        before,
        new,
        np.arange(3),
        np.array([0, -1, 1]),
    ).verification
    assert (after.weights, after.things) == (before.weights, 2)
    assert (after.usual[0], after.usual[2]) == (0.3, 0.1)
    assert (
        0.176 < after.usual[1] < 0.21
    )  # between what is usual of the others and what was seen
    assert [len(row) for row in after.excess] == [3, 3, 3]


@pytest.mark.parametrize(
    ("things", "of", "each"),
    [(1, 1, 20), (3, 3, 6), (1, 78, 1), (78, 78, 1), (1000, 1000, 1)],
)
def test_a_bounded_number_of_episodes_is_shown(
    things, of, each, few_episodes, monkeypatch
):
    monkeypatch.setattr(verification_fit, "ENOUGH_EPISODES", few_episodes)
    items = to_be_shown(range(things), of, np.random.default_rng(0))
    assert len(items) == min(things, 150) * each
    assert len(set(items)) == len(items)


@pytest.fixture(scope="module")
def blocks(tmp_path_factory):
    """Two blocks that differ in the third dimension alone, and a class of two balls,
    millimetres, and their memory.
    """
    folder = tmp_path_factory.mktemp("blocks")
    scans = folder / "scans"
    for name, mesh in {
        "low.ply": trimesh.creation.box((120, 60, 30)),
        "high.ply": trimesh.creation.box((120, 60, 60)),
        "ball/small.ply": trimesh.creation.icosphere(3, 30),
        "ball/large.ply": trimesh.creation.icosphere(3, 40),
    }.items():
        (scans / name).parent.mkdir(parents=True, exist_ok=True)
        mesh.apply_translation((500, -200, 100)).export(scans / name)
    learned = nextview.learn(scans, folder / "mine", unit="mm", upright=True, workers=0)
    return folder, learned


@pytest.mark.long
def test_learn_says_how_often_things_are_named_right_by_their_geometry(blocks):
    folder, learned = blocks
    assert learned.judged == 4
    assert len(learned.accuracy) == len(learned.by_outline) == 3
    assert learned.accuracy[2] >= 0.8
    assert "by outline and size alone" in str(learned)
    card = read_card(folder / "mine/memory.json")
    assert card.scores["verified by geometry"]["3"] == pytest.approx(
        learned.accuracy[2],
        abs=1e-4,
    )
    assert len(card.memory.verification.usual) == 4
    symmetries = {
        thing.name: [one.order for one in thing.symmetries]
        for thing in card.memory.things
    }
    assert symmetries == {
        "small": [0, 0, 0],
        "large": [0, 0, 0],
        "high": [4, 2, 2],
        "low": [2, 2, 2],
    }


def test_learn_says_which_things_are_never_confident_and_why(tmp_path):
    scans = tmp_path / "scans"
    scans.mkdir()
    step = trimesh.util.concatenate(
        [
            trimesh.creation.box((90, 50, 20)),
            trimesh.creation.box(bounds=[[-45, -25, 10], [-5, 5, 60]]),
        ]
    )
    for name, mesh in {
        "step": step,
        "rod": trimesh.creation.cylinder(15, 110, sections=64),
        "twin": trimesh.creation.box((70, 70, 30)),
        "other_twin": trimesh.creation.box((70, 70, 30)),
    }.items():
        mesh.export(scans / f"{name}.ply")
    named = ("rod=none",)  # as if it had a mark that no depth camera sees
    learned = nextview.learn(
        scans, tmp_path / "mine", unit="mm", workers=0, symmetry=named
    )
    why = dict(learned.never_confident)
    assert set(why) == {"rod", "twin", "other_twin"}
    assert "its orientation is known to ±" in why["rod"]
    assert "it looks the same after a turn of" in why["rod"]
    assert why["twin"].endswith("it looks like other_twin")
    assert why["other_twin"].endswith("it looks like twin")
    assert f"never confident: rod, {why['rod']}" in str(learned)


def test_geometry_is_carried_over_and_only_new_things_are_shown(blocks, tmp_path):
    folder, _ = blocks
    before = TaughtThings.of(TaughtRecogniser(folder / "mine/memory.json"))
    scans = tmp_path / "new"
    scans.mkdir()
    trimesh.creation.cylinder(25, 100).export(scans / "can.ply")
    models = tmp_path / "mine"
    models.mkdir()
    for file in (folder / "mine").iterdir():
        (models / file.name).write_bytes(file.read_bytes())

    learned = nextview.learn(
        scans,
        models,
        unit="mm",
        upright=True,
        workers=0,
        add=True,
    )
    assert learned.judged == 1
    assert "of 1 of them" in str(learned)
    after = TaughtThings.of(TaughtRecogniser(models / "memory.json"))
    assert sorted(after.names) == sorted([*before.names, "can"])
    for number, name in enumerate(before.names):
        same = after.names.index(name)
        old, new = (
            before.verifier.caster.surfaces[number],
            after.verifier.caster.surfaces[same],
        )
        np.testing.assert_array_equal(old.vertices, new.vertices)
        np.testing.assert_array_equal(old.faces, new.faces)
        assert before.symmetries[number] == after.symmetries[same]
        assert before.residuals.usual[number] == after.residuals.usual[same]
    assert before.verifier.weights == after.verifier.weights

    named = ("small=none", "large=z:6")
    nextview.learn(models, models, remove=("can", "low"), symmetry=named)
    kept = TaughtThings.of(TaughtRecogniser(models / "memory.json"))
    assert sorted(kept.names) == ["high", "large", "small"]
    assert len(kept.residuals.usual) == 3
    symmetries = dict(zip(kept.names, kept.symmetries, strict=True))
    found = dict(zip(after.names, after.symmetries, strict=True))
    assert symmetries == {
        "high": found["high"],
        "large": (Symmetry((0.0, 0.0, 1.0), 6),),
        "small": (),
    }
    with pytest.raises(UsageError, match="nothing is called mug"):
        nextview.learn(models, models, symmetry=("mug=none",))
