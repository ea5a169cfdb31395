"""Tables of text, and a leaderboard of them as Markdown.

Names of methods and of archives come from elsewhere. ``plain`` escapes line breaks and control
characters in all texts of a leaderboard; ``_escaped`` escapes each text for Markdown.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from typing import Any

from nextview.checks import one_line

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
