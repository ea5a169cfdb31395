"""The picture of true and predicted maps."""

import numpy as np
import pytest
from PIL import Image
from pipeline import some_predictions

from nextview.errors import ResultsError
from nextview_lab.thesis.example_maps import draw, example_maps


def test_a_row_a_class_from_the_best_to_the_worst(tmp_path):
    p = some_predictions(30, seed=1)
    grid = [
        axes
        for axes in example_maps(p, "lem", np.random.default_rng(0)).axes
        if axes.get_title()
    ]
    errors = [float(axes.get_title().rpartition(" ")[2]) for axes in grid]
    assert len(grid) == 5 * len(set(p.labels))
    assert all(
        errors[k : k + 5] == sorted(errors[k : k + 5]) for k in range(0, len(errors), 5)
    )
    p.save(tmp_path / "p.npz")
    draw(tmp_path / "p.npz", "lem", tmp_path / "lem.png")
    with Image.open(tmp_path / "lem.png") as picture:
        assert np.ptp(np.asarray(picture.convert("L"))) > 100  # something is drawn
    with pytest.raises(ResultsError, match="no map 'lcm'"):
        draw(tmp_path / "p.npz", "lcm", tmp_path / "lcm.png")
