"""``nextview measures``: what makes a view good, by name."""

from __future__ import annotations


def measures() -> None:
    """List the view measures: what each needs, where it comes from, and which values are those of good views.

    One that needs the depth is had from a view store alone, one that needs the mesh from the folder too that the store
    was rendered from. MODULE:FUNCTION is a measure of your own (docs/add_a_measure.md).
    """
    from rich.table import Table

    from nextview.cli.terminal import Terminal
    from nextview.measures.registry import MEASURES

    table = Table("measure", "needs", "better views", "source")
    for name, measure in MEASURES.items():
        table.add_row(name, measure.needs, "high" if measure.good == "peak" else "low", measure.source)
    Terminal().print(table)
