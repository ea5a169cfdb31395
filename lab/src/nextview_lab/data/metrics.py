"""Accuracy, calibration error, and the errors of predicted maps and of poses."""

import numpy as np
from scipy.spatial import cKDTree

from nextview.types import Float, Floats, Index, Mask


def ratio(top: Float, bottom: Float, weights: Float) -> Float:
    """Return ratios of weighted sums over objects.

    Args:
        top: numerators, (N, M).
        bottom: denominators, (N, M).
        weights: of the objects in each sample, (S, N).

    Returns:
        Ratios, (S, M) float64; NaN where the denominator is 0.
    """
    with np.errstate(invalid="ignore"):
        return (weights @ top) / (weights @ bottom)


def class_mean(top: Float, bottom: Float, labels: Index, weights: Float) -> Float:
    """Return ratios of weighted sums in each class, averaged over the classes.

    Args:
        top: numerators, (N, M).
        bottom: denominators, (N, M).
        labels: class of each object, (N,) int64.
        weights: of the objects in each sample, (S, N).

    Returns:
        Mean ratios, (S, M) float64, over the classes that are not empty.
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


def accuracy(answers: Index, labels: Index) -> dict[str, float]:
    """Return the accuracy over all answers and as the mean over classes.

    Args:
        answers: classes, any shape.
        labels: true classes, the same shape.

    Returns:
        "instance": over all; "class": mean over classes. Both rounded to four decimals.
    """
    right = answers == labels
    of_classes = [right[labels == label].mean() for label in np.unique(labels)]
    return {
        "instance": round(float(right.mean()), 4),
        "class": round(float(np.mean(of_classes)), 4),
    }


def recogniser_scores(logits: Floats, labels: Index) -> dict[str, dict[str, float]]:
    """Return the accuracy for single views and for the summed logits of all views.

    Args:
        logits: (N, V, classes).
        labels: true classes, (N,) int64.

    Returns:
        "single_view" and "all_views_fused", see ``accuracy``.
    """
    spread = np.broadcast_to(labels[:, None], logits.shape[:2])
    fused = accuracy(logits.sum(1).argmax(1), labels)
    return {"single_view": accuracy(logits.argmax(2), spread), "all_views_fused": fused}


def calibration_error(confidence: Float, right: Mask, bins: int = 15) -> float:
    """Return the expected calibration error.

    It is the mean gap between confidence and accuracy over bins of equal width (Guo et al., On
    calibration of modern neural networks, 2017, section 2).

    Args:
        confidence: of each answer, (N,), 0 to 1.
        right: whether each answer is right, (N,) bool.
        bins: number of bins.

    Returns:
        The error, 0 to 1.
    """
    at = np.clip((confidence * bins).astype(np.int64), 0, bins - 1)
    gaps = np.bincount(at, confidence, bins) - np.bincount(at, right, bins)
    return float(np.abs(gaps).sum() / max(1, len(at)))


# scores of a map, and their digits on a card
MAP_DIGITS = {"mse": 5, "d0": 4, "d_le_1": 4, "d_lt_2": 4, "regret": 4}


def map_errors(predicted: Floats, true: Floats) -> dict[str, Float]:
    """Return the errors of predicted local maps (thesis, section 5.3 and table 4).

    The errors are the mean squared error ("mse"); whether the predicted highest cell is at d = 0, d
    <= 1 and d < 2 cells from the true one; and the regret, the true highest value minus the true
    value at the predicted highest cell. In case of ties the first cell is used.

    Args:
        predicted: (M, rings, 3).
        true: (M, rings, 3).

    Returns:
        The errors of each map by name, (M,) float64 each.
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


def map_scores(predicted: Floats, true: Floats) -> dict[str, float]:
    """Return the means of ``map_errors`` over all maps, rounded for a card.

    Args:
        predicted: (M, rings, 3).
        true: (M, rings, 3).

    Returns:
        The means by name.
    """
    return {
        name: round(float(v.mean()), MAP_DIGITS[name])
        for name, v in map_errors(predicted, true).items()
    }


def add_s(points: Float, pose: Float, true: Float) -> float:
    """Return the mean distance of points in a pose from the nearest points in the true pose.

    Args:
        points: of the surface, (N, 3).
        pose: (4, 4).
        true: pose, (4, 4).
    """
    here, there = (points @ one[:3, :3].T + one[:3, 3] for one in (pose, true))
    return float(np.mean(cKDTree(there).query(here)[0]))
