"""Every score, once: accuracy and its mean over classes, calibration error, and how well maps
are predicted.
"""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def ratio(top: Float, bottom: Float, weights: Float) -> Float:
    """Ratios (S, M) of sums over objects: ``top``, ``bottom`` (N, M), ``weights`` (S, N); NaN
    where bottom is empty.
    """
    with np.errstate(invalid="ignore"):
        return (weights @ top) / (weights @ bottom)


def class_mean(top: Float, bottom: Float, labels: NDArray[np.int64], weights: Float) -> Float:
    """The same ratio in each class, then the mean over the classes (those in which there is
    anything), (S, M).
    """
    total = np.zeros((len(weights), top.shape[1]))
    classes = np.zeros((len(weights), top.shape[1]))
    for label in np.unique(labels):
        here = labels == label
        value = ratio(top[here], bottom[here], weights[:, here])
        total += np.nan_to_num(value)
        classes += ~np.isnan(value)
    with np.errstate(invalid="ignore"):
        return total / classes


def mean_over_classes(values: NDArray, labels: NDArray[np.int64]) -> float:
    """The mean of values (...,) in each class, then the mean over the classes that there are."""
    top = np.asarray(values, np.float64).reshape(-1, 1)
    return float(class_mean(top, np.ones_like(top), labels.ravel(), np.ones((1, len(top))))[0, 0])


def accuracy(answers: NDArray[np.int64], labels: NDArray[np.int64]) -> dict[str, float]:
    """Share of right answers (...,) over all ("instance") and as the mean over classes
    ("class").
    """
    right = answers == labels
    return {
        "instance": round(float(right.mean()), 4),
        "class": round(mean_over_classes(right, labels), 4),
    }


def recogniser_scores(
    logits: NDArray[np.floating], labels: NDArray[np.int64]
) -> dict[str, dict[str, float]]:
    """Accuracy from one view, over all views, and with all views' logits (N, V, classes) of an
    object summed.
    """
    spread = np.broadcast_to(labels[:, None], logits.shape[:2])
    fused = accuracy(logits.sum(1).argmax(1), labels)
    return {"single_view": accuracy(logits.argmax(2), spread), "all_views_fused": fused}


def reliability(
    confidence: Float, right: NDArray[np.bool_], bins: int = 15
) -> tuple[Float, Float, NDArray[np.int64]]:
    """Mean confidence and share of right answers in bins of equal width, and how many fall in each,
    (bins,) each.

    Guo et al., On calibration of modern neural networks (2017), section 2. Empty bins are 0.
    """
    at = np.clip((confidence * bins).astype(np.int64), 0, bins - 1)
    count = np.bincount(at, minlength=bins)
    some = np.maximum(count, 1)
    return np.bincount(at, confidence, bins) / some, np.bincount(at, right, bins) / some, count


def calibration_error(confidence: Float, right: NDArray[np.bool_]) -> float:
    """Expected calibration error: the mean gap between confidence and accuracy over the bins of
    ``reliability``.
    """
    sure, accuracy, count = reliability(confidence, right)
    return float((count * np.abs(sure - accuracy)).sum() / max(1, count.sum()))


# scores of a map, and their digits on a card
MAP_DIGITS = {"mse": 5, "d0": 4, "d_le_1": 4, "d_lt_2": 4, "regret": 4}


def map_errors(
    predicted: NDArray[np.floating], true: NDArray[np.floating]
) -> dict[str, NDArray[np.float64]]:
    """How well each of M local maps (M, rings, 3) is predicted (thesis, section 5.3 and table 4);
    each (M,).

    The mean squared error; whether the predicted highest cell is d = 0, d <= 1, d < 2 cells from
    the true one; the
    regret: true highest value minus the true value at the predicted highest cell. Of equal cells
        the first counts.
    """
    m, _, columns = true.shape
    p = predicted.reshape(m, -1).astype(np.float64)
    t = true.reshape(m, -1).astype(np.float64)
    at = p.argmax(1)
    best = t.argmax(1)
    distance = np.hypot(at // columns - best // columns, at % columns - best % columns)
    rows = np.arange(m)
    return {
        "mse": ((p - t) ** 2).mean(1),
        "d0": (distance == 0).astype(np.float64),
        "d_le_1": (distance <= 1).astype(np.float64),
        "d_lt_2": (distance < 2).astype(np.float64),
        "regret": t[rows, best] - t[rows, at],
    }


def map_scores(predicted: NDArray[np.floating], true: NDArray[np.floating]) -> dict[str, float]:
    """The means of ``map_errors`` over all maps, rounded for a card."""
    return {
        name: round(float(v.mean()), MAP_DIGITS[name])
        for name, v in map_errors(predicted, true).items()
    }
