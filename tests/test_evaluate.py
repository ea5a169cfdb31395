"""Evaluation of recognisers and maps from made-up predictions, against counts by hand and scikit-image."""

import pytest

from nextview.benchmark.published import published_map, published_recognisers, read_table

TEN = tuple(read_table("table8_accuracy_per_class_modelnet10"))
TESTED = dict(zip(TEN, (50, 100, 100, 86, 86, 100, 86, 100, 100, 100), strict=True))
"""Objects of each class in ModelNet10's test split."""


@pytest.mark.parametrize("measure", ["d0", "d_le_1", "d_lt_2"])
def test_table_4_prints_peaks_over_classes(measure):
    rows = [published_map("lem", measure, TEN, name) for name in TEN]
    assert published_map("lem", f"class_{measure}", TEN) == pytest.approx(sum(rows) / 10, abs=1e-4)
    assert published_map("lem", measure, TEN) is None


def test_table_4_prints_the_loss_over_objects():
    rows = {name: published_map("lem", "mse", TEN, name) for name in TEN}
    over_objects = sum(TESTED[name] * rows[name] for name in TEN) / sum(TESTED.values())
    assert published_map("lem", "mse", TEN) == pytest.approx(over_objects, abs=5e-5)
    assert published_map("lem", "class_mse", TEN) == pytest.approx(sum(rows.values()) / 10)


def test_published_scores_stand_only_beside_what_they_were_published_for():
    assert published_recognisers(TEN, 40)[0] == ("ResNet34", 32, 0.871)
    assert published_recognisers(TEN[::-1], 12) == [("ResNet18", 32, 0.8901)]
    assert published_recognisers(TEN, 7) == published_recognisers(("cat", "dog"), 40) == []
    assert published_map("lcm", "class_d_le_1", TEN) == 0.2332
    assert published_map("lcm", "d_le_1", TEN, "bed") is None
    assert published_map("lem", "regret", TEN) is published_map("lem", "d0", ("cat", "dog")) is None
    assert published_map("gain", "d0", TEN) is None
