"""One table of several runs of ``nextview-lab benchmark things``, with one correction of all tests.

    python -m benchmarks.joined_things heavy half clear pairs

Each argument is the folder of a run. Its name is that of the set in the table. Every test of every
run, of all things and of the confusable half, counts in Holm's correction. A p-value in the table
is the corrected one; ceilings are not tested. "Fewer" is by how much fewer views than the reference
(random by default) a policy takes until it is confident: of all views, and of those after the
first, where all begin alike. Each run has its own reference, as the best blind rule of each set may
be another.

Below the table stands, for each policy that is in all runs, the p-value of the hypothesis that it
names as many things as the references after two views, over all runs (Stouffer's method, each run
with the square root of its families as its weight). No correction is applied to it, so the policy
and the number of views must have been chosen before.
"""

import json
from pathlib import Path

from nextview.cli.exit_status import orderly_end
from nextview_lab.extras import require

require("benchmark")

import numpy as np
import pandas as pd
import tyro
from scipy.stats import combine_pvalues

from nextview.errors import UsageError
from nextview_lab.benchmark.board_page import markdown
from nextview_lab.benchmark.comparison import ALL, corrected
from nextview_lab.benchmark.results import RECORD
from nextview_lab.benchmark.thing_tables import FAR_POSE, POSE_AFTER

COLUMNS = (
    "set",
    "policy",
    "right after 1",
    "2",
    "3",
    "5",
    "points after 2",
    "until confident",
    "fewer",
)
COLUMNS += ("wrong, of the confident", "pose, mm: median, 95 %", "its change")
SURE = "views until confident"
JOINED_VIEWS = 2  # after which all runs are tested together


def read_runs(runs: list[Path]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Measures and tests of all runs, each with a column "run"; "p_holm" is of all of them.

    Args:
        runs: folders of results.

    Raises:
        UsageError: a folder holds no tables.
    """
    for run in runs:
        if not (run / "tests.csv").is_file():
            raise UsageError(
                f"{run}: holds no results of nextview-lab benchmark things"
            )
    measures, tests = (
        [pd.read_csv(run / f"{name}.csv").assign(run=run.name) for run in runs]
        for name in ("measures", "tests")
    )
    return pd.concat(measures), corrected(tests)


def reference_of(run: Path) -> str:
    """The policy that those of a run are compared with."""
    record = json.loads((run / RECORD).read_text())
    return str(record.get("compared_with") or record.get("reference", "random"))


def tested(row: pd.Series, times: float, unit: str) -> str:
    """A difference to the reference with its interval and corrected p, in words."""
    low, high = (times * row[end] for end in ("low", "high"))
    return (
        f"{times * row['difference']:+.1f}{unit} ({low:+.1f} to {high:+.1f}){p_of(row)}"
    )


def p_of(row: pd.Series) -> str:
    """The corrected p of a test, in words; nothing for a ceiling."""
    return "" if np.isnan(row["p_holm"]) else f", p {max(row['p_holm'], 0.0001):.2g}"


def row_of(values: pd.DataFrame, tests: pd.DataFrame, reference: float) -> list[str]:
    """The cells of one policy, after set and policy.

    Args:
        values: its measures.
        tests: its differences to the reference.
        reference: views until the reference is confident.
    """
    found = values.set_index(["measure", "views"])["value"]
    right = [found.get(("accuracy", k), np.nan) for k in (1, 2, 3, 5)]
    cells = ["" if np.isnan(share) else f"{share:.3f}" for share in right]

    apart = tests.set_index(["measure", "views"])
    until = found[SURE, 0]
    of_all = 100 * (1 - until / reference)
    after_first = 100 * (reference - until) / (reference - 1) if reference > 1 else 0.0
    has_tests = ("accuracy", 2) in apart.index
    cells.append(tested(apart.loc["accuracy", 2], 100, "") if has_tests else "")
    cells.append(f"{until:.2f}")
    fewer = f"{of_all:.0f} %, {after_first:.0f} %"
    cells.append(fewer + p_of(apart.loc[SURE, 0]) if has_tests else "")
    cells.append(f"{found['wrong, of the confident', 0]:.3f}")
    pose = [found[f"pose error, {name}", POSE_AFTER] for name in ("median", "95 %")]
    cells.append(", ".join(f"{error:.1f}" for error in pose))
    cells.append(tested(apart.loc[FAR_POSE, POSE_AFTER], 1, " mm") if has_tests else "")
    return cells


def over_all(tests: pd.DataFrame) -> str:
    """The tests of all runs together, a line for each policy.

    Args:
        tests: of all things, with the column "run".
    """
    kept = tests[
        (tests["measure"] == "accuracy")
        & (tests["views"] == JOINED_VIEWS)
        & tests["p"].notna()
    ]
    runs = kept["run"].nunique()
    lines = []
    for policy, own in kept.groupby("policy", sort=False):
        if len(own) < runs:
            continue
        half = own["p"].clip(lower=np.finfo(float).tiny) / 2
        more = np.where(own["difference"] > 0, half, 1 - half)
        weights = np.sqrt(own["families"])
        joined = combine_pvalues(more, method="stouffer", weights=weights).pvalue
        both_sides = 2 * min(joined, 1 - joined)
        lines.append(
            f"{policy}: {100 * own['difference'].mean():+.1f} points after {JOINED_VIEWS}"
            f" views, mean of {runs} runs, p = {both_sides:.2g}"
        )
    return "\n".join(lines)


def main(runs: tyro.conf.Positional[list[Path]], things: str = ALL) -> None:
    """Print the table.

    Args:
        runs: folders of results.
        things: "all", or "confusable half".
    """
    measures, tests = read_runs(runs)
    rows = []
    for run in runs:
        own, apart = (
            table[(table["run"] == run.name) & (table["set"] == things)]
            for table in (measures, tests)
        )
        reference = own[
            (own["policy"] == reference_of(run)) & (own["measure"] == SURE)
        ]["value"].item()
        for policy in own["policy"].unique():
            is_reference = policy == reference_of(run)
            cells = row_of(
                own[own["policy"] == policy],
                apart[apart["policy"] == policy],
                reference,
            )
            label = f"{policy}, the reference" if is_reference else policy
            rows.append([run.name, label, *cells])
    print(markdown(COLUMNS, rows))
    print(over_all(tests[tests["set"] == things]))


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
