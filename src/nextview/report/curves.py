"""The figures of a benchmark, from its tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nextview.benchmark.entries import is_oracle
from nextview.benchmark.leaderboard import SIGNIFICANT, headline_threshold
from nextview.benchmark.results import Results
from nextview.measures.map_names import LCM, LEM
from nextview.policies.policy_card import bundled_policies
from nextview.policies.registry import DEFAULT, POLICIES, map_policy_names
from nextview.report.diagrams import confusion_matrix, draw_reliability, reliability_figure
from nextview.report.style import ACCENT, BLUE, GREY, INK, LIGHT_BLUE, legend, new_figure, percent_axis

COLOURS = {
    "random": GREY,
    "gain": "#b5179e",
    "random-all": "#4a5560",
    "furthest": "#d99000",
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
}
OWN = ("#7b2d00", "#3a7d00", "#7209b7", "#00a3a3", "#e0679b", "#b3a000", "#ff7043", "#5c6bc0")
"""For all others, in turn."""
LINES = ("-", "-.", (0, (1, 1)))
"""Of the others, each time that the colours begin anew."""
CROWD, BEST = 12, 8
"""With more curves than the first, only so many besides the reference are drawn, or more if more are the user's own."""


def followed(results: Results) -> list[str]:
    """The policies that a robot could follow, then the published one and the ceiling."""
    names = list(results.tables.sweep["policy"].unique())
    return [n for n in names if not is_oracle(n)] + [n for n in ("oracle-valley", *ceiling(results)) if n in names]


def ceiling(results: Results) -> list[str]:
    """One step of foresight, in the window if it was run there, else over all views; empty if it was not run."""
    ran = set(results.tables.sweep["policy"])
    return [name for name in ("oracle-gain", "oracle-gain-all") if name in ran][:1]


def own_policies(results: Results) -> list[str]:
    """The user's own: a MODULE:CLASS, or a card that is not bundled."""
    known = {*POLICIES, *map_policy_names(results.predictions.maps), *bundled_policies()}
    return [n for n in results.tables.sweep["policy"].unique() if not is_oracle(n) and n.split("@")[0] not in known]


def compared(results: Results) -> list[str]:
    """The policies of the curves and of the viewer: those ``followed``.

    Of more than ``CROWD``: the reference, the default policy, the user's own, the published one and the ceiling; and,
    up to ``BEST`` besides the reference, those others that are the most accurate at the headline threshold.
    """
    names = followed(results)
    if len(names) <= CROWD:
        return names
    reference, summary = results.settings["reference"], results.tables.summary
    at = (summary["measure"] == "accuracy") & (
        summary["threshold"] == headline_threshold(results.settings["thresholds"])
    )
    accuracy = summary[at].set_index("policy")["value"]
    drawn = {DEFAULT, *own_policies(results)} - {reference}
    rivals = (n for n in names if not is_oracle(n) and n not in drawn and n != reference)
    rest = max(0, BEST - len(drawn & set(names)))
    drawn |= {reference, *sorted(rivals, key=lambda n: -accuracy[n])[:rest]}
    return [n for n in names if n in drawn or is_oracle(n)]


def look_of(policy: str, results: Results) -> dict:
    """Colour and line of a policy, the same in all figures; no two of those ``compared`` in a crowd share both."""
    names = dict.fromkeys([*compared(results), *results.tables.sweep["policy"].unique()])
    own = [name for name in names if name not in COLOURS]
    again, at = divmod(own.index(policy), len(OWN)) if policy in own else (0, 0)
    colour = COLOURS.get(policy) or OWN[at]
    line = LINES[again % len(LINES)]
    style = {"oracle-gain": ":", "oracle-gain-all": ":"}.get(policy, "--" if is_oracle(policy) else line)
    return {"color": colour, "linestyle": style}


def threshold_curve(results: Results, measure: str = "class_accuracy") -> Figure:
    """Accuracy against threshold, with 95 % intervals (figures 15 and 18)."""
    figure, axes = new_figure(4.6, 3.5)
    table = results.tables.summary.query("measure == @measure and threshold == threshold")
    ticks = sorted(table["threshold"].unique())
    for k, name in enumerate(names := [n for n in compared(results) if n in set(table["policy"])]):
        rows = table[table["policy"] == name].sort_values("threshold")
        x = np.arange(len(rows)) + (k - len(names) / 2) * 0.04  # side by side, so that the bars can be told apart
        style = look_of(name, results)
        axes.plot(x, rows["value"], marker="o", markersize=3.5, label=name, **style)
        axes.vlines(x, rows["low"], rows["high"], color=style["color"], linewidth=0.8, alpha=0.55)
    axes.set_xticks(np.arange(len(ticks)), [f"{t:g}" for t in ticks])
    axes.set_xlabel("confidence threshold")
    axes.set_ylabel("class accuracy" if measure == "class_accuracy" else "accuracy")
    percent_axis(axes.yaxis)
    legend(axes)
    return figure


def budget_curve(results: Results, budget: str) -> Figure:
    """Accuracy against mean views or mean travel, over all thresholds; in the legend the mean height of the curve."""
    figure, axes = new_figure(4.6, 3.5)
    areas = results.tables.areas.query("budget == @budget").set_index("policy")["value"]
    for name in compared(results):
        rows = results.tables.sweep[results.tables.sweep["policy"] == name]
        axes.plot(
            rows[budget], rows["accuracy"], label=f"{name}  {areas.get(name, np.nan):.3f}", **look_of(name, results)
        )
    labels = {"n_views": "mean views", "travel_all": "mean travel, grid cells", "arc_all": "mean travel, radians"}
    axes.set_xlabel(labels[budget])
    axes.set_ylabel("accuracy")
    percent_axis(axes.yaxis)
    legend(axes, "policy  mean height")
    return figure


def differences(results: Results, threshold: float, measure: str) -> Figure:
    """Difference of every policy to the reference with its 95 % interval; filled where Holm's p is under 0.05."""
    rows = results.tables.tests.query("threshold == @threshold and measure == @measure").iloc[::-1]
    unit = 100 if measure.endswith("accuracy") else 1
    difference, low, high = (unit * rows[column].to_numpy(float) for column in ("difference", "low", "high"))
    clear = rows["p_holm"].to_numpy(float) < SIGNIFICANT
    figure, axes = new_figure(4.6, 0.6 + 0.24 * max(3, len(rows)))
    for y, policy in enumerate(rows["policy"]):
        colour = look_of(policy, results)["color"]
        axes.hlines(y, low[y], high[y], color=colour, linewidth=1.6)
        inside = colour if clear[y] else "white"
        axes.plot(difference[y], y, "o", color=colour, markersize=5, markerfacecolor=inside)
    axes.axvline(0, color=INK, linewidth=0.9)
    axes.set_yticks(np.arange(len(rows)), rows["policy"])
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)
    what = {"n_views": "views", "travel_all": "travel, grid cells"}.get(measure, "accuracy, percentage points")
    axes.set_xlabel(f"{what}: difference to {results.settings['reference']}")
    return figure


def reliability_diagram(results: Results, policies: Sequence[str], threshold: float) -> Figure:
    """Share of right answers against the confidence at which the episodes stopped, dots as large as they are many.

    Bins of fewer than 20 episodes are left out.
    """
    figure, axes = reliability_figure("when it stopped")
    error = results.tables.summary.query("measure == 'calibration_error' and threshold == @threshold")
    errors = error.set_index("policy")["value"]
    for name in policies:
        rows = results.tables.reliability.query("policy == @name and threshold == @threshold and episodes >= 20")
        draw_reliability(axes, rows, rows["episodes"], f"{name}  {errors[name]:.3f}", **look_of(name, results))
    legend(axes, "policy  calibration error")
    return figure


def confusion(episodes: pd.DataFrame, classes: Sequence[str], title: str) -> Figure:
    """Confusion matrix, rows the true classes, each summing to 1."""
    counts = np.zeros((len(classes), len(classes)))
    label, answer = (pd.Categorical(episodes[c], categories=list(classes)).codes for c in ("label", "answer"))
    np.add.at(counts, (label, answer), 1)
    return confusion_matrix(counts, classes, title)


def class_differences(results: Results, threshold: float) -> Figure:
    """Accuracy of each class against the reference in percentage points, for the policies of the curves."""
    reference = results.settings["reference"]
    table = results.tables.per_class.query("measure == 'accuracy' and threshold == @threshold")
    table = table.pivot(index="label", columns="policy", values="value")
    names = [name for name in compared(results) if name in table and name not in (reference, *ceiling(results))]
    values = np.round(100 * (table[names].to_numpy() - table[[reference]].to_numpy()).T, 1) + 0.0  # no minus zero
    figure, axes = new_figure(4.9, 0.9 + 0.3 * len(names))
    reach = max(1.0, float(np.abs(values).max()))
    axes.imshow(values, cmap="RdBu", vmin=-reach, vmax=reach, aspect="auto")
    if values.shape[1] <= 15:
        for i, j in np.ndindex(*values.shape):
            colour = "white" if abs(values[i, j]) > 0.6 * reach else INK
            axes.text(j, i, f"{values[i, j]:+.1f}", ha="center", va="center", fontsize=7.5, color=colour)
    axes.set_xticks(np.arange(len(table)), [c.replace("_", " ") for c in table.index], rotation=50, ha="right",
                    rotation_mode="anchor", fontsize=8.5 if len(table) <= 15 else 5)  # fmt: skip
    axes.set_yticks(np.arange(len(names)), names, fontsize=8.5)
    axes.grid(visible=False)
    axes.tick_params(length=0)
    return figure
