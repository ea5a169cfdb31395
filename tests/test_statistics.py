import numpy as np
import pytest
from scipy import stats

from nextview.benchmark import statistics as st
from nextview.data import metrics


def test_ratios_and_class_means_agree_with_plain_loops():
    rng = np.random.default_rng(0)
    top, bottom, labels = (
        rng.random((12, 2)),
        rng.integers(0, 3, (12, 2)).astype(float),
        rng.integers(0, 3, 12),
    )
    draws = rng.integers(12, size=(5, 12))
    weights = np.stack([np.bincount(draw, minlength=12) for draw in draws]).astype(
        float
    )
    ratio, mean = (
        metrics.ratio(top, bottom, weights),
        metrics.class_mean(top, bottom, labels, weights),
    )
    for s, draw in enumerate(draws):
        for m in range(2):
            assert ratio[s, m] == pytest.approx(
                top[draw, m].sum() / bottom[draw, m].sum()
            )
            each = [draw[labels[draw] == c] for c in range(3)]
            parts = [
                top[d, m].sum() / bottom[d, m].sum()
                for d in each
                if bottom[d, m].sum() > 0
            ]
            assert mean[s, m] == pytest.approx(np.mean(parts))


def test_mcnemar_with_one_run_is_the_textbook_test():
    right = np.array([[1, 1, 1, 1, 1, 1, 0, 0, 1, 0, 1, 1, 1]], bool)
    other = np.array([[1, 0, 0, 0, 0, 0, 1, 0, 1, 1, 0, 0, 0]], bool)
    b, c = (right & ~other).sum(), (~right & other).sum()
    assert st.mcnemar(right, other) == pytest.approx(
        stats.chi2.sf((b - c) ** 2 / (b + c), 1)
    )
    assert st.mcnemar(right, right) == 1


def test_mcnemar_does_not_count_ten_runs_of_an_object_as_ten_objects():
    once = np.random.default_rng(0).random((2, 1, 80)) < 0.6
    ten = np.repeat(once, 10, axis=1)
    assert st.mcnemar(*ten) == pytest.approx(st.mcnemar(*once))


def test_mcnemar_rejects_a_true_null_hypothesis_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hard = rng.random((600, 1, 200))  # objects differ, policies do not
    p = np.array(
        [
            st.mcnemar(a > h, b > h)
            for h, a, b in zip(hard, *rng.random((2, 600, 5, 200)), strict=True)
        ]
    )
    assert stats.binomtest(int((p < 0.05).sum()), 600, 0.05).pvalue > 0.001


def test_holm_gives_the_textbook_values():
    # R: p.adjust(c(0.01, 0.04, 0.03, 0.005), "holm")
    np.testing.assert_allclose(
        st.holm(np.array([0.01, 0.04, 0.03, 0.005])),
        [0.03, 0.06, 0.06, 0.02],
    )
    np.testing.assert_allclose(st.holm(np.array([0.6, np.nan, 0.9])), [1, np.nan, 1])


def test_bootstrap_p_agrees_with_the_paired_t_test():
    difference = np.random.default_rng(0).normal(0.1, 1, 500)
    weights = st.resample(500, 5000, np.random.default_rng(1))
    p = st.bootstrap_p(
        difference.mean(keepdims=True),
        weights @ difference[:, None] / 500,
    )
    assert p[0] == pytest.approx(stats.ttest_1samp(difference, 0).pvalue, rel=0.15)
    assert st.bootstrap_p(np.zeros(1), np.zeros((10, 1))) == [1]


def test_differences_by_rounding_are_no_differences():
    rounding = np.random.default_rng(0).normal(0, 1e-16, (1000, 1))
    assert st.bootstrap_p(np.array([4e-16]), rounding) == [1]


def test_calibration_error_is_the_gap_between_confidence_and_accuracy():
    assert metrics.calibration_error(
        np.full(8, 0.75),
        np.arange(8) < 4,
    ) == pytest.approx(0.25)
    rng = np.random.default_rng(0)
    confidence = rng.uniform(0.1, 1, 200_000)
    assert (
        metrics.calibration_error(confidence, rng.random(200_000) < confidence) < 0.01
    )
    sure, accuracy, count = metrics.reliability(
        np.array([0.0, 1.0]),
        np.array([False, True]),
        bins=4,
    )
    np.testing.assert_array_equal(count, [1, 0, 0, 1])
    np.testing.assert_array_equal([sure[3], accuracy[3]], [1, 1])
