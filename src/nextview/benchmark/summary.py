"""From episodes to tables: every number with its interval, its test and the published value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from nextview import metrics
from nextview.benchmark import statistics as st
from nextview.benchmark.entries import is_oracle
from nextview.benchmark.experiment import Grid
from nextview.benchmark.levels import by_level, target_weights
from nextview.benchmark.published import comparable_classes, published
from nextview.benchmark.replay import Outcomes, truncate

Float = NDArray[np.float64]

Cell = tuple[str, float | None, Outcomes]

TESTED = ("accuracy", "clean_accuracy", "n_views", "travel_all")
SWEEP = (0.0, *(1 - np.logspace(np.log10(0.75), -9, 40)), 1.0)
"""Thresholds of the curves of accuracy against views and travel: from the first view for all to the last for most."""


@dataclass(frozen=True)
class Tables:
    """The results, each a long table; intervals are 95 % bootstrap intervals over objects, ``low`` to ``high``.

    Attributes:
        summary: policy, threshold, measure, value, low, high, published. The measures: ``accuracy``;
            ``clean_accuracy``, without the objects whose very mesh also has another label; ``n_views``;
            ``travel_moved``, over the episodes that moved, as published, and ``travel_all``, in grid cells;
            ``arc_all`` in radians; ``confident``, the share that reached the threshold, and ``confident_accuracy``,
            how often these are right; ``calibration_error``. With ``class_`` before them they are means over classes;
            ``class_accuracy_std`` is the deviation between classes.
        per_class: policy, threshold, label, measure (accuracy, travel_moved), value, low, high, published.
        tests: policy, threshold, measure, difference to the reference, low, high, p (paired bootstrap), p_holm, and
            for accuracy mcnemar, mcnemar_holm. Holm's correction is over all rows of a measure.
        sweep: policy, threshold, accuracy, views, travel_all, arc_all: the points of the curves.
        areas: policy, budget (n_views or travel_all), value: mean accuracy over all budgets, low, high, and the
            difference to the reference with difference_low, difference_high, p and p_holm.
        reliability: policy, threshold, bin, confidence, accuracy, episodes.
        risks: policy, risk (an error rate that was promised), threshold that promises it, error (measured among the
            episodes that reached it), low, high, confident (their share): only of policies a robot could follow.
        levels: of worlds, see ``levels.by_level``.
    """

    summary: pd.DataFrame
    per_class: pd.DataFrame
    tests: pd.DataFrame
    sweep: pd.DataFrame
    areas: pd.DataFrame
    reliability: pd.DataFrame
    risks: pd.DataFrame
    levels: pd.DataFrame

    def named(self) -> dict[str, pd.DataFrame]:
        """The tables by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def summarise(
    grid: Grid, reference: str, samples: int, rng: np.random.Generator, promised: Mapping[float, float] | None = None
) -> Tables:
    """All tables of a grid.

    Args:
        grid: what was run.
        reference: the policy that the others are compared with.
        samples: of the bootstrap.
        rng: draws them; the same ones for all policies, which pairs the differences.
        promised: the threshold for each error rate that the calibration promises, among those of the grid.
    """
    weights = target_weights(grid.specs.predictions.names, samples, rng)
    cells = list(grid.cells())
    summary, drawn = _summary(grid, cells, weights)
    sweep, areas = _areas(grid, reference, weights[:500])
    tests = _tests(grid, cells, summary, drawn, reference)
    per_class, risks = _per_class(grid, cells, weights), _risks(summary, promised or {})
    levels = by_level(grid, reference, samples, rng)
    return Tables(summary, per_class, tests, sweep, areas, _reliability(grid, cells), risks, levels)


def _measures(grid: Grid, ends: Outcomes) -> dict[str, tuple[Float, Float]]:
    """Each measure of a cell as a sum for each object and what to divide it by, (N,) each."""
    right = grid.right(ends.answer).astype(np.float64)
    clean = np.where(grid.specs.predictions.conflicting, 0.0, 1.0)
    one = np.ones(right.shape[1])

    def of(values: NDArray) -> NDArray:
        return values.reshape(grid.runs, -1)

    moved, confident, mean = of(ends.n_views > 1), of(ends.confident), right.mean(0)
    return {
        "accuracy": (mean, one),
        "clean_accuracy": (mean * clean, clean),
        "n_views": (of(ends.n_views).mean(0), one),
        "travel_moved": (of(ends.travel).sum(0), moved.sum(0).astype(np.float64)),
        "travel_all": (of(ends.travel).mean(0), one),
        "arc_all": (of(ends.arc).mean(0), one),
        "confident": (confident.mean(0), one),
        "confident_accuracy": ((right * confident).sum(0), confident.sum(0).astype(np.float64)),
    }


def _columns(grid: Grid, cells: list[Cell], names: tuple[str, ...] | None = None) -> tuple[list, Float, Float]:
    """The measures of all cells side by side: (policy, threshold, measure), tops (N, M), bottoms (N, M)."""
    keys, tops, bottoms = [], [], []
    for policy, threshold, ends in cells:
        for measure, (top, bottom) in _measures(grid, ends).items():
            if names is None or measure in names:
                keys.append((policy, threshold, measure))
                tops.append(top)
                bottoms.append(bottom)
    return keys, np.stack(tops, 1), np.stack(bottoms, 1)


def _summary(grid: Grid, cells: list[Cell], weights: Float) -> tuple[pd.DataFrame, dict[tuple, Float]]:
    """The table, and the bootstrap samples (S,) behind each of its cells."""
    labels, classes = grid.specs.predictions.labels, comparable_classes(grid.specs.predictions)
    duplicate_groups = np.ones((1, weights.shape[1]))
    keys, top, bottom = _columns(grid, cells)
    value, drawn = metrics.ratio(top, bottom, duplicate_groups)[0], metrics.ratio(top, bottom, weights)
    per_class = [i for i, key in enumerate(keys) if key[2] in ("accuracy", "travel_moved", "n_views")]
    keys += [(keys[i][0], keys[i][1], f"class_{keys[i][2]}") for i in per_class]
    top, bottom = top[:, per_class], bottom[:, per_class]
    value = np.concatenate([value, metrics.class_mean(top, bottom, labels, duplicate_groups)[0]])
    drawn = np.concatenate([drawn, metrics.class_mean(top, bottom, labels, weights)], 1)
    low, high = st.interval(drawn)
    rows = []
    for i, (policy, threshold, measure) in enumerate(keys):
        beside = published(policy, threshold, measure, classes)
        rows.append((policy, threshold, measure, value[i], low[i], high[i], beside))
    for policy, threshold, ends in cells:
        right = grid.right(ends.answer)
        error = metrics.calibration_error(ends.confidence, right.ravel())
        between = np.std([right[:, labels == label].mean() for label in np.unique(labels)])
        rows.append((policy, threshold, "calibration_error", error, np.nan, np.nan, None))
        rows.append((policy, threshold, "class_accuracy_std", between, np.nan, np.nan, None))
    columns = ["policy", "threshold", "measure", "value", "low", "high", "published"]
    return _frame(rows, columns), {key: drawn[:, i] for i, key in enumerate(keys)}


def _per_class(grid: Grid, cells: list[Cell], weights: Float) -> pd.DataFrame:
    p, classes = grid.specs.predictions, comparable_classes(grid.specs.predictions)
    keys, top, bottom = _columns(grid, cells, ("accuracy", "travel_moved"))
    rows = []
    for index in np.unique(p.labels):
        here, label = p.labels == index, p.classes[index]
        value = metrics.ratio(top[here], bottom[here], np.ones((1, int(here.sum()))))[0]
        low, high = st.interval(metrics.ratio(top[here], bottom[here], weights[:, here]))
        for i, (policy, threshold, measure) in enumerate(keys):
            beside = published(policy, threshold, measure, classes, label)
            rows.append((policy, threshold, label, measure, value[i], low[i], high[i], beside))
    return _frame(rows, ["policy", "threshold", "label", "measure", "value", "low", "high", "published"])


def _tests(
    grid: Grid, cells: list[Cell], summary: pd.DataFrame, drawn: dict[tuple, Float], reference: str
) -> pd.DataFrame:
    value = summary.set_index(["policy", "threshold", "measure"])["value"].to_dict()
    right = {(policy, threshold): grid.right(ends.answer) for policy, threshold, ends in cells}
    rows = []
    for policy, threshold in right:
        if policy == reference or (reference, threshold) not in right:
            continue
        for measure in TESTED:
            ours, theirs = (policy, threshold, measure), (reference, threshold, measure)
            difference = np.array([value[ours] - value[theirs]])
            samples = (drawn[ours] - drawn[theirs])[:, None]
            low, high = st.interval(samples)
            paired = np.nan
            if measure == "accuracy":
                paired = st.mcnemar(right[policy, threshold], right[reference, threshold])
            rows.append((*ours, difference[0], low[0], high[0], st.bootstrap_p(difference, samples)[0], paired))
    table = _frame(rows, ["policy", "threshold", "measure", "difference", "low", "high", "p", "mcnemar"])
    for column in ("p", "mcnemar"):
        table[f"{column}_holm"] = _holm(table, "measure", column)
    return table


def _areas(grid: Grid, reference: str, weights: Float) -> tuple[pd.DataFrame, pd.DataFrame]:
    measures = ("accuracy", "n_views", "travel_all", "arc_all")
    points, drawn = {}, {}  # of each policy: (T, measures), and its bootstrap samples (S, T, measures)
    for name, paths in grid.paths.items():
        if not paths.fixed:
            _, top, _ = _columns(grid, [(name, t, truncate(paths, t, grid.threshold_decay)) for t in SWEEP], measures)
            points[name] = top.mean(0).reshape(len(SWEEP), -1)
            drawn[name] = (weights @ top / weights.sum(1, keepdims=True)).reshape(len(weights), len(SWEEP), -1)
    rows = [(name, t, *values) for name, curve in points.items() for t, values in zip(SWEEP, curve, strict=True)]
    sweep = _frame(rows, ["policy", "threshold", *measures])
    reach = {"n_views": (1.0, float(grid.max_views)), "travel_all": (0.0, float(sweep["travel_all"].max()))}
    rows = []
    for budget, (low, high) in reach.items():
        if not high > low:
            continue

        def height(curve: Float, x: int = measures.index(budget), low: float = low, high: float = high) -> float:
            return st.area(curve[:, x], curve[:, 0], low, high)

        value = {name: height(curve) for name, curve in points.items()}
        spread = {name: np.array([height(curve) for curve in curves])[:, None] for name, curves in drawn.items()}
        for name in points:
            row = [name, budget, value[name], *np.ravel(st.interval(spread[name]))]
            if reference in points and name != reference:
                difference, samples = np.array([value[name] - value[reference]]), spread[name] - spread[reference]
                row += [difference[0], *np.ravel(st.interval(samples)), st.bootstrap_p(difference, samples)[0]]
            rows.append((*row, *[np.nan] * (9 - len(row))))
    areas = _frame(
        rows, ["policy", "budget", "value", "low", "high", "difference", "difference_low", "difference_high", "p"]
    )
    areas["p_holm"] = _holm(areas, "budget", "p")
    return sweep, areas


def _holm(table: pd.DataFrame, family: str, column: str) -> pd.Series:
    """Holm's correction of a column within each family of tests."""
    return table.groupby(family)[column].transform(lambda p: st.holm(p.to_numpy()))


def _reliability(grid: Grid, cells: list[Cell]) -> pd.DataFrame:
    rows = []
    for policy, threshold, ends in cells:
        sure, accuracy, count = metrics.reliability(ends.confidence, grid.right(ends.answer).ravel())
        rows += [(policy, threshold, i, sure[i], accuracy[i], count[i]) for i in np.flatnonzero(count)]
    return _frame(rows, ["policy", "threshold", "bin", "confidence", "accuracy", "episodes"])


def _risks(summary: pd.DataFrame, promised: Mapping[float, float]) -> pd.DataFrame:
    rows = []
    for risk, threshold in promised.items():
        at = summary[summary["threshold"] == threshold]
        right, share = (at[at["measure"] == measure] for measure in ("confident_accuracy", "confident"))
        measured = right[["value", "high", "low"]].to_numpy(float)  # the upper end of accuracy is the lower of error
        for policy, (mean, high, low), stopped in zip(right["policy"], measured, share["value"], strict=True):
            if not is_oracle(policy):
                rows.append((policy, risk, threshold, 1 - mean, 1 - high, 1 - low, stopped))
    return _frame(rows, ["policy", "risk", "threshold", "error", "low", "high", "confident"])


def _frame(rows: list, columns: list[str]) -> pd.DataFrame:
    table = pd.DataFrame(rows, columns=columns)
    numbers = [c for c in columns if c in ("threshold", "published")]
    return table.astype(dict.fromkeys(numbers, "float64"))
