"""The files of a benchmark whose tables say how they are shown: Markdown, LaTeX and figures."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nextview.benchmark.figures import differences, views_curve
from nextview.benchmark.results import (
    ComparedTables,
    compared_markdown,
    latex,
    write_results,
)
from nextview.session.style import to_png


def write_compared(
    out: Path,
    tables: ComparedTables,
    made: Mapping[str, Any],
    measure: str,
    what: str,
) -> None:
    """Write tables and figures into a folder, in the place of earlier ones.

    Args:
        out: the folder.
        tables: what was found.
        made: how, as JSON can hold it.
        measure: the share that is drawn, after numbers of views.
        what: the same in words.
    """

    def more(part: Path) -> None:
        (part / "tables.md").write_text(compared_markdown(tables), encoding="utf-8")
        (part / "table.tex").write_text(latex(tables), encoding="utf-8")
        to_png(views_curve(tables, measure, what), part / "accuracy.png")
        tests = tables.tests[tables.tests["measure"] == measure]
        if len(tests):
            k = tests["views"].min()
            drawn = differences(tables, tests[tests["views"] == k], f"{what} after {k}")
            to_png(drawn, part / "differences.png")

    write_results(out, tables, made, more)
