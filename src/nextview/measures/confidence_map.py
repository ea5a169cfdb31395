"""The recogniser's confidence as a measure of views: what an LCM learns (thesis, section 4.1.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax


def confidence_maps(logits: NDArray[np.floating], labels: NDArray[np.integer]) -> NDArray[np.float32]:
    """Confidence in each view alone where it is recognised rightly, 0 where it is not.

    An object that is right from no view has a row of zeros, and the thesis leaves it out: keep ``maps.any(1)``. A
    view is wrong where another class has the larger logit, or an equal one and the lower index.

    Args:
        logits: of the recogniser, finite, (N, V, classes).
        labels: true class of each object, (N,).

    Returns:
        (N, V) float32, 0 .. 1.
    """
    logits = np.asarray(logits, np.float64)
    right = logits.argmax(2) == labels[:, None]
    return np.where(right, softmax(logits, axis=2).max(2), 0).astype(np.float32)
