"""Evaluation of recognisers and maps from made-up predictions, against counts by hand, brute
force and SciPy.
"""

from dataclasses import replace

import numpy as np
import pytest
from pipeline import some_predictions
from scipy.stats import bootstrap

from nextview.geometry.viewsphere import ViewSphere
from nextview_lab.benchmark.evaluation import evaluate

RING = ViewSphere((45.0,), 3)


def by_hand():
    """Four objects of two classes, three views.

    Right views: 3, 1 and 2 of class a, none of class b.
    """
    sure, unsure = np.log([9, 1]), np.log([2, 3])  # beliefs 0.9 for a, 0.6 for b
    logits = np.array(
        [[sure] * 3, [sure, unsure, unsure], [sure, sure, unsure], [sure] * 3],
        np.float32,
    )
    maps = np.zeros((4, 3, 1, 3), np.float32)
    maps[..., 2] = 1
    return replace(
        some_predictions(4),
        logits=logits,
        maps={"lem": maps, "lcm": maps},
        depth_entropy=np.array([[0, 1, 3]] * 4, np.float32),
        labels=np.array([0, 0, 0, 1]),
        classes=("a", "b"),
        conflicting=np.array([False, True, False, False]),
        sphere=RING,
    )


def score(table, **where):
    rows = table
    for column, value in where.items():
        rows = rows[rows[column] == value]
    assert len(rows) == 1
    return rows.iloc[0]


def test_accuracy_by_hand():
    table = evaluate(by_hand(), 200, np.random.default_rng(0)).accuracy
    of = {
        (row.n_views, row.label, row.measure): (row.value, row.objects)
        for row in table.itertuples()
    }
    assert of[1, "", "accuracy"] == pytest.approx((6 / 12, 4))
    assert of[1, "a", "accuracy"] == pytest.approx((6 / 9, 3))
    assert of[1, "b", "accuracy"] == (0, 1)
    assert of[1, "", "class_accuracy"] == pytest.approx((6 / 18, 4))
    assert of[1, "", "clean_accuracy"] == pytest.approx((5 / 9, 3))
    assert of[1, "", "class_clean_accuracy"] == pytest.approx(((5 / 6 + 0) / 2, 3))
    # fused: 9 against 1 outweighs 2 * (3 against 2), so all of class a are right
    assert of[3, "", "accuracy"] == (3 / 4, 4)
    assert of[3, "", "class_clean_accuracy"] == (1 / 2, 3)
    assert table["published"].isna().all()


def test_intervals_are_scipys():
    p = some_predictions(60, seed=3)
    found = evaluate(p, 4000, np.random.default_rng(0))
    single = (p.logits.argmax(2) == p.labels[:, None]).mean(1)
    error = ((p.maps["lem"] - true_windows(p)) ** 2).mean((1, 2, 3))
    for row, values in (
        (score(found.accuracy, n_views=1, label="", measure="accuracy"), single),
        (
            score(found.accuracy, n_views=1, label="box", measure="accuracy"),
            single[p.labels == 1],
        ),
        (score(found.maps, by="network", label="", measure="mse"), error),
    ):
        theirs = bootstrap(
            (values,), np.mean, n_resamples=4000, method="percentile", rng=1
        ).confidence_interval
        assert row.value == pytest.approx(values.mean())
        assert (row.low, row.high) == pytest.approx(
            theirs, abs=0.1 * (theirs.high - theirs.low)
        )


def true_windows(p):
    """The true LEM's windows, cell by cell."""
    values = p.depth_entropy.astype(float)
    values = (values - values.min(1, keepdims=True)) / np.ptp(
        values, axis=1, keepdims=True
    )
    windows = np.empty((len(p), 40, 5, 3))
    for view, ring, column in np.ndindex(40, 5, 3):
        windows[:, view, ring, column] = values[
            :, 8 * ring + (view % 8 + column - 1) % 8
        ]
    return windows


def test_map_scores_by_hand():
    found = evaluate(by_hand(), 50, np.random.default_rng(0))
    # The true map is 0, 1/3, 1 round the ring; its windows are (1, 0, 1/3), (0, 1/3, 1) and (1/3,
    # 1, 0). The network says (0, 0, 1) everywhere: its peak is 2, 0 and 1 cells off.
    errors = [1 + 4 / 9, 1 / 9, 1 / 9 + 1 + 1]
    lem = {
        m: score(found.maps, map="lem", by="network", label="", measure=m).value
        for m in ("mse", "d0", "regret")
    }
    assert lem == pytest.approx(
        {"mse": sum(errors) / 9, "d0": 1 / 3, "regret": (2 / 3 + 0 + 1) / 3}
    )
    near = {
        m: score(found.maps, map="lem", by="network", label="b", measure=m).value
        for m in ("d_le_1", "d_lt_2")
    }
    assert near == pytest.approx({"d_le_1": 2 / 3, "d_lt_2": 2 / 3})
    # All objects have the same true map, so the class's mean at the view is the truth; the mean map
    # is 4/9 everywhere.
    of_class = score(
        found.maps, map="lem", by="mean map of the class", label="", measure="mse"
    )
    assert of_class.value == pytest.approx(0, abs=1e-12)
    mean = score(found.maps, map="lem", by="mean map", label="", measure="mse")
    assert mean.value == pytest.approx(((4 / 9) ** 2 + (1 / 9) ** 2 + (5 / 9) ** 2) / 3)
