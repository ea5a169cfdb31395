"""Compare policies on taught things after fixed numbers of views, on all of them and on those that
are confused most.

    nextview render THINGS shown.zarr --sensor wrist --rotated --seed 7
    nextview render THINGS again.zarr --sensor wrist --rotated --seed 7 --noise-seed 1
    nextview predict shown.zarr shown.npz --models MINE
    nextview predict again.zarr again.npz --models MINE
    python benchmarks/things.py MINE/memory.json things shown.npz again.npz [--by-shape]
        [--policies MODULE:CLASS]

The second store shows the same views with other errors of the sensor.

Each predictions file is a draw of the sensor's noise: all are judged. Writes things.md (the table)
and things.csv (every number) into the folder. The bootstrap is over things, whose runs and draws
belong together; p is by sign flips over things, with one Holm correction. ``foresight`` sees what
each view will say, its noise too. The fair ceiling knows the thing and its azimuth, but of the
noise only other draws: it goes where these believe in the truth most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro
from numpy.typing import NDArray

from nextview.benchmark.replay import Trajectories, make_specs, replay, replay_policy
from nextview.benchmark.statistics import holm, interval, resample, sign_flip_p
from nextview.checks import extras
from nextview.cli.exit_status import orderly_end
from nextview.data.metrics import ratio
from nextview.data.predictions import Predictions
from nextview.errors import UsageError
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import EpisodeState, best_view
from nextview.recognition.belief import (
    Calibration,
    Stopping,
    log_evidence_of,
    of_true_class,
)
from nextview.things.memory import TaughtRecogniser

if TYPE_CHECKING:
    import pandas as pd

RIVALS = ("random-all", "spread", "furthest", "orbit-10")
OWN = "discriminate"
FORESIGHT = "foresight"
CEILING = "fair ceiling"
MOST = 10
ENOUGH = 0.95
"""Views within which so many are to be right."""
ROWS = 64
SAMPLES = 4000
Float = NDArray[np.floating]
Whole = NDArray[np.int64]


@dataclass(frozen=True)
class FairCeiling:
    """The view after which the true class is believed most, in the mean over other draws of the
    noise.

    Attributes:
        log_evidence: (draws, things, V, D).
        labels: of the things, (N,).
        objects: draw * things + thing of each episode, (E,).
    """

    sphere: ViewSphere
    log_evidence: Float
    labels: Whole
    objects: Whole
    classes: int
    calibration: Calibration
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Whole:
        """See ``Policy.next_views``."""
        rows = np.split(
            np.arange(len(state.current)),
            range(ROWS, len(state.current), ROWS),
        )
        return best_view(
            self.sphere,
            state,
            np.concatenate([self._worth(state, each) for each in rows]),
        )

    def _worth(
        self,
        state: EpisodeState,
        rows: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        """Mean logarithm of the belief in the truth after each view, (rows, V)."""
        draw, thing = np.divmod(
            self.objects[state.episodes[rows]],
            self.log_evidence.shape[1],
        )
        seen = np.matmul(
            state.visited[rows, None].astype(np.float32),
            self.log_evidence[draw, thing],
        )
        worth = np.zeros((len(rows), len(self.sphere)))
        for step in range(1, len(self.log_evidence)):
            other = self.log_evidence[(draw + step) % len(self.log_evidence), thing]
            logs = self.calibration.log_belief(
                seen + other,
                state.step + 1,
                self.classes,
            )
            worth += of_true_class(logs, self.labels[thing])
        return worth


def together(draws: Sequence[Predictions]) -> Predictions:
    """All draws as one: object = draw * things + thing."""
    if len({(draw.names, draw.models["recogniser"][1]) for draw in draws}) > 1:
        raise UsageError("the predictions are of other things, or by another memory")
    fields = ["logits", "depth_entropy", "labels", "splits", "conflicting"]
    fields += ["azimuth_bins"] * (draws[0].azimuth_bins is not None)
    arrays = {
        name: np.concatenate([getattr(draw, name) for draw in draws]) for name in fields
    }
    names = tuple(f"{name} {k}" for k, draw in enumerate(draws) for name in draw.names)
    return replace(draws[0], **arrays, names=names, maps={}, of_size=None)


def margins(recogniser: TaughtRecogniser, by_shape: bool) -> NDArray[np.float64]:
    """How clearly the memory's own held-out views, one at a time, name each class: the mean
    margin, (C,).
    """
    memory = recogniser.memory
    k, f = memory.held_out.shape[1:]
    where = memory.held_out_views.reshape(-1, 2)
    evidence = recogniser.evidence(
        memory.held_out.reshape(-1, f).astype(np.float32),
        where[:, 0],
    )
    logits = evidence.logits
    size = recogniser.card.size
    if size is not None and not by_shape:
        logits = logits + size.logits(np.repeat(memory.radii, k))
    total = log_evidence_of(logits, evidence.azimuth_bins, where[:, 1])
    logs = recogniser.calibration.log_belief(total, 1, len(recogniser.classes))
    first = np.unique(memory.thing, return_index=True)[1]
    label = np.repeat(np.array(recogniser.calibration.hypotheses)[first], k)
    own = logs[np.arange(len(label)), label]
    logs[np.arange(len(label)), label] = -np.inf
    return np.bincount(label, own - logs.max(1)) / np.bincount(label)


def run(
    draws: Sequence[Predictions],
    card: Path,
    others: Sequence[str],
    runs: int,
    seed: int,
    most: int,
) -> dict[str, Trajectories]:
    """Where each policy goes, by its name in the table; ``others`` are compared too."""
    specs = make_specs(together(draws), runs, seed)
    p = specs.predictions
    n = len(draws[0])
    found = {
        name: replay(name, specs, MOST, seed)
        for name in dict.fromkeys((*RIVALS, *others))
    }
    found[OWN] = replay(str(card), specs, MOST, seed)
    found[FORESIGHT] = replay("oracle-gain-all", specs, most, seed)
    if len(draws) > 1:
        evidence = p.log_evidence.reshape(len(draws), n, len(p.sphere), -1)
        policy = FairCeiling(
            p.sphere,
            evidence,
            p.labels[:n],
            specs.objects,
            len(p.classes),
            p.calibration,
        )
        found[CEILING] = replay_policy(
            CEILING,
            policy,
            specs,
            Stopping(1.0, most),
            np.random.default_rng(seed),
        )
    return found


def measured(
    paths: dict[str, Trajectories],
    labels: Whole,
    things: Whole,
    n_views: Sequence[int],
) -> list[dict]:
    """Numbers of some of the things: accuracy, travel, the lead over random, its p, and the
    share of the ceiling's.
    """
    weights = resample(len(things), SAMPLES, np.random.default_rng(1))
    right: dict[tuple[str, int], NDArray[np.bool_]] = {}
    for name, path in paths.items():
        for k in range(1, (max(n_views) if name in (FORESIGHT, CEILING) else MOST) + 1):
            answer = path.answers[
                np.arange(len(path.views)),
                np.minimum(k, (path.views >= 0).sum(1)) - 1,
            ]
            right[name, k] = (answer.reshape(-1, len(labels)) == labels)[:, things]
    rows = []
    for (name, k), hits in right.items():
        random = right[RIVALS[0], k]
        each = np.stack([hits.mean(0), hits.mean(0) - random.mean(0)], 1)
        low, high = interval(ratio(each, np.ones_like(each), weights))
        gap = (
            right[CEILING, k].mean() - random.mean()
            if (CEILING, k) in right
            else np.nan
        )
        ends = paths[name].travel[:, :k][:, -1].reshape(-1, len(labels))[:, things]
        tested = name not in (RIVALS[0], FORESIGHT, CEILING) and k in n_views and k > 1
        lead = each[:, 1].mean()
        rows.append(
            {
                "policy": name,
                "n_views": k,
                "accuracy": hits.mean(),
                "low": low[0],
                "high": high[0],
                "lead": lead,
                "travel": ends.mean(),
                "lead_low": low[1],
                "lead_high": high[1],
                "p": sign_flip_p(each[:, 1:])[0] if tested else np.nan,
                "of_ceiling": lead / gap if gap > 0 and k > 1 else np.nan,
            }
        )
    return rows


def markdown(table: pd.DataFrame, n_views: Sequence[int]) -> str:
    """The table as text."""
    head = [
        "things",
        "policy",
        *(f"{k} view{'s' * (k > 1)}" for k in n_views),
        f"{ENOUGH:.0%} right",
    ]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for (things, name), rows in table.groupby(["things", "policy"], sort=False):
        cells = []
        by_views = rows.set_index("n_views")
        for k in n_views:
            row = by_views.loc[k]
            cell = f"{row.accuracy:.3f} ({row.low:.3f}-{row.high:.3f})"
            if k > 1 and name != RIVALS[0]:
                cell += (
                    f", {100 * row.lead:+.1f} ({100 * row.lead_low:+.1f} to"
                    f" {100 * row.lead_high:+.1f})"
                )
                cell += "" if np.isnan(row.p_holm) else f", p {row.p_holm:.2g}"
                cell += (
                    ""
                    if np.isnan(row.of_ceiling) or name == CEILING
                    else f", {row.of_ceiling:.0%}"
                )
            cells.append(cell + (f", travel {row.travel:.1f}" if k > 1 else ""))
        enough = rows.n_views[rows.accuracy >= ENOUGH]
        views = (
            f"{enough.min()} views"
            if len(enough)
            else "-"
            if rows.n_views.max() < MOST
            else f"not after {MOST}"
        )
        lines.append(f"| {things} | {name} | {' | '.join(cells)} | {views} |")
    return "\n".join(lines) + "\n"


def main(
    card: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    predictions: tyro.conf.Positional[tuple[Path, ...]],
    policies: tuple[str, ...] = (),
    by_shape: bool = False,
    runs: int = 10,
    views: tuple[int, ...] = (1, 2, 3, 5),
    seed: int = 0,
) -> None:
    """Run all policies and write the table.

    Args:
        card: of the memory; ``out`` is the folder to write.
        predictions: made by it, of one draw of the noise each.
        policies: compared too: MODULE:CLASS of your own, or any name that nextview benchmark takes.
        by_shape: as if sizes were not known.
        runs: random first views of each thing in each draw.
        views: after how many the policies are compared.
        seed: decides first views and random policies.
    """
    with extras():
        import pandas as pd

    if not predictions:
        raise UsageError(
            "name at least one file of predictions, made by nextview predict with these models"
        )
    draws = [
        draw.by_shape() if by_shape else draw
        for draw in map(Predictions.load, predictions)
    ]
    recogniser = TaughtRecogniser(card)
    if recogniser.classes != draws[0].classes:
        raise UsageError(f"{card}: knows other things than the predictions")
    margin = margins(recogniser, by_shape)[draws[0].labels]
    half = np.sort(np.argsort(margin, kind="stable")[: len(margin) // 2])
    paths = run(draws, card, policies, runs, seed, max(views))
    rows: list[dict] = []
    for name, things in (
        ("all", np.arange(len(margin))),
        ("the confusable half", half),
    ):
        rows += [
            {"things": name} | row
            for row in measured(paths, draws[0].labels, things, views)
        ]
    table = pd.DataFrame(rows)
    table["p_holm"] = holm(table["p"].to_numpy())
    out.mkdir(parents=True, exist_ok=True)
    table.to_csv(out / "things.csv", index=False)
    (out / "things.md").write_text(text := markdown(table, views), encoding="utf-8")
    print(text, end="")


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
