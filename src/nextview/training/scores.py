"""The scores on a model's card."""

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


def map_scores(predicted: NDArray[np.floating], true: NDArray[np.floating]) -> dict[str, float]:
    """How well local maps are predicted (thesis, section 5.3 and table 4).

    Args:
        predicted: (M, rings, 3).
        true: the same shape.

    Returns:
        Mean squared error; the share of maps whose predicted highest cell lies at distance d = 0, d <= 1, d < 2 cells
        from the true one; the mean regret: true highest value minus the true value at the predicted highest cell.
    """
    m, _, columns = true.shape
    p, t = predicted.reshape(m, -1), true.reshape(m, -1)
    at, best = p.argmax(1), t.argmax(1)
    distance = np.hypot(at // columns - best // columns, at % columns - best % columns)
    rows = np.arange(m)
    return {
        "mse": round(float(((p - t) ** 2).mean()), 5),
        "d0": round(float((distance == 0).mean()), 4),
        "d_le_1": round(float((distance <= 1).mean()), 4),
        "d_lt_2": round(float((distance < 2).mean()), 4),
        "regret": round(float((t[rows, best] - t[rows, at]).mean()), 4),
    }
