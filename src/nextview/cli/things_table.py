"""The results of a benchmark of things as a table in the terminal."""

from math import isnan

from rich import box
from rich.table import Table

from nextview.benchmark.leaderboard import SIGNIFICANT
from nextview.benchmark.thing_results import (
    groups_of,
    policies_of_tables,
    too_few_things,
    values_of,
    views_of,
)
from nextview.benchmark.thing_tables import ThingTables
from nextview.cli.progress import Terminal


def print_things(found: ThingTables) -> None:
    """Print a table for all things, and one for the confusable half."""
    console = Terminal()
    for things in groups_of(found):
        console.print(_table(found, things))
    console.print(
        f"* differs from {found.reference}: p after Holm's correction is below {SIGNIFICANT};"
        " choice is the median of its CPU"
    )
    for sentence in (*filter(None, [found.chosen]), *too_few_things(found)):
        console.print(sentence)


def _table(found: ThingTables, things: str) -> Table:
    """One group of things, in 80 columns."""
    values = values_of(found, things)
    views = views_of(found)
    tests = found.tests[
        (found.tests["things"] == things) & (found.tests["p_holm"] < SIGNIFICANT)
    ]
    differs = set(zip(tests["policy"], tests["measure"], tests["views"], strict=True))

    table = Table(title=f"{things}: share named right after views", box=box.SIMPLE_HEAD)
    table.add_column("policy", no_wrap=True)
    for head in (*map(str, views), "until confident", "wrong", "travel", "choice, ms"):
        table.add_column(head, justify="right")
    for policy in policies_of_tables(found):

        def shown(measure: str, k: int, digits: int, policy: str = policy) -> str:
            value = values[policy, measure, k][0]
            star = "*" if (policy, measure, k) in differs else ""
            return "-" if isnan(value) else f"{value:.{digits}f}{star}"

        table.add_row(
            policy,
            *(shown("accuracy", k, 3) for k in views),
            shown("views until confident", 0, 2),
            shown("wrong, of the confident", 0, 3),
            shown("travel, rad", views[-1], 2),
            shown("decision, ms, median", 0, 0),
        )
    return table
