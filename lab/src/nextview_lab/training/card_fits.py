"""Fit calibration, error rates, sizes and valleys to held-out predictions."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from numpy.random import Generator
from scipy.optimize import minimize
from scipy.stats import beta, gaussian_kde

from nextview.checks import number
from nextview.errors import DatasetError, UsageError
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import EpisodeState, Evidence
from nextview.policies.baselines import Random, RandomAll
from nextview.policies.maps import MapPeak
from nextview.recognition.belief import (
    PLAIN_SUM,
    Calibration,
    RiskBounds,
    SizeEvidence,
    fuse,
)
from nextview.recognition.model_card import ModelCard
from nextview.types import Float, Floats, Index, Mask
from nextview_lab.data.predictions import Predictions, of_true_class
from nextview_lab.data.splits import deduplicated
from nextview_lab.data.store import ViewStore
from nextview_lab.errors import PredictionsError
from nextview_lab.training.fitting_set import (
    blind_walks,
    card_to_fit,
    for_fitting,
    load_sensed,
)

# thresholds with guaranteed error rates
PROMISED_THRESHOLDS = tuple(np.round(1 - np.geomspace(0.5, 0.002, 32), 4).tolist())


@dataclass(frozen=True)
class FittedCalibration:
    """Result of ``fit_calibration``.

    Attributes:
        calibration: the calibration.
        objects: number of objects in the fit.
        before: negative log-likelihood over 1 to 5 views before the fit.
        after: the same after the fit.
    """

    calibration: Calibration
    objects: int
    before: float
    after: float


def fit_calibration(
    predictions: Path,
    card: Path,
    sensed: tuple[Path, ...] = (),
    delta: float = 0.1,
    seed: int = 0,
) -> FittedCalibration:
    """Calibrate a recogniser: temperature, correlation of views, and error rates.

    The result is written into the card. Run nextview-lab predict again to update existing
    predictions; it does not run the networks again. The size of the objects is not used.

    Args:
        predictions: predictions of the training split (nextview-lab predict --held-out, or --split
            train).
        card: card of the recogniser, into which "calibration" is written. The fit uses the objects
            that the card lists as held out.
        sensed: predictions of the same objects through sensors (nextview-lab render --sensor mix),
            which are used for the fit as well.
        delta: probability with which a guaranteed error rate may be wrong.
        seed: seed of the random walks of the fit.
    """
    if not 0 < number(delta, "--delta") < 1:
        raise UsageError(f"delta is a probability between 0 and 1, not {delta}")

    table = Predictions.load(predictions).by_shape()
    with card_to_fit(card) as (model, write):
        _check_recogniser(card, model, predictions, table)
        table = _held_out(predictions, table, card, model)
        data = Predictions.joined([table, *load_sensed(sensed, table)])
        walks = 1 + 8000 // len(data)  # more walks per object if there are few objects
        calibration = fit_temperature(
            data,
            np.random.default_rng([seed, 0]),
            walks=walks,
        )
        risk = fit_risk(
            data,
            calibration,
            np.random.default_rng([seed, 1]),
            delta,
            walks=walks,
        )
        calibration = replace(calibration, risk=risk)
        about = f"{len(table)} objects of the training split, classes weighted evenly"
        if sensed:
            about += ", clean and through sensors"
        write("calibration", about, [table], calibration=calibration)
    before, after = (
        loss(data, c, np.random.default_rng([seed, 2]), walks=walks)
        for c in (PLAIN_SUM, calibration)
    )

    return FittedCalibration(calibration, len(data), before, after)


def _held_out(
    path: Path,
    table: Predictions,
    card: Path,
    model: ModelCard,
) -> Predictions:
    """Return the objects that a card lists as held out of its training, without duplicates."""
    once = deduplicated(for_fitting(table).labels, table.depth_entropy)
    kept = once[np.isin(np.array(table.names)[once], model.held_out)]
    if len(kept) == 0:
        raise PredictionsError(
            f"{path}: holds no object that {card} calls held out of its training"
        )
    return table.of_objects(kept)


def _check_recogniser(
    path: Path,
    card: ModelCard,
    predictions: Path,
    table: Predictions,
) -> None:
    """Reject predictions of another recogniser than a card's.

    Predictions without the name of a recogniser are accepted.
    """
    by = table.models.get("recogniser")
    if card.sha256 != by[1] if by else card.classes != table.classes:
        raise PredictionsError(
            f"{predictions}: comes from another recogniser than {path}"
        )


@dataclass(frozen=True)
class Walks:
    """Random walks over all objects: half in the local window, half over the sphere.

    Attributes:
        data: predictions for the objects.
        objects: object of each walk, (walks,).
        totals: log-evidence summed over the views so far, (walks, views, D).
    """

    data: Predictions
    objects: Index
    totals: Float

    @classmethod
    def draw(
        cls,
        data: Predictions,
        rng: Generator,
        n_views: int,
        walks: int,
    ) -> "Walks":
        """Draw random walks over every object.

        Args:
            data: predictions.
            rng: source of all random numbers.
            n_views: views of each walk.
            walks: number of walks of each kind (local window, whole sphere) over every object.

        Returns:
            The walks.
        """
        objects = np.tile(np.arange(len(data)), 2 * walks)
        views = []
        n_views = min(n_views, len(data.sphere))
        for policy in (Random(data.sphere), RandomAll(data.sphere)):
            starts = rng.integers(len(data.sphere), size=walks * len(data))
            views.append(blind_walks(data.sphere, policy, starts, n_views, rng))
        evidence = data.log_evidence[objects[:, None], np.concatenate(views)].astype(
            np.float64
        )
        return cls(data, objects, np.cumsum(evidence, axis=1))

    @property
    def numbers(self) -> Index:
        """Return the numbers of views so far, 1, 2, ..."""
        return np.arange(1, self.totals.shape[1] + 1)

    def loss(self, calibration: Calibration) -> float:
        """Return the mean negative log-likelihood over all numbers of views.

        Classes have equal weight.
        """
        logs = calibration.log_belief(self.totals, self.numbers, len(self.data.classes))
        weights = self.data.weights[self.objects]
        of_truth = of_true_class(logs, self.data.labels[self.objects])
        return -float((weights / weights.sum() / len(self.numbers)) @ of_truth.sum(1))


def fit_temperature(
    data: Predictions,
    rng: Generator,
    n_views: int = 5,
    walks: int = 4,
) -> Calibration:
    """Fit the temperature of one view and the correlations of several by maximum likelihood.

    Args:
        data: predictions of held-out objects.
        rng: source of all random numbers.
        n_views: largest number of views that are fused.
        walks: number of random walks of each kind over every object.

    Returns:
        The calibration.
    """
    walked = Walks.draw(data, rng, n_views, walks)

    def calibration(parameters: Float) -> Calibration:
        temperature, correlation, *of_bins = parameters.tolist()
        return Calibration(
            temperature,
            correlation,
            bin_correlation=of_bins[0] if of_bins else None,
        )

    def lost(parameters: Float) -> float:
        return walked.loss(calibration(parameters))

    begin = np.array([1.0, 0.5] if data.azimuth_bins is None else [1.0, 0.5, 0.1])
    bounds = [(0.01, 100.0), (0.0, 5.0), (0.0, 5.0)][: len(begin)]
    return calibration(
        np.round(minimize(lost, begin, method="L-BFGS-B", bounds=bounds).x, 4)
    )


def loss(
    data: Predictions,
    calibration: Calibration,
    rng: Generator,
    n_views: int = 5,
    walks: int = 4,
) -> float:
    """Return the mean negative log-likelihood of the true class; see ``fit_temperature``.

    Args:
        data: predictions of held-out objects.
        calibration: to evaluate.
        rng: source of all random numbers.
        n_views: largest number of views that are fused.
        walks: number of random walks of each kind over every object.

    Returns:
        The loss, nats.
    """
    return Walks.draw(data, rng, n_views, walks).loss(calibration)


def fit_risk(
    data: Predictions,
    calibration: Calibration,
    rng: Generator,
    delta: float = 0.1,
    n_views: int = 8,
    walks: int = 4,
) -> RiskBounds:
    """Fit the error rates that can be guaranteed among the episodes that stop at a threshold.

    The bounds hold on either half of the walks.

    Args:
        data: predictions of held-out objects.
        calibration: of the recogniser.
        rng: source of all random numbers.
        delta: probability with which a bound may be wrong.
        n_views: largest number of views of an episode.
        walks: number of random walks of each kind over every object.

    Returns:
        The bounds.
    """
    walked = Walks.draw(data, rng, n_views, walks)
    belief = calibration.belief(walked.totals, walked.numbers, len(data.classes))
    sure = belief.max(2)
    wrong = belief.argmax(2) != data.labels[walked.objects][:, None]
    halves = np.split(np.arange(len(walked.objects)), 2)
    promised = []
    for n in walked.numbers:
        each = [
            _promise(sure[half, :n], wrong[half, :n], data.weights, delta)
            for half in halves
        ]
        promised.append(tuple(np.max(each, axis=0).round(5).tolist()))
    return RiskBounds(PROMISED_THRESHOLDS, tuple(promised), delta)


def _promise(sure: Float, wrong: Mask, weights: Float, delta: float) -> Float:
    """Return the guaranteed error rate of each threshold, (T,).

    Confidences and errors are (walks * N, views).
    """
    promised = np.ones(len(PROMISED_THRESHOLDS))
    worst = 0.0
    for t in reversed(range(len(PROMISED_THRESHOLDS))):
        reached = sure >= PROMISED_THRESHOLDS[t]
        failed = wrong[np.arange(len(wrong)), reached.argmax(1)] & reached.any(1)
        failed, stopped = (
            x.reshape(-1, len(weights)).mean(0) for x in (failed, reached.any(1))
        )
        if worst > 0 or weights @ stopped >= weights.sum() / 2:
            worst = max(worst, error_bound(failed, stopped, weights, delta))
            promised[t] = worst
    return promised


def error_bound(failed: Float, stopped: Float, weights: Float, delta: float) -> float:
    """Return an upper bound of a weighted error rate.

    It is the bound of Clopper and Pearson for an effective number of objects.

    Args:
        failed: share of failures of each object, (N,).
        stopped: share of stops of each object, (N,).
        weights: of the objects, (N,).
        delta: probability with which the bound may be wrong.

    Returns:
        The bound, 0 to 1.
    """
    total = float(weights @ stopped)
    if total == 0:
        return 1.0
    rate = float(weights @ failed) / total
    objects = total**2 / float(((weights * stopped) ** 2).sum())
    variance = float(((weights * (failed - rate * stopped)) ** 2).sum()) / total**2
    effective = min(objects, rate * (1 - rate) / variance) if variance > 0 else objects
    return float(
        beta.ppf(1 - delta, effective * rate + 1, max(effective * (1 - rate), 1e-9))
    )


RADII = np.geomspace(0.02, 20, 93)  # metres; steps of 7.8 %
# share of the objects of a class with an arbitrary size: toys, and models in wrong units
ANY_SIZE = 0.05


@dataclass(frozen=True)
class FittedSize:
    """Result of ``fit_size``.

    Attributes:
        size: the sizes of each class.
        objects: number of objects that define the sizes.
        weighed_on: number of other objects that define the weight.
        before: negative log-likelihood of single views without the size.
        after: the same with the size.
    """

    size: SizeEvidence
    objects: int
    weighed_on: int
    before: float
    after: float


def fit_size(
    store: Path,
    predictions: Path,
    card: Path,
) -> FittedSize:
    """Fit the sizes of the objects of each class, for stores and cameras with a known scale.

    The result is written into the card. Run nextview-lab predict again to update existing
    predictions; it does not run the networks again.

    Args:
        store: view store with a known unit of its meshes (nextview-lab render --unit). The fit uses
            its training objects, except those in the predictions.
        predictions: predictions of training objects that the recogniser has not seen (nextview-lab
            predict --held-out). They determine the weight of the size relative to the shape.
        card: card of the recogniser, into which "size" is written.
    """
    views = ViewStore.open(store)
    predicted = Predictions.load(predictions)
    table = predicted.deduplicate().by_shape()

    if np.isnan(views.radii[views.done]).any():
        raise DatasetError(
            f"{store}: does not know the unit of its meshes; tell it with nextview-lab"
            " render --unit"
        )

    rows = views.rows_of(predicted.names)
    if (rows < 0).any():
        raise PredictionsError(
            f"{predictions}: holds {predicted.names[rows.argmin()]!r}, which {store} does not"
        )

    with card_to_fit(card) as (model, write):
        _check_recogniser(card, model, predictions, table)
        data = for_fitting(table)
        judged = views.rows_of(table.names)

        of_training = (
            views.done
            & (views.splits == "train")
            & np.isin(views.attributes.labels, table.classes)
        )
        taught = np.setdiff1d(np.flatnonzero(of_training), rows)

        classes = np.array(
            [
                table.classes.index(name) if name in table.classes else -1
                for name in views.classes
            ]
        )
        log_density = densities(
            views.radii[taught],
            classes[views.labels[taught]],
            len(table.classes),
        )

        size, before, after = fit_weight(data, views.radii[judged], log_density)
        about = f"{len(taught)} objects of the training split, weighed on {len(data)} others"
        write("size", about, [views, table], size=size)
    return FittedSize(size, len(taught), len(data), before, after)


def densities(radii: Float, labels: Index, classes: int) -> Float:
    """Return the log-density of each class over the log radius.

    Args:
        radii: of the objects, metres, (N,).
        labels: class of each object, (N,).
        classes: number of classes.

    Returns:
        Log-density at ``RADII``, (classes, R) float64.

    Raises:
        DatasetError: a class has no objects of different sizes.
    """
    span = np.log(RADII[-1] / RADII[0])
    density = np.empty((classes, len(RADII)))
    for c in range(classes):
        logs = np.log(radii[labels == c])
        if len(logs) < 2 or np.ptp(logs) == 0:
            raise DatasetError("every class needs objects of several sizes")
        # standard deviation of a Gaussian with these quartiles
        middle = np.subtract(*np.percentile(logs, (75, 25))) / 1.34
        deviation = logs.std(ddof=1)
        width = len(logs) ** -0.2 * (min(middle, deviation) or deviation)
        kernels = gaussian_kde(logs, width / deviation)(np.log(RADII))
        density[c] = np.log((1 - ANY_SIZE) * kernels + ANY_SIZE / span)
    return density


def fit_weight(
    data: Predictions,
    radii: Float,
    log_density: Float,
) -> tuple[SizeEvidence, float, float]:
    """Fit the weight of the size relative to the logits of single views.

    The temperature is fitted together with the weight.

    Args:
        data: predictions of held-out objects.
        radii: of the objects, metres, (N,).
        log_density: of each class at ``RADII``, (classes, R).

    Returns:
        The evidence from size, the loss without it, and the loss with it.
    """
    of_size = SizeEvidence.from_arrays(RADII, log_density, 1.0).logits(radii)[:, None]

    def loss(parameters: Float) -> float:
        temperature, weight = parameters
        logs = (data.logits + weight * of_size).astype(np.float64) / temperature
        return -float(
            np.average(of_true_class(logs, data.labels).mean(1), weights=data.weights)
        )

    fitted = minimize(
        loss,
        np.ones(2),
        method="L-BFGS-B",
        bounds=[(0.01, 100.0), (0.0, 10.0)],
    )
    size = SizeEvidence.from_arrays(
        RADII.round(5),
        log_density.round(3),
        round(float(fitted.x[1]), 4),
    )
    return size, loss(np.array([1.0, 0.0])), float(fitted.fun)


@dataclass(frozen=True)
class FittedValleys:
    """Result of ``fit_valleys``.

    Attributes:
        classes: for which the valley is the better view.
        objects: number of objects in the fit.
    """

    classes: tuple[str, ...]
    objects: int


def fit_valleys(
    predictions: Path,
    card: Path,
) -> FittedValleys:
    """Choose the classes for which the valley of a predicted map is a better view than its peak.

    The result is written into the card. Run nextview-lab predict again to update existing
    predictions; it does not run the networks again.

    Args:
        predictions: predictions of the training split by a recogniser that was not trained on the
            objects (nextview-lab predict --held-out). The fit uses those objects that the map
            network was not trained on either.
        card: card of the map network, into which "valley_classes" is written.
    """
    table = Predictions.load(predictions)

    with card_to_fit(card, recogniser=False) as (model, write):
        if model.kind not in table.maps or table.models.get(model.kind) != (
            model.name,
            model.sha256,
        ):
            raise PredictionsError(f"{predictions}: holds no maps by {card}")

        kept = _held_out(predictions, table, card, model)
        by_class = valley_gains(
            kept.sphere,
            kept.logits,
            kept.maps[model.kind],
            kept.labels,
        )
        classes = tuple(table.classes[c] for c, gain in by_class.items() if gain > 0)
        gains = {table.classes[c]: round(gain, 4) for c, gain in by_class.items()}
        judge = table.models.get("recogniser", ("a recogniser without a card", ""))[0]

        about = f"{len(kept)} objects of the training split, judged by {judge}"
        write("valleys", about, [table], valley_classes=classes, valley_gain=gains)
    return FittedValleys(classes, len(kept))


def valley_gains(
    sphere: ViewSphere,
    logits: Floats,
    maps: Floats,
    labels: Index,
) -> dict[int, float]:
    """Return the gain of a map's valley over its peak for each class.

    The gain is that of the belief in the true class after the second view.

    Args:
        sphere: the viewpoints.
        logits: (N, V, classes).
        maps: predicted local maps of each view, (N, V, rings, 3).
        labels: true classes, (N,) int64.

    Returns:
        Mean gain by class index.
    """
    n, v, classes = logits.shape
    objects = np.repeat(np.arange(n), v)
    first = np.tile(np.arange(v), n)
    seen = logits[objects, first]
    visited = np.eye(v, dtype=bool)[first]
    evidence = Evidence(seen, {"map": maps[objects, first]})
    state = EpisodeState(
        current=first,
        visited=visited,
        belief=fuse(seen[:, None]),
        evidence=evidence,
        step=1,
    )

    def belief_in_truth(valley_classes: tuple[int, ...]) -> Float:
        policy = MapPeak(sphere, "map", valley_classes)
        second = policy.next_views(state, np.random.default_rng(0))  # deterministic
        return fuse(np.stack([seen, logits[objects, second]], 1))[
            np.arange(n * v),
            labels[objects],
        ]

    gain = belief_in_truth(tuple(range(classes))) - belief_in_truth(())
    return {int(c): float(gain[labels[objects] == c].mean()) for c in np.unique(labels)}
