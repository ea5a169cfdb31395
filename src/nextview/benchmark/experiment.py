"""The experiment: every entry under every threshold from the same first views."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nextview.benchmark.entries import EpisodeSpecs
from nextview.benchmark.replay import Outcomes, Trajectories, replay, truncate
from nextview.errors import NextviewError

THRESHOLDS = (0.85, 0.9, 0.95, 0.97, 0.99)
"""The thesis's (section 5.3)."""


@dataclass(frozen=True)
class Grid:
    """What was run, and what came of it.

    Attributes:
        specs: the episodes, the same for all.
        runs: first views of each object.
        thresholds: of the belief, ascending.
        max_views: views at most.
        seed: of everything random.
        threshold_decay: how fast the threshold of each threshold comes down with the views, see ``Stopping``.
        paths: of each entry that came to its end, by name.
        failures: a sentence for each that did not.
    """

    specs: EpisodeSpecs
    runs: int
    thresholds: tuple[float, ...]
    max_views: int
    seed: int
    threshold_decay: float = 0.0
    paths: dict[str, Trajectories] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)

    def cells(self) -> Iterator[tuple[str, float | None, Outcomes]]:
        """Every entry under every threshold; fixed views once, with threshold None."""
        for name, paths in self.paths.items():
            for threshold in (None,) if paths.fixed else self.thresholds:
                yield name, threshold, truncate(paths, threshold, self.threshold_decay)

    def right(self, answer: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which answers, (E,), name the true class, (runs, N)."""
        return (answer == self.specs.labels).reshape(self.runs, -1)


def run_grid(
    grid: Grid, names: Sequence[str], through: Callable[[Grid, str], object] = lambda grid, name: None
) -> Iterator[int]:
    """Run the entries one after the other; one that fails leaves its sentence and takes nothing from the others.

    Args:
        grid: what is run, and takes in what comes of it.
        names: of the entries.
        through: is called with the grid and the name of each entry that has just been run.

    Yields:
        How many are through.
    """
    for n, name in enumerate(names, 1):
        try:
            grid.paths[name] = replay(name, grid.specs, grid.max_views, grid.seed)
        except NextviewError as error:
            grid.failures[name] = str(error)
        through(grid, name)
        yield n
