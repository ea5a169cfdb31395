"""Where policies that decide by the depth seen so far go, from every first view of every object,
into a store.

    python -m research.plan views.zarr research.volumetric:Volumetric research.volumetric:coverage
        [--split test]

The replay of predictions holds no depth. But the way of such a policy depends on nothing else: not
on what the models say, nor on a threshold. So it is found once, by the episode loop itself, and the
benchmark goes it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import follow, say_done
from nextview.errors import DatasetError
from nextview.geometry.observation import Observation
from nextview.policies.base import Evidence
from nextview.policies.registry import make_policy
from nextview.recognition.belief import FixedLength
from nextview.session.episode import run_episodes
from nextview_lab.data.measures import Made, keep
from nextview_lab.data.scene_views import SceneSight, scene_views, sight_of
from nextview_lab.data.splits import some_objects
from nextview_lab.data.store import PLANNED, ViewStore


def plan(
    path: Path,
    names: Sequence[str],
    workers: int | None = None,
    scheduler: str | None = None,
    objects: NDArray[np.int64] | None = None,
) -> Iterator[tuple[int, int]]:
    """Put the views that policies take into a store, as ``plans/NAME`` (N, V, K) float32: row V
    from first view V.

    Args:
        path: the store.
        names: of the policies, as ``make_policy`` takes them.
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
    names = tuple(names)
    for name in names:
        needs = tuple(make_policy(name, store.sphere).needs)
        if needs != ("observations",):
            raise DatasetError(
                f"policy {name} needs {', '.join(needs) or 'nothing that was seen'}; planned are"
                " those that need the depth that was seen and nothing else"
            )
    arrays = [f"plans/{name}" for name in names]
    yield from keep(
        path,
        arrays,
        partial(_plan, names),
        workers,
        scheduler,
        objects=objects,
    )


def _plan(names: tuple[str, ...], store: ViewStore, i: int) -> Made:
    sphere = store.sphere
    sight = SceneSight.of(store, [store.names[i]])
    scenes = None if sight is None else scene_views(store, i)
    views = [
        Observation(
            depth,
            pose,
            store.intrinsics,
            scene=None if scenes is None else scenes.scene_view(view),
        )
        for view, (depth, pose) in enumerate(
            zip(store.depth(i), sphere.poses, strict=True)
        )
    ]

    def observe(episodes: NDArray[np.int64], at: NDArray[np.int64]) -> Evidence:
        return Evidence(
            np.zeros((len(at), 2)),
            observations=[views[view] for view in at],
        )

    found = {}
    for name in names:
        starts = np.arange(len(sphere))
        length = FixedLength(max_views=PLANNED)
        constrain, _ = sight_of(sight, np.zeros(len(sphere), np.int64))
        rng = np.random.default_rng(0)
        episodes = run_episodes(
            observe,
            sphere,
            make_policy(name, sphere),
            starts,
            length,
            rng,
            constrain=constrain,
        )
        found[f"plans/{name}"] = episodes.outcome.views.astype(np.float32)
    return found


def main(
    store: tyro.conf.Positional[Path],
    names: tyro.conf.Positional[tuple[str, ...]],
    /,
    split: Literal["train", "test"] | None = None,
    held_out: str | None = None,
    objects: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Find the way of geometric policies from every first view of every object, and keep it in the
    store.

    Resumes where it was.

    Args:
        store: view store made by nextview-lab render.
        names: of the policies, MODULE:CLASS or an installed one.
        split: only this split.
        held_out: only the objects that this model, bundled or a card (NAME.json), calls held out of
            its training.
        objects: only so many of these, spread evenly; twice as many later hold the same.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler to use instead.
    """
    steps = plan(
        store,
        names,
        workers,
        scheduler,
        some_objects(ViewStore.open(store), split, held_out, objects),
    )
    before, total = follow(steps, f"planning {store.name}")
    say_done(store, "planned", before, total)


if __name__ == "__main__":
    with orderly_end("run the same command again; it resumes"):
        tyro.cli(main)
