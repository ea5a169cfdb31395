"""Write what several pages repeat: the table of what is measured, and how to cite.

    python workflow/repeated.py

The table of ``workflow/measured.toml`` and an entry for BibTeX, made from CITATION.cff, go into
README.md, each between two comments that name it. The README is the home page of the site as well.
``tests/test_pages.py`` fails if it differs.
"""

from __future__ import annotations

import os
import re
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import tyro
import yaml

ROOT = Path(__file__).resolve().parents[1]
"""Of the repository."""

sys.path.insert(0, str(ROOT))
from nextview_lab.benchmark.statistics import wilson

PARTS = {"README.md": ("measured", "citation")}
"""What a page repeats."""

MANY = 300
"""Of as many a share has no interval."""

NOT_MEASURED = "not measured"
COLUMNS = (
    "task",
    "real or simulated",
    "n",
    "right (a stranger: called unknown)",
    "confident and wrong",
)


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        task: what was to be told, by how many views, under which conditions.
        page: that has the figure, from the root of the repository, with its anchor.
        real: whether the frames are of a real camera.
        n: how many were to be told; 0: not measured.
        right: how many of them are right; None: not measured.
        sure_and_wrong: how many have a confident, wrong name; words where a number is not known;
            None: not measured.
        command: that a user can run for it, as on the page; "": not measured.
    """

    task: str
    page: str
    real: bool
    n: int = 0
    right: int | None = None
    sure_and_wrong: int | str | None = None
    command: str = ""


def measured_rows() -> list[Row]:
    """The rows of the table, in their order."""
    text = (ROOT / "workflow/measured.toml").read_text(encoding="utf-8")
    return [Row(**row) for row in tomllib.loads(text)["rows"]]


def measured(page: str) -> str:
    """The table in Markdown.

    Args:
        page: on which it stands, from the root of the repository.
    """
    lines = [COLUMNS, ["---"] * len(COLUMNS)]
    for row in measured_rows():
        link = os.path.relpath(row.page, Path(page).parent)
        lines.append(
            (
                re.sub(r"\[(.+?)\]", rf"[\1]({link})", row.task, count=1),
                "**real**" if row.real else "simulated",
                str(row.n or ""),
                share(row.right, row.n),
                share(row.sure_and_wrong, row.n),
            )
        )
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def share(count: int | str | None, total: int) -> str:
    """A count, the share that it is and its 95 % Wilson interval, in words."""
    if count is None:
        return NOT_MEASURED
    if isinstance(count, str):
        return count
    said = f"{count}: {count / total:.3f}"
    if total >= MANY:
        return said
    low, high = wilson(count, total)
    return f"{said} ({low:.2f} to {high:.2f})"


def citation(_: str) -> str:
    """The entry for BibTeX, as a block of code, the same on all pages."""
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    # further braces keep the capitals of a title, and a name whole
    names = " and ".join(f"{{{author['name']}}}" for author in cited["authors"])
    return f"""\
```bibtex
@software{{nextview,
  title = {{{{{cited["title"]}}}}}, author = {{{names}}},
  year = {{{cited["date-released"].year}}}, version = {{{cited["version"]}}}
}}
```"""


MAKERS = {"measured": measured, "citation": citation}


def with_parts(page: str) -> str:
    """The text of a page, with what it repeats as it is now.

    Args:
        page: from the root of the repository.
    """
    text = (ROOT / page).read_text(encoding="utf-8")
    for part in PARTS[page]:
        begin, end = f"<!-- {part}: workflow/repeated.py -->\n", f"<!-- {part} ends -->"
        before, _, rest = text.partition(begin)
        _, _, after = rest.partition(end)
        text = f"{before}{begin}{MAKERS[part](page)}\n{end}{after}"
    return text


def main() -> None:
    """Write what pages repeat, the table of what is measured and the citation, into the pages."""
    for page in PARTS:
        (ROOT / page).write_text(with_parts(page), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
