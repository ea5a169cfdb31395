import numpy as np
import pytest
from scipy import stats

from nextview_lab.benchmark import statistics as st


@pytest.mark.parametrize("families", [8, 14, 40])
def test_the_p_value_is_that_of_scipy_s_permutation_test(families):
    ours, theirs = np.random.default_rng(families).normal(0, 1, (2, families))
    ours += 0.4
    theirs_test = stats.permutation_test(
        (ours, theirs),
        lambda a, b, axis: np.mean(a - b, axis=axis),
        permutation_type="samples",
        n_resamples=2**14 if families < 15 else 40_000,
        vectorized=True,
        random_state=np.random.default_rng(1),
    )
    exact = families < 15
    assert st.sign_flip_p((ours - theirs)[:, None])[0] == pytest.approx(
        theirs_test.pvalue, abs=1e-12 if exact else 0.01
    )


@pytest.mark.parametrize(("families", "repeats"), [(10, 1500), (100, 600)])
def test_a_true_null_hypothesis_is_rejected_as_often_as_it_says(families, repeats):
    rng = np.random.default_rng(0)
    hard = rng.random((families, repeats))  # families differ, policies do not
    right = (rng.random((2, 5, families, repeats)) > hard).mean(1)
    rejected = (st.sign_flip_p(right[0] - right[1]) < 0.05).sum()
    assert rejected <= stats.binom.ppf(0.999, repeats, 0.05)
    # Equal differences of few families make it careful; without them it is as it says.
    rejected = (st.sign_flip_p(rng.normal(0, 1, right[0].shape)) < 0.05).sum()
    assert stats.binomtest(int(rejected), repeats, 0.05).pvalue > 0.001


def test_holm_gives_the_textbook_values():
    # R: p.adjust(c(0.01, 0.04, 0.03, 0.005), "holm")
    np.testing.assert_allclose(
        st.holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02]
    )
    np.testing.assert_allclose(st.holm(np.array([0.6, np.nan, 0.9])), [1, np.nan, 1])
