"""How large an object is counts for its class where it is known, and nowhere else."""

import numpy as np
import pytest
from pipeline import train_predictions
from scipy.stats import norm

from nextview.geometry.viewsphere import ViewSphere
from nextview_lab.training.card_fits import ANY_SIZE, RADII, densities, fit_weight


def test_a_density_is_that_of_its_class_and_a_share_of_anything():
    rng = np.random.default_rng(0)
    radii = np.exp(
        np.concatenate(
            [rng.normal(np.log(0.1), 0.1, 500), rng.normal(np.log(2), 0.1, 500)]
        )
    )
    found = densities(radii, np.repeat([0, 1], 500), 2)
    span = np.log(RADII[-1] / RADII[0])
    share = np.exp(found).mean(1) * span  # under the curve
    assert share == pytest.approx([1, 1], rel=0.03)
    near = np.abs(RADII - 0.1).argmin()
    wanted = 0.95 * norm.pdf(
        np.log(RADII[near]), np.log(0.1), np.hypot(0.1, 0.1 * 500**-0.2)
    )
    assert np.exp(found[0, near]) == pytest.approx(wanted, rel=0.15)
    assert np.exp(found[1, near]) == pytest.approx(ANY_SIZE / span)
    strays = np.concatenate([radii[:500], np.full(20, 15.0)])  # drawn in another unit
    blurred = densities(strays, np.repeat(0, 520), 1)[0, near]
    assert np.exp(blurred) == pytest.approx(wanted * 500 / 520, rel=0.15)
    with pytest.raises(ValueError, match="objects of several sizes"):
        densities(radii[:3], np.array([0, 0, 1]), 2)


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
