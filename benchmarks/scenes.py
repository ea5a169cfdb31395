"""Choose and judge policies in scenes: objects among others, half hidden.

    python -m benchmarks.scenes choose learning.npz [--policies random-all visibility@0
        visible-gain@0]
    python -m research.plan scenes.zarr volumetric  # the store that scenes.npz was predicted from
    python -m benchmarks.scenes judge scenes.npz ... --ours visible-gain [--policies ...]
        [--figure scenes_travel.png]
    python -m benchmarks.scenes picture ModelNet10 docs/images/scenes.png [--target chair_0917]
    python -m benchmarks.scenes calibration scenes.npz ... --alone single-objects.npz ...

``choose``: what policies reach on scenes for learning, classes weighted evenly: mean log-belief in
the truth and accuracy after 2 to 5 views, as ``nextview-lab train gain`` judges. ``judge``: by
level accuracy and travel after 2, 3 and 5 views, points over random, and those of ours over each
rival, with 95 % bootstrap intervals over scenes and one Holm correction for all that is claimed;
the share of what one step of foresight gains; as a figure, accuracy against travel in cells and in
seconds of a robot that takes ``SECONDS`` for a view and ``TURN`` for a radian around the object.
``calibration``: how far the belief after 1, 2, 3 and 5 random views can be trusted, by level and by
how much of the target they show. ``picture``: one object at three levels, seen from some of the
40 views. The target is orange, what stands around it grey, the table light. Above each picture is
the share of the target that shows; a view to which no camera can be brought is crossed out.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise, product
from pathlib import Path

from nextview_lab.extras import require

require("benchmark")

import matplotlib
import numpy as np
import pandas as pd
import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import track
from nextview.data.folders import list_dataset
from nextview.errors import UsageError
from nextview.geometry.depth import headlight
from nextview.geometry.observation import pinhole
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.registry import make_policy
from nextview.recognition.belief import of_true_class
from nextview.session.style import FIGURE_STYLE, PAPER
from nextview_lab.benchmark.class_tables import levels_of
from nextview_lab.benchmark.comparison import Counted, Key, corrected
from nextview_lab.benchmark.entries import is_oracle
from nextview_lab.benchmark.replay import Grid, make_specs, run_grid
from nextview_lab.benchmark.statistics import interval, resample
from nextview_lab.data.metrics import calibration_error
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.scene_drawing import Meshes, draw_scene
from nextview_lab.data.scene_views import scenes_of
from nextview_lab.training.rollout import ReplayTable
from nextview_lab.training.rollout import judge as follow
from nextview_lab.worlds.scene import TargetScene, build_scene
from nextview_lab.worlds.scene_cameras import (
    SHOWS_OTHER,
    SHOWS_TABLE,
    SHOWS_TARGET,
    SceneCamera,
)
from nextview_lab.worlds.scene_layout import CLUTTER_LEVELS

POLICIES = ("random", "gain", "visibility", "volumetric", "visible-gain")
RIVALS = ("random-all", "visibility", "volumetric", "gain")
CEILINGS = ("true-visible_share-all", "oracle-gain-all")
REFERENCE = "random-all"
COUNTS = (2, 3, 5)
SECONDS = 1.0
TURN = 2.0
"""Of a robot: for each view, and for a turn by a radian."""
SURE = 0.9
"""Whoever is at least so sure and wrong is so confidently."""
SHARES = (0.0, 0.1, 0.3, 0.6, 1.0)
"""Ends of the bins of the mean share of the target that the views show; where nothing was seen
yet, in none.
"""
LEAST = 10
"""Targets of which a row of the table tells."""
COLOURS = (
    "#4a5560",
    "#d99000",
    "#0b5fa5",
    "#00805a",
    "#b5179e",
    "#d1495b",
    "#7a6fd0",
    "#38a0d9",
)
PICTURE_SIZE = 240  # pixels
WIDER = 0.55  # of the focal length with which the target fills the picture
OWNER_COLOURS = {
    SHOWS_TARGET: (0.95, 0.55, 0.15),
    SHOWS_OTHER: (0.74, 0.71, 0.67),
    SHOWS_TABLE: (0.95, 0.92, 0.86),
}
SHOWN_VIEWS = (10, 12, 14, 16, 18, 27)
CEILING = dict(zip(CEILINGS, [("--", "#8a939b"), (":", "#8a939b")], strict=True))


def choose(
    predictions: tyro.conf.Positional[Path],
    policies: tuple[str, ...] = (REFERENCE, "gain@0", "visibility@0", "visible-gain@0"),
    n_views: int = 5,
    seed: int = 0,
) -> None:
    """Print what policies reach on scenes for learning."""
    p = Predictions.load(predictions).deduplicate()
    table = ReplayTable.select(p, np.arange(len(p)), np.random.default_rng(seed))
    print(
        f"{len(p)} scenes; after 2 to {n_views} views: log-belief in the truth (mean), accuracy,"
        " travel (cells)"
    )
    for name in policies:
        policy = make_policy(name, p.sphere, (), p.classes)
        reached = [
            follow(table, policy, n_views, kind, np.random.default_rng(seed))
            for kind in ("log-belief", "right")
        ]
        logs, right = (", ".join(f"{x:.4f}" for x in value.mean) for value in reached)
        print(
            f"{name:24}{logs} ({reached[0].mean.mean():.4f})   {right}  "
            f" {reached[1].travel[-1]:.2f}"
        )


@dataclass(frozen=True)
class Reached:
    """What a policy reaches in scenes of one level after 1 to K views, means over the first views
    of each scene.

    Attributes:
        right: how often its answer is right, (N, K).
        cells: of travel until then, (N, K).
        seconds: the same of a robot, (N, K).
    """

    right: np.ndarray
    cells: np.ndarray
    seconds: np.ndarray


def reached_in(grid: Grid, name: str) -> Reached:
    """That of all scenes of a grid, in their order."""
    path = grid.paths[name]
    most = max(COUNTS)
    # some end before: no view is free
    last = np.minimum((path.views >= 0).sum(1)[:, None], np.arange(1, most + 1)) - 1
    rows = np.arange(len(last))[:, None]
    right = path.answers[rows, last] == grid.specs.labels[:, None]
    travel = path.travel[rows, last], SECONDS * last + TURN * path.arc[rows, last]
    return Reached(
        *(
            np.asarray(values, np.float64).reshape(grid.runs, -1, most).mean(0)
            for values in (right, *travel)
        )
    )


def judge(
    predictions: tyro.conf.Positional[tuple[Path, ...]],
    ours: str,
    policies: tuple[str, ...] = POLICIES,
    rivals: tuple[str, ...] = RIVALS,
    known: tuple[Path, ...] = (),
    figure: Path | None = None,
    table: Path | None = None,
    runs: int = 10,
    samples: int = 10000,
    seed: int = 0,
) -> None:
    """Print the tables, and draw the figure.

    Args:
        predictions: of scenes of the test split; several stores of them are put together.
        ours: the policy that is tested.
        policies: that stand in the tables, with their points over random.
        rivals: those that ours is tested against.
        known: predictions of scenes that were looked at before; those around the same targets are
            left out.
        figure: accuracy against travel, a picture.
        table: the comparisons, with p before and after the correction, as CSV.
        runs: first views of each scene.
        samples: of the bootstrap.
        seed: of all that is random.
    """
    names = list(dict.fromkeys([REFERENCE, *policies, ours, *CEILINGS]))
    found: dict[str, dict[str, list[Reached]]] = {level: {} for level in CLUTTER_LEVELS}
    looked_at = {
        name.rpartition("@")[0]
        for path in known
        for name in Predictions.load(path).names
    }
    for path in predictions:
        p = Predictions.load(path)
        p = p.of_objects(
            np.flatnonzero(
                [name.rpartition("@")[0] not in looked_at for name in p.names]
            )
        )
        grid = Grid(make_specs(p, runs, seed), runs, (1.0,), max(COUNTS), seed)
        track(run_grid(grid, names), len(names), f"going through {path.name}")
        for name, why in grid.failures.items():
            print(f"{name}: {why}")
        of = levels_of(p.names)
        for level, name in product(sorted({*of}), grid.paths):
            mine = of == level
            every = reached_in(grid, name)
            part = Reached(*(getattr(every, f.name)[mine] for f in fields(Reached)))
            found[level].setdefault(name, []).append(part)
    scenes = {
        level: {
            name: Reached(
                *(
                    np.concatenate([getattr(part, f.name) for part in parts])
                    for f in fields(Reached)
                )
            )
            for name, parts in by_name.items()
        }
        for level, by_name in found.items()
        if by_name
    }
    comparisons = compared(
        scenes,
        ours,
        rivals,
        samples,
        np.random.default_rng([seed, 1]),
    )
    show(scenes, comparisons, ours)
    if table is not None:
        comparisons.to_csv(table, index=False)
    if figure is not None:
        draw(scenes, figure)


def compared(
    scenes: dict[str, dict[str, Reached]],
    ours: str,
    rivals: tuple[str, ...],
    samples: int,
    rng: np.random.Generator,
) -> pd.DataFrame:
    """All with random, and ours with its rivals; only the latter are tested, with one Holm
    correction.
    """
    tests = []
    for level, of in scenes.items():
        count = len(of[REFERENCE].right)
        shares = {
            Key(name, None, k, "accuracy"): reached.right[:, k - 1]
            for name, reached in of.items()
            for k in COUNTS
        }
        top = np.stack(list(shares.values()), 1)
        counted = Counted(tuple(shares), top, np.ones_like(top), np.arange(count))
        weights = resample(count, samples, rng)
        others = counted.tests(
            level, weights, REFERENCE, lambda key: key.policy != ours
        )
        tests.append(others)
        tests += [
            counted.tests(level, weights, rival, lambda key: key.policy == ours)
            for rival in rivals
            if rival in of
        ]
    return corrected(tests, lambda policy: policy != ours)


def show(scenes: dict[str, dict[str, Reached]], table: pd.DataFrame, ours: str) -> None:
    """Print the tables."""
    print(f"{int(table['p'].notna().sum())} comparisons, one correction")
    for level, of in scenes.items():
        print(f"\n{level} clutter, {len(of[REFERENCE].right)} scenes\n")
        print(
            "| policy | against | "
            + " | ".join(f"after {k} (cells) | points (95 %), p" for k in COUNTS)
            + " |"
        )
        print("|---" * (2 + 2 * len(COUNTS)) + "|")
        known = {name: means(reached) for name, reached in of.items()}
        print(
            f"| {REFERENCE} | | "
            + " | ".join(f"{known[REFERENCE][k]} | " for k in COUNTS)
            + " |"
        )
        for (name, other), rows in table[table["set"] == level].groupby(
            ["policy", "reference"],
            sort=False,
        ):
            cells = []
            for row in rows.itertuples():
                lead, low, high = 100 * row.difference, 100 * row.low, 100 * row.high
                points = f"{lead:+.1f} ({low:+.1f} to {high:+.1f})"
                cells += [
                    known[name][row.views],
                    points + ("" if np.isnan(row.p_holm) else f", {row.p_holm:.2g}"),
                ]
            print(f"| {name} | {other} | " + " | ".join(cells) + " |")
        for k in COUNTS:
            had, most = (
                (of[name].right - of[REFERENCE].right)[:, k - 1].mean()
                for name in (ours, CEILINGS[-1])
            )
            print(
                f"\n{ours} after {k}: {had / most:.0%} of the {100 * most:.1f} points of one step"
                " of foresight"
            )


def means(reached: Reached) -> dict[int, str]:
    """Accuracy and travel after so many views."""
    return {
        k: f"{reached.right[:, k - 1].mean():.3f} ({reached.cells[:, k - 1].mean():.2f})"
        for k in COUNTS
    }


def draw(scenes: dict[str, dict[str, Reached]], out: Path) -> None:
    """Accuracy after 1 to 5 views against the travel until then, in cells and in seconds, by
    level.
    """
    with matplotlib.rc_context(FIGURE_STYLE):
        figure = Figure((3.2 * len(scenes), 6.4), layout="constrained")
        axes = figure.subplots(2, len(scenes), sharey="col", squeeze=False)
        for column, (level, of) in zip(axes.T, scenes.items(), strict=True):
            shown = {name: reached for name, reached in of.items() if "@" not in name}
            followed = [name for name in shown if not is_oracle(name)]
            for name, reached in shown.items():
                drawn = (
                    ("-", COLOURS[followed.index(name) % len(COLOURS)])
                    if name in followed
                    else CEILING.get(name)
                )
                line, colour = drawn or ("-.", "#8a939b")
                for axis, travel in zip(
                    column,
                    (reached.cells, reached.seconds),
                    strict=True,
                ):
                    right = reached.right.mean(0)
                    axis.plot(
                        travel.mean(0),
                        right,
                        line,
                        color=colour,
                        marker="o",
                        markersize=3,
                        label=name,
                    )
            column[0].set_title(f"{level} clutter", fontsize=10)
            column[0].set_xlabel("travel (cells)")
            column[1].set_xlabel("travel (s)")
            column[0].yaxis.set_major_formatter(PercentFormatter(1, 0))
        for row in axes:
            row[0].set_ylabel("accuracy after 1 to 5 views")
        figure.legend(
            *axes[0, 0].get_legend_handles_labels(),
            loc="outside lower center",
            ncols=4,
        )
        figure.savefig(out, dpi=110, facecolor="white")


@dataclass(frozen=True)
class Believed:
    """What is believed after 1 to K views of each of E walks: belief in the answer, whether it is
    right, and minus the logarithm of the belief in the truth; (E, K) each."""

    confidence: np.ndarray
    right: np.ndarray
    loss: np.ndarray

    @classmethod
    def of(cls, p: Predictions, rows: np.ndarray, views: np.ndarray) -> Believed:
        """Of walks through views, (E, K), around objects, (E,)."""
        weights = p.seen[rows[:, None], views]
        total = (
            weights[..., None] * p.log_evidence[rows[:, None], views].astype(np.float64)
        ).cumsum(1)
        logs = p.calibration.log_belief(
            total,
            np.maximum(weights.cumsum(1), 1),
            len(p.classes),
        )
        answers = logs.argmax(-1)
        labels = p.labels[rows]
        sure = np.exp(
            np.stack(
                [
                    of_true_class(step, answer)
                    for step, answer in zip(logs, answers, strict=True)
                ]
            )
        )
        return cls(sure, answers == labels[:, None], -of_true_class(logs, labels))


def calibration(
    predictions: tyro.conf.Positional[tuple[Path, ...]],
    alone: tuple[Path, ...],
    episodes: int = 10,
    samples: int = 2000,
    seed: int = 0,
) -> None:
    """Print how far the belief can be trusted, as a table in Markdown.

    Args:
        predictions: of scenes.
        alone: of single objects, among them the targets of these scenes.
        episodes: of random views that can be reached, of each scene; the same ones of the target
            alone.
        samples: of the bootstrap over targets.
        seed: of all that is random.
    """
    singles = [Predictions.load(path) for path in alone]
    parts = []
    for path in predictions:
        p = Predictions.load(path)
        rng = np.random.default_rng(seed)
        scenes = scenes_of(p)
        if scenes is None:
            raise UsageError(f"{path}: holds single objects, no scenes")
        rows = np.repeat(np.arange(len(p)), episodes)
        draws = np.where(
            scenes.reachable[rows],
            rng.random((len(rows), len(p.sphere))),
            -1,
        )
        views = np.argsort(-draws, axis=1)[:, : max(COUNTS)]
        targets = np.array([name.partition("@")[0] for name in p.names])
        single = next(
            (single for single in singles if {*targets} <= {*single.names}),
            None,
        )
        if single is None:
            raise UsageError(
                f"{path}: no predictions of single objects hold all targets of these scenes"
            )
        same = np.array([single.names.index(name) for name in targets])[rows]
        share = np.stack(
            [scenes.store.read("measures/visible_share", row) for row in scenes.rows]
        )[rows[:, None], views]
        nothing = ~p.seen[rows[:, None], views].cumsum(1).astype(bool)
        show = np.where(
            nothing,
            np.nan,
            share.cumsum(1) / np.arange(1, max(COUNTS) + 1),
        )
        ours = Believed.of(p, rows, views)
        bare = Believed.of(single, same, views)
        parts.append(
            (
                levels_of(p.names)[rows],
                targets[rows],
                show,
                *(vars(of) for of in (ours, bare)),
            )
        )
    level, target, show = (
        np.concatenate([part[i] for part in parts]) for i in range(3)
    )
    both = [
        Believed(
            *(
                np.concatenate([part[i][f.name] for part in parts])
                for f in fields(Believed)
            )
        )
        for i in (3, 4)
    ]
    print(
        "| clutter | views | show | walks (targets) | accuracy, alone | surer than right, points"
        f" (95 %), alone | calibration error, alone | log-loss, alone | at least {SURE} sure and"
        " wrong, alone |"
    )
    print("|---" * 9 + "|")
    rng = np.random.default_rng([seed, 1])
    for name, k in product(
        (*(name for name in CLUTTER_LEVELS if name in level), "any"),
        (1, *COUNTS),
    ):
        mine = (level == name) | (name == "any")
        share = show[:, k - 1]
        kept = {"all": mine} | {
            f"{low:g} to {high:g}": mine & (share >= low) & (share < high + (high == 1))
            for low, high in pairwise(SHARES)
        }
        for bin_, here in kept.items():
            if len(n := {*target[here]}) >= LEAST:
                cells = trusted(both, here, k, target[here], samples, rng)
                print(f"| {name} | {k} | {bin_} | {here.sum()} ({len(n)}) | {cells} |")


def trusted(
    both: list[Believed],
    here: np.ndarray,
    k: int,
    targets: np.ndarray,
    samples: int,
    rng: np.random.Generator,
) -> str:
    """The cells of the table after k views of some walks; in each that of the targets alone
    stands behind.
    """
    _, at = np.unique(targets, return_inverse=True)
    weights = resample(int(at.max()) + 1, samples, rng)[:, at]
    cells = []
    for of in both:
        sure, right, loss = (getattr(of, f.name)[here, k - 1] for f in fields(of))
        gap = 100 * (sure - right)
        low, high = interval(((weights @ gap) / weights.sum(1))[:, None])
        sure_and_wrong = ((sure >= SURE) & ~right).mean()
        cells.append(
            (
                f"{right.mean():.3f}",
                f"{gap.mean():+.1f} ({low[0]:+.1f} to {high[0]:+.1f})",
                f"{calibration_error(sure, right):.3f}",
                f"{loss.mean():.3f}",
                f"{100 * sure_and_wrong:.1f} %",
            )
        )
    return " | ".join(map(", ".join, zip(*cells, strict=True)))


def in_colours(scene: TargetScene, pose: np.ndarray) -> np.ndarray:
    """What a camera sees, (PICTURE_SIZE, PICTURE_SIZE, 3), in the colours of the owners."""
    intrinsics = pinhole(PICTURE_SIZE, 3.0) * [[WIDER, 1, 1], [1, WIDER, 1], [1, 1, 1]]
    depth, owner = SceneCamera(scene, intrinsics, (PICTURE_SIZE, PICTURE_SIZE)).look(
        pose
    )
    shade = headlight(depth, intrinsics)[..., None] / 255
    image = np.tile(np.array([0.98, 0.965, 0.94]), (PICTURE_SIZE, PICTURE_SIZE, 1))
    for which, colour in OWNER_COLOURS.items():
        image = np.where(
            (owner == which)[..., None],
            np.array(colour) * (0.45 + 0.55 * shade),
            image,
        )
    return np.clip(image, 0, 1)


def picture(
    dataset: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    target: str = "chair_0917",
    split: str = "test",
    seed: int = 0,
) -> None:
    """Draw one object at three levels of clutter, from some of the 40 views.

    Args:
        dataset: folder of the objects.
        out: PNG.
        target: name of the object.
        split: of it, and of what stands around it.
        seed: of what stands around it.
    """
    files = {
        e.name: e.path.relative_to(dataset).as_posix()
        for e in list_dataset(dataset)
        if e.split == split
    }
    if target not in files:
        raise UsageError(
            f"{dataset}: no object of the split {split} is called {target}"
        )
    meshes = Meshes(dataset, tuple(sorted(files.values())))
    sphere = ViewSphere.named("40")
    with matplotlib.rc_context(FIGURE_STYLE | {"axes.grid": False}):
        figure = Figure((1.65 * len(SHOWN_VIEWS), 1.85 * len(CLUTTER_LEVELS)))
        axes = figure.subplots(
            len(CLUTTER_LEVELS),
            len(SHOWN_VIEWS),
            gridspec_kw={"wspace": 0.04, "hspace": 0.16},
        )
        for row, level in zip(axes, CLUTTER_LEVELS, strict=True):
            layout = draw_scene(
                files[target],
                meshes,
                level,
                seed,
                f"{target}@{level}-0",
            )
            scene = build_scene(layout, dataset)
            for axis, view in zip(row, SHOWN_VIEWS, strict=True):
                axis.imshow(in_colours(scene, sphere.poses[view]))
                axis.set_title(
                    f"view {view}: {layout.visible[view]:.0%}",
                    fontsize=8,
                    pad=3,
                )
                axis.set(xticks=[], yticks=[])
                if view in layout.unreachable:
                    axis.plot(
                        [0, PICTURE_SIZE - 1],
                        [0, PICTURE_SIZE - 1],
                        color="#b00020",
                        linewidth=1.2,
                    )
                    axis.plot(
                        [0, PICTURE_SIZE - 1],
                        [PICTURE_SIZE - 1, 0],
                        color="#b00020",
                        linewidth=1.2,
                    )
            row[0].set_ylabel(
                f"{level}, {np.mean(layout.visible):.0%} on average",
                fontsize=8,
            )
        figure.savefig(
            out,
            dpi=120,
            facecolor=PAPER,
            bbox_inches="tight",
            pad_inches=0.05,
        )


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.extras.subcommand_cli_from_dict(
            {
                "choose": choose,
                "judge": judge,
                "calibration": calibration,
                "picture": picture,
            }
        )
