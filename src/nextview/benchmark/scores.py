"""How often a recogniser is right, and how well maps are predicted: the scores on a model's card."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def accuracy(answers: NDArray[np.int64], labels: NDArray[np.int64]) -> dict[str, float]:
    """Share of right answers (...,) over all ("instance") and as the mean over classes ("class")."""
    right = answers == labels
    classes = [right[labels == c].mean() for c in np.unique(labels)]
    return {"instance": round(float(right.mean()), 4), "class": round(float(np.mean(classes)), 4)}


def recogniser_scores(logits: NDArray[np.floating], labels: NDArray[np.int64]) -> dict[str, dict[str, float]]:
    """Accuracy from one view, over all views, and with the logits of all views of an object summed.

    Args:
        logits: (N, V, classes).
        labels: (N,).
    """
    spread = np.broadcast_to(labels[:, None], logits.shape[:2])
    return {
        "single_view": accuracy(logits.argmax(2), spread),
        "all_views_fused": accuracy(logits.sum(1).argmax(1), labels),
    }


MAP_DIGITS = {"mse": 5, "d0": 4, "d_le_1": 4, "d_lt_2": 4, "regret": 4}
"""Scores of a map, and the digits of them on a card."""


def map_errors(predicted: NDArray[np.floating], true: NDArray[np.floating]) -> dict[str, NDArray[np.float64]]:
    """How well each of M local maps is predicted (thesis, section 5.3 and table 4).

    Args:
        predicted: (M, rings, 3).
        true: the same shape.

    Returns:
        Each (M,): the mean squared error; whether the predicted highest cell lies at distance d = 0, d <= 1, d < 2
        cells from the true one, 0 or 1; the regret: true highest value minus the true value at the predicted highest
        cell. Of equal cells the first one is the highest.
    """
    m, _, columns = true.shape
    p, t = predicted.reshape(m, -1).astype(np.float64), true.reshape(m, -1).astype(np.float64)
    at, best = p.argmax(1), t.argmax(1)
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
    return {name: round(float(v.mean()), MAP_DIGITS[name]) for name, v in map_errors(predicted, true).items()}
