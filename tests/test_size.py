"""benchmarks/size.py: what is known of how large objects are is weighed in, and chosen without the test split."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.test_predictions import some_predictions

from nextview.recognition import Calibration

SIZE = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "size.py"))


def test_the_density_of_a_size_is_that_of_its_class():
    rng = np.random.default_rng(0)
    sizes, labels = np.concatenate([rng.normal(0, 0.1, 200), rng.normal(2, 0.1, 200)]), np.repeat([0, 1], 200)
    found = SIZE["log_densities"](sizes, labels, 2, np.array([0.0, 2.0, 50.0]))
    normal = -np.log(0.1 * np.sqrt(2 * np.pi))
    assert found[[0, 1], [0, 1]] == pytest.approx([normal, normal], abs=0.3)
    assert (found[[0, 1, 2, 2], [1, 0, 0, 1]] == -10).all()


def test_looks_are_fused_in_order_and_a_telling_size_repairs_what_they_get_wrong():
    p = replace(some_predictions(40), calibration=Calibration(0.7, 0.5))
    single = SIZE["log_beliefs"](p, 1, np.random.default_rng(3))
    assert np.sort(single.ravel()) == pytest.approx(np.sort(p.logits.ravel() / 0.7), rel=1e-5)
    everything = SIZE["log_beliefs"](p, len(p.sphere), np.random.default_rng(3))
    wanted = p.logits.sum(1) / (0.7 * (1 + 0.5 * (len(p.sphere) - 1)))
    np.testing.assert_allclose(everything, np.broadcast_to(wanted[:, None], everything.shape), rtol=1e-4, atol=1e-5)
    rows = list(SIZE["lines"](p, 100.0 * np.eye(len(p.classes))[p.labels], 1.0, samples=50))
    assert all("| 1.000 (1.000) |" in row for row in rows)
    assert rows[0].startswith("| 1 |")
    none = list(SIZE["lines"](p, np.zeros((len(p), len(p.classes))), 1.0, samples=50))
    assert all("+0.0 (+0.0 to +0.0)" in row for row in none)


def test_test_objects_may_not_choose(tmp_path):
    p = some_predictions(10)
    path = tmp_path / "test.npz"
    replace(p, splits=np.array(["test"] * 10)).save(path)
    with pytest.raises(ValueError, match="holds test objects, which choose nothing"):
        SIZE["main"](tmp_path, path, path)
