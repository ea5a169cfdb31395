"""Evaluate the models on every view of every object, without a policy."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ResultsError
from nextview.recognition.belief import Calibration
from nextview.recognition.map_names import CONFIDENCE, measure_of
from nextview.recognition.model_card import ModelCard
from nextview.types import Float, Float32, Floats, Index, Mask
from nextview_lab.benchmark import statistics as st
from nextview_lab.benchmark.published import (
    published_map,
    published_recognisers,
)
from nextview_lab.benchmark.true_maps import known_maps, true_map
from nextview_lab.data import metrics
from nextview_lab.data.predictions import Predictions
from nextview_lab.extras import extras

with extras():
    import pandas as pd


@dataclass(frozen=True)
class Evaluation:
    """The results of an evaluation, as long tables.

    Intervals are 95 % bootstrap intervals over objects, ``low`` to ``high``.

    Attributes:
        accuracy: by n_views (1, or V: all logits summed), label (empty: all) and measure:
            ``accuracy``; ``clean_accuracy``, without objects whose identical mesh also has another
            label; ``shape_accuracy``, without size evidence; the prefix ``class_`` marks means over
            classes.
        fusion: accuracy, mean confidence and calibration error after fusing a number of random
            views.
        confusion: answers by n_views, label and answer; an answer is given per view, or per object.
        maps: scores (``metrics.map_errors``) by map, by, label. ``by`` is the network, or the mean
            of the true maps of these objects: over all, or for the true class at the view.
        left_out: reason for each map that is not evaluated, or not on all objects.
    """

    accuracy: pd.DataFrame
    fusion: pd.DataFrame
    confusion: pd.DataFrame
    maps: pd.DataFrame
    left_out: dict[str, str]

    def tables(self) -> dict[str, pd.DataFrame]:
        """Return the tables by name."""
        return {
            name: table
            for name, table in vars(self).items()
            if isinstance(table, pd.DataFrame)
        }


def evaluate(p: Predictions, samples: int, rng: np.random.Generator) -> Evaluation:
    """Evaluate the recogniser and the map networks behind predictions.

    Args:
        p: the predictions.
        samples: number of bootstrap samples.
        rng: source of all random numbers.

    Returns:
        All tables.

    Raises:
        ResultsError: there is only one class, or no bootstrap sample.
    """
    if len(p.classes) < 2:
        raise ResultsError(
            f"the recogniser knows one class only, {p.classes[0]}: there is nothing to tell apart"
        )

    if samples < 1:
        raise ResultsError(
            f"at least one sample of the bootstrap is needed, not {samples}"
        )

    weights = st.resample(len(p), samples, rng)
    right, confidence = fused_views(
        p.log_evidence,
        p.labels,
        p.calibration,
        rng,
        len(p.classes),
    )
    judged, (maps, left_out) = _judged(p), _maps(p, weights)
    accuracy = _accuracy(p, judged, weights)
    fusion = _fusion(p, right, confidence, weights)
    return Evaluation(
        accuracy,
        fusion,
        _confusion(p, judged),
        maps,
        left_out,
    )


def _judged(p: Predictions) -> dict[int, NDArray]:
    """Return logits of single views and log-beliefs of all views, (N, answers, C) each."""
    fused = p.calibration.log_belief(
        p.log_evidence.astype(np.float64).sum(1),
        len(p.sphere),
        len(p.classes),
    )
    return {1: p.logits, len(p.sphere): fused[:, None]}


def fused_views(
    log_evidence: Floats,
    labels: Index,
    calibration: Calibration,
    rng: np.random.Generator,
    classes: int,
) -> tuple[Mask, Float32]:
    """Fuse 1, 2, ... V views of each object, in a random order and all of its rotations.

    Args:
        log_evidence: of the views, (N, V, D).
        labels: true classes, (N,) int64.
        calibration: of the recogniser.
        rng: source of all random numbers.
        classes: number of classes.

    Returns:
        Whether the answer is right, (V, N, V) bool, and the confidence in it, (V, N, V) float32: by
        number of views, object and rotation.
    """
    n, v, _ = log_evidence.shape
    order = rng.permuted(np.tile(np.arange(v), (n, 1)), axis=1)
    shuffled = np.take_along_axis(
        log_evidence.astype(np.float64),
        order[:, :, None],
        axis=1,
    )
    right = np.empty((v, n, v), bool)
    confidence = np.empty((v, n, v), np.float32)

    for turn in range(v):
        belief = calibration.belief(
            np.roll(shuffled, -turn, axis=1).cumsum(1),
            np.arange(1, v + 1),
            classes,
        )
        right[:, :, turn] = (belief.argmax(2) == labels[:, None]).T
        confidence[:, :, turn] = belief.max(2).T

    return right, confidence


def _means(
    top: Float,
    bottom: Float,
    labels: Index,
    classes: tuple[str, ...],
    weights: Float | None,
) -> Iterator[tuple[str, str, Float, Float, Float]]:
    """Return ratios of sums over objects, (N, M): over all, over classes, and by class.

    The prefix "class_" marks the mean over classes.
    """
    every = np.ones(len(labels), bool)
    in_classes = [(classes[index], "", labels == index) for index in np.unique(labels)]
    for label, over, here in (("", "", every), ("", "class_", every), *in_classes):
        drawn = np.zeros((1, len(labels))) if weights is None else weights
        value, samples = st.estimate(
            top[here],
            bottom[here],
            drawn[:, here],
            labels if over else None,
        )
        yield label, over, value, *st.interval(samples)


def _accuracy(
    p: Predictions,
    judged: dict[int, NDArray],
    weights: Float,
) -> pd.DataFrame:
    one = np.ones(len(p))
    clean = np.where(p.conflicting, 0.0, 1.0)
    by_shape = {} if p.of_size is None else _judged(p.by_shape())
    best = published_recognisers(p.classes, len(p.sphere))

    rows = []
    for n_views, logits in judged.items():
        scored = {"accuracy": logits, "clean_accuracy": logits}
        if by_shape:
            scored["shape_accuracy"] = by_shape[n_views]

        right = np.stack(
            [(x.argmax(2) == p.labels[:, None]).mean(1) for x in scored.values()],
            1,
        )
        bottom = np.stack(
            [clean if measure == "clean_accuracy" else one for measure in scored],
            1,
        )
        for label, over, value, low, high in _means(
            right * bottom,
            bottom,
            p.labels,
            p.classes,
            weights,
        ):
            here = p.labels == p.classes.index(label) if label else slice(None)
            for i, (measure, objects) in enumerate(
                zip(scored, bottom[here].sum(0), strict=True)
            ):
                beside = (
                    best[0][2]
                    if best and (n_views, label, over, i) == (1, "", "", 0)
                    else np.nan
                )
                rows.append(
                    (
                        n_views,
                        label,
                        over + measure,
                        int(objects),
                        value[i],
                        low[i],
                        high[i],
                        beside,
                    )
                )

    return pd.DataFrame(
        rows,
        columns=[
            "n_views",
            "label",
            "measure",
            "objects",
            "value",
            "low",
            "high",
            "published",
        ],
    )


def _fusion(
    p: Predictions,
    right: Mask,
    confidence: Float32,
    weights: Float,
) -> pd.DataFrame:
    top = right.mean(2).T
    one = np.ones_like(top)
    low, high = st.interval(metrics.ratio(top, one, weights))
    errors = [
        metrics.calibration_error(c.ravel(), r.ravel())
        for c, r in zip(confidence, right, strict=True)
    ]

    return pd.DataFrame(
        {
            "n_views": np.arange(1, len(right) + 1),
            "accuracy": top.mean(0),
            "low": low,
            "high": high,
            "class_accuracy": metrics.class_mean(
                top,
                one,
                p.labels,
                np.ones((1, len(p))),
            )[0],
            "confidence": confidence.mean((1, 2), np.float64),
            "calibration_error": errors,
        }
    )


def _confusion(p: Predictions, judged: dict[int, NDArray]) -> pd.DataFrame:
    rows = []
    for n_views, logits in judged.items():
        counts = np.zeros((len(p.classes), len(p.classes)), np.int64)
        np.add.at(counts, (p.labels[:, None], logits.argmax(2)), 1)
        rows += [
            (n_views, p.classes[i], p.classes[j], int(count))
            for (i, j), count in np.ndenumerate(counts)
        ]
    return pd.DataFrame(rows, columns=["n_views", "label", "answer", "answers"])


def judged_objects(p: Predictions, name: str) -> Index:
    """Return the objects whose true map is defined.

    The confidence map needs an object that is recognised from some view (thesis, section 4.1.3).

    Args:
        p: the predictions.
        name: of the map.

    Returns:
        Rows of the objects.
    """
    right = p.logits.argmax(2) == p.labels[:, None]
    return (
        np.flatnonzero(right.any(1))
        if measure_of(name) == CONFIDENCE
        else np.arange(len(p))
    )


def baselines(true: Floats, labels: Index) -> dict[str, Floats]:
    """Return baseline maps for the comparison with networks.

    Args:
        true: the true maps, (N, V, rings, 3).
        labels: class of each object, (N,) int64.

    Returns:
        The mean map, and the mean map of the class at the view, each of the shape of ``true``.
    """
    classes, row = np.unique(labels, return_inverse=True)
    of_class = np.stack([true[labels == index].mean(0) for index in classes])
    return {
        "mean map": np.broadcast_to(true.mean((0, 1)), true.shape),
        "mean map of the class": of_class[row],
    }


def _maps(p: Predictions, weights: Float) -> tuple[pd.DataFrame, dict[str, str]]:
    rows: list[tuple] = []
    left_out = {} if p.maps else {"maps": "these predictions hold none"}
    known = known_maps(p)

    for name, predicted in p.maps.items():
        if name.endswith("-sphere"):  # its local window is evaluated
            continue
        if name not in known:
            left_out[name] = (
                f"what is true of this map is not known; known are {', '.join(known)}"
            )
            continue
        kept = judged_objects(p, name)
        if len(kept) == 0:
            left_out[name] = "no object is recognised from any view"
            continue
        if len(kept) < len(p):
            left_out[name] = (
                f"without the objects that are recognised from no view: {len(p) - len(kept)} of"
                f" {len(p)}"
            )
        true = true_map(p, name)[kept]
        labels = p.labels[kept]
        for by, maps in {"network": predicted[kept], **baselines(true, labels)}.items():
            window = true.shape[2:]
            errors = metrics.map_errors(
                maps.reshape(-1, *window),
                true.reshape(-1, *window),
            )
            top = np.stack(
                [values.reshape(len(kept), -1).mean(1) for values in errors.values()],
                1,
            )
            drawn = weights[:, kept] if by == "network" else None
            for label, over, value, low, high in _means(
                top,
                np.ones_like(top),
                labels,
                p.classes,
                drawn,
            ):
                for i, measure in enumerate(errors):
                    beside = None
                    if by == "network":
                        beside = published_map(
                            name,
                            over + measure,
                            p.classes,
                            label or None,
                        )
                    rows.append(
                        (
                            name,
                            by,
                            label,
                            over + measure,
                            value[i],
                            low[i],
                            high[i],
                            beside,
                        )
                    )
    columns = ["map", "by", "label", "measure", "value", "low", "high", "published"]

    return pd.DataFrame(rows, columns=columns).astype(
        {"published": "float64"}
    ), left_out


def scores_for_card(card: ModelCard, p: Predictions) -> dict[str, Any]:
    """Return the scores of a model for its card.

    Args:
        card: of the model.
        p: predictions of the model.

    Returns:
        The scores by name.

    Raises:
        ResultsError: the predictions are from another model, or no object can be evaluated.
    """
    if p.models.get(card.kind) != (card.name, card.sha256):
        raise ResultsError(f"these predictions were not made by model {card.name}")
    if card.kind == "recogniser":
        return metrics.recogniser_scores(p.logits, p.labels)
    kept = judged_objects(p, card.kind)
    if card.kind not in known_maps(p) or len(kept) == 0:
        raise ResultsError(
            f"these predictions hold no object by which model {card.name} can be judged"
        )
    shape = (-1, p.sphere.rings, 3)
    return metrics.map_scores(
        p.maps[card.kind][kept].reshape(shape),
        true_map(p, card.kind)[kept].reshape(shape),
    )
