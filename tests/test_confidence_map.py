"""What an LCM learns, by hand."""

import numpy as np

from nextview.measures.confidence_map import confidence_maps


def test_confidence_where_right_and_zero_where_wrong():
    half, three_quarters = np.log([1, 1]), np.log([1, 3])
    logits = np.array([[three_quarters, half], [three_quarters, -three_quarters], [half, three_quarters]])
    maps = confidence_maps(logits, np.array([1, 0, 0]))
    # a tie counts for the lower index, so the second view of the first object is wrong and the first of the last right
    np.testing.assert_allclose(maps, [[0.75, 0], [0, 0.75], [0.5, 0]], rtol=1e-6)
    assert maps.dtype == np.float32


def test_an_object_that_is_never_right_has_no_confidence():
    logits = np.random.default_rng(0).normal(size=(4, 8, 3))
    logits[2, :, 1] -= 50
    maps = confidence_maps(logits, np.array([0, 2, 1, 1]))
    assert not maps[2].any()
    assert maps[[0, 1, 3]].any(1).all()


def test_large_logits_do_not_overflow():
    assert confidence_maps(np.array([[[1e4, -1e4]]], np.float32), np.array([0])) == 1
