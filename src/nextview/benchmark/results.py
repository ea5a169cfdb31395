"""A folder of results: tables as CSV, Markdown and LaTeX, figures, and how it was made."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nextview.benchmark.comparison import Tables, too_few, values_of
from nextview.benchmark.figures import differences, views_curve
from nextview.checks import extras
from nextview.files import new_folder
from nextview.session.style import to_png

with extras():
    import pandas as pd

RECORD = "benchmark.json"


@dataclass(frozen=True)
class Column:
    """A column of a table that compares policies.

    Attributes:
        heading: above it.
        measures: shown in a cell, with commas between.
        views: after how many; 0 for whole episodes.
        digits: after the point.
        short: heading in the narrow tables; "" where it is not in them.
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
        title: above it.
        name: of the set of objects.
        columns: after the one that names the policies.
        about: a line below the title.
    """

    title: str
    name: str
    columns: tuple[Column, ...]
    about: str = ""

    def narrow(self) -> list[Column]:
        """The columns of the narrow tables."""
        return [column for column in self.columns if column.short]


@dataclass(frozen=True)
class ComparedTables(Tables):
    """Tables of a benchmark that says itself how they are shown.

    Attributes:
        boards: the tables that compare policies.
        chosen: how the reference was chosen, in a sentence; "" where it was named.
    """

    boards: tuple[Board, ...]
    chosen: str

    def sentences(self) -> list[str]:
        """What follows: how the reference was chosen, and where nothing can be told."""
        few = [f"{name}: {sentence}" for name, sentence in too_few(self.tests).items()]
        return [*filter(None, [self.chosen]), *few]


def write_results(
    out: Path,
    tables: Tables,
    made: Mapping[str, Any],
    more: Callable[[Path], None],
    overwrite: bool = True,
    withdraw: bool = False,
) -> None:
    """Write tables and how they were made into a folder.

    Args:
        out: the folder.
        tables: what was found.
        made: how, as JSON can hold it.
        more: writes whatever else belongs there.
        overwrite: whether earlier results are replaced.
        withdraw: see ``files.new_folder``.
    """
    with new_folder(out, overwrite, last=RECORD, withdraw=withdraw) as part:
        for name, table in tables.frames().items():
            table.to_csv(part / f"{name}.csv", index=False)
        more(part)
        (part / RECORD).write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")


def board_rows(
    tables: Tables,
    board: Board,
    columns: Sequence[Column],
    marked: Iterable[tuple[str, str, int]] = (),
) -> Iterator[list[str]]:
    """The rows of a board as text: the policy, then a cell for each column.

    Args:
        tables: of the benchmark.
        board: which policies are compared on.
        columns: those that are shown.
        marked: policy, measure and views of the numbers that get a star.

    Yields:
        The cells of a policy.
    """
    values = values_of(tables, board.name)
    stars = set(marked)

    def shown(policy: str, measure: str, column: Column) -> str:
        value = values[policy, measure, column.views][0]
        star = "*" * ((policy, measure, column.views) in stars)
        return "-" if np.isnan(value) else f"{value:.{column.digits}f}{star}"

    for policy in tables.policies():
        yield [
            policy,
            *(", ".join(shown(policy, m, c) for m in c.measures) for c in columns),
        ]


def markdown(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A table as Markdown.

    Args:
        head: headings.
        rows: cells.
    """
    head = list(head)
    lines = [head, *rows]
    text = [f"| {' | '.join(map(str, line))} |" for line in lines]
    return "\n".join([text[0], "|---" * len(head) + "|", *text[1:]]) + "\n"


def compared_markdown(tables: ComparedTables) -> str:
    """The boards as Markdown, then all tests."""
    parts = []
    for board in tables.boards:
        head = ["policy", *(column.heading for column in board.columns)]
        rows = board_rows(tables, board, board.columns)
        about = [f"{board.about}\n"] if board.about else []
        parts += [f"### {board.title}\n", *about, markdown(head, rows)]
    few = tables.sentences()
    chosen = [few.pop(0) + "\n"] if tables.chosen else []
    parts += [*chosen, f"### Differences to {tables.reference}\n", _tests(tables)]
    return "\n".join([*parts, *(f"{sentence}\n" for sentence in few)])


def _tests(tables: Tables) -> str:
    """All tests as Markdown."""
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


def latex(tables: ComparedTables) -> str:
    """The narrow columns of the boards as LaTeX tables; they need the package booktabs."""
    parts = []
    for board in tables.boards:
        columns = board.narrow()
        head = ["policy", *(column.short for column in columns)]
        rows = pd.DataFrame(board_rows(tables, board, columns), columns=head)
        rows["policy"] = [policy.rpartition(":")[2] for policy in rows["policy"]]
        parts.append(f"% {board.title}\n{rows.to_latex(index=False, escape=True)}")
    return "\n".join(parts)
