"""``nextview render`` and ``nextview check``: view stores."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from nextview.cli.progress import console, track
from nextview.data import checking, rendering
from nextview.data.store import ViewStore
from nextview.errors import DatasetError
from nextview.geometry.viewsphere import ViewSphere

Split = Literal["train", "test", "val"]


@dataclass(frozen=True)
class Workers:
    """Who does the work.

    Attributes:
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler to use instead, as tcp://HOST:8786.
    """

    workers: int | None = None
    scheduler: str | None = None


def render(
    dataset: Path,
    store: Path,
    /,
    viewpoints: Literal["40", "12"] = "40",
    azimuths: int | None = None,
    size: int = 224,
    how: rendering.RenderOptions = rendering.RenderOptions(),
    workers: Workers = Workers(),
    overwrite: bool = False,
) -> None:
    """Render a dataset folder (CLASS/SPLIT/MESH, SPLIT/CLASS/MESH or CLASS/MESH) into a view store; resumes.

    A folder of scenes (nextview scenes) makes a store too: of what shows of each target, and of the scene around it.

    Args:
        dataset: folder of meshes, or of scenes.
        store: the store to make or to complete.
        viewpoints: from where it is seen.
        azimuths: views on each ring, if not 8 of the 40 and 12 of the 12.
        size: side of the images, pixels.
        how: what is rendered, and how.
        workers: who does the work.
        overwrite: replace a store of other objects or settings.
    """
    sphere = ViewSphere.named(viewpoints)
    sphere = sphere if azimuths is None else replace(sphere, azimuths=azimuths)
    found = rendering.listing(dataset, how)
    console.print(found.summary())
    try:
        before = int(ViewStore.open(store).done.sum())
    except DatasetError:
        before = 0  # there is none yet, or rendering says what is wrong
    jobs = rendering.render(dataset, store, sphere, size, how, **vars(workers), overwrite=overwrite)
    track_all(jobs, len(found.entries), f"rendering {store.name}", before)
    made = ViewStore.open(store)
    done, copies = int(made.done.sum()), made.duplicates
    if copies:
        console.print(f"{sum(map(len, copies)) - len(copies)} meshes are byte-identical copies of another one")
    for group in copies:
        if len(set(made.labels[group])) > 1:
            same = " = ".join(f"{made.names[i]} ({made.classes[made.labels[i]]})" for i in group)
            console.print(f"one mesh, several labels: {same}", style="yellow")
    if not done:
        raise DatasetError(f"{store}: none of the {len(made)} meshes can be used; see the reasons above")
    console.print(f"{store}: {done} of {len(made)} objects, {len(sphere)} views each", soft_wrap=True)


def check(store: Path, /, repair: bool = False, workers: Workers = Workers()) -> None:
    """Read every object of a view store and hold its arrays against each other. Ends with status 2 if one is damaged.

    Args:
        store: view store made by nextview render.
        repair: take damaged objects out, so that the next nextview render makes them anew.
        workers: who does the work.
    """
    views = ViewStore.open(store)
    done = int(views.done.sum())
    damaged = track_all(checking.check(store, repair, **vars(workers)), done, f"checking {store.name}")
    for reason in views.failures.values():
        console.print(f"left out: {reason}", style="yellow")
    for name, held in checking.incomplete(store).items():
        console.print(f"{name}: of {held} of {done} objects only", style="yellow")
    missing = len(views) - done - len(views.failures)
    console.print(f"{store}: {done - len(damaged)} objects are sound, {len(damaged)} damaged, {missing} not rendered")
    if damaged:
        what = ("" if repair else "with --repair, ") + "nextview render makes them anew"
        raise DatasetError(f"{store}: {len(damaged)} of {done} objects are damaged; {what}")


def track_all(done: Iterable[tuple[str, str | None]], total: int, what: str, before: int = 0) -> list[str]:
    """Follow a job that yields what is done, and why it failed; return and print the reasons."""
    failed: list[str] = []

    def counts() -> Iterator[int]:
        for n, (_, reason) in enumerate(done, before + 1):
            failed.extend([reason] if reason else [])
            yield n

    track(counts(), total, what)
    for reason in failed:
        console.print(reason, style="yellow", soft_wrap=True)
    return failed
