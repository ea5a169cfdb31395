"""The numbers of the thesis "Multi-View 3D Object Recognition: Selecting the Best Sequences of Views", beside ours."""

from __future__ import annotations

import csv
from functools import cache
from importlib.resources import files

import numpy as np

COLUMNS = {
    "random": "random",
    "furthest": "furthest",
    "unidirectional": "unidirectional",
    "oracle-valley": "LEM10",  # the thesis takes peak or valley by the true class
    "lcm-peak": "LCM10",
}
"""Policies of tables 5, 8 to 11 under their published names."""

FIVE_VIEWS = {
    "low-entropy-5": "low_entropy",
    "high-entropy-5": "high_entropy",
    "best-5": "best",
    "random-fixed-5": "random",
}
"""Fixed views of tables 3 and 12. Both are of a network for 40 classes."""

ACCURACY = {10: "table8_accuracy_per_class_modelnet10", 40: "table10_accuracy_per_class_modelnet40"}
TRAVEL = {10: "table9_travel_per_class_modelnet10", 40: "table11_travel_per_class_modelnet40"}


@cache
def read_table(name: str) -> dict[str, dict[str, float]]:
    """A table that ships with the package: rows by their first column, then numbers by the name of the column."""
    with (files("nextview.benchmark") / "published" / f"{name}.csv").open(encoding="utf-8") as file:
        return {row.pop(next(iter(row))): {k: float(v) for k, v in row.items()} for row in csv.DictReader(file)}


def published_threshold(policy: str) -> float | None:
    """The threshold of the published numbers of a policy (table 5); None if there are none or none is needed."""
    return read_table("table5_nbv_modelnet10")["threshold"][COLUMNS[policy]] if policy in COLUMNS else None


def published(
    policy: str, threshold: float | None, measure: str, classes: tuple[str, ...], label: str | None = None
) -> float | None:
    """The published value of one of our cells; None where nothing was published for it.

    Args:
        policy: name of a contestant.
        threshold: of the cell; the published ones differ between policies (table 5).
        measure: "accuracy" or "travel_moved", over objects or, with "class_" before it, over classes.
        classes: of the data: only those of ModelNet10 and 40 were published.
        label: the class, for one of the tables by class.
    """
    n = len(classes)
    if n not in ACCURACY or set(classes) != set(read_table(ACCURACY[n])):
        return None
    over_classes, kind = measure.startswith("class_"), measure.removeprefix("class_")
    if policy in FIVE_VIEWS and kind == "accuracy":
        rows = read_table("table12_fixed_five_views_modelnet40")
        column = {name: rows[name][FIVE_VIEWS[policy]] for name in classes}
    elif threshold == published_threshold(policy) is not None and kind in ("accuracy", "travel_moved"):
        rows = read_table((ACCURACY if kind == "accuracy" else TRAVEL)[n])
        column = {name: rows[name][COLUMNS[policy]] for name in classes}
    else:
        return None
    if label is not None:
        return column[label]
    if over_classes:
        return float(np.mean(list(column.values())))
    if policy in FIVE_VIEWS or n != 10:
        return None
    row = "instance_accuracy" if kind == "accuracy" else "instance_travel"
    return read_table("table5_nbv_modelnet10")[row][COLUMNS[policy]]
