"""How likely each size is for an object of each class, and how much that counts beside what is seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import gaussian_kde

from nextview.belief import of_true_class
from nextview.calibration.fitting_set import FittingSet
from nextview.errors import DatasetError
from nextview.models.size_evidence import SizeEvidence

Float = NDArray[np.float64]

RADII = np.geomspace(0.02, 20, 93)
"""Metres; steps of 7.8 %."""
ANY_SIZE = 0.05
"""Share of the objects of a class that may have any size: models are drawn in wrong units, and toys are sold."""


def densities(radii: Float, labels: NDArray[np.int64], classes: int) -> Float:
    """Logarithm of the density of each class over log radius, at ``RADII``, (classes, R).

    Gaussian kernels, and a share of ``ANY_SIZE`` that is spread evenly. The width is n ** -0.2 times the spread, which
    the quartiles tell: a few meshes of another unit would blur it (Silverman, Density estimation, 1986, section 3.4.2).

    Args:
        radii: of the objects, metres, (N,).
        labels: classes, (N,).
        classes: how many.

    Raises:
        DatasetError: a class has fewer than two objects, or only objects of one size.
    """
    at, span = np.log(RADII), np.log(RADII[-1] / RADII[0])
    found = np.empty((classes, len(RADII)))
    for c in range(classes):
        logs = np.log(radii[labels == c])
        if len(logs) < 2 or np.ptp(logs) == 0:
            raise DatasetError("every class needs objects of several sizes")
        middle = np.subtract(*np.percentile(logs, (75, 25))) / 1.34  # the deviation of a Gaussian with these quartiles
        deviation = logs.std(ddof=1)
        width = len(logs) ** -0.2 * (min(middle, deviation) or deviation)
        density = gaussian_kde(logs, width / deviation)(at)
        found[c] = np.log((1 - ANY_SIZE) * density + ANY_SIZE / span)
    return found


def fit_weight(data: FittingSet, radii: Float, log_density: Float) -> tuple[SizeEvidence, float, float]:
    """The weight beside the logits that is most likely, over single views, at the temperature most likely with it.

    Args:
        data: what the recogniser says by shape alone.
        radii: of the objects, metres, (N,).
        log_density: see ``densities``.

    Returns:
        The evidence, and the mean negative log-likelihood of single views by shape alone and with it, classes weighted
        evenly.
    """
    of_size = SizeEvidence(RADII, log_density, 1.0).logits(radii)[:, None]

    def loss(parameters: Float) -> float:
        temperature, weight = parameters
        logs = (data.logits + weight * of_size).astype(np.float64) / temperature
        return -float(np.average(of_true_class(logs, data.labels).mean(1), weights=data.weights))

    found = minimize(loss, np.ones(2), method="L-BFGS-B", bounds=[(0.01, 100.0), (0.0, 10.0)])
    return SizeEvidence(RADII, log_density, float(found.x[1])), loss(np.array([1.0, 0.0])), float(found.fun)
