"""The figures of a benchmark, from its tables, and of an evaluation."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from nextview.benchmark.entries import is_oracle
from nextview.benchmark.evaluation import Evaluation
from nextview.benchmark.leaderboard import SIGNIFICANT, headline_threshold
from nextview.benchmark.page import words
from nextview.benchmark.run import Results
from nextview.checks import extras
from nextview.recognition.map_names import LCM, LEM
from nextview.session.style import (
    ACCENT,
    BLUE,
    GREY,
    INK,
    LIGHT_BLUE,
    legend,
    new_figure,
    percent_axis,
)

with extras():
    import pandas as pd

POLICY_COLOURS = {
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
# all others, in turn
OWN = (
    "#7b2d00",
    "#3a7d00",
    "#7209b7",
    "#00a3a3",
    "#e0679b",
    "#b3a000",
    "#ff7043",
    "#5c6bc0",
)
MOST_CURVES = 8  # curves of policies that a robot could follow, at most


def ceiling(results: Results) -> list[str]:
    """Return the oracle of one step ahead, in the window or over all views.

    It is empty if neither was run.
    """
    ran = set(results.tables.sweep["policy"])
    return [name for name in ("oracle-gain", "oracle-gain-all") if name in ran][:1]


def compared(results: Results) -> list[str]:
    """Return the policies of the curves.

    They are the reference, the most accurate others, the published oracle and the upper bound.
    """
    names = list(results.tables.sweep["policy"].unique())
    reference = results.settings["reference"]
    summary = results.tables.summary
    headline = headline_threshold(results.settings["thresholds"])
    at = (summary["measure"] == "accuracy") & (summary["threshold"] == headline)
    accuracy = summary[at].set_index("policy")["value"]
    robots = sorted(
        (n for n in names if not is_oracle(n)),
        key=lambda n: (n != reference, -accuracy[n]),
    )[:MOST_CURVES]
    return [n for n in names if n in robots] + [
        n for n in ("oracle-valley", *ceiling(results)) if n in names
    ]


def look_of(policy: str, results: Results) -> dict:
    """Return the colour and the line style of a policy, the same in all figures.

    Args:
        policy: its name.
        results: of the benchmark.

    Returns:
        Keyword arguments of ``plot``; no two compared policies have the same.
    """
    own = [
        name
        for name in (*compared(results), *results.tables.sweep["policy"].unique())
        if name not in POLICY_COLOURS
    ]
    colour = (
        POLICY_COLOURS.get(policy)
        or OWN[list(dict.fromkeys(own)).index(policy) % len(OWN)]
    )
    line = (
        ":" if policy.startswith("oracle-gain") else "--" if is_oracle(policy) else "-"
    )
    return {"color": colour, "linestyle": line}


def threshold_curve(results: Results, measure: str = "class_accuracy") -> Figure:
    """Draw accuracy against threshold, with 95 % intervals (figures 15 and 18).

    Args:
        results: of the benchmark.
        measure: name of the accuracy.

    Returns:
        The figure.
    """
    figure, axes = new_figure(4.6, 3.5)
    table = results.tables.summary.query(
        "measure == @measure and threshold == threshold"
    )
    ticks = sorted(table["threshold"].unique())
    for k, name in enumerate(
        names := [n for n in compared(results) if n in set(table["policy"])]
    ):
        rows = table[table["policy"] == name].sort_values("threshold")
        # side by side, so that the bars can be told apart
        x = np.arange(len(rows)) + (k - len(names) / 2) * 0.04
        look = look_of(name, results)
        axes.plot(x, rows["value"], marker="o", markersize=3.5, label=name, **look)
        axes.vlines(
            x,
            rows["low"],
            rows["high"],
            color=look["color"],
            linewidth=0.8,
            alpha=0.55,
        )
    axes.set_xticks(np.arange(len(ticks)), [f"{t:g}" for t in ticks])
    axes.set(xlabel="confidence threshold", ylabel=words(measure))
    percent_axis(axes.yaxis)
    legend(axes)
    return figure


def budget_curve(results: Results, budget: str) -> Figure:
    """Draw accuracy against mean views or mean travel, over all thresholds.

    Args:
        results: of the benchmark.
        budget: "n_views" or "travel_all".

    Returns:
        The figure.
    """
    figure, axes = new_figure(4.6, 3.5)
    for name in compared(results):
        rows = results.tables.sweep[results.tables.sweep["policy"] == name]
        axes.plot(rows[budget], rows["accuracy"], label=name, **look_of(name, results))
    axes.set(
        xlabel={"n_views": "mean views", "travel_all": "mean travel, grid cells"}[
            budget
        ],
        ylabel="accuracy",
    )
    percent_axis(axes.yaxis)
    legend(axes)
    return figure


def differences(results: Results, threshold: float) -> Figure:
    """Draw the difference of every policy from the reference in accuracy.

    Lines are 95 % intervals; dots are filled where Holm's p is below 0.05.

    Args:
        results: of the benchmark.
        threshold: of the belief.

    Returns:
        The figure.
    """
    rows = results.tables.tests.query(
        "threshold == @threshold and measure == 'accuracy'"
    ).iloc[::-1]
    figure, axes = new_figure(4.6, 0.6 + 0.24 * max(3, len(rows)))
    row: Any  # a named tuple

    for y, row in enumerate(rows.itertuples()):
        colour = look_of(row.policy, results)["color"]
        axes.hlines(y, 100 * row.low, 100 * row.high, color=colour, linewidth=1.6)
        inside = colour if row.p_holm < SIGNIFICANT else "white"
        axes.plot(
            100 * row.difference,
            y,
            "o",
            color=colour,
            markersize=5,
            markerfacecolor=inside,
        )
    axes.axvline(0, color=INK, linewidth=0.9)
    axes.set_yticks(np.arange(len(rows)), rows["policy"])
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel(
        f"accuracy, percentage points: difference to {results.settings['reference']}"
    )

    return figure


def confusion_matrix(counts: NDArray, classes: Sequence[str], title: str) -> Figure:
    """Draw the percentage of each true class that was taken for each class (figure 12).

    Args:
        counts: by true class (rows) and answer (columns), (C, C).
        classes: names of the classes.
        title: of the figure.

    Returns:
        The figure.
    """
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    figure, axes = new_figure(4.6, 4.4)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1)

    few = len(classes) <= 15
    ticks = np.arange(len(classes))
    names = [words(name) for name in classes]
    for i, j in np.argwhere(share >= 0.01) if few else ():
        text: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7.5}
        axes.text(
            j,
            i,
            f"{100 * share[i, j]:.0f}",
            color="white" if share[i, j] > 0.55 else INK,
            **text,
        )

    size = 8.5 if few else 5
    axes.set_xticks(
        ticks,
        names,
        rotation=50,
        ha="right",
        rotation_mode="anchor",
        fontsize=size,
    )
    axes.set_yticks(ticks, names, fontsize=size)
    axes.grid(visible=False)
    axes.tick_params(length=0)
    axes.set(xlabel="answer", ylabel="true class")
    axes.set_title(title, fontsize=10, loc="left")

    return figure


def confusion(episodes: pd.DataFrame, classes: Sequence[str], title: str) -> Figure:
    """Draw the confusion matrix of episodes.

    Args:
        episodes: with the columns "label" and "answer".
        classes: names of the classes.
        title: of the figure.

    Returns:
        The figure.
    """
    label, answer = (
        pd.Categorical(episodes[c], categories=list(classes))
        for c in ("label", "answer")
    )
    return confusion_matrix(
        pd.crosstab(label, answer, dropna=False).to_numpy(),
        classes,
        title,
    )


def reliability_diagram(
    results: Results,
    policies: Sequence[str],
    threshold: float,
) -> Figure:
    """Draw the reliability of the confidence at which the episodes stopped.

    Bins of fewer than 20 episodes are left out.

    Args:
        results: of the benchmark.
        policies: names of the policies.
        threshold: of the belief.

    Returns:
        The figure.
    """
    error = results.tables.summary.query(
        "measure == 'calibration_error' and threshold == @threshold"
    )
    errors = error.set_index("policy")["value"]
    table = results.tables.reliability.query("threshold == @threshold").rename(
        columns={"episodes": "answers"}
    )
    curves = {
        f"{n}  {errors[n]:.3f}": (table[table["policy"] == n], look_of(n, results))
        for n in policies
    }
    return _reliability(curves, "when it stopped", "policy  calibration error")


def _reliability(
    curves: dict[str, tuple[pd.DataFrame, dict]],
    when: str,
    title: str,
) -> Figure:
    """Draw accuracy against confidence; the size of a dot is its number of answers."""
    figure, axes = new_figure(4.6, 3.9)
    axes.plot([0, 1], [0, 1], color=INK, linewidth=0.9)
    axes.set(
        xlim=(0, 1.03),
        ylim=(0, 1.03),
        xlabel=f"confidence {when}",
        ylabel="share that was right",
    )
    axes.set_aspect("equal")

    for label, (table, look) in curves.items():
        rows = table[table["answers"] >= 20]
        axes.plot(
            rows["confidence"],
            rows["accuracy"],
            linewidth=1.1,
            label=label,
            **look,
        )
        size = 8 + 220 * rows["answers"] / rows["answers"].sum()
        colour = look["color"]

        axes.scatter(
            rows["confidence"],
            rows["accuracy"],
            size,
            colour,
            alpha=0.55,
            linewidths=0,
            clip_on=False,
        )

    legend(axes, title)
    return figure


def evaluated_confusion(e: Evaluation, n_views: int, classes: Sequence[str]) -> Figure:
    """Draw the confusion matrix after a number of views.

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
    title = "one view" if n_views == 1 else f"all {n_views} views fused"
    return confusion_matrix(
        table.loc[list(classes), list(classes)].to_numpy(),
        classes,
        title,
    )


def fusion_curve(e: Evaluation) -> Figure:
    """Draw accuracy, with intervals, and confidence against the number of fused views."""
    figure, axes = new_figure(4.6, 3.5)
    table = e.fusion

    axes.fill_between(
        table["n_views"],
        table["low"],
        table["high"],
        color=BLUE,
        alpha=0.15,
        linewidth=0,
    )
    axes.plot(
        table["n_views"],
        table["accuracy"],
        color=BLUE,
        label="over objects, 95 % interval",
    )
    axes.plot(
        table["n_views"],
        table["class_accuracy"],
        color=INK,
        linestyle="--",
        linewidth=1.1,
        label="over classes",
    )
    axes.plot(
        table["n_views"],
        table["confidence"],
        color=ACCENT,
        linestyle=":",
        label="mean confidence",
    )

    published = e.accuracy.query(
        "n_views == 1 and label == '' and measure == 'accuracy'"
    )["published"].iloc[0]
    if np.isfinite(published):
        axes.plot(
            1,
            published,
            "D",
            color=ACCENT,
            markersize=5,
            clip_on=False,
            label="published, one view",
        )

    axes.set_xscale("log")
    ticks = [k for k in (1, 2, 3, 5, 10, 20, 40, 80) if k <= len(table)]
    axes.set_xticks(ticks, [str(k) for k in ticks])
    axes.minorticks_off()
    axes.set(xlabel="random views fused", ylabel="share")
    percent_axis(axes.yaxis)
    legend(axes)
    return figure


def evaluated_reliability(e: Evaluation) -> Figure:
    """Draw the reliability after one view and more, in random order.

    Bins of fewer than 20 answers are left out.
    """
    errors = e.fusion.set_index("n_views")["calibration_error"]
    curves = {}
    n: Any
    for (n, rows), colour in zip(
        e.reliability.groupby("n_views"),
        ("#7cc4ec", LIGHT_BLUE, BLUE, INK),
        strict=False,
    ):
        curves[f"{n} view{'s' * (n > 1)}  {errors[n]:.3f}"] = rows, {"color": colour}
    return _reliability(curves, "in the answer", "calibration error")
