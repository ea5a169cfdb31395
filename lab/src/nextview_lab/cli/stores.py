"""``nextview-lab render``, ``measure`` and ``predict``: make and use view stores."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from nextview.cli.progress import console, follow, track
from nextview.errors import DatasetError, ModelError, UsageError
from nextview.geometry.mesh import MAX_FACES
from nextview.geometry.viewsphere import ViewSphere
from nextview.recognition.model_card import RECOGNISER, find_card, find_models
from nextview_lab.data import measures as view_measures
from nextview_lab.data import predicting, rendering
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.splits import some_objects
from nextview_lab.data.store import ViewStore
from nextview_lab.data.surfaces import mesh_views

NamedSplit = Literal["train", "test", "val"]


@dataclass(frozen=True)
class Workers:
    """Parallel processes.

    Attributes:
        workers: number of processes; by default one per core.
        scheduler: address of a dask.distributed scheduler to use instead, such as
            tcp://HOST:8786.
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
    """Render the meshes of a dataset folder into a view store.

    The store holds a depth image of every object from every viewpoint. The layout of the folder is
    CLASS/SPLIT/MESH, SPLIT/CLASS/MESH or CLASS/MESH. An interrupted run resumes.

    Args:
        dataset: folder of meshes.
        store: view store to create or to complete.
        viewpoints: number of viewpoints.
        azimuths: views per ring; by default 8 for the 40 viewpoints and 12 for the 12.
        size: side of the square images, pixels.
        overwrite: replace a store with other objects or settings.
    """
    sphere = ViewSphere.named(viewpoints)
    sphere = sphere if azimuths is None else replace(sphere, azimuths=azimuths)
    if size % (side := find_card(RECOGNISER).input.size):
        takes = (
            f"the bundled networks take images whose side is a multiple of {side} pixels, such as"
            f" {2 * side}"
        )
        console.print(
            f"{takes}; those of {size} are for models of your own",
            style="yellow",
        )
    found = rendering.listing(dataset, how)
    console.print(found.summary())

    try:
        before = int(ViewStore.open(store).done.sum())
    except DatasetError:
        before = 0  # there is no store yet, or rendering reports the error
    jobs = rendering.render(
        dataset,
        store,
        sphere,
        size,
        how,
        **vars(workers),
        overwrite=overwrite,
    )
    track_all(jobs, len(found.entries), f"rendering {store.name}", before)
    made = ViewStore.open(store)
    done = int(made.done.sum())
    if not done:
        raise DatasetError(
            f"{store}: none of the {len(made)} meshes can be used; see the reasons above"
        )

    console.print(
        f"{store}: {done} of {len(made)} objects, {len(sphere)} views each",
        soft_wrap=True,
    )


def measure(
    store: Path,
    /,
    measures: tuple[str, ...] = (),
    meshes: Path | None = None,
    max_faces: int = MAX_FACES,
    split: NamedSplit | None = None,
    held_out: str | None = None,
    objects: int | None = None,
    workers: Workers = Workers(),
    overwrite: bool = False,
) -> None:
    """Compute view measures of every rendered object and write them to the store.

    An interrupted run resumes.

    Args:
        store: view store made by nextview-lab render.
        measures: names of measures (docs/measures.md), or MODULE:FUNCTION for your
            own; by default all that need only the depth or, with --meshes, all.
        meshes: dataset folder that the store was rendered from, for measures that need the meshes.
        max_faces: largest number of triangles in a mesh, as for nextview-lab render.
        split: measure only this split.
        held_out: measure only objects that this model (name or card) held out of its training.
        objects: measure only this number of evenly spaced objects; a later run with twice the
            number includes the same objects.
        overwrite: recompute existing values.
    """
    opened = ViewStore.open(store)
    views: view_measures.MeasuredViews = view_measures.depth_views
    if meshes is not None:
        views = mesh_views(opened, meshes, max_faces)
    steps = view_measures.measure(
        store,
        measures,
        **vars(workers),
        objects=some_objects(opened, split, held_out, objects),
        overwrite=overwrite,
        views=views,
    )
    before, total = follow(steps, f"measuring {store.name}")
    say_done(store, "measured", before, total)


def predict(
    store: Path,
    out: Path,
    /,
    split: NamedSplit | None = None,
    models: str = "modelnet10",
    recogniser: str | None = None,
    held_out: str | None = None,
    maps: tuple[str, ...] | None = None,
    by_shape: bool = False,
    workers: Workers = Workers(),
    overwrite: bool = False,
) -> None:
    """Run the recogniser and the map networks over every view of a store, once.

    An interrupted run resumes.

    Args:
        store: view store made by nextview-lab render.
        out: file of predictions to write (.npz); nextview-lab benchmark classes replays policies on
            it.
        split: predict only this split.
        models: name of bundled models, or folder of your own models.
        recogniser: recogniser to use instead: name of a bundled model, or path of a card.
        held_out: predict only objects that this model (name or card) held out of its training.
        maps: maps to predict with these models, or NAME=CARD for other networks; by default all
            maps of the models that are of the viewpoints of the store; without a value none.
        by_shape: ignore the size of the objects. By default size counts as evidence if the store
            has it (nextview-lab render --unit) and the card of the recogniser has a size model
            (nextview-lab fit size).
        overwrite: replace existing predictions.
    """
    if out.suffix != ".npz":
        raise UsageError(f"{out}: predictions are one .npz file; end the name in .npz")

    found = find_models(models)
    cards = {}
    for item in found.maps if maps is None else maps:
        name, _, card = item.partition("=")
        if not card and name not in found.maps:
            raise ModelError(
                f"no network of {models} predicts the map {name!r}; there are"
                f" {', '.join(found.maps)}"
            )
        cards[name] = find_card(card or found.maps[name])
    if maps is None:
        views = ViewStore.open(store)
        every = list(cards)
        cards = predicting.fitting(cards, views)
        if left_out := ", ".join(name for name in every if name not in cards):
            console.print(
                f"the maps {left_out} of {models} are of other views than the {len(views.sphere)}"
                f" of {store}: they are not predicted",
                style="yellow",
                soft_wrap=True,
            )

    what = (
        find_card(recogniser or found.recogniser),
        cards,
        split,
        held_out,
        not by_shape,
    )
    follow(
        predicting.predict(store, out, *what, **vars(workers), overwrite=overwrite),
        f"predicting {store.name}",
    )

    for line in summed_up(Predictions.load(out)):
        console.print(line)
    console.print(
        f"predictions in {out}; compare policies with: nextview-lab benchmark classes {out}"
        " RESULTS",
        soft_wrap=True,
    )


def summed_up(p: Predictions) -> list[str]:
    """Describe the accuracy in each split, for single views and for all views together."""
    lines: list[str] = []
    right = p.logits.argmax(2) == p.labels[:, None]
    fused = p.logits.sum(1).argmax(1) == p.labels

    for split in np.unique(p.splits):
        here = p.splits == split
        shares = (
            f"right from one view {right[here].mean():.3f}, from all {len(p.sphere)}"
            f" {fused[here].mean():.3f}"
        )
        lines.append(f"{here.sum()} {split} objects: {shares}".replace("  ", " "))

    return lines


def track_all(
    done: Iterable[tuple[str, str | None]],
    total: int,
    what: str,
    before: int = 0,
) -> list[str]:
    """Show the progress of a job and print the reasons of failed items.

    Args:
        done: name of each finished item, with None or the reason why it failed.
        total: number of items.
        what: name of the work.
        before: number of items that were finished before this run.

    Returns:
        The reasons of the failed items.
    """
    failed: list[str] = []

    def counts() -> Iterator[int]:
        for n, (_, reason) in enumerate(done, before + 1):
            failed.extend([reason] if reason else [])
            yield n

    track(counts(), total, what)
    for reason in failed:
        console.print(reason, style="yellow", soft_wrap=True)
    return failed


def say_done(where: Path, done: str, before: int, total: int) -> None:
    """Print a summary of a run of a resumable stage.

    Args:
        where: output of the stage.
        done: participle of the work, such as "measured" or "planned".
        before: number of objects that were finished before this run.
        total: number of all objects.
    """
    if before == total:
        console.print(
            f"{where}: nothing was left to do; all {total} objects were {done} before",
            soft_wrap=True,
        )
        return
    earlier = f", {before} were before" if before else ""
    console.print(
        f"{where}: {total - before} of {total} objects {done} now{earlier}",
        soft_wrap=True,
    )
