"""``nextview-lab benchmark classes --views`` with policies and references of its own, and its
figure.

    python -m benchmarks.views test.npz views [--policies gain@0.01 ...] [--views 2 3 5]
        [--against lem ...]

Writes views.md (the table), measures.csv and tests.csv (every number in a row of its own) and
front.png (accuracy against travel) into the folder, and prints the table. The gap is that between
random and oracle-gain, which sees what every view of the window would say.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import Literal

from nextview_lab.extras import require

require("benchmark")

import matplotlib
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter
from matplotlib.transforms import Bbox

from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import track
from nextview.errors import UsageError
from nextview.session.style import FIGURE_STYLE, GREY, to_png
from nextview_lab.benchmark.board_page import markdown
from nextview_lab.benchmark.class_tables import ONE_STEP, after_views
from nextview_lab.benchmark.comparison import ALL, SIGNIFICANT, Tables, values_of
from nextview_lab.benchmark.entries import EpisodeSpecs, entry_policy, knows_truth
from nextview_lab.benchmark.figures import OWN, POLICY_COLOURS
from nextview_lab.benchmark.leaderboard import after_views_rows
from nextview_lab.benchmark.replay import Grid, make_specs, run_grid
from nextview_lab.benchmark.statistics import resample_families, target_families
from nextview_lab.data.predictions import Predictions

POLICIES = (
    "random",
    "random-all",
    "lem",
    "lcm-peak",
    "furthest",
    "spread",
    "fixed-sequence",
    "fixed-sequence-near",
    "class-table",
    "gain@0",
    "gain",
    "gain@0.005",
    "gain@0.01",
    "gain@0.02",
    "gain@0.05",
    "oracle-gain",
)
REFERENCES = ("random", "random-all")


def families(
    names: Sequence[str],
    specs: EpisodeSpecs,
) -> dict[str, list[tuple[float, str]]]:
    """The policies that were run at two travel weights or more: travel weight and full name of
    each, ascending.

    Where a policy's own travel weight was asked for by number too, it is the policy's.
    """
    found: dict[str, dict[float, str]] = {}
    for name in sorted(names):
        travel_weight = getattr(entry_policy(name, specs), "travel_weight", None)
        if travel_weight is not None:
            found.setdefault(name.partition("@")[0], {}).setdefault(travel_weight, name)
    return {
        family: sorted(members.items())
        for family, members in found.items()
        if len(members) > 1
    }


def front(
    tables: Tables,
    travel_weights: dict[str, list[tuple[float, str]]],
) -> Figure:
    """Accuracy against travel, a panel for each number of views; what takes the truth is only named
    above it.

    A line joins the travel weights of one policy. Dots are filled where p against random,
    corrected, is under 0.05.
    """
    found = values_of(tables.measures, ALL)
    table = tables.measures
    n_views = [int(k) for k in table["views"].unique()]
    tests = tables.tests[tables.tests["reference"] == REFERENCES[0]]
    sure = tests[tests["p_holm"] < SIGNIFICANT]
    differs = set(zip(sure["policy"], sure["views"], strict=True))
    at_prices = {name for members in travel_weights.values() for _, name in members}
    drawn = [name for name in table["policy"].unique() if not knows_truth(name)]
    names = [
        name
        for name in drawn
        if name in at_prices or name.partition("@")[0] not in travel_weights
    ]
    colour = {name: POLICY_COLOURS.get(name, "#4a5560") for name in names}
    text_of = {name: Path(name).name for name in names}
    for own, (family, members) in zip(
        OWN * len(travel_weights),
        travel_weights.items(),
        strict=False,
    ):
        for travel_weight, name in members:
            colour[name] = own
            text_of[name] = (
                f"{Path(family).name if name == family else ''}@{travel_weight:g}"
            )
        if family not in text_of:
            text_of[members[0][1]] = Path(members[0][1]).name
    with matplotlib.rc_context(FIGURE_STYLE):
        figure = Figure((3.7 * len(n_views), 4.4), dpi=160, layout="constrained")
        FigureCanvasAgg(figure)  # measures text
        panels = figure.subplots(1, len(n_views), sharey=True, squeeze=False)[0]
        lines = []
        for axes, k in zip(panels, n_views, strict=True):
            place = {
                name: (found[name, "travel", k][0], found[name, "accuracy", k][0])
                for name in names
            }
            for members in travel_weights.values():
                line = [place[name] for _, name in members]
                axes.plot(
                    *zip(*line, strict=True),
                    color=colour[members[0][1]],
                    linewidth=1.2,
                    zorder=2,
                )
                lines.append((axes, line))
            for name, (x, y) in place.items():
                clear = (name, k) in differs
                axes.plot(
                    x,
                    y,
                    "o",
                    color=colour[name],
                    markersize=5,
                    zorder=3,
                    markerfacecolor=colour[name] if clear else "white",
                )
            axes.margins(0.16, 0.1)
            axes.yaxis.set_major_locator(MaxNLocator(steps=[1, 2, 5, 10]))
            axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=1))
            axes.set_xlabel("mean travel, grid cells")
            above = [
                f"{name}: {100 * found[name, 'accuracy', k][0]:.1f} % for"
                f" {found[name, 'travel', k][0]:.1f} cells"
                for name in table["policy"].unique()
                if knows_truth(name)
            ]
            axes.set_title(
                f"{k} view{'s' * (k > 1)}",
                loc="left",
                fontweight="bold",
                fontsize=10,
                y=1.0,
                pad=8 + 11 * len(above),
            )
            axes.annotate(
                "\n".join(above),
                (0, 1),
                xytext=(0, 5),
                xycoords="axes fraction",
                textcoords="offset points",
                fontsize=8,
                va="bottom",
            )
        panels[0].set_ylabel("accuracy")
        filled = (
            "filled: differs from random by sign flips, corrected for all comparisons (p <"
            " 0.05)"
        )
        figure.supxlabel(filled, fontsize=8, x=0.99, ha="right")
        figure.canvas.draw()  # settles where the points are
        figure.set_layout_engine("none")
        for axes, k in zip(panels, n_views, strict=True):
            points = {
                name: (found[name, "travel", k][0], found[name, "accuracy", k][0])
                for name in names
            }
            label(
                axes,
                points,
                text_of,
                colour,
                [line for of, line in lines if of is axes],
            )
    return figure


def label(
    axes: Axes,
    points: dict[str, tuple[float, float]],
    text_of: dict[str, str],
    colour: dict[str, str],
    lines: Sequence[Sequence[tuple[float, float]]],
) -> None:
    """Write the name of each point beside it, where it covers no other name, no point and as little
    line as may be.

    Each takes the best of the places round its point in turn, the most crowded point first; a name
    that has to stand off is tied to its point by a thin line.
    """
    point = axes.figure.dpi / 72  # in pixels
    dots = {name: axes.transData.transform(at) for name, at in points.items()}
    along = [
        np.linspace(a, b, 60)
        for line in lines
        for a, b in pairwise(axes.transData.transform(line))
    ]
    taken = [
        Bbox.from_extents(*(at - 3.5 * point), *(at + 3.5 * point))
        for at in dots.values()
    ]
    inside = axes.get_window_extent()
    tied = []
    everyone = np.array(list(dots.values()))
    crowd = {
        name: np.sort(np.hypot(*(everyone - at).T))[:4].sum()
        for name, at in dots.items()
    }
    for name in sorted(dots, key=crowd.__getitem__):
        at = dots[name]
        text = axes.annotate(
            text_of[name],
            points[name],
            xytext=(0, 0),
            textcoords="offset points",
            va="bottom",
            fontsize=7.5,
            color=colour[name],
            zorder=4,
        )
        size = np.array(text.get_window_extent().size)
        tries = []
        for far, angle in product(
            (6, 11, 17, 25, 35, 47),
            np.radians(np.arange(0, 360, 15)),
        ):
            way = np.array([np.cos(angle), np.sin(angle)])
            tie = np.linspace(at, at + way * far * point, 20)
            centre = tie[-1] + way * size / 2
            box = Bbox([centre - size / 2, centre + size / 2])
            bad = 40 * sum(_overlap(box, other) for other in taken)
            bad += 40 * (box.width * box.height - _overlap(box, inside))
            bad += 300 * sum(map(box.count_contains, tied)) + 30 * sum(
                map(box.count_contains, along)
            )
            if far > 11:
                bad += 60 * sum(other.count_contains(tie[6:]) for other in taken)
            tries.append((bad + far * far + 20 * abs(np.sin(angle)), far, box, tie))
        _, far, box, tie = min(tries, key=lambda tried: tried[0])
        text.set_position((box.p0 - at) / point)
        taken.append(box)
        if far > 11:
            tied.append(tie)
            ends = axes.transData.inverted().transform(tie[[0, -1]])
            axes.plot(
                *ends.T,
                color=GREY,
                linewidth=0.6,
                zorder=1,
                scalex=False,
                scaley=False,
            )


def _overlap(a: Bbox, b: Bbox) -> float:
    shared = Bbox.intersection(a, b)
    return 0.0 if shared is None else float(shared.width * shared.height)


def main(
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path] = Path("views"),
    policies: tuple[str, ...] = (),
    views: tuple[int, ...] = (2, 3, 5),
    split: Literal["train", "test"] | None = None,
    runs: int = 10,
    samples: int = 2000,
    seed: int = 0,
    against: tuple[str, ...] = REFERENCES,
) -> None:
    """Write the table and the figure.

    Args:
        predictions: made by nextview-lab predict.
        out: folder for views.md, measures.csv, tests.csv and front.png.
        policies: names, or MODULE:CLASS for your own, beside random, random-all and oracle-gain; by
            default a choice of those that the predictions allow.
        views: after how many the policies are compared.
        split: take only the objects of this one; needed where the predictions hold several.
        runs: random first views of each object.
        samples: of the bootstrap.
        seed: decides first views, random policies and the bootstrap.
        against: names of policies with which, beside random, all are compared.
    """
    table = Predictions.load(predictions)
    if split:
        table = table.of_split(split)
    elif len(set(table.splits)) > 1:
        raise UsageError(
            f"{predictions}: holds training and test objects; choose with --split which are"
            " compared"
        )
    if not views or not 1 <= min(views) <= max(views) <= len(table.sphere):
        raise UsageError(
            f"policies are compared after 1 to {len(table.sphere)} views, not {views}"
        )
    specs = make_specs(table, runs, seed)
    sys.path.insert(0, str(Path.cwd()))  # where a user's own policy lies
    names = list(
        dict.fromkeys([*REFERENCES, *against, *(policies or POLICIES), ONE_STEP])
    )
    grid = Grid(specs, runs, (), max(views), seed)
    track(run_grid(grid, names), len(names), "replaying policies")
    for name in [
        name
        for name, paths in grid.paths.items()
        if paths.views.shape[1] < max(views) and paths.fixed
    ]:
        grid.failures[name] = f"{name} is over before view {max(views)}"
        del grid.paths[name]
    compared = [
        name for name in dict.fromkeys((REFERENCES[0], *against)) if name in grid.paths
    ]
    drawn_together = target_families(table.names)
    weights = resample_families(
        drawn_together, samples, np.random.default_rng([seed, 1])
    )
    both = after_views(grid, sorted(set(views)), weights, compared)
    found = Tables(*both, compared[0])
    rows = after_views_rows(found)
    left_out = [f"\nLeft out: {sentence}\n" for sentence in grid.failures.values()]
    text = "".join([markdown(rows.columns, rows.itertuples(index=False)), *left_out])
    out.mkdir(parents=True, exist_ok=True)
    (out / "views.md").write_text(text, encoding="utf-8")
    for name, frame in found.frames().items():
        frame.to_csv(out / f"{name}.csv", index=False)
    choosing = [name for name, paths in grid.paths.items() if not paths.fixed]
    to_png(front(found, families(choosing, specs)), out / "front.png")
    print(text, end="")
    if (policies or against != REFERENCES) and grid.failures:
        raise UsageError("not all that was asked for could be run")


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.cli(main)
