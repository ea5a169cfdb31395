"""From episodes to tables: every number with its interval, its test and the published value."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nextview.benchmark import statistics as st
from nextview.benchmark.entries import is_oracle
from nextview.benchmark.published import comparable_classes, published
from nextview.benchmark.replay import Grid
from nextview.benchmark.views import RESULT_COLUMNS, measured
from nextview.checks import extras
from nextview.data import metrics
from nextview.session.episode import Outcome
from nextview.simulation.scene_layout import CLUTTER_LEVELS, clutter_level
from nextview.types import Float, Index

with extras():
    import pandas as pd

Drawn = dict[tuple, Float]  # what resampling gives, by policy, threshold and measure
Cell = tuple[str, float | None, Outcome]
TESTED = ("accuracy", "clean_accuracy", "n_views", "travel_all")
# from the first view for all to the last for most
SWEEP = (0.0, *(1 - np.logspace(np.log10(0.75), -9, 40)), 1.0)
LEVEL_VIEWS = (2, 3, 5)  # after so many views the policies are compared
LEVEL_COLUMNS = [
    "level",
    "scenes",
    "policy",
    "n_views",
    "accuracy",
    "low",
    "high",
    "travel",
    "difference",
]
LEVEL_COLUMNS += ["difference_low", "difference_high", "p"]


@dataclass(frozen=True)
class Tables:
    """The results of a benchmark, as long tables.

    Intervals are 95 % bootstrap intervals over objects, ``low`` to ``high``.

    Attributes:
        summary: a row a policy, threshold and measure: ``accuracy``; ``clean_accuracy``, without
            the objects whose very mesh also has another label; ``n_views``; ``travel_moved``, over
            the episodes that moved, as published, and ``travel_all``, grid cells; ``arc_all``,
            radians; ``confident``, the share that reached the threshold, and
            ``confident_accuracy``, of these; ``calibration_error``; with ``class_`` before it the
            mean over classes.
        per_class: the same of classes (accuracy, travel_moved).
        tests: differences to the reference, p (see ``statistics.sign_flip_p``; scenes around one
            target are one family), and p_holm, after Holm's correction over all rows of a measure.
        sweep: the points of the curves of accuracy against views and travel.
        reliability: confidence and accuracy by bin.
        risks: error rates promised, and those measured among the episodes that reached their
            threshold.
        levels: of scenes: accuracy after so many views by the level of clutter, see ``by_level``.
        views: accuracy and travel after fixed numbers of views, see ``views.measured``.
    """

    summary: pd.DataFrame
    per_class: pd.DataFrame
    tests: pd.DataFrame
    sweep: pd.DataFrame
    reliability: pd.DataFrame
    risks: pd.DataFrame
    levels: pd.DataFrame
    views: pd.DataFrame = field(
        default_factory=lambda: pd.DataFrame(columns=RESULT_COLUMNS)
    )


def summarise(
    grid: Grid,
    reference: str,
    samples: int,
    rng: np.random.Generator,
    promised: Mapping[float, float] | None = None,
    n_views: Sequence[int] = (),
) -> Tables:
    """Compute all tables of a benchmark.

    Args:
        grid: the episodes.
        reference: name of the reference policy.
        samples: number of bootstrap samples.
        rng: source of all random numbers.
        promised: thresholds by the error rates that they guarantee.
        n_views: numbers of views for the table of fixed lengths; empty for none.

    Returns:
        The tables.
    """
    families = st.target_families(grid.specs.predictions.names)
    weights = st.resample_families(families, samples, rng)
    cells = list(grid.cells())
    summary, drawn = _summary(grid, cells, weights)
    return Tables(
        summary,
        _per_class(grid, cells, weights),
        _tests(grid, cells, drawn, reference, families),
        _sweep(grid),
        _reliability(grid, cells),
        _risks(summary, promised or {}),
        by_level(grid, reference, samples, rng),
        *([measured(grid, n_views, samples, [reference])] if n_views else []),
    )


def _measures(grid: Grid, ends: Outcome) -> dict[str, tuple[Float, Float]]:
    """Each measure of a cell as a sum for each object and what to divide it by, (N,) each."""
    right = grid.right(ends.answer).astype(np.float64)
    clean = np.where(grid.specs.predictions.conflicting, 0.0, 1.0)
    one = np.ones(right.shape[1])

    def of(values: NDArray) -> NDArray:
        return values.reshape(grid.runs, -1)

    moved = of(ends.n_views > 1)
    confident = of(ends.confident)
    mean = right.mean(0)
    return {
        "accuracy": (mean, one),
        "clean_accuracy": (mean * clean, clean),
        "n_views": (of(ends.n_views).mean(0), one),
        "travel_moved": (of(ends.travel).sum(0), moved.sum(0).astype(np.float64)),
        "travel_all": (of(ends.travel).mean(0), one),
        "arc_all": (of(ends.arc).mean(0), one),
        "confident": (confident.mean(0), one),
        "confident_accuracy": (
            (right * confident).sum(0),
            confident.sum(0).astype(np.float64),
        ),
    }


def _columns(
    grid: Grid,
    cells: list[Cell],
    names: tuple[str, ...] | None = None,
) -> tuple[list, Float, Float]:
    """Return the measures of all cells: their keys, numerators and denominators, (N, M)."""
    found = {
        (policy, threshold, measure): sums
        for policy, threshold, ends in cells
        for measure, sums in _measures(grid, ends).items()
        if names is None or measure in names
    }
    tops, bottoms = zip(*found.values(), strict=True)
    return list(found), np.stack(tops, 1), np.stack(bottoms, 1)


def _summary(
    grid: Grid,
    cells: list[Cell],
    weights: Float,
) -> tuple[pd.DataFrame, dict[tuple, Float]]:
    labels = grid.specs.predictions.labels
    classes = comparable_classes(grid.specs.predictions)
    keys, top, bottom = _columns(grid, cells)
    of_class = [
        i
        for i, key in enumerate(keys)
        if key[2] in ("accuracy", "travel_moved", "n_views")
    ]
    keys += [(keys[i][0], keys[i][1], f"class_{keys[i][2]}") for i in of_class]

    over_objects = st.estimate(top, bottom, weights)
    over_classes = st.estimate(top[:, of_class], bottom[:, of_class], weights, labels)
    value, drawn = (
        np.concatenate(both, -1)
        for both in zip(over_objects, over_classes, strict=True)
    )

    numbers = zip(keys, value, *st.interval(drawn), strict=True)
    rows = [
        (*key, *number, published(key[0], key[1], key[2], classes))
        for key, *number in numbers
    ]

    for policy, threshold, ends in cells:
        right = grid.right(ends.answer)
        error = metrics.calibration_error(ends.confidence, right.ravel())
        between = np.std(
            [right[:, labels == label].mean() for label in np.unique(labels)]
        )
        rows.append(
            (policy, threshold, "calibration_error", error, np.nan, np.nan, None)
        )
        rows.append(
            (policy, threshold, "class_accuracy_std", between, np.nan, np.nan, None)
        )

    columns = ["policy", "threshold", "measure", "value", "low", "high", "published"]
    return _frame(rows, columns), {key: drawn[:, i] for i, key in enumerate(keys)}


def _per_class(grid: Grid, cells: list[Cell], weights: Float) -> pd.DataFrame:
    p = grid.specs.predictions
    classes = comparable_classes(grid.specs.predictions)
    keys, top, bottom = _columns(grid, cells, ("accuracy", "travel_moved"))

    rows = []
    for index in np.unique(p.labels):
        here = p.labels == index
        label = p.classes[index]
        value, drawn = st.estimate(top[here], bottom[here], weights[:, here])
        for (policy, threshold, measure), *number in zip(
            keys,
            value,
            *st.interval(drawn),
            strict=True,
        ):
            beside = published(policy, threshold, measure, classes, label)
            rows.append((policy, threshold, label, measure, *number, beside))

    return _frame(
        rows,
        [
            "policy",
            "threshold",
            "label",
            "measure",
            "value",
            "low",
            "high",
            "published",
        ],
    )


def _tests(
    grid: Grid,
    cells: list[Cell],
    drawn: Drawn,
    reference: str,
    families: Index,
) -> pd.DataFrame:
    keys, top, bottom = _columns(grid, cells, TESTED)
    place = {key: i for i, key in enumerate(keys)}
    pairs = [
        (ours, place[reference, ours[1], ours[2]])
        for ours in keys
        if ours[0] != reference and (reference, ours[1], ours[2]) in place
    ]
    own = [place[ours] for ours, _ in pairs]
    theirs = [column for _, column in pairs]
    # Both have the same denominators: a sum of differences is theirs but for a factor.
    differences = top[:, own] - top[:, theirs]
    p = st.sign_flip_p(st.by_family(differences, families))
    once = np.ones((1, len(top)))
    shares = metrics.ratio(differences, bottom[:, own], once)[0]
    samples = [drawn[ours] - drawn[keys[column]] for ours, column in pairs]
    rows = [
        (*ours, share, *(float(end[0]) for end in st.interval(sample[:, None])), value)
        for (ours, _), share, sample, value in zip(
            pairs,
            shares,
            samples,
            p,
            strict=True,
        )
    ]
    table = _frame(
        rows,
        ["policy", "threshold", "measure", "difference", "low", "high", "p"],
    )
    table["p_holm"] = table.groupby("measure")["p"].transform(
        lambda p: st.holm(p.to_numpy())
    )
    return table


def _sweep(grid: Grid) -> pd.DataFrame:
    measures = ("accuracy", "n_views", "travel_all", "arc_all")
    points = []
    for name, paths in grid.paths.items():
        if not paths.fixed:
            _, top, _ = _columns(
                grid,
                [(name, t, grid.ends(name, t)) for t in SWEEP],
                measures,
            )
            curve = top.mean(0).reshape(len(SWEEP), -1)
            points += [
                (name, t, *values) for t, values in zip(SWEEP, curve, strict=True)
            ]
    return _frame(points, ["policy", "threshold", *measures])


def _reliability(grid: Grid, cells: list[Cell]) -> pd.DataFrame:
    rows = []
    for policy, threshold, ends in cells:
        sure, accuracy, count = metrics.reliability(
            ends.confidence,
            grid.right(ends.answer).ravel(),
        )
        rows += [
            (policy, threshold, i, sure[i], accuracy[i], count[i])
            for i in np.flatnonzero(count)
        ]
    return _frame(
        rows,
        ["policy", "threshold", "bin", "confidence", "accuracy", "episodes"],
    )


def _risks(summary: pd.DataFrame, promised: Mapping[float, float]) -> pd.DataFrame:
    rows = []
    for risk, threshold in promised.items():
        at = summary[summary["threshold"] == threshold]
        right, share = (
            at[at["measure"] == measure]
            for measure in ("confident_accuracy", "confident")
        )
        # the upper end of accuracy is the lower of error
        measured = right[["value", "high", "low"]].to_numpy(float)
        for policy, (mean, high, low), stopped in zip(
            right["policy"],
            measured,
            share["value"],
            strict=True,
        ):
            if not is_oracle(policy):
                rows.append(
                    (policy, risk, threshold, 1 - mean, 1 - high, 1 - low, stopped)
                )
    return _frame(
        rows,
        ["policy", "risk", "threshold", "error", "low", "high", "confident"],
    )


def _frame(rows: list, columns: list[str]) -> pd.DataFrame:
    table = pd.DataFrame(rows, columns=columns)
    return table.astype(
        dict.fromkeys(
            [c for c in columns if c in ("threshold", "published")],
            "float64",
        )
    )


def levels_of(names: Sequence[str]) -> NDArray[np.str_]:
    """The level of clutter of each scene, by its name, (N,); "" for a single object."""
    return np.array([clutter_level(name) for name in names])


def by_level(
    grid: Grid,
    reference: str,
    samples: int,
    rng: np.random.Generator,
) -> pd.DataFrame:
    """Compute the accuracy in scenes by the level of clutter.

    Episodes have 1 view and LEVEL_VIEWS views; no threshold ends them.

    Args:
        grid: the episodes.
        reference: name of the reference policy.
        samples: number of bootstrap samples.
        rng: source of all random numbers.

    Returns:
        One row for each level, policy and number of views.
    """
    names: tuple[str, ...] = grid.specs.predictions.names
    level_of = levels_of(names)
    order = list(CLUTTER_LEVELS)
    rows = []
    paths = {name: paths for name, paths in grid.paths.items() if not paths.fixed}
    counts = [k for k in (1, *LEVEL_VIEWS) if k <= grid.max_views]
    known = [level for level in order if level in level_of]
    for level in [*known, *sorted({*level_of} - {*known, ""})]:
        mine = np.flatnonzero(level_of == level)
        families = st.target_families([names[i] for i in mine])
        weights = st.resample_families(families, samples, rng)
        weights /= weights.sum(1, keepdims=True)
        right = {}
        for name, path in paths.items():
            answers = _after(path.answers, path.views, counts)
            right[name] = grid_mean(
                grid,
                (answers == grid.specs.labels[:, None]).astype(np.float64),
            )[mine]
        for name, path in paths.items():
            low, high = st.interval(weights @ right[name])
            travel = grid_mean(grid, _after(path.travel, path.views, counts))[
                mine
            ].mean(0)
            compared = np.full((4, len(counts)), np.nan)
            if reference in right and name != reference:
                against = right[name] - right[reference]
                drawn = weights @ against
                compared = np.stack(
                    [
                        against.mean(0),
                        *st.interval(drawn),
                        st.sign_flip_p(st.by_family(against, families)),
                    ]
                )
                # there the policies have chosen nothing
                compared[3, np.array(counts) == 1] = np.nan
            mean = right[name].mean(0)
            for i, k in enumerate(counts):
                rows.append(
                    (
                        level,
                        len(mine),
                        name,
                        k,
                        mean[i],
                        low[i],
                        high[i],
                        travel[i],
                        *compared[:, i],
                    )
                )
    table = pd.DataFrame(rows, columns=LEVEL_COLUMNS)
    return table.assign(p_holm=st.holm(table["p"].to_numpy(np.float64)))


def _after(values: NDArray, views: Index, counts: list[int]) -> NDArray:
    """Return values after numbers of views, or at the end of shorter episodes, (E, counts)."""
    return values[
        np.arange(len(values))[:, None],
        np.minimum((views >= 0).sum(1)[:, None], counts) - 1,
    ]


def grid_mean(grid: Grid, values: NDArray) -> Float:
    """Average over the runs of each object.

    Args:
        grid: the episodes.
        values: of the episodes, (E, ...).

    Returns:
        Means, (N, ...) float64.
    """
    return values.reshape(grid.runs, -1, *values.shape[1:]).mean(0)
