"""Fits to the surfaces of taught things: weight of the geometry, and usual residuals."""

import re
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from nextview.errors import ObservationError
from nextview.geometry.mesh import make_mesh
from nextview.geometry.observation import Observation
from nextview.geometry.resting import rotated, stable_poses
from nextview.geometry.viewsphere import look_at_origin, rotation_z
from nextview.recognition.belief import Stopping
from nextview.recognition.model_card import Verification
from nextview.recognition.poses import turn_apart
from nextview.simulation.sensed_camera import SensedCamera
from nextview.things.doubt import ORIENTATION_DOUBT, doubt_of
from nextview.things.memory import RINGS, TaughtRecogniser
from nextview.things.pose_candidates import candidates_of
from nextview.things.recogniser import most_pixels
from nextview.things.taught import TaughtThings, residuals_of
from nextview.things.unknown import KnownResiduals
from nextview.things.verifier import Verified
from nextview.things.weighing import (
    LEAST_TRUE_BELIEF,
    EvidenceWeights,
    JudgedEpisode,
    fit_weights,
)
from nextview.types import Float, Index

VIEWS_VERIFIED = (1, 2, 3)  # numbers of views after which things are tested
# most rendered views per test, including those that miss the thing
SHOWING_VIEWS_TRIED = 6
MOST_THINGS_VERIFIED = 150  # most things in the test; more are sampled
EPISODES_PER_THING = 1  # episodes per thing, if there are many
ENOUGH_EPISODES = 20  # episodes of all things together, at least
GROWTH = 2  # growth of the number of things after which the weights are refitted
# weight of the defaults, in things of the fit
DEFAULT_THINGS = 10.0
# increase of the log-likelihood that five fitted weights must reach (Akaike, 1974)
WEIGHTS_COST = 5.0
# most residuals for a number of views; more are replaced by their quantiles
MOST_RESIDUALS = 400
# fewer are extrapolated to so many: a p-value of 0.01 needs them
FEW_RESIDUALS = 100
DECIMALS = 4


@dataclass(frozen=True, eq=False)
class Shown:
    """Result of a test with one thing and some views.

    Attributes:
        thing: number of the thing among those of known geometry.
        views: number of views.
        named: number of the thing that explains the views best.
        residual: residual of that thing.
        judged: evidence; its belief is in classes.
        doubt: reason why a result is not confident in its pose, see ``things.doubt``; "" without
            one, or if later views were judged, too.
    """

    thing: int
    views: int
    named: int
    residual: float
    judged: JudgedEpisode
    doubt: str = ""


@dataclass(frozen=True)
class NeverConfident:
    """A thing that was confident in none of its tests, after all their views.

    Attributes:
        thing: number of the thing among those of known geometry.
        tests: number of its tests.
        confused: class that it was most often confused with; None if its pose was in doubt.
        doubt: the most frequent doubt about its pose; "" if it was confused.
    """

    thing: int
    tests: int
    confused: int | None
    doubt: str


@dataclass(frozen=True)
class VerifiedFit:
    """Fits to the results of tests.

    Attributes:
        verification: for the card, of the things of known geometry alone.
        accuracy: share of correct answers after 1, 2 and 3 views, with weights that were fitted to
            other things; () without tests.
        by_outline: the same by outline and size alone.
        confused: pairs of a true and an answered class, with the share of the cases, after two
            views.
        things: number of tested things.
        unseen: names of the things that no view showed well enough.
        never: tested things that were never confident.
    """

    verification: Verification
    accuracy: tuple[float, ...] = ()
    by_outline: tuple[float, ...] = ()
    confused: tuple[tuple[int, int, float], ...] = ()
    things: int = 0
    unseen: tuple[str, ...] = ()
    never: tuple[NeverConfident, ...] = ()


def to_be_shown(
    things: Sequence[int],
    known: int,
    rng: Generator,
) -> list[tuple[int, int]]:
    """Choose the tests.

    Args:
        things: numbers of the things to be tested.
        known: number of all things.
        rng: samples from very many things.

    Returns:
        (thing, draw) of each test.
    """
    some = np.sort(rng.permutation(things)[:MOST_THINGS_VERIFIED])
    episodes = max(EPISODES_PER_THING, ENOUGH_EPISODES // known)
    return [(int(thing), draw) for thing in some for draw in range(episodes)]


def show(card: Path, sensor: str, seed: int, item: tuple[int, int]) -> list[Shown]:
    """Test the recognition of one thing in simulated views of a sensor, in a random stable pose.

    A thing in a class of several is recognised by the others of its class, because a taught class
    will meet new members.

    Args:
        card: card of a memory; its weights are not used.
        sensor: see ``sensor_named``.
        seed: seed of all draws.
        item: number of the thing among those of known geometry, and number of the draw.

    Returns:
        Results after one or more views; empty if the thing is not visible, or no other thing of the
        class is known.
    """
    thing, draw = item
    known, labels = _opened(card)
    others = np.arange(len(labels))
    alone = (labels == labels[thing]).sum() == 1
    if not alone:
        others = np.delete(others, thing)
        known = TaughtThings(
            known.recogniser,
            [known.verifier.caster.surfaces[k] for k in others],
        )

    rng = np.random.default_rng([seed, thing, draw])
    observations = _views(_opened(card)[0], thing, sensor, rng)
    if not observations:
        return []

    found = []
    for count in VIEWS_VERIFIED[: len(observations)]:
        try:
            verified = known(observations[:count])
        except ObservationError:  # too little is visible for a comparison with surfaces
            continue
        judged = _of_classes(verified.judged(0), int(labels[thing]), labels[others])
        named = int(others[verified.things[0]])
        # Of a class only other members are known, whose poses say nothing about this one.
        last = alone and count == len(observations)
        doubt = _doubt(known, verified, observations) if last else ""
        found.append(Shown(thing, count, named, verified.residual, judged, doubt))
    return found


def _doubt(
    known: TaughtThings,
    verified: Verified,
    observations: Sequence[Observation],
) -> str:
    """Doubt about the likeliest pose after some views, and which pose it is mistaken for."""
    numbers = np.arange(len(known.names))
    poses, _ = candidates_of(known, verified, observations, numbers)
    doubt = doubt_of(
        verified,
        poses,
        most_pixels(observations),
        partial(known.log_odds_of_stranger, observations, verified),
    )
    own = [pose for pose in poses if pose.thing == poses[0].thing]
    if not doubt.startswith(ORIENTATION_DOUBT) or len(own) < 2:
        return doubt
    apart = [pose.probability * turn_apart(own[0], pose) ** 2 for pose in own]
    other = own[int(np.argmax(apart))]
    between = Rotation.from_matrix(own[0].pose[:3, :3].T @ other.pose[:3, :3])
    return f"{doubt}, because it looks the same after {_in_words(between)}"


def _in_words(turn: Rotation) -> str:
    """A rotation in the axes of a scan file, such as ``a turn of 180° about (1, 0, 1)``."""
    vector = turn.as_rotvec()
    angle = np.linalg.norm(vector)
    axis = vector / np.abs(vector).max()
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    # Axes that are not quite those of the file are rounded to tenths.
    named = ", ".join(f"{value:g}" for value in np.round(axis, 1) + 0.0)
    return f"a turn of {np.degrees(angle):.0f}° about the axis ({named}) of its file"


@lru_cache(maxsize=1)
def _opened(card: Path) -> tuple[TaughtThings, Index]:
    """The things of known geometry of a memory, and the class of each."""
    recogniser = TaughtRecogniser(card, threads=1)
    known = TaughtThings.of(recogniser)
    assert known is not None
    known.verifier.prepare()
    return known, class_of_things(recogniser, known)


def class_of_things(recogniser: TaughtRecogniser, known: TaughtThings) -> Index:
    """Class of each thing of known geometry.

    Args:
        recogniser: the memory.
        known: its things of known geometry.

    Returns:
        Classes, (T,) int64.
    """
    about = recogniser.card.memory
    assert about is not None
    names = [thing.name for thing in about.things]
    first = np.unique(recogniser.memory.thing, return_index=True)[1]
    of_all = np.array(recogniser.calibration.hypotheses)[first]
    return of_all[[names.index(name) for name in known.names]]


def _views(
    known: TaughtThings,
    thing: int,
    sensor: str,
    rng: Generator,
) -> list[Observation]:
    """Random views of a thing that show it.

    Its stable pose is drawn by its probability after a throw; a thing that is known in its upright
    pose only stands.
    """
    surface = known.verifier.caster.surfaces[thing]
    mesh = make_mesh(
        surface.vertices.astype(np.float64),
        surface.faces,
        surface.name,
        "m",
    )
    lies = known.standing(thing)[None]
    shares = np.ones(1)
    if not known.upright[thing]:
        stable = stable_poses(mesh)
        lies = stable.rotations
        shares = stable.shares

    turn = rotation_z(rng.uniform(0, 2 * np.pi)) @ lies[rng.choice(len(lies), p=shares)]
    camera = SensedCamera(rotated(mesh, turn), sensor, rng.spawn(1)[0])

    elevations = np.arcsin(
        rng.uniform(0, np.sin(np.radians(RINGS[-1])), SHOWING_VIEWS_TRIED)
    )
    observations = []
    for pose in look_at_origin(
        elevations,
        rng.uniform(0, 2 * np.pi, SHOWING_VIEWS_TRIED),
    ):
        observation = camera.observe(pose)
        if observation.seen:
            observations.append(observation)
        if len(observations) == max(VIEWS_VERIFIED):
            break
    return observations


def _of_classes(judged: JudgedEpisode, truth: int, labels: Index) -> JudgedEpisode:
    """Convert evidence to classes, by the class of each thing; ``truth`` is the true class."""
    by_outline = np.zeros(max(int(labels.max()), truth) + 1)
    np.add.at(by_outline, labels, judged.by_outline)
    return JudgedEpisode(
        truth,
        labels[judged.things],
        judged.mean,
        judged.camera_costs,
        judged.log_belief,
        by_outline,
    )


def fit_verification(shown: Sequence[Shown], labels: Index) -> VerifiedFit:
    """Fit weights and residuals to the results of tests.

    Args:
        shown: the results.
        labels: class of each thing of known geometry, (T,).

    Returns:
        The fits. With few things the weights are near their defaults.
    """
    things = np.array([one.thing for one in shown], np.int64)
    weights = _weights(shown)
    half = {thing: k % 2 for k, thing in enumerate(np.unique(things).tolist())}
    halves = [[one for one in shown if half[one.thing] == k] for k in (0, 1)]
    beliefs = dict[int, Float]()
    for own, other in (halves, halves[::-1]):
        fitted_elsewhere = _weights(other)
        beliefs |= {id(one): one.judged.belief(fitted_elsewhere) for one in own}

    residuals = _residuals(shown, labels)
    verification = as_stored(weights, residuals, len(labels))
    answers = [int(beliefs[id(one)].argmax()) for one in shown]
    by_outline = [int(one.judged.by_outline.argmax()) for one in shown]
    return VerifiedFit(
        verification,
        _accuracy(shown, answers),
        _accuracy(shown, by_outline),
        _confused(shown, answers),
        len(half),
        never=_never_confident(shown, [beliefs[id(one)] for one in shown], labels),
    )


def _weights(shown: Sequence[Shown]) -> EvidenceWeights:
    """Fit the weights, shrunk towards the defaults."""
    count = len({one.judged.truth for one in shown})
    if count < 2:  # a single thing is correct with any weights
        return EvidenceWeights()

    episodes = [one.judged for one in shown]
    fitted = fit_weights(episodes)
    if (
        _log_likelihood(fitted, episodes)
        < _log_likelihood(EvidenceWeights(), episodes) + WEIGHTS_COST
    ):
        return EvidenceWeights()

    share = count / (count + DEFAULT_THINGS)
    found = []
    for default, value in zip(astuple(EvidenceWeights()), astuple(fitted), strict=True):
        if min(default, value) > 0:
            found.append(default ** (1 - share) * value**share)
        else:
            found.append((1 - share) * default + share * value)
    return EvidenceWeights(*found)


def _log_likelihood(
    weights: EvidenceWeights,
    episodes: Sequence[JudgedEpisode],
) -> float:
    """Sum of the log-belief in the truth."""
    believed = [episode.belief(weights)[episode.truth] for episode in episodes]
    return float(np.log(np.maximum(believed, LEAST_TRUE_BELIEF)).sum())


def _residuals(shown: Sequence[Shown], labels: Index) -> KnownResiduals | None:
    """Residuals of known things; None without a correct answer."""
    named, values, views = _right(shown, labels)
    if not len(named):
        return None
    fitted = KnownResiduals.fit(named, values, views, len(labels))
    return KnownResiduals(
        fitted.usual,
        tuple(likely_excess(row) for row in fitted.excess),
    )


def _right(shown: Sequence[Shown], labels: Index) -> tuple[Index, Float, Index]:
    """Thing, residual and number of views of the correct answers."""
    right = [one for one in shown if labels[one.named] == one.judged.truth]
    things = np.array([one.named for one in right], np.int64)
    residuals = np.array([one.residual for one in right], np.float64)
    return things, residuals, np.array([one.views for one in right], np.int64)


def likely_excess(found: Float) -> Float:
    """Predictive quantiles of the excess residuals of known things.

    A small sample does not show how rare larger values are. For fewer than FEW_RESIDUALS values,
    the result contains the quantiles of the predictive distribution of a further normal value
    (Student's t, as for a prediction interval), or the empirical quantiles where these are larger.

    Args:
        found: see ``KnownResiduals.excess``, ascending, (N,).

    Returns:
        The same values, or FEW_RESIDUALS quantiles, ascending.
    """
    count = len(found)
    if not 1 < count < FEW_RESIDUALS:
        return found

    from scipy.special import stdtrit  # scipy.stats takes two seconds to import

    levels = (np.arange(FEW_RESIDUALS) + 0.5) / FEW_RESIDUALS
    scale = found.std(ddof=1) * np.sqrt(1 + 1 / count)
    predicted = found.mean() + scale * stdtrit(count - 1, levels)
    return np.maximum(predicted, np.quantile(found, levels))


def with_new_things(
    before: Verification,
    shown: Sequence[Shown],
    labels: Index,
    carried: Index,
) -> VerifiedFit:
    """Add the results of new things to earlier fits.

    Args:
        before: fits to all earlier things.
        shown: results of the new things; the weights do not change.
        labels: class of each thing of known geometry, (T,).
        carried: previous number of each thing, -1 for a new one, (T,).

    Returns:
        The extended fits.
    """
    weights = EvidenceWeights(**before.weights)
    beliefs = [one.judged.belief(weights) for one in shown]
    answers = [int(belief.argmax()) for belief in beliefs]
    by_outline = [int(one.judged.by_outline.argmax()) for one in shown]

    residuals = residuals_of(before, range(len(before.usual)))
    if residuals is not None:
        residuals = residuals.extended(carried, *_right(shown, labels))

    verification = as_stored(weights, residuals, before.things)
    return VerifiedFit(
        verification,
        _accuracy(shown, answers),
        _accuracy(shown, by_outline),
        _confused(shown, answers),
        len({one.thing for one in shown}),
        never=_never_confident(shown, beliefs, labels),
    )


def as_stored(
    weights: EvidenceWeights,
    residuals: KnownResiduals | None,
    things: int,
) -> Verification:
    """Round weights and residuals for a card.

    Args:
        weights: weights of the evidence.
        residuals: residuals of known things; None without any.
        things: number of things in the fit of the weights.

    Returns:
        Their entry on the card.
    """
    named = {
        field.name: float(f"{getattr(weights, field.name):.4g}")
        for field in fields(weights)
    }
    if residuals is None:
        return Verification(named, things)
    excess = []

    for row in residuals.excess:
        if len(row) > MOST_RESIDUALS:
            row = np.quantile(row, np.linspace(0, 1, MOST_RESIDUALS))
        excess.append(tuple(np.round(row, DECIMALS).tolist()))

    return Verification(
        named,
        things,
        tuple(np.round(residuals.usual, DECIMALS).tolist()),
        tuple(excess),
    )


def _accuracy(shown: Sequence[Shown], answers: Sequence[int]) -> tuple[float, ...]:
    """Share of correct answers after each number of views."""
    if not shown:
        return ()
    right = np.array([one.judged.truth for one in shown]) == answers
    views = np.array([one.views for one in shown])
    return tuple(
        float(right[views == count].mean())
        for count in VIEWS_VERIFIED
        if (views == count).any()
    )


def _confused(
    shown: Sequence[Shown],
    answers: Sequence[int],
) -> tuple[tuple[int, int, float], ...]:
    """Pairs of classes by the frequency of their confusion, worst first."""
    truths = [one.judged.truth for one in shown if one.views == 2]
    named = [
        answer for one, answer in zip(shown, answers, strict=True) if one.views == 2
    ]
    pairs = dict[tuple[int, int], float]()
    for truth, answer in zip(truths, named, strict=True):
        if truth != answer:
            pair = min(truth, answer), max(truth, answer)
            pairs[pair] = pairs.get(pair, 0) + 0.5 / truths.count(truth)
    return tuple(
        (a, b, share)
        for (a, b), share in sorted(pairs.items(), key=lambda item: -item[1])
    )


def _never_confident(
    shown: Sequence[Shown],
    beliefs: Sequence[Float],
    labels: Index,
) -> tuple[NeverConfident, ...]:
    """Things that no test ends with confidence in, and what they are confused with.

    Args:
        shown: results of the tests.
        beliefs: belief in each class, of each result.
        labels: class of each thing of known geometry, (T,).

    Returns:
        The things, by their numbers. A member of a class is left out: it is tested as a stranger.
    """
    ends = dict[int, list[tuple[Shown, Float]]]()
    for one, belief in zip(shown, beliefs, strict=True):
        if (labels == labels[one.thing]).sum() == 1:
            tests = ends.setdefault(one.thing, [])
            if one.views > 1 and tests and tests[-1][0].views < one.views:
                tests.pop()  # an earlier result of the same test
            tests.append((one, belief))

    found = []
    for thing, tests in sorted(ends.items()):
        truth = int(labels[thing])
        least = Stopping().threshold
        unsure = [one.doubt for one, belief in tests if belief[truth] >= least]
        if any(not doubt for doubt in unsure):
            continue
        count = len(tests)
        if len(unsure) * 2 > count:
            found.append(NeverConfident(thing, count, None, _usual_doubt(unsure)))
            continue
        rest = np.sum([belief for _, belief in tests], 0)
        rest[truth] = 0
        found.append(NeverConfident(thing, count, int(rest.argmax()), ""))
    return tuple(found)


def _usual_doubt(doubts: Sequence[str]) -> str:
    """The first doubt of the most frequent kind; two of a kind differ in their numbers alone."""
    kinds = [re.sub(r"\d+|, because.*", "", doubt) for doubt in doubts]
    return doubts[kinds.index(max(kinds, key=kinds.count))]
