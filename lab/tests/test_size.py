"""How large an object is counts for its class where it is known, and nowhere else."""

import numpy as np
import pytest
from pipeline import train_predictions
from scipy.stats import norm

from nextview.geometry.viewsphere import ViewSphere
from nextview_lab.training.card_fits import RADII, fit_weight


def test_the_weight_is_the_most_likely_one():
    """Log-odds of the shape and of the size that are both calibrated add up as they are."""
    rng = np.random.default_rng(0)
    n = 4000
    labels = rng.integers(0, 2, n)
    logs = rng.normal(np.log([0.3, 0.6])[labels], 0.5)
    density = norm.logpdf(np.log(RADII)[None], np.log([[0.3], [0.6]]), 0.5)
    # log-odds of the first class
    shape = rng.normal(np.where(labels == 0, 1, -1), np.sqrt(2))
    # three views, all alike
    logits = np.stack([shape, np.zeros(n)], 1)[:, None].repeat(3, 1).astype(np.float32)
    data = train_predictions(logits, labels, ViewSphere((0.0,), 3), ("a", "b"))
    evidence, before, after = fit_weight(data, np.exp(logs), density)
    assert evidence.weight == pytest.approx(1, abs=0.15)
    alone = np.log1p(np.exp(np.where(labels == 0, -shape, shape)))
    assert before == pytest.approx(
        np.mean([alone[labels == c].mean() for c in (0, 1)]), rel=1e-4
    )
    assert after < before - 0.1
    assert fit_weight(data, np.exp(rng.permutation(logs)), density)[
        0
    ].weight == pytest.approx(0, abs=0.1)
