"""Tables of text, and a leaderboard of them as Markdown.

Names of methods and of archives come from elsewhere. ``plain`` escapes line breaks and control
characters in all texts of a leaderboard; ``_escaped`` escapes each text for Markdown.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from nextview.checks import one_line
from nextview_lab.benchmark.comparison import Tables, values_of

NONE = "\N{EN DASH}"
LONGEST_TEXT = 1000  # characters of a cell or a sentence


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


@dataclass(frozen=True)
class Leaderboard:
    """Methods that are compared on an archive.

    Attributes:
        archive: its name.
        reference: the method with which the others are compared; None without a blind one.
        tables: all of them, the most important first.
        notes: what a reader has to know.
    """

    archive: str
    reference: str | None
    tables: tuple[WrittenTable, ...]
    notes: tuple[str, ...]


def points(difference: float) -> str:
    """Format a difference of shares in percentage points."""
    return f"{round(100 * difference, 1) + 0.0:+.1f}"


def plain(board: Leaderboard) -> Leaderboard:
    """Return a leaderboard whose texts are one line each, control characters escaped.

    Args:
        board: the leaderboard.
    """
    return Leaderboard(
        _plain(board.archive),
        None if board.reference is None else _plain(board.reference),
        tuple(
            WrittenTable(
                _plain(table.title),
                _plain(table.about),
                tuple(map(_plain, table.headings)),
                tuple(tuple(map(_plain, row)) for row in table.rows),
            )
            for table in board.tables
        ),
        tuple(map(_plain, board.notes)),
    )


def _plain(text: str) -> str:
    return one_line(text, LONGEST_TEXT)


def as_markdown(board: Leaderboard) -> str:
    """Return a leaderboard as Markdown.

    Args:
        board: the leaderboard, plain.
    """
    lines = [f"# {_escaped(board.archive)}", ""]
    for table in board.tables:
        lines += [f"## {_escaped(table.title)}", "", _escaped(table.about), ""]
        rows = [map(_escaped, row) for row in table.rows]
        lines.append(markdown(map(_escaped, table.headings), rows))
    lines += [f"- {_escaped(note)}" for note in board.notes]
    return "\n".join(lines) + "\n"


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


def _escaped(text: str) -> str:
    """Return a text that Markdown shows as it is.

    Entities instead of ``\\<``: not all that read Markdown know the latter.
    """
    text = re.sub(r"[\\`*_{}\[\]|~$#]", r"\\\g<0>", text)
    text = escape(text, quote=False)
    # addresses become links without any mark
    return re.sub(r":(?=//)|(?<=www)\.", lambda mark: f"&#{ord(mark[0])};", text)
