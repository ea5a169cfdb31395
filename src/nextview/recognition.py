"""What the looks add up to: belief over classes, and when to stop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


def fuse(logits: NDArray[np.floating]) -> NDArray[np.float64]:
    """Belief after several looks: softmax of the sum of their logits (thesis, section 4.4).

    Args:
        logits: (..., looks, classes).

    Returns:
        (..., classes) float64, sums to 1.

    Raises:
        ValueError: a logit is not finite.
    """
    logits = np.asarray(logits, np.float64)
    if not np.isfinite(logits).all():
        raise ValueError("the recogniser gave a logit that is not a finite number")
    total = logits.sum(-2)
    total = np.exp(total - total.max(-1, keepdims=True))
    return total / total.sum(-1, keepdims=True)


@dataclass(frozen=True)
class Stopping:
    """Stop when the belief's peak reaches ``threshold``, or after ``max_views`` looks.

    Raises:
        ValueError: a threshold outside 0 .. 1 or fewer than one view.
    """

    threshold: float = 0.97
    max_views: int = 5

    def __post_init__(self) -> None:
        if not 0 <= self.threshold <= 1:
            raise ValueError(f"the threshold is a probability between 0 and 1, not {self.threshold}")
        if self.max_views < 1:
            raise ValueError(f"at least one view has to be taken, not {self.max_views}")
