"""Belief against SciPy, sizes of objects, and the limits of a stopping rule."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.special import log_softmax, softmax
from scipy.stats import multivariate_normal

from nextview.errors import NextviewError, RiskError
from nextview.recognition.belief import (
    Calibration,
    RiskBounds,
    SizeEvidence,
    Stopping,
    fuse,
    log_evidence_of,
    reorient,
)

STEP = np.pi / 4

logits = npst.arrays(
    st.sampled_from([np.float32, np.float64]),
    npst.array_shapes(min_dims=2, max_dims=4, max_side=6),
    elements=st.floats(-80, 80, width=32),
)


@given(logits)
def test_belief_is_the_softmax_of_the_sum(values):
    belief = fuse(values)
    assert belief.dtype == np.float64
    np.testing.assert_allclose(
        belief,
        softmax(values.astype(np.float64).sum(-2), axis=-1),
        rtol=1e-12,
        atol=1e-300,
    )
    np.testing.assert_allclose(belief.sum(-1), 1)


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.9])
def test_calibrated_belief_is_the_posterior_of_equally_correlated_looks(correlation):
    # Two classes, each view a Gaussian measurement around -1 or +1 whose noise is correlated
    # between views.
    rng, spread = np.random.default_rng(0), 1.7
    for n_views in (1, 2, 5, 20):
        noise = spread**2 * ((1 - correlation) * np.eye(n_views) + correlation)
        seen = rng.multivariate_normal(np.ones(n_views), noise, size=6)
        likelihood = np.stack(
            [
                multivariate_normal(np.full(n_views, m), noise).logpdf(seen)
                for m in (-1, 1)
            ],
            -1,
        )
        of_each = np.stack([-((seen - m) ** 2) / (2 * spread**2) for m in (-1, 1)], -1)
        belief = fuse(of_each, Calibration(1.0, correlation).temperature_after(n_views))
        np.testing.assert_allclose(belief, softmax(likelihood, -1), atol=1e-9)


@given(st.lists(st.floats(0.01, 0.5), min_size=1, max_size=8), st.floats(0.02, 0.4))
def test_the_threshold_of_a_risk_is_the_lowest_that_promises_it(row, risk):
    thresholds = tuple(np.linspace(0.5, 0.99, len(row)))
    bounds = RiskBounds(thresholds, (tuple(row),), 0.1)
    held = [t for t, b in zip(thresholds, row, strict=True) if b <= risk]
    if held:
        assert bounds.threshold(risk, 1) == min(held)
    else:
        with pytest.raises(RiskError):
            bounds.threshold(risk, 1)


@given(st.floats(0.5, 0.999), st.floats(0, 2), st.integers(1, 8), st.integers(0, 2**32))
def test_with_a_decline_of_its_correlation_a_calibrated_belief_stops_where_the_plain_sum_does(
    threshold_at, c, n_views, seed
):
    # Of two classes, where the peak of the belief is one to one with the difference of the logits.
    logits = np.random.default_rng(seed).normal(size=(50, n_views, 2))
    plain = fuse(logits).max(-1) >= Stopping(threshold_at).threshold_at(n_views)
    belief = fuse(logits, Calibration(1.0, c).temperature_after(n_views)).max(-1)
    near = np.abs(belief - Stopping(threshold_at, 8, c).threshold_at(n_views)) < 1e-9
    np.testing.assert_array_equal(
        (belief >= Stopping(threshold_at, 8, c).threshold_at(n_views)) | near,
        plain | near,
    )


def test_what_is_said_of_sides_is_said_of_where_side_0_points():
    azimuth_bins = np.random.default_rng(0).normal(size=(3, 2, 8))
    azimuth = np.pi * np.array([0.0, 0.5, -1.0])
    pointing = reorient(azimuth_bins, azimuth)
    for observation, step in enumerate((0, 2, -4)):
        for side in range(
            8
        ):  # from azimuth a side s is seen if azimuth bin 0 points to a - s
            np.testing.assert_array_equal(
                pointing[observation, :, (step - side) % 8],
                azimuth_bins[observation, :, side],
            )
    np.testing.assert_array_equal(reorient(pointing, azimuth), azimuth_bins)


def some_views(n_views, classes=3, azimuth_bins=8):
    rng = np.random.default_rng(n_views)
    likely = log_softmax(2 * rng.normal(size=(n_views, classes, azimuth_bins)), axis=2)
    return rng.normal(size=(n_views, classes)), likely, rng.integers(0, 8, n_views)


@pytest.mark.parametrize("n_views", [1, 2, 5])
def test_looks_that_agree_on_the_side_are_believed_as_bayes_would(n_views):
    """Independent looks at an object of which neither class nor azimuth is known, each as likely
    as any other.
    """
    logits, azimuth_bins, azimuth = some_views(n_views)
    belief = Calibration(0.7, 0.0, bin_correlation=0.0).belief(
        log_evidence_of(logits, azimuth_bins, azimuth * STEP).sum(0), n_views, 3
    )
    joint = np.zeros((3, 8))
    for c in range(3):
        for zero in range(8):
            seen = [azimuth_bins[k, c, (azimuth[k] - zero) % 8] for k in range(n_views)]
            joint[c, zero] = np.exp((logits[:, c] / 0.7).sum() + np.sum(seen))
    np.testing.assert_allclose(belief, joint.sum(1) / joint.sum())
    if n_views == 1:  # one view has nothing to agree with
        np.testing.assert_allclose(belief, softmax(logits[0] / 0.7))


def test_invalid_settings_are_rejected():
    for make, value in (
        (Stopping, 1.01),
        (fuse, np.array([[0.0, np.nan]])),
        (Calibration, 0.0),
    ):
        with pytest.raises(NextviewError):
            make(value)


def test_sizes_between_two_radii_are_interpolated_and_unknown_ones_say_nothing():
    evidence = SizeEvidence((1.0, 4.0), ((0.0, 2.0), (1.0, 1.0)), 0.5)
    found = evidence.logits(np.array([1.0, 2.0, 4.0, 100.0, 0.001, np.nan]))
    np.testing.assert_allclose(
        found, [[0, 0.5], [0.5, 0.5], [1, 0.5], [1, 0.5], [0, 0.5], [0, 0]], atol=1e-6
    )
