"""Accuracy in worlds by how much stands around, after a fixed number of views: who sees around things."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from nextview.benchmark import statistics as st
from nextview.benchmark.experiment import Grid
from nextview.worlds import LEVELS, level_of

VIEWS = (2, 3, 5)
"""After so many views the policies are compared."""
ORDER = tuple(LEVELS)
COLUMNS = [
    "level", "worlds", "policy", "n_views", "accuracy", "low", "high", "travel", "difference", "difference_low",
    "difference_high", "p", "p_holm",
]  # fmt: skip


def levels_of(names: tuple[str, ...]) -> NDArray[np.str_]:
    """The level of each world, by its name, (N,); "" for what is none."""
    return np.array([level_of(name) for name in names])


def target_weights(names: Sequence[str], samples: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Bootstrap weights, (samples, N), in which worlds around one target are drawn together: they are no two witnesses.

    Of single objects ``statistics.resample``.
    """
    targets = [name.rpartition("@")[0] if level_of(name) else name for name in names]
    place = {target: i for i, target in enumerate(dict.fromkeys(targets))}
    return st.resample(len(place), samples, rng)[:, [place[target] for target in targets]]


def by_level(grid: Grid, reference: str, samples: int, rng: np.random.Generator) -> pd.DataFrame:
    """What every policy knows after one view, and after VIEWS, whatever it believes; no threshold ends an episode.

    Args:
        grid: what was run.
        reference: the policy that the others are compared with, over the same worlds and first views.
        samples: of the bootstrap over targets.
        rng: draws them.

    Returns:
        level, worlds (how many), policy, n_views, accuracy, low, high, travel (cells so far), difference to the
        reference, difference_low, difference_high, p (paired bootstrap), p_holm (one correction for all of them).
        Empty where the objects are no worlds. Fixed views are left out.
    """
    names: tuple[str, ...] = grid.specs.predictions.names
    of, rows = levels_of(names), []
    paths = {name: paths for name, paths in grid.paths.items() if not paths.fixed}
    counts = [k for k in (1, *VIEWS) if k <= grid.max_views]
    for level in sorted({*of} - {""}, key=lambda name: (ORDER.index(name) if name in ORDER else len(ORDER), name)):
        mine = np.flatnonzero(of == level)
        weights = target_weights([names[i] for i in mine], samples, rng)
        weights /= weights.sum(1, keepdims=True)
        right = {name: _after(grid, path.answers, path.views, counts)[mine] for name, path in paths.items()}
        for name, path in paths.items():
            spread = weights @ right[name]
            low, high = st.interval(spread)
            travel = grid_mean(grid, _last(path.travel, path.views, counts))[mine].mean(0)
            told = np.full((4, len(counts)), np.nan)
            if reference in right and name != reference:
                against = right[name] - right[reference]
                drawn = weights @ against
                told = np.stack([against.mean(0), *st.interval(drawn), st.bootstrap_p(against.mean(0), drawn)])
                told[3, np.array(counts) == 1] = np.nan  # there the policies have chosen nothing
            mean = right[name].mean(0)
            rows += [
                (level, len(mine), name, k, mean[i], low[i], high[i], travel[i], *told[:, i])
                for i, k in enumerate(counts)
            ]
    table = pd.DataFrame(rows, columns=COLUMNS[:-1])
    return table.assign(p_holm=st.holm(table["p"].to_numpy(np.float64)))


def _last(values: NDArray, views: NDArray[np.int64], counts: list[int]) -> NDArray:
    """Values after so many views, or after the last one where an episode ended before, (E, counts)."""
    taken = (views >= 0).sum(1)
    return values[np.arange(len(values))[:, None], np.minimum(taken[:, None], counts) - 1]


def _after(grid: Grid, answers: NDArray[np.int64], views: NDArray[np.int64], counts: list[int]) -> NDArray:
    """How often each object is named right after so many views, (N, counts)."""
    right = _last(answers, views, counts) == grid.specs.labels[:, None]
    return grid_mean(grid, right.astype(np.float64))


def grid_mean(grid: Grid, values: NDArray) -> NDArray[np.float64]:
    """Mean over the runs of each object, (E, ...) to (N, ...)."""
    return values.reshape(grid.runs, -1, *values.shape[1:]).mean(0)
