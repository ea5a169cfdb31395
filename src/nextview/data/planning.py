"""Where policies that decide by the depth seen so far go, from every first view of every object, into a store.

The replay of predictions holds no depth. But the way of such a policy depends on nothing else: not on what the models
say, nor on a threshold. So it is found once, by the episode loop itself, and the benchmark goes it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.belief import FixedLength
from nextview.data.measuring import Made, keep
from nextview.data.store import PLANNED, ViewStore
from nextview.data.world_sight import WorldSight, sight_of
from nextview.data.world_views import world_views
from nextview.episode import run_episodes
from nextview.errors import DatasetError
from nextview.observation import Observation
from nextview.policies.base import Evidence
from nextview.policies.registry import POLICIES, make_policy
from nextview.viewsphere import ViewSphere


def plannable() -> list[str]:
    """The policies of the registry that need the depth that was seen, and nothing else."""
    grid = ViewSphere.named("40")
    return [name for name, make in POLICIES.items() if tuple(make(grid).needs) == ("observations",)]


@takes_paths("path")
def plan(
    path: Path,
    names: Sequence[str] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    objects: NDArray[np.int64] | None = None,
) -> Iterator[tuple[int, int]]:
    """Put the views that policies take into a store, as ``plans/NAME`` (N, V, K) float32: row V from first view V.

    Args:
        path: the store.
        names: of the policies, "MODULE:CLASS" for your own; all that are ``plannable`` by default.
        workers: processes; one for each core by default; 0 to work in this one.
        scheduler: address of a dask.distributed scheduler, to use instead.
        objects: indices of those to plan for; all that are rendered by default.

    Yields:
        Objects done so far, and how many there are.

    Raises:
        DatasetError: there is no store, it cannot be written, or a policy needs more than depth.
        PolicyError: there is no such policy, or it failed.
    """
    store = ViewStore.open(path)
    store.array("depth")  # says if it is missing, before anything is begun
    names = tuple(names) or tuple(plannable())
    for name in names:
        needs = tuple(make_policy(name, store.sphere).needs)
        if needs != ("observations",):
            raise DatasetError(
                f"policy {name} needs {', '.join(needs) or 'nothing that was seen'}; planned are those that need the "
                "depth that was seen and nothing else"
            )
    arrays = [f"plans/{name}" for name in names]
    yield from keep(path, arrays, partial(_plan, names), workers, scheduler, objects=objects)


def _plan(names: tuple[str, ...], store: ViewStore, i: int) -> Made:
    sphere, worlds = store.sphere, WorldSight.of(store, [store.names[i]])
    scenes = None if worlds is None else world_views(store, i)
    views = [
        Observation(depth, pose, store.intrinsics, scene=None if scenes is None else scenes.scene_view(view))
        for view, (depth, pose) in enumerate(zip(store.depth(i), sphere.poses, strict=True))
    ]

    def observe(episodes: NDArray[np.int64], at: NDArray[np.int64]) -> Evidence:
        return Evidence(np.zeros((len(at), 2)), observations=[views[view] for view in at])

    found = {}
    for name in names:
        starts, length = np.arange(len(sphere)), FixedLength(max_views=PLANNED)
        constrain, _ = sight_of(worlds, np.zeros(len(sphere), np.int64))
        rng = np.random.default_rng(0)
        episodes = run_episodes(observe, sphere, make_policy(name, sphere), starts, length, rng, constrain=constrain)
        found[f"plans/{name}"] = episodes.outcome.views.astype(np.float32)
    return found, None
