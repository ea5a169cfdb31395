"""The policies as they come through a benchmark, above its progress bar."""

from __future__ import annotations

from rich.console import RenderableType
from rich.table import Table

from nextview.benchmark.experiment import Grid
from nextview.benchmark.leaderboard import headline_threshold, is_oracle
from nextview.benchmark.replay import truncate

SHOWN = 12
"""The best of them are shown, so many that they fit into a small terminal."""


class LiveLeaderboard:
    """The policies that have come through, the most accurate first."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, float, float, float]] = []
        self.title = ""

    def add(self, grid: Grid, name: str) -> None:
        """Take in a policy that has just come through under the headline threshold; fixed views do not take part."""
        paths = grid.paths.get(name)
        if paths is None or paths.fixed:
            return
        at = headline_threshold(grid.thresholds)
        ends = truncate(paths, at, grid.threshold_decay)
        row = name, float(grid.right(ends.answer).mean()), float(ends.n_views.mean()), float(ends.travel.mean())
        self.title = f"so far, at threshold {at:g}"
        self.rows = sorted([*self.rows, row], key=lambda row: -row[1])

    def table(self) -> RenderableType:
        """The best of them."""
        if not self.rows:
            return ""
        table = Table(title=self.title, title_justify="left", box=None, pad_edge=False)
        table.add_column("policy", no_wrap=True, min_width=20)
        for column in ("accuracy", "views", "travel"):
            table.add_column(column, justify="right")
        for name, accuracy, n_views, travel in self.rows[:SHOWN]:
            cells = f"{accuracy:.3f}", f"{n_views:.2f}", f"{travel:.2f}"
            table.add_row(name, *cells, style="dim" if is_oracle(name) else None)
        return table
