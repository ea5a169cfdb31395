"""Compare policies after fixed numbers of views.

A policy chooses without knowing how many views there will be, so it is run once and its path cut
after each number.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from nextview.benchmark.entries import knows_truth
from nextview.benchmark.replay import Grid, Trajectories, truncate
from nextview.benchmark.statistics import (
    by_family,
    holm,
    interval,
    resample_families,
    sign_flip_p,
    target_families,
)
from nextview.checks import extras
from nextview.data.metrics import ratio
from nextview.session.episode import Outcome

with extras():
    import pandas as pd

CEILING = "oracle-gain"
RESULT_COLUMNS = ["policy", "n_views", "measure", "value", "low", "high", "p", "p_holm"]
# value, low, high, p, Holm's p
Numbers = dict[tuple[str, int, str], tuple[float, float, float, float, float]]


def after(paths: Trajectories, n_views: int) -> Outcome:
    """Return how episodes stand after a number of views.

    Args:
        paths: of the episodes.
        n_views: number of views.

    Returns:
        How the episodes end.
    """
    fields = ("views", "answers", "confidences", "travel", "arc")
    return truncate(
        replace(paths, **{name: getattr(paths, name)[:, :n_views] for name in fields}),
        None,
    )


def measured(
    grid: Grid,
    n_views: Sequence[int],
    samples: int,
    references: Sequence[str],
) -> pd.DataFrame:
    """Compare policies after fixed numbers of views.

    The measures are ``accuracy``; ``travel`` in grid cells; ``to_random`` and so on, differences of
    accuracy from references; and ``share_of_gap``, the share of the lead of ``oracle-gain`` over
    the first reference that a policy has. The bootstrap samples are those of the benchmark, the
    same for all policies, which pairs the differences. p is that of ``statistics.sign_flip_p`` over
    objects, scenes around one target as one, with one Holm correction for every policy without the
    truth, reference and number of views.

    Args:
        grid: the episodes; the paths are as long, or end by themselves.
        n_views: numbers of views.
        samples: number of bootstrap samples.
        references: names of the reference policies.

    Returns:
        One number per row, with the columns RESULT_COLUMNS.
    """
    names = [
        name
        for name, paths in grid.paths.items()
        if not paths.fixed or paths.views.shape[1] >= max(n_views)
    ]
    references = [name for name in references if name in names]
    families = target_families(grid.specs.predictions.names)
    rng = np.random.default_rng([grid.seed, 1])
    weights = resample_families(families, samples, rng)
    rows: list[tuple] = []

    for k in n_views:
        ends = [after(grid.paths[name], k) for name in names]
        right = dict(zip(names, (grid.right(e.answer) for e in ends), strict=True))
        columns = {(name, "accuracy"): r.mean(0) for name, r in right.items()}
        travel = (e.travel.reshape(grid.runs, -1).mean(0) for e in ends)
        columns |= {
            (name, "travel"): mean for name, mean in zip(names, travel, strict=True)
        }

        for name, reference in product(names, references):
            columns[name, f"to_{reference}"] = (
                columns[name, "accuracy"] - columns[reference, "accuracy"]
            )

        top = np.stack(list(columns.values()), 1)
        low, high = interval(ratio(top, np.ones_like(top), weights))
        tested = [
            column
            for column, (name, measure) in enumerate(columns)
            if measure.startswith("to_") and measure != f"to_{name}"
        ]
        p_values = np.full(len(columns), np.nan)
        p_values[tested] = sign_flip_p(by_family(top[:, tested], families))
        value = dict(zip(columns, top.mean(0), strict=True))
        for i, (name, measure) in enumerate(columns):
            numbers = (value[name, measure], low[i], high[i], p_values[i])
            rows.append((name, k, measure, *numbers))

        gap = (
            value[CEILING, f"to_{references[0]}"]
            if CEILING in names and references
            else 0.0
        )
        for name in names:
            share = value[name, f"to_{references[0]}"] / gap if gap > 0 else np.nan
            rows.append((name, k, "share_of_gap", share, np.nan, np.nan, np.nan))

    table = pd.DataFrame(rows, columns=RESULT_COLUMNS[:-1])
    table["p_holm"] = holm(
        np.where(~table["policy"].map(knows_truth).astype(bool), table["p"], np.nan)
    )
    return table


def by_key(table: pd.DataFrame) -> Numbers:
    """The numbers of a table by policy, number of views and measure."""
    return {
        (policy, k, measure): tuple(rest)
        for policy, k, measure, *rest in table.itertuples(index=False)
    }


def as_rows(table: pd.DataFrame) -> pd.DataFrame:
    """The table as it is read: a row a policy, its numbers as text."""
    found = by_key(table)
    n_views = table["n_views"].unique().tolist()
    references = [
        m.removeprefix("to_") for m in table["measure"].unique() if m.startswith("to_")
    ]
    at = " at " + ", ".join(map(str, n_views))

    def difference(name: str, k: int, reference: str) -> str:
        value, *_, p = found[name, k, f"to_{reference}"]
        # rounded first: no minus before a zero
        shown = f"{round(100 * value, 1) + 0.0:+.1f}"
        if np.isnan(p):  # a ceiling is no rival
            return shown
        return f"{shown} (p {'< 0.0001' if p < 1e-4 else f'{p:.2g}'})"

    rows = []
    for name in table["policy"].unique():
        row = {"policy": name}
        for k in n_views:
            row[f"{k} view{'s' * (k > 1)}"] = "{:.3f} ({:.3f}-{:.3f})".format(
                *found[name, k, "accuracy"][:3]
            )
        row[f"travel{at}"] = ", ".join(
            f"{found[name, k, 'travel'][0]:.2f}" for k in n_views
        )
        for reference in references:
            over = (
                ""
                if name == reference
                else ", ".join(difference(name, k, reference) for k in n_views)
            )
            row[f"points over {reference}{at}"] = over
        shares = [found[name, k, "share_of_gap"][0] for k in n_views]
        row[f"of the gap{at}"] = ", ".join(
            "-" if np.isnan(s) else f"{100 * s:.0f} %" for s in shares
        )
        rows.append(row)
    return pd.DataFrame(rows)


def markdown(rows: pd.DataFrame, left_out: Sequence[str] = ()) -> str:
    """Return a table of text as Markdown.

    Args:
        rows: the table.
        left_out: sentences about what was left out.

    Returns:
        The table, and the sentences below it.
    """
    lines = ["| " + " | ".join(rows.columns) + " |", "|---" * len(rows.columns) + "|"]
    lines += [
        "| " + " | ".join(map(str, row)) + " |" for row in rows.itertuples(index=False)
    ]
    return (
        "\n".join([*lines, *(f"\nLeft out: {sentence}" for sentence in left_out)])
        + "\n"
    )
