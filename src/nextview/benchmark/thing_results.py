"""The results of a benchmark of things as files: CSV, Markdown, LaTeX and figures."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from nextview.benchmark.figures import OWN
from nextview.benchmark.leaderboard import SIGNIFICANT, too_few_families
from nextview.benchmark.thing_policies import CEILINGS
from nextview.benchmark.thing_tables import ALL, CONFUSABLE, ThingTables
from nextview.files import new_folder
from nextview.session.style import (
    ACCENT,
    BLUE,
    GREY,
    INK,
    LIGHT_BLUE,
    legend,
    new_figure,
    percent_axis,
    to_png,
)

THING_POLICY_COLOURS = {
    "random": GREY,
    "spread": "#d99000",
    "furthest": LIGHT_BLUE,
    "fixed": "#7a6fd0",
    "ring": "#b3a000",
    "picture": "#5bb98c",
    "geometry": ACCENT,
    "pose": BLUE,
    "ceiling": "#111111",
}
RECORD = "benchmark.json"
LOWEST_RIGHT = 0.9  # share named right that the axis reaches down to, at least


def write_results(out: Path, tables: ThingTables, made: Mapping[str, Any]) -> None:
    """Write tables and figures into a folder, in the place of earlier ones.

    Args:
        out: the folder.
        tables: what was found.
        made: how, as JSON can hold it.
    """
    with new_folder(out, overwrite=True, last=RECORD) as part:
        tables.measures.to_csv(part / "measures.csv", index=False)
        tables.tests.to_csv(part / "tests.csv", index=False)
        tables.alike.to_csv(part / "things.csv", index=False)
        (part / "tables.md").write_text(markdown(tables), encoding="utf-8")
        (part / "table.tex").write_text(latex(tables), encoding="utf-8")
        to_png(accuracy_figure(tables), part / "accuracy.png")
        to_png(difference_figure(tables), part / "differences.png")
        (part / RECORD).write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")


def groups_of(tables: ThingTables) -> list[str]:
    """All things, and the confusable half where there is one."""
    return list(tables.measures["things"].unique())


def policies_of_tables(tables: ThingTables) -> list[str]:
    """The policies, in their order."""
    return list(tables.measures["policy"].unique())


def views_of(tables: ThingTables) -> list[int]:
    """After how many views policies are compared."""
    return [int(k) for k in tables.measures["views"].unique() if k]


def values_of(
    tables: ThingTables,
    things: str,
) -> dict[tuple[str, str, int], tuple[float, ...]]:
    """Value and interval by policy, measure and views.

    Args:
        tables: all measures.
        things: which half of the things, or all.
    """
    some = tables.measures[tables.measures["things"] == things]
    keys = zip(some["policy"], some["measure"], some["views"], strict=True)
    numbers = some[["value", "low", "high"]].to_numpy(np.float64)
    return {key: tuple(row.tolist()) for key, row in zip(keys, numbers, strict=True)}


def markdown(tables: ThingTables) -> str:
    """The tables as Markdown: a table for each group of things, then all tests."""
    parts = []
    for things in groups_of(tables):
        count = (
            len(tables.alike)
            if things == ALL
            else int(tables.alike["confusable"].sum())
        )
        title = f"{things.capitalize()} things" if things == ALL else f"The {things}"
        parts += [
            f"### {title}",
            "",
            f"{count} things",
            "",
            *_table(tables, things),
            "",
        ]

    parts += [f"{tables.chosen}\n"] if tables.chosen else []
    parts += [f"### Differences to {tables.reference}", "", *_tests(tables), ""]
    parts += [f"{sentence}\n" for sentence in too_few_things(tables)]
    return "\n".join(parts)


def too_few_things(tables: ThingTables) -> list[str]:
    """A warning for each group of things in which no difference could be significant."""
    tested = tables.tests[tables.tests["p"].notna()]
    warnings = []
    for things in tested["things"].unique():
        families = int(tested[tested["things"] == things]["families"].iloc[0])
        sentence = too_few_families(families, len(tested))
        if sentence is not None:
            warnings.append(f"{things}: {sentence}")
    return warnings


def _table(tables: ThingTables, things: str) -> list[str]:
    values = values_of(tables, things)
    views = views_of(tables)
    head = [
        "policy",
        *(f"right after {k}" for k in views),
        "views until confident",
        "confident",
    ]
    head += [
        "wrong, of the confident",
        f"travel to view {views[-1]}, rad",
        "travel until confident, rad",
    ]
    later = [k for k in views if k > 1]
    head += [f"pose error after {k}, mm: median, 95 %" for k in later]
    head += ["choice, ms of CPU: median, 95 %"]
    lines = [_row(head), "|---" * len(head) + "|"]
    for policy in policies_of_tables(tables):

        def shown(
            measure: str,
            k: int = 0,
            digits: int = 3,
            policy: str = policy,
        ) -> str:
            value = values[policy, measure, k][0]
            return "-" if np.isnan(value) else f"{value:.{digits}f}"

        cells = [
            policy,
            *(shown("accuracy", k) for k in views),
            shown("views until confident", 0, 2),
        ]
        cells += [
            shown("confident"),
            shown("wrong, of the confident"),
            shown("travel, rad", views[-1], 2),
        ]
        cells += [shown("travel until confident, rad", 0, 2)]
        cells += [
            f"{shown('pose error, median', k, 1)}, {shown('pose error, 95 %', k, 1)}"
            for k in later
        ]
        spent = (shown("decision, ms, median", 0, 0), shown("decision, ms, 95 %", 0, 0))
        lines.append(_row([*cells, ", ".join(spent)]))
    return lines


def _tests(tables: ThingTables) -> list[str]:
    head = [
        "things",
        "policy",
        "measure",
        f"difference to {tables.reference}",
        "95 % interval",
        "p (Holm)",
    ]
    lines = [_row(head), "|---" * len(head) + "|"]

    row: Any  # a named tuple
    for row in tables.tests.itertuples():
        measure = f"{row.measure} after {row.views}" if row.views else row.measure
        p = "-" if np.isnan(row.p_holm) else f"{row.p_holm:.4f}"
        between = f"{row.low:+.3f} to {row.high:+.3f}"
        cells = [row.things, row.policy, measure, f"{row.difference:+.3f}", between, p]
        lines.append(_row(cells))
    return lines


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def latex(tables: ThingTables) -> str:
    """A LaTeX table that fits a column of 8.5 cm; it needs the package booktabs."""
    views = views_of(tables)
    lines = [
        "% \\usepackage{booktabs}",
        "\\begin{table}[t]",
        "\\centering\\footnotesize\\setlength{\\tabcolsep}{3.5pt}",
        "\\caption{Things named right after "
        + ", ".join(map(str, views))
        + " views, \\%, and"
        " views until the belief reaches the threshold.}",
        "\\begin{tabular}{@{}l" + "r" * len(views) + "rr@{}}",
        "\\toprule",
        " & ".join(["", *map(str, views), "until confident", "wrong"]) + " \\\\",
    ]

    for things in groups_of(tables):
        lines += [
            "\\midrule",
            f"\\multicolumn{{{len(views) + 3}}}{{@{{}}l}}{{\\emph{{{things}}}}} \\\\",
        ]
        values = values_of(tables, things)
        for policy in policies_of_tables(tables):
            cells = [_plain_tex(policy)]
            cells += [f"{100 * values[policy, 'accuracy', k][0]:.1f}" for k in views]
            cells.append(f"{values[policy, 'views until confident', 0][0]:.2f}")
            wrong = values[policy, "wrong, of the confident", 0][0]
            cells.append("--" if np.isnan(wrong) else f"{100 * wrong:.1f}")
            lines.append(" & ".join(cells) + " \\\\")
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", "\\end{table}", ""])


def _plain_tex(text: str) -> str:
    """Text in which no character means anything to LaTeX."""
    return "".join(f"\\{c}" if c in "&%$#_{}" else c for c in text.rpartition(":")[2])


def look_of_policy(policy: str, tables: ThingTables) -> dict[str, Any]:
    """Colour and line of a policy, the same in all figures.

    Args:
        policy: its name.
        tables: that name all policies.
    """
    own = [
        name for name in policies_of_tables(tables) if name not in THING_POLICY_COLOURS
    ]
    colour = THING_POLICY_COLOURS.get(policy) or OWN[own.index(policy) % len(OWN)]
    return {"color": colour, "linestyle": ":" if policy in CEILINGS else "-"}


def accuracy_figure(tables: ThingTables) -> Figure:
    """Share named right against the number of views, with 95 % intervals."""
    figure, axes = new_figure(4.6, 3.5)
    values = values_of(tables, ALL)
    views = views_of(tables)
    policies = policies_of_tables(tables)
    for row, policy in enumerate(policies):
        numbers = np.array([values[policy, "accuracy", k] for k in views])
        look = look_of_policy(policy, tables)
        # Side by side, so that the bars can be told apart.
        x = np.array(views) + (row - len(policies) / 2) * 0.05
        axes.plot(x, numbers[:, 0], marker="o", markersize=3.5, label=policy, **look)
        axes.vlines(
            x[1:],
            numbers[1:, 1],
            numbers[1:, 2],
            color=look["color"],
            linewidth=0.8,
            alpha=0.55,
        )
    axes.set_xticks(views)
    axes.set(xlabel="views", ylabel="named right")
    axes.set_ylim(min(axes.get_ylim()[0], LOWEST_RIGHT), 1 + (1 - LOWEST_RIGHT) / 10)
    percent_axis(axes.yaxis)
    legend(axes)
    return figure


def difference_figure(tables: ThingTables) -> Figure:
    """Differences to the reference after two views; filled where the corrected p is below 0.05."""
    views = [k for k in views_of(tables) if k > 1]
    at = views[0] if views else 0
    tests = tables.tests
    rows = tests[(tests["measure"] == "accuracy") & (tests["views"] == at)]
    policies = [
        name for name in policies_of_tables(tables) if name != tables.reference
    ][::-1]
    figure, axes = new_figure(4.6, 0.8 + 0.3 * max(3, len(policies)))

    for things, shift, marker in ((ALL, 0.14, "o"), (CONFUSABLE, -0.14, "s")):
        some = rows[rows["things"] == things].set_index("policy")
        for y, policy in enumerate(policies):
            if policy not in some.index:
                continue
            row = some.loc[policy]
            colour = look_of_policy(policy, tables)["color"]
            ends = 100 * row["low"], 100 * row["high"]
            axes.hlines(y + shift, *ends, color=colour, linewidth=1.6)
            inside = colour if row["p_holm"] < SIGNIFICANT else "white"
            axes.plot(
                100 * row["difference"],
                y + shift,
                marker,
                color=colour,
                markersize=5,
                clip_on=False,
                markerfacecolor=inside,
            )
    for things, marker in ((ALL, "o"), (CONFUSABLE, "s")):
        axes.plot([], [], marker, color=INK, markerfacecolor="white", label=things)
    axes.axvline(0, color=INK, linewidth=0.9)
    axes.set_yticks(np.arange(len(policies)), policies)
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel(
        f"named right after {at} views, percentage points: difference to {tables.reference}"
    )
    legend(axes)

    return figure
