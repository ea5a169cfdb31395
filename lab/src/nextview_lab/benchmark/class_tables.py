"""Summarise episodes of classes: numbers with intervals, tests, published values, conclusions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nextview.session.episode import Outcome
from nextview.types import Float
from nextview_lab.benchmark import statistics as st
from nextview_lab.benchmark.comparison import (
    ALL,
    ONE,
    SIGNIFICANT,
    Counted,
    Tables,
    corrected,
    measures_of,
    significant,
    too_few,
    values_of,
    written,
)
from nextview_lab.benchmark.entries import is_oracle, knows_truth
from nextview_lab.benchmark.published import published
from nextview_lab.benchmark.replay import Grid
from nextview_lab.benchmark.text_tables import Board, Column, WrittenTable
from nextview_lab.data import metrics
from nextview_lab.data.predictions import Predictions
from nextview_lab.extras import extras

with extras():
    import pandas as pd
    import pyarrow.parquet as pq

Cell = tuple[str, float | None, Outcome]
Both = tuple["pd.DataFrame", "pd.DataFrame"]  # measures and tests
TESTED = ("accuracy", "clean_accuracy", "n_views", "travel_all")
OF_CLASSES = ("accuracy", "travel_moved")  # measures that are also reported by class
# measures of whole episodes, and after a number of views: columns of the long table
ENDS = {
    "accuracy": ("right", ONE),
    "clean_accuracy": ("clean_right", "clean"),
    "n_views": ("n_views", ONE),
    "travel_moved": ("travel", "moved"),
    "travel_all": ("travel", ONE),
    "arc_all": ("arc", ONE),
    "confident": ("confident", ONE),
    "confident_accuracy": ("confident_right", "confident"),
}
AFTER = {"accuracy": ("right", ONE), "travel": ("travel", ONE)}


@dataclass(frozen=True)
class ClassTables(Tables):
    """The results of a benchmark of classes.

    The sets are ``all``, and ``class NAME``, the objects of a class.

    Measures at a threshold are ``accuracy``; ``clean_accuracy``, without objects whose identical
    mesh also has another label; ``n_views``; ``travel_moved``, over the episodes that moved, as
    published, and ``travel_all``, grid cells; ``arc_all``, radians; ``confident``, the share that
    reached the threshold, and ``confident_accuracy``, the accuracy of these; and
    ``calibration_error``. The prefix ``class_`` marks means over classes.

    Measures after a number of views are ``accuracy`` and ``travel``, grid cells. Published values
    have a column of their own, "published".

    Holm's correction is applied to all tests of a measure at the thresholds, and to all tests
    after fixed numbers of views, without policies that know the truth.
    """

    def choosing(self) -> list[str]:
        """Return the policies that stop at thresholds; fixed views have none."""
        return list(self.measures.dropna(subset="threshold")["policy"].unique())


@dataclass(frozen=True)
class ClassResults:
    """A folder of results: settings, predictions and tables.

    Attributes:
        folder: with the results.
        settings: of the benchmark.
        predictions: that were replayed.
        tables: the results.
    """

    folder: Path
    settings: dict[str, Any]
    predictions: Predictions
    tables: ClassTables

    def episodes(self, policy: str, threshold: float | None) -> pd.DataFrame:
        """Read the episodes of a policy at a threshold.

        Args:
            policy: name of the policy.
            threshold: of the belief; None for fixed views.

        Returns:
            One episode per row, run by run, with the objects in the order of the predictions.
        """
        cell = [("policy", "==", policy)] + (
            [] if threshold is None else [("threshold", "==", threshold)]
        )
        return pq.read_table(self.folder / "episodes.parquet", filters=cell).to_pandas()


def class_set(label: str) -> str:
    """Return the name of the set of the objects of a class."""
    return f"class {label}"


def summarise(
    grid: Grid,
    reference: str,
    samples: int,
    rng: np.random.Generator,
    n_views: Sequence[int] = (),
) -> ClassTables:
    """Compute all tables of a benchmark.

    Args:
        grid: the episodes.
        reference: name of the reference policy.
        samples: number of bootstrap samples.
        rng: source of all random numbers.
        n_views: further numbers of views after which policies are compared; empty for none.

    Returns:
        The tables.
    """
    families = np.arange(len(grid.specs.predictions))
    weights = st.resample(len(families), samples, rng)
    cells = list(grid.cells())
    counted = Counted.of(_ended(grid, cells), {}, ENDS, families)
    whole = counted.tests(ALL, weights, reference, lambda key: key.measure in TESTED)
    of_measures = [whole[whole["measure"] == measure] for measure in TESTED]
    parts = [after_views(grid, n_views, weights, reference)] if n_views else []
    measures = [_measures(grid, cells, counted, weights), *(part for part, _ in parts)]
    tests = [*(corrected([some]) for some in of_measures), *(part for _, part in parts)]

    return ClassTables(
        pd.concat([table for table in measures if len(table)], ignore_index=True),
        pd.concat(tests, ignore_index=True),
        reference,
    )


def _ended(grid: Grid, cells: list[Cell]) -> pd.DataFrame:
    """Return the long table of whole episodes."""
    specs = grid.specs
    clean = ~specs.predictions.conflicting[specs.objects]
    parts = []
    for policy, threshold, ends in cells:
        right = ends.answer == specs.labels
        columns = {
            "policy": policy,
            "threshold": np.nan if threshold is None else threshold,
            "views": 0,
            "object": specs.objects,
            ONE: 1.0,
            "right": right,
            "clean": clean,
            "clean_right": right & clean,
            "n_views": ends.n_views,
            "moved": ends.n_views > 1,
            "travel": ends.travel,
            "arc": ends.arc,
            "confident": ends.confident,
            "confident_right": right & ends.confident,
        }
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def _measures(
    grid: Grid,
    cells: list[Cell],
    counted: Counted,
    weights: Float,
) -> pd.DataFrame:
    """Return measures of whole episodes over all objects, over classes, and for each class."""
    p = grid.specs.predictions
    over_classes = counted.only([*OF_CLASSES, "n_views"])
    means = over_classes.measures(ALL, weights, p.labels)
    found = [
        counted.measures(ALL, weights),
        means.assign(measure="class_" + means["measure"]),
        _calibration(grid, cells),
    ]

    by_class = counted.only(OF_CLASSES)
    for index in np.unique(p.labels):
        here = p.labels == index
        of_one = by_class.among(here)
        found.append(of_one.measures(class_set(p.classes[index]), weights[:, here]))

    classes = p.classes
    table = pd.concat(found, ignore_index=True)
    keys = table[["set", "policy", "threshold", "measure"]].to_numpy(object).tolist()
    beside = [
        published(
            policy,
            None if np.isnan(threshold) else threshold,
            measure,
            classes,
            None if name == ALL else name.removeprefix(class_set("")),
        )
        for name, policy, threshold, measure in keys
    ]
    return table.assign(published=np.array(beside, np.float64))


def _calibration(grid: Grid, cells: list[Cell]) -> pd.DataFrame:
    """Return the calibration error."""
    rows = []
    for policy, threshold, ends in cells:
        right = grid.right(ends.answer).ravel()
        error = metrics.calibration_error(ends.confidence, right)
        rows.append((policy, threshold, 0, "calibration_error", error, np.nan, np.nan))
    return measures_of(ALL, rows)


def after_views(
    grid: Grid,
    n_views: Sequence[int],
    weights: Float,
    reference: str,
) -> Both:
    """Compare policies after fixed numbers of views, without a threshold.

    A policy does not know the number of views, so it is run once and its path is cut after each
    number.

    Args:
        grid: the episodes; the paths are long enough, or end by themselves.
        n_views: numbers of views.
        weights: bootstrap weight of each object in each sample, (S, N).
        reference: name of the reference policy.

    Returns:
        Measures and tests.
    """
    long = max(n_views)
    names = [
        name
        for name, paths in grid.paths.items()
        if not paths.fixed or paths.views.shape[1] >= long
    ]
    families = np.arange(len(grid.specs.predictions))
    counted = Counted.of(_after(grid, names, n_views), AFTER, {}, families)
    tests = counted.tests(
        ALL, weights, reference, lambda key: key.measure == "accuracy"
    )
    return counted.measures(ALL, weights), corrected([tests], knows_truth)


def _after(grid: Grid, policies: Sequence[str], counts: Sequence[int]) -> pd.DataFrame:
    """Return the long table after numbers of views, or at the end of a path."""
    parts = []
    for policy in policies:
        path = grid.paths[policy]
        rows = np.arange(len(path.views))
        for k in counts:
            last = np.minimum((path.views >= 0).sum(1), k) - 1
            columns = {
                "policy": policy,
                "threshold": np.nan,
                "views": k,
                "object": grid.specs.objects,
                ONE: 1.0,
                "right": path.answers[rows, last] == grid.specs.labels,
                "travel": path.travel[rows, last],
            }
            parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


# with fewer objects, or wider intervals of differences in accuracy, a warning is given
FEW_OBJECTS = 200
WIDE_INTERVAL = 0.03


def headline_threshold(thresholds: Sequence[float]) -> float:
    """Return the threshold used in reports: 0.97, the library's default, or the closest one."""
    return min(thresholds, key=lambda t: abs(t - 0.97))


def leaderboard(tables: ClassTables, threshold: float) -> list[Any]:
    """List the policies at one threshold, the most accurate first and oracles last.

    Args:
        tables: of the benchmark.
        threshold: of the belief.

    Returns:
        Rows with policy, accuracy, its 95 % interval (low, high), class_accuracy, n_views, travel
        (grid cells, over all episodes), difference and p_holm to the reference (NaN for the
        reference itself), and differs, whether the difference is significant.
    """
    rows = tables.measures.query("set == @ALL and threshold == @threshold")
    table = rows.pivot(index="policy", columns="measure", values="value")
    table = table.join(
        rows[rows["measure"] == "accuracy"].set_index("policy")[["low", "high"]]
    )
    tests = accuracy_tests(tables, threshold).set_index("policy")
    table = table.join(tests[["difference", "p_holm"]]).reset_index()
    table = table.rename(columns={"travel_all": "travel"}).assign(
        differs=table["p_holm"] < SIGNIFICANT
    )
    return sorted(
        table.itertuples(index=False), key=lambda s: (is_oracle(s.policy), -s.accuracy)
    )


def promised_risks(tables: ClassTables, risks: Mapping[str, float]) -> list[Any]:
    """Compare guaranteed error rates with actual ones, for realisable policies.

    Args:
        tables: of the benchmark.
        risks: thresholds by guaranteed error rate.

    Returns:
        Rows with policy, risk, threshold, error among the episodes that reached the threshold, its
        interval (low, high), the share of these episodes (confident), and whether the guarantee is
        violated significantly (broken).
    """
    rows = []
    for risk, threshold in risks.items():
        values = values_of(tables.measures, threshold)
        for policy in dict.fromkeys(policy for policy, _, _ in values):
            # the upper limit of the accuracy is the lower limit of the error
            right, high, low = values[policy, "confident_accuracy", 0]
            share = values[policy, "confident", 0][0]
            row = (policy, float(risk), threshold, 1 - right, 1 - low, 1 - high, share)
            rows += [] if is_oracle(policy) else [row]
    columns = ["policy", "risk", "threshold", "error", "low", "high", "confident"]
    table = pd.DataFrame(rows, columns=columns)
    return list(
        table.assign(broken=table["low"] > table["risk"]).itertuples(index=False)
    )


def nothing_differs(
    tables: ClassTables,
    threshold: float,
    reference: str,
) -> str | None:
    """Return a sentence if no realisable policy differs significantly from the reference.

    Args:
        tables: of the benchmark.
        threshold: of the belief.
        reference: name of the reference policy.

    Returns:
        The sentence; None if some policy differs.
    """
    tests = _robot_tests(tables, threshold)
    if tests.empty or (tests["p_holm"] < SIGNIFICANT).any():
        return None
    return (
        f"No policy that a robot could follow differs significantly from {reference} in accuracy at"
        f" threshold {threshold:g} (every p after Holm's correction is {SIGNIFICANT} or more)."
    )


def too_few_objects(tables: Tables, threshold: float, objects: int) -> str | None:
    """Return a warning if there are too few objects to compare policies.

    Args:
        tables: of the benchmark.
        threshold: of the belief.
        objects: number of objects.

    Returns:
        The warning; None if there are enough.
    """
    if hopeless := too_few(accuracy_tests(tables)):
        return hopeless
    tests = _robot_tests(tables, threshold)
    # NaN without comparisons
    half = float((tests["high"] - tests["low"]).median() / 2)
    if objects >= FEW_OBJECTS and not half > WIDE_INTERVAL:
        return None
    unclear = (
        ""
        if half != half
        else f" and differences in accuracy are known to ±{100 * half:.1f} points"
    )
    what = (
        f"Too few objects to tell: there are {objects:,}{unclear}. Take no order of the policies"
        " from this"
    )
    return f"{what}; it wants at least {FEW_OBJECTS} objects and ±{100 * WIDE_INTERVAL:g} points."


def accuracy_tests(tables: Tables, threshold: float | None = None) -> "pd.DataFrame":
    """Return the tests of accuracy at one threshold; by default at all of them."""
    t = tables.tests.query("set == @ALL and views == 0 and measure == 'accuracy'")
    return t if threshold is None else t[t["threshold"] == threshold]


def _robot_tests(tables: Tables, threshold: float) -> "pd.DataFrame":
    tests = accuracy_tests(tables, threshold)
    return tests[~tests["policy"].map(is_oracle).astype(bool)]


def after_views_table(tables: Tables) -> WrittenTable | None:
    """Return the results after fixed numbers of views as text; None if there are none."""
    after = tables.measures.query("set == @ALL and views > 0")
    counts = [int(k) for k in after["views"].unique()]
    columns = [Column(f"{k} view{'s' * (k > 1)}", ("accuracy",), k) for k in counts]
    columns += [Column(f"travel at {k}", ("travel",), k, 2) for k in counts]
    board = Board(f"points over {tables.reference}: tests.csv", tuple(columns))
    stars = significant(tables)
    named = {column.heading: column for column in columns}
    return written(tables, board, named, stars) if counts else None
