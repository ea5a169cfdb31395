"""Choose and judge policies in worlds: objects among others, half hidden.

    python benchmarks/worlds.py choose learning.npz [--policies random-all visibility@0 visible-gain@0]
    python benchmarks/worlds.py judge worlds.npz --ours visible-gain [--policies ...] [--out worlds_travel.png]

``choose``: what policies reach on worlds for learning, classes weighted evenly: the mean log-belief in the truth and
the accuracy after 2 to 5 views, by which ``nextview train gain`` judges as well. ``judge``: by level the accuracy and
the travel after 2, 3 and 5 views, the points over random, and those of ours over each of its rivals, with 95 %
bootstrap intervals over worlds and one Holm correction for all of it but the ceilings; how much of what one step of
foresight gains is had; and, as a figure, accuracy against travel in cells, and in seconds of a robot that takes
``SECONDS`` for each view and ``TURN`` for a turn of the camera around the object by one radian.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from nextview.benchmark.entries import is_oracle
from nextview.benchmark.experiment import Grid, run_grid
from nextview.benchmark.levels import by_level, levels_of
from nextview.benchmark.replay import Trajectories, make_specs
from nextview.benchmark.statistics import holm
from nextview.calibration.rollout import ReplayTable
from nextview.calibration.rollout import judge as follow
from nextview.cli.ending import orderly_end
from nextview.cli.progress import track
from nextview.data.predictions import Predictions
from nextview.policies.registry import make_policy
from nextview.report.style import STYLE

POLICIES = ("random", "gain", "visibility", "visible-gain")
CEILINGS = ("true-visible_share-all", "oracle-gain-all")
REFERENCE = "random-all"
COUNTS = (2, 3, 5)
SECONDS, TURN = 1.0, 2.0
"""Of a robot: for each view, and for a turn by a radian."""
COLOURS = ("#4a5560", "#d99000", "#0b5fa5", "#00805a", "#b5179e", "#d1495b", "#7a6fd0", "#38a0d9")


def choose(
    predictions: tyro.conf.Positional[Path],
    policies: tuple[str, ...] = (REFERENCE, "gain@0", "visibility@0", "visible-gain@0"),
    n_views: int = 5,
    seed: int = 0,
) -> None:
    """Print what policies reach on worlds for learning."""
    p = Predictions.load(predictions).deduplicate()
    table = ReplayTable.of(p, np.arange(len(p)), np.random.default_rng(seed))
    print(f"{len(p)} worlds; after 2 to {n_views} views: log-belief in the truth (mean), accuracy, travel (cells)")
    for name in policies:
        policy = make_policy(name, p.sphere, (), p.classes)
        reached = [
            follow(table, policy, n_views, kind, np.random.default_rng(seed)) for kind in ("log-belief", "right")
        ]
        logs, right = (", ".join(f"{x:.4f}" for x in value.mean) for value in reached)
        print(f"{name:24}{logs} ({reached[0].mean.mean():.4f})   {right}   {reached[1].travel[-1]:.2f}")


def judge(
    predictions: tyro.conf.Positional[Path],
    ours: str,
    policies: tuple[str, ...] = POLICIES,
    rivals: tuple[str, ...] = ("visibility", "gain"),
    thrifty: tuple[float, ...] = (),
    out: Path | None = None,
    runs: int = 10,
    samples: int = 10000,
    seed: int = 0,
) -> None:
    """Print the tables, and draw the figure.

    Args:
        predictions: of worlds of the test split.
        ours: the policy that is compared with the rivals.
        policies: that are compared with random.
        rivals: some of them.
        thrifty: travel weights of ours and of visibility, for the figure alone.
        out: the figure.
        runs: first views of each world.
        samples: of the bootstrap.
        seed: of all that is random.
    """
    p = Predictions.load(predictions)
    grid = Grid(make_specs(p, runs, seed), runs, (1.0,), max(COUNTS), seed)
    names = list(dict.fromkeys([REFERENCE, *policies, ours, *CEILINGS]))
    extra = [f"{name}@{weight:g}" for weight in thrifty for name in ("visibility", ours)]
    track(run_grid(grid, [*names, *extra]), len(names) + len(extra), "going")
    for name, why in grid.failures.items():
        print(f"{name}: {why}")
    judged = replace(grid, paths={name: grid.paths[name] for name in names})
    rng = np.random.default_rng([seed, 1])
    table = by_level(judged, REFERENCE, samples, rng)
    against = []
    for rival in rivals:
        two = replace(grid, paths={name: grid.paths[name] for name in (ours, rival)})
        against.append(by_level(two, rival, samples, rng).query("policy == @ours").assign(rival=rival))
    table = pd.concat([table.assign(rival=REFERENCE), *against], ignore_index=True)
    known = table["policy"].map(is_oracle).to_numpy()
    table["p_holm"] = holm(np.where(known, np.nan, table["p"].to_numpy(np.float64)))
    show(table, ours)
    if out is not None:
        draw(grid, [name for name in grid.paths if name in (*names, *extra)], out)


def show(table: pd.DataFrame, ours: str) -> None:
    """Print the tables."""
    print(f"{np.count_nonzero(~np.isnan(table['p_holm']))} comparisons, one correction")
    for (rival, level), rows in table.groupby(["rival", "level"], sort=False):
        print(f"\n{level} clutter, {rows['worlds'].iloc[0]} worlds, against {rival}\n")
        print("| policy | " + " | ".join(f"after {k}: accuracy, cells | points, p" for k in COUNTS) + " |")
        print("|---" * (1 + 2 * len(COUNTS)) + "|")
        for name in rows["policy"].unique():
            cells = []
            for k in COUNTS:
                row = rows[(rows["policy"] == name) & (rows["n_views"] == k)].iloc[0]
                cells.append(f"{row['accuracy']:.3f}, {row['travel']:.2f}")
                points = [100 * row[f"difference{end}"] for end in ("", "_low", "_high")]
                tested = "" if np.isnan(row["p_holm"]) else f", {row['p_holm']:.2g}"
                cells.append(
                    "" if np.isnan(points[0]) else f"{points[0]:+.1f} ({points[1]:+.1f} to {points[2]:+.1f}){tested}"
                )
            print(f"| {name} | " + " | ".join(cells) + " |")
    print(f"\nShare of what one step of foresight gains over {REFERENCE} that {ours} has:")
    wide = table[table["rival"] == REFERENCE].pivot_table("accuracy", ["level", "n_views"], "policy", sort=False)
    for (level, k), row in wide.iterrows():
        if k in COUNTS:
            had, all_of_it = row[ours] - row[REFERENCE], row["oracle-gain-all"] - row[REFERENCE]
            print(f"{level}, {k} views: {had / all_of_it:.2f} of {100 * all_of_it:.1f} points")


def travelled(path: Trajectories, k: int) -> tuple[np.ndarray, np.ndarray]:
    """What each episode travelled until view k, or its last one: cells, and seconds."""
    last = np.minimum((path.views >= 0).sum(1), k) - 1
    rows = np.arange(len(last))
    return path.travel[rows, last], SECONDS * last + TURN * path.arc[rows, last]


def draw(grid: Grid, names: list[str], out: Path) -> None:
    """Accuracy after 1 to 5 views against the travel until then, by level."""
    of = levels_of(grid.specs.predictions.names)[grid.specs.objects]
    levels = [level for level in ("light", "medium", "heavy") if level in of]
    with matplotlib.rc_context(STYLE):
        figure = Figure((3.2 * len(levels), 6.2), layout="constrained")
        axes = figure.subplots(2, len(levels), sharey="col", squeeze=False)
        for column, level in zip(axes.T, levels, strict=True):
            for name, colour in zip(names, COLOURS * 2, strict=False):
                line(column, grid.paths[name], of == level, grid.specs.labels, name, colour)
            column[0].set_title(f"{level} clutter", fontsize=10)
            column[0].set_xlabel("travel (cells)")
            column[1].set_xlabel("travel (s)")
            column[0].yaxis.set_major_formatter(PercentFormatter(1, 0))
        for row in axes:
            row[0].set_ylabel("accuracy after 1 to 5 views")
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        figure.savefig(out, dpi=110, facecolor="white")


def line(axes: np.ndarray, path: Trajectories, mine: np.ndarray, labels: np.ndarray, name: str, colour: str) -> None:
    """One policy, in cells above and in seconds below."""
    taken, points = (path.views >= 0).sum(1), []
    for k in range(1, max(COUNTS) + 1):
        answers = path.answers[np.arange(len(taken)), np.minimum(taken, k) - 1]
        cells, seconds = (values[mine].mean() for values in travelled(path, k))
        points.append((cells, seconds, (answers == labels)[mine].mean()))
    cells, seconds, right = np.array(points).T
    axis: Axes
    for axis, travel in zip(axes, (cells, seconds), strict=True):
        axis.plot(travel, right, ":" if is_oracle(name) else "--" if "@" in name else "-", color=colour, marker="o",
                  markersize=3, label=name)  # fmt: skip


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.extras.subcommand_cli_from_dict({"choose": choose, "judge": judge})
