"""Figures of a benchmark, from its tables, and of an evaluation."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from nextview.figures.style import (
    ACCENT,
    BLUE,
    GREY,
    INK,
    LIGHT_BLUE,
    legend,
    new_figure,
)
from nextview.recognition.map_names import LCM, LEM
from nextview_lab.benchmark.comparison import SIGNIFICANT, Tables, values_of
from nextview_lab.benchmark.entries import is_oracle
from nextview_lab.benchmark.evaluation import Evaluation
from nextview_lab.benchmark.page import words
from nextview_lab.extras import extras

with extras():
    import pandas as pd

POLICY_COLOURS = {
    "random": GREY,
    "gain": "#b5179e",
    "random-all": "#4a5560",
    "furthest": "#d99000",
    "spread": "#7b2d00",
    "unidirectional": LIGHT_BLUE,
    LEM: BLUE,
    f"{LEM}-peak": "#7a6fd0",
    LCM: "#00805a",
    f"{LCM}-peak": "#5bb98c",
    "oracle-valley": ACCENT,
    f"true-{LEM}": BLUE,
    f"true-{LEM}-peak": "#7a6fd0",
    "true-oracle-valley": ACCENT,
    f"true-{LCM}": "#00805a",
    "oracle-gain": "#111111",
    "oracle-gain-all": "#777777",
    "fixed": "#7a6fd0",
    "ring": "#b3a000",
    "geometry": ACCENT,
    "pose": BLUE,
    "ceiling": "#111111",
    "target": ACCENT,
}
# colours of all other policies, in order
OWN = (
    "#3a7d00",
    "#7209b7",
    "#00a3a3",
    "#e0679b",
    "#b3a000",
    "#ff7043",
    "#5c6bc0",
)
# policies that depend on the true outcome of a view: drawn dotted
FORESEES = ("ceiling", "oracle-gain", "oracle-gain-all")
LOWEST_AXIS = 0.9  # largest lower limit of an axis of shares


def look_of(policy: str, tables: Tables) -> dict[str, Any]:
    """Return the colour and the line style of a policy, the same in all figures.

    Args:
        policy: its name.
        tables: with all policies.

    Returns:
        Keyword arguments of ``plot``; different for any eight policies without a fixed colour.
    """
    own = [name for name in tables.policies() if name not in POLICY_COLOURS]
    colour = POLICY_COLOURS.get(policy) or OWN[own.index(policy) % len(OWN)]
    line = ":" if policy in FORESEES else "--" if is_oracle(policy) else "-"
    return {"color": colour, "linestyle": line}


def as_text(name: str) -> str:
    """Return a name such that matplotlib takes no part of it for a formula."""
    return name.replace("$", r"\$")


def views_curve(tables: Tables, measure: str, what: str) -> Figure:
    """Draw a share against the number of views, with 95 % intervals.

    Args:
        tables: of the benchmark.
        measure: name of the share.
        what: description of the share.
    """
    figure, axes = new_figure(4.6, 3.5)
    values = values_of(tables.measures)
    views = sorted({k for _, name, k in values if name == measure})
    policies = tables.policies()
    for row, policy in enumerate(policies):
        shares = np.array([values[policy, measure, k] for k in views])
        # offset, so that the bars do not overlap
        x = np.array(views) + (row - len(policies) / 2) * 0.05
        look = look_of(policy, tables)
        mark: dict[str, Any] = {
            "marker": "o",
            "markersize": 3.5,
            "label": as_text(policy),
        }
        axes.plot(x, shares[:, 0], **mark, **look)
        bars = {"color": look["color"], "linewidth": 0.8, "alpha": 0.55}
        axes.vlines(x, shares[:, 1], shares[:, 2], **bars)
    axes.set_xticks(views)
    axes.set(xlabel="views", ylabel=what)
    axes.set_ylim(min(axes.get_ylim()[0], LOWEST_AXIS), 1 + (1 - LOWEST_AXIS) / 10)
    percent_axis(axes.yaxis)
    legend(axes)
    return figure


def differences(tables: Tables, tests: pd.DataFrame, what: str) -> Figure:
    """Draw the differences of all policies from the reference.

    Lines are 95 % intervals; dots are filled if Holm's p is below 0.05.

    Args:
        tables: of the benchmark.
        tests: of one measure.
        what: description of the measure.
    """
    policies = list(tests["policy"].unique())[::-1]
    figure, axes = new_figure(4.6, 0.7 + 0.26 * max(3, len(policies)))
    row: Any  # a named tuple
    for row in tests.itertuples():
        y = policies.index(row.policy)
        colour = look_of(row.policy, tables)["color"]
        axes.hlines(y, 100 * row.low, 100 * row.high, color=colour, linewidth=1.6)
        inside = colour if row.p_holm < SIGNIFICANT else "white"
        dot = {"color": colour, "markersize": 5, "markerfacecolor": inside}
        axes.plot(100 * row.difference, y, "o", clip_on=False, **dot)
    axes.axvline(0, color=INK, linewidth=0.9)
    axes.set_yticks(np.arange(len(policies)), [as_text(name) for name in policies])
    axes.set_ylim(-0.5, len(policies) - 0.5)
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)
    reference = as_text(tables.reference)
    axes.set_xlabel(f"{what}, percentage points: difference to {reference}")

    return figure


def confusion_matrix(e: Evaluation, n_views: int, classes: Sequence[str]) -> Figure:
    """Draw the percentage of answers for each true class (figure 12).

    Args:
        e: the evaluation.
        n_views: number of views, one or all.
        classes: names of the classes.

    Returns:
        The figure.
    """
    table = e.confusion[e.confusion["n_views"] == n_views].pivot(
        index="label",
        columns="answer",
        values="answers",
    )
    counts = table.loc[list(classes), list(classes)].to_numpy()
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    figure, axes = new_figure(4.6, 4.4)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1)

    few = len(classes) <= 15
    ticks = np.arange(len(classes))
    names = [words(name) for name in classes]
    for i, j in np.argwhere(share >= 0.01) if few else ():
        text: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7.5}
        text["color"] = "white" if share[i, j] > 0.55 else INK
        axes.text(j, i, f"{100 * share[i, j]:.0f}", **text)

    size = 8.5 if few else 5
    turned: dict[str, Any] = {"rotation": 50, "ha": "right", "rotation_mode": "anchor"}
    axes.set_xticks(ticks, names, fontsize=size, **turned)
    axes.set_yticks(ticks, names, fontsize=size)
    axes.grid(visible=False)
    axes.tick_params(length=0)
    axes.set(xlabel="answer", ylabel="true class")
    title = "one view" if n_views == 1 else f"all {n_views} views fused"
    axes.set_title(title, fontsize=10, loc="left")
    return figure


def percent_axis(axis: Axis) -> None:
    """Format the ticks of an axis in percent, with as few digits as possible."""
    axis.set_major_formatter(
        FuncFormatter(lambda share, _: f"{round(100 * share, 6):g} %")
    )
