"""Belief against SciPy, and the limits of a stopping rule."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.special import log_softmax, softmax

from nextview.recognition import Stopping, fuse

logits = npst.arrays(
    st.sampled_from([np.float32, np.float64]),
    npst.array_shapes(min_dims=2, max_dims=4, max_side=6),
    elements=st.floats(-80, 80, width=32),
)


@given(logits)
def test_belief_is_the_softmax_of_the_sum(values):
    belief = fuse(values)
    assert belief.dtype == np.float64
    np.testing.assert_allclose(belief, softmax(values.astype(np.float64).sum(-2), axis=-1), rtol=1e-12, atol=1e-300)
    np.testing.assert_allclose(belief.sum(-1), 1)


@given(logits)
def test_belief_is_the_normalised_product_of_single_beliefs(values):
    product = log_softmax(values.astype(np.float64), axis=-1).sum(-2)
    np.testing.assert_allclose(fuse(values), softmax(product, axis=-1), atol=1e-12)


@given(logits, st.randoms(use_true_random=False))
def test_the_order_of_looks_and_a_constant_do_not_matter(values, random):
    values = values.astype(np.float64)
    order = random.sample(range(values.shape[-2]), values.shape[-2])
    np.testing.assert_allclose(fuse(values[..., order, :] + 7.5), fuse(values), atol=1e-12)


def test_huge_logits_do_not_overflow():
    np.testing.assert_array_equal(fuse(np.array([[1e300, -1e300], [1e300, 0]])), [1, 0])
    np.testing.assert_array_equal(fuse(np.array([[-1e300, -1e300]])), [0.5, 0.5])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_logit_that_is_not_finite_is_refused(bad):
    with pytest.raises(ValueError, match="a logit that is not a finite number"):
        fuse(np.array([[0.0, 1.0], [bad, 0.0]]))


@pytest.mark.parametrize("threshold", [-0.01, 1.01, np.nan, np.inf])
def test_a_threshold_is_a_probability(threshold):
    with pytest.raises(ValueError, match="threshold is a probability"):
        Stopping(threshold)


@pytest.mark.parametrize("views", [0, -3])
def test_at_least_one_view(views):
    with pytest.raises(ValueError, match="at least one view"):
        Stopping(0.9, views)
