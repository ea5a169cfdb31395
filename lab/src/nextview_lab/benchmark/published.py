"""Published results of "Multi-View 3D Object Recognition: Selecting the Best Sequences"."""

import csv
from functools import cache
from importlib.resources import files

import numpy as np

from nextview.recognition.map_names import LCM, LEM

PUBLISHED_COLUMNS = {  # policies of tables 5, 8 to 11 under their published names
    "random": "random",
    "furthest": "furthest",
    "unidirectional": "unidirectional",
    "oracle-valley": "LEM10",  # the thesis chooses peak or valley by the true class
    f"{LCM}-peak": "LCM10",
}
FIVE_VIEWS = {  # fixed views of tables 3 and 12, for a network with 40 classes
    "low-entropy-5": "low_entropy",
    "high-entropy-5": "high_entropy",
    "best-5": "best",
    "random-fixed-5": "random",
}
ACCURACY = {
    10: "table8_accuracy_per_class_modelnet10",
    40: "table10_accuracy_per_class_modelnet40",
}
TRAVEL = {
    10: "table9_travel_per_class_modelnet10",
    40: "table11_travel_per_class_modelnet40",
}


@cache
def read_rows(name: str) -> list[dict[str, str]]:
    """Read a table that ships with the package, as one dictionary per row."""
    with (files("nextview_lab.benchmark") / "published" / f"{name}.csv").open(
        encoding="utf-8"
    ) as file:
        return list(csv.DictReader(file))


@cache
def read_table(name: str) -> dict[str, dict[str, float]]:
    """Read a table of numbers by its first column and the names of the other columns."""
    rows = [list(row.items()) for row in read_rows(name)]
    return {
        first: {column: float(value) for column, value in rest}
        for (_, first), *rest in rows
    }


def published_classes(classes: tuple[str, ...]) -> int | None:
    """Return 10 or 40 for the classes of ModelNet10 or ModelNet40, in any order; else None."""
    n = len(classes)
    return n if n in ACCURACY and set(classes) == set(read_table(ACCURACY[n])) else None


def published_threshold(policy: str) -> float | None:
    """Return the published threshold of a policy (table 5); None if there is none."""
    return (
        read_table("table5_nbv_modelnet10")["threshold"][PUBLISHED_COLUMNS[policy]]
        if policy in PUBLISHED_COLUMNS
        else None
    )


def published(
    policy: str,
    threshold: float | None,
    measure: str,
    classes: tuple[str, ...],
    label: str | None = None,
) -> float | None:
    """Return the published value for a cell of our tables.

    Args:
        policy: name of the policy.
        threshold: of the belief; None for fixed views.
        measure: name of the measure.
        classes: names of the classes.
        label: name of one class; None for all.

    Returns:
        The value; None if nothing was published.
    """
    n = published_classes(classes)
    if n is None:
        return None

    over_classes = measure.startswith("class_")
    kind = measure.removeprefix("class_")
    if policy in FIVE_VIEWS and kind == "accuracy":
        rows = read_table("table12_fixed_five_views_modelnet40")
        column = {name: rows[name][FIVE_VIEWS[policy]] for name in classes}
    elif threshold == published_threshold(policy) is not None and kind in (
        "accuracy",
        "travel_moved",
    ):
        rows = read_table((ACCURACY if kind == "accuracy" else TRAVEL)[n])
        column = {name: rows[name][PUBLISHED_COLUMNS[policy]] for name in classes}
    else:
        return None

    if label is not None:
        return column[label]
    if over_classes:
        return float(np.mean(list(column.values())))
    if policy in FIVE_VIEWS or n != 10:
        return None

    row = "instance_accuracy" if kind == "accuracy" else "instance_travel"
    return read_table("table5_nbv_modelnet10")[row][PUBLISHED_COLUMNS[policy]]


def published_recognisers(
    classes: tuple[str, ...],
    views: int,
) -> list[tuple[str, int, float]]:
    """Return the published recognisers of table 6.

    Args:
        classes: names of the classes.
        views: number of views in the dataset.

    Returns:
        Network, batch size and single-view accuracy over objects, the best first.
    """
    n = published_classes(classes)
    rows = [
        (row["model"], int(row["batch_size"]), float(row["accuracy"]))
        for row in read_rows("table6_resnet")
        if (int(row["classes"]), int(row["views"])) == (n, views)
    ]
    return sorted(rows, key=lambda row: -row[2])


def published_map(
    name: str,
    measure: str,
    classes: tuple[str, ...],
    label: str | None = None,
) -> float | None:
    """Return the published score of a map network (tables 4 and 7).

    Args:
        name: of the map.
        measure: name of the score.
        classes: of the training and test data.
        label: name of one class; None for all.

    Returns:
        The score; None if nothing was published.
    """
    n = published_classes(classes)
    over_classes = measure.startswith("class_")
    kind = measure.removeprefix("class_")
    column = {"mse": "loss"}.get(kind, kind)
    if n is None or column not in ("loss", "d0", "d_le_1", "d_lt_2"):
        return None

    if label is None and over_classes == (kind != "mse"):
        for row in read_rows("table4_map_prediction"):
            if (
                row["model"].lower(),
                int(row["classes_train"]),
                int(row["classes_test"]),
            ) == (
                name,
                n,
                n,
            ):
                return float(row[column])

    if (name, n) == (LEM, 10) and (label is not None or over_classes):
        rows = read_table("table7_lem_per_class_modelnet10")
        return (
            rows[label][column]
            if label is not None
            else float(np.mean([row[column] for row in rows.values()]))
        )
    return None
