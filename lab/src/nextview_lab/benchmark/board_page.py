"""Tables of text."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from nextview_lab.benchmark.comparison import Tables, values_of

NONE = "\N{EN DASH}"


@dataclass(frozen=True)
class WrittenTable:
    """A table of text, for a terminal or a file.

    Attributes:
        title: above it.
        about: what it shows, a sentence or two; "" for nothing.
        headings: of the columns.
        rows: cells, as many as headings in each.
    """

    title: str
    about: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Column:
    """A column of a table that compares policies.

    Attributes:
        heading: of the column.
        measures: in a cell, separated by commas.
        views: number of views; 0 for whole episodes.
        digits: after the decimal point.
        short: heading in narrow tables; "" if it is not part of them.
    """

    heading: str
    measures: tuple[str, ...]
    views: int = 0
    digits: int = 3
    short: str = ""


@dataclass(frozen=True)
class Board:
    """A table that compares policies.

    Attributes:
        title: of the table.
        columns: after the column of policy names.
        about: a line below the title.
    """

    title: str
    columns: tuple[Column, ...]
    about: str = ""

    def narrow(self) -> dict[str, Column]:
        """Return the columns of the narrow tables, by their short headings."""
        return {column.short: column for column in self.columns if column.short}


def written(
    tables: Tables,
    board: Board,
    columns: Mapping[str, Column],
    marked: Iterable[tuple[str, str, int]] = (),
) -> WrittenTable:
    """Return a board as text: a row for each policy that has all of its numbers.

    Args:
        tables: of the benchmark.
        board: the table.
        columns: of the table, by heading.
        marked: policy, measure and views of the numbers marked with a star.
    """
    values = values_of(tables.measures)
    stars = set(marked)

    def shown(policy: str, measure: str, column: Column) -> str:
        value = values[policy, measure, column.views][0]
        star = "*" * ((policy, measure, column.views) in stars)
        return "-" if np.isnan(value) else f"{value:.{column.digits}f}{star}"

    rows = tuple(
        (
            policy,
            *(
                ", ".join(shown(policy, m, c) for m in c.measures)
                for c in columns.values()
            ),
        )
        for policy in tables.policies()
        if all(
            (policy, m, c.views) in values for c in columns.values() for m in c.measures
        )
    )
    return WrittenTable(board.title, board.about, ("policy", *columns), rows)


def points(difference: float) -> str:
    """Format a difference of shares in percentage points."""
    return f"{round(100 * difference, 1) + 0.0:+.1f}"


def markdown(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """Format a table as Markdown.

    Args:
        head: headings.
        rows: cells.
    """
    head = list(head)
    lines = [head, *rows]
    text = [f"| {' | '.join(map(str, line))} |" for line in lines]
    return "\n".join([text[0], "|---" * len(head) + "|", *text[1:]]) + "\n"
