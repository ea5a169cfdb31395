"""Tables of text."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

NONE = "\N{EN DASH}"


@dataclass(frozen=True)
class WrittenTable:
    """A table of text, for a terminal or a file.

    Attributes:
        title: above it.
        headings: of the columns.
        rows: cells, as many as headings in each.
    """

    title: str
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
