"""A leaderboard as Markdown and as a page of HTML.

Names of methods and of archives come from elsewhere. ``plain`` escapes line breaks and control
characters in all texts of a leaderboard; ``_markdown`` and ``_html`` escape each text for a file.
"""

import re
from dataclasses import dataclass
from html import escape
from importlib.resources import files

from nextview.checks import one_line

NONE = "\N{EN DASH}"
LONGEST_TEXT = 1000  # characters of a cell or a sentence


@dataclass(frozen=True)
class WrittenTable:
    """A table of the leaderboard.

    Attributes:
        title: above it.
        about: what it shows, a sentence or two.
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
    lines = [f"# {_markdown(board.archive)}", ""]
    for table in board.tables:
        lines += [f"## {_markdown(table.title)}", "", _markdown(table.about), ""]
        lines.append(_markdown_row(table.headings))
        lines.append("|---" * len(table.headings) + "|")
        lines += [*map(_markdown_row, table.rows), ""]
    lines += [f"- {_markdown(note)}" for note in board.notes]
    return "\n".join(lines) + "\n"


def as_html(board: Leaderboard, sha256: str) -> str:
    """Return a leaderboard as a page of HTML, which loads nothing.

    Args:
        board: the leaderboard, plain.
        sha256: of the archive's manifest.
    """
    style = files("nextview_lab.benchmark") / "templates" / "page.css"
    title = _html(f"Leaderboard of {board.archive}")
    anchors = [f"table-{row}" for row in range(1, len(board.tables) + 1)]
    parts = [
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f'<meta name="generator" content="nextview"><title>{title}</title>',
        f"<style>{style.read_text(encoding='utf-8')}</style></head>",
        f"<body><main>\n<h1>{title}</h1>",
        *(f"<p>{_html(note)}</p>" for note in board.notes),
        f'<p class="soft">SHA-256 of the archive\'s manifest: {_html(sha256)}</p>',
        "<nav>",
        *(
            f'<a href="#{anchor}">{_html(table.title)}</a>'
            for anchor, table in zip(anchors, board.tables, strict=True)
        ),
        "</nav>",
    ]
    for anchor, table in zip(anchors, board.tables, strict=True):
        about = _html(table.about)
        parts += [
            f'<section id="{anchor}"><h2>{_html(table.title)}</h2>',
            f'<p class="soft">{about}</p>',
            f'<div class="wide" tabindex="0"><table aria-label="{about}">\n<thead><tr>',
            *(f'<th scope="col">{_html(heading)}</th>' for heading in table.headings),
            "</tr></thead>\n<tbody>",
            *map(_html_row, table.rows),
            "</tbody>\n</table></div></section>",
        ]
    return "\n".join([*parts, "</main></body></html>"]) + "\n"


def _markdown_row(cells: tuple[str, ...]) -> str:
    return f"| {' | '.join(map(_markdown, cells))} |"


def _html_row(cells: tuple[str, ...]) -> str:
    first, *others = map(_html, cells)
    numbers = "".join(f"<td>{cell}</td>" for cell in others)
    return f'<tr><th scope="row">{first}</th>{numbers}</tr>'


def _markdown(text: str) -> str:
    """Return a text that Markdown shows as it is.

    Entities instead of ``\\<``: not all that read Markdown know the latter.
    """
    text = re.sub(r"[\\`*_{}\[\]|~$#]", r"\\\g<0>", text)
    text = escape(text, quote=False)
    # addresses become links without any mark
    return re.sub(r":(?=//)|(?<=www)\.", lambda mark: f"&#{ord(mark[0])};", text)


def _html(text: str) -> str:
    """Return a text that HTML shows as it is."""
    return escape(text)
