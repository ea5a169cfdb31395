"""Accuracy in worlds at a fixed number of views: random views, and two that know the truth, at every level.

    python benchmarks/worlds.py worlds.zarr worlds.npz [--views 2 3 5] [--runs 10]

The store is one of worlds, the predictions are made of it by nextview predict. Only views that can be reached are
taken, first ones too, and views that do not show the target are no evidence. "visible" goes to the view from which
most of the target shows; "foresight" to that after which the true class is believed most. Both know the truth, so they
are ceilings and no policies. The intervals are 95 % bootstrap intervals over worlds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

from nextview.belief import Stopping
from nextview.cli.ending import orderly_end
from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.data.world_views import world_views
from nextview.episode import Episodes
from nextview.policies.base import EpisodeState, Evidence, Policy
from nextview.policies.baselines import RandomAll
from nextview.policies.oracle import OracleGain

Make = Callable[[Predictions, NDArray[np.int64], NDArray[np.float32]], Policy]


@dataclass(frozen=True)
class OracleVisible:
    """The view from which most of the target shows.

    Attributes:
        visible: true shares of each object, (N, V).
        objects: the object of each episode, (E,).
    """

    visible: NDArray[np.float32]
    objects: NDArray[np.int64]
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``; equal ones with equal chance."""
        values = self.visible[self.objects[state.episodes]] + 1e-6 * rng.random(state.visited.shape)
        return np.where(state.free, values, -1).argmax(1)


def _foresight(p: Predictions, objects: NDArray[np.int64], visible: NDArray[np.float32]) -> Policy:
    return OracleGain(p.sphere, p.log_evidence, len(p.classes), p.labels, objects, "global", p.calibration)


POLICIES: dict[str, Make] = {
    "random": lambda p, objects, visible: RandomAll(p.sphere),
    "visible": lambda p, objects, visible: OracleVisible(visible, objects),
    "foresight": _foresight,
}


def answers(
    p: Predictions, policy: Policy, objects: NDArray[np.int64], starts: NDArray[np.int64], reachable: NDArray[np.bool_],
    n_views: int, seed: int,
) -> NDArray[np.int64]:  # fmt: skip
    """The class believed most after each view of each episode, (E, n_views); of one that ends early, its last."""
    seen = np.ptp(p.logits, axis=2) > 0  # where nothing shows all classes have the same logit
    episodes = Episodes(p.sphere, policy, starts, Stopping(1.0, n_views), np.random.default_rng(seed), p.calibration)
    found = np.zeros((len(objects), n_views), np.int64)

    def in_reach(state: EpisodeState) -> EpisodeState:
        return replace(state, reachable=reachable[objects[state.episodes]])

    while len(episodes.running):
        rows, views = objects[episodes.running], episodes.current[episodes.running]
        bins = None if p.azimuth_bins is None else p.azimuth_bins[rows, views]
        evidence = Evidence(p.logits[rows, views], azimuth_bins=bins, seen=seen[rows, views])
        step = episodes.update(evidence, constrain=in_reach)
        found[step.episodes, len(episodes.steps) - 1 :] = step.belief.argmax(1)[:, None]
    return found


def main(
    store: tyro.conf.Positional[Path],
    predictions: tyro.conf.Positional[Path],
    views: tuple[int, ...] = (2, 3, 5),
    runs: int = 10,
    seed: int = 0,
) -> None:
    """Print a table for each level."""
    opened, p = ViewStore.open(store), Predictions.load(predictions)
    row = {name: i for i, name in enumerate(opened.names)}
    worlds = [world_views(opened, row[name]) for name in p.names]
    visible, reachable = np.stack([w.visible_share for w in worlds]), np.stack([w.reachable for w in worlds])
    level = np.array([name.rpartition("@")[2].partition("-")[0] for name in p.names])
    rng = np.random.default_rng(seed)
    for which in dict.fromkeys(level):
        mine = np.flatnonzero(level == which)
        objects = np.tile(mine, runs)
        starts = np.where(reachable[objects], rng.random((len(objects), len(p.sphere))), -1).argmax(1)
        print(f"\n{which}: {len(mine)} worlds, {visible[mine].mean():.2f} of the target shows, "
              f"{reachable[mine].mean():.2f} of the views can be reached")  # fmt: skip
        print("policy      " + "".join(f"{f'{k} views':>22}" for k in (1, *views)))
        for name, make in POLICIES.items():
            said = answers(p, make(p, objects, visible), objects, starts, reachable, max(views), seed)
            right = (said == p.labels[objects][:, None]).reshape(runs, len(mine), -1).mean(0)
            drawn = right[rng.integers(len(mine), size=(1000, len(mine)))].mean(1)
            low, high = np.quantile(drawn, (0.025, 0.975), axis=0)
            print(f"{name:<12}" + "".join(
                f"{right[:, k - 1].mean():>9.3f} [{low[k - 1]:.3f}, {high[k - 1]:.3f}]"[:22].rjust(22)
                for k in (1, *views)
            ))  # fmt: skip


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.cli(main)
