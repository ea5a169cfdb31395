"""Write a folder of results: tables as CSV and Markdown, figures, and settings."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nextview.figures.style import to_png
from nextview.files import new_folder
from nextview_lab.benchmark.comparison import Tables, too_few, written
from nextview_lab.benchmark.figures import differences, views_curve
from nextview_lab.benchmark.text_tables import Board, markdown

RECORD = "benchmark.json"


@dataclass(frozen=True)
class ComparedTables(Tables):
    """Tables of a benchmark with their layout.

    Attributes:
        boards: the tables that compare policies.
        chosen: a sentence on how the reference was selected; "" if it was named.
    """

    boards: tuple[Board, ...]
    chosen: str

    def sentences(self) -> list[str]:
        """Return the conclusions: the selection of the reference, and whether there are too few."""
        return [*filter(None, [self.chosen, too_few(self.tests)])]


def write_results(
    out: Path,
    tables: Tables,
    made: Mapping[str, Any],
    more: Callable[[Path], None],
    overwrite: bool = True,
    withdraw: bool = False,
) -> None:
    """Write tables and settings to a folder.

    Args:
        out: the folder.
        tables: the results.
        made: settings, as JSON-compatible values.
        more: writes further files.
        overwrite: whether to replace earlier results.
        withdraw: see ``files.new_folder``.
    """
    with new_folder(out, overwrite, last=RECORD, withdraw=withdraw) as part:
        for name, table in tables.frames().items():
            table.to_csv(part / f"{name}.csv", index=False)
        more(part)
        (part / RECORD).write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")


def compared_markdown(tables: ComparedTables) -> str:
    """Format the boards, followed by all tests, as Markdown."""
    parts = []
    for board in tables.boards:
        text = written(tables, board, {one.heading: one for one in board.columns})
        about = [f"{board.about}\n"] if board.about else []
        parts += [f"### {board.title}\n", *about, markdown(text.headings, text.rows)]
    few = tables.sentences()
    chosen = [few.pop(0) + "\n"] if tables.chosen else []
    parts += [*chosen, f"### Differences to {tables.reference}\n", _tests(tables)]
    return "\n".join([*parts, *(f"{sentence}\n" for sentence in few)])


def _tests(tables: Tables) -> str:
    """Format all tests as Markdown."""
    head = ["set", "policy", "measure", f"difference to {tables.reference}"]
    rows = []
    row: Any  # a named tuple
    for row in tables.tests.itertuples():
        measure = f"{row.measure} after {row.views}" if row.views else row.measure
        p = "-" if np.isnan(row.p_holm) else f"{row.p_holm:.4f}"
        between = f"{row.low:+.3f} to {row.high:+.3f}"
        rows.append(
            [row.set, row.policy, measure, f"{row.difference:+.3f}", between, p]
        )
    return markdown([*head, "95 % interval", "p (Holm)"], rows)


def write_compared(
    out: Path,
    tables: ComparedTables,
    made: Mapping[str, Any],
    measure: str,
    what: str,
    overwrite: bool = True,
) -> None:
    """Write tables and figures to a folder.

    Args:
        out: the folder.
        tables: the results.
        made: settings, as JSON-compatible values.
        measure: the share shown in the figures, after numbers of views.
        what: description of that share.
        overwrite: whether to replace earlier results.
    """

    def more(part: Path) -> None:
        (part / "tables.md").write_text(compared_markdown(tables), encoding="utf-8")
        to_png(views_curve(tables, measure, what), part / "accuracy.png")
        tests = tables.tests[tables.tests["measure"] == measure]
        if len(tests):
            k = tests["views"].min()
            drawn = differences(tables, tests[tests["views"] == k], f"{what} after {k}")
            to_png(drawn, part / "differences.png")

    write_results(out, tables, made, more, overwrite)
