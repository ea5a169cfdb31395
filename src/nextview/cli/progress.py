"""A progress bar around anything that reports what it has done."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text

from nextview.cli.ending import printable
from nextview.cli.terminal import Terminal

console = Terminal(stderr=True)


def track(
    done: Iterable[int],
    total: int,
    what: str,
    before: int = 0,
    views: int = 0,
    above: Callable[[], RenderableType] | None = None,
) -> None:
    """Exhaust an iterable that yields how much is done so far; show it, the time left and, at the end, the time taken.

    Args:
        done: counts, growing.
        total: the last count.
        what: what is being done.
        before: how much an earlier run had done.
        views: if given, the speed is shown too, in objects of so many views.
        above: if given, what it makes is shown above the bar while something is left to do; in a terminal only.
    """
    # All of it fits into 80 columns, at thousands of objects and views a second too.
    name = TextColumn(
        "{task.description}", markup=False, table_column=Column(no_wrap=True, max_width=20, overflow="ellipsis")
    )
    columns = [name, BarColumn(8), MofNCompleteColumn(), TimeRemainingColumn(elapsed_when_finished=True)]
    columns += [Speed(views)] if views else []
    with _ProgressBelow(*columns, console=console, above=above if console.is_terminal else None) as progress:
        task = progress.add_task(printable(what), total=total, completed=before)
        for n in done:
            progress.update(task, completed=n, refresh=above is not None)


class _ProgressBelow(Progress):
    """Progress bars below something else."""

    def __init__(self, *columns: ProgressColumn, console: Console, above: Callable[[], RenderableType] | None) -> None:
        self.above = above
        super().__init__(*columns, console=console)

    def get_renderables(self) -> Iterable[RenderableType]:
        """What stands above, until all is done, and the bars."""
        if self.above is not None and not self.finished:
            yield self.above()
        yield from super().get_renderables()


class Speed(ProgressColumn):
    """Objects and views a second."""

    def __init__(self, views: int) -> None:
        super().__init__()
        self.views = views

    def render(self, task: Task) -> Text:
        """As text; empty until there is a speed to speak of."""
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.1f} objects/s, {speed * self.views:.0f} views/s" if speed else "", no_wrap=True)
