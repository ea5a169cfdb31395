"""``nextview-lab list``: the view measures."""

from typing import Literal

from rich.table import Table

from nextview.cli.progress import Terminal
from nextview_lab.data.measures import all_measures


def show(what: Literal["measures"], /) -> None:
    """List the view measures.

    A view measure is a number that scores a view. Measures that need only the depth are computed
    from a view store; docs/add_a_measure.md describes the others, and how to add your own.

    Args:
        what: list to print.
    """
    table = Table("measure", "needs", "better views", "source")
    table.columns[0].no_wrap = True
    for key, measure in all_measures().items():
        table.add_row(
            key,
            measure.needs,
            "high" if measure.good == "peak" else "low",
            measure.source,
        )
    Terminal().print(table)
