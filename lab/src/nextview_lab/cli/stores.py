"""``nextview-lab render`` and ``measure``: create and process view stores."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

from nextview.cli.common_options import NamedSplit, Workers
from nextview.cli.progress import console, follow, say_done, track_all
from nextview.errors import DatasetError
from nextview.geometry.viewsphere import ViewSphere
from nextview.recognition.model_card import RECOGNISER, find_card
from nextview_lab.data import measures as view_measures
from nextview_lab.data import rendering
from nextview_lab.data.splits import some_objects
from nextview_lab.data.store import ViewStore


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
    copies = made.duplicates
    if copies:
        console.print(
            f"{sum(map(len, copies)) - len(copies)} meshes are byte-identical copies of another one"
        )
    for group in copies:
        if len(set(made.labels[group])) > 1:
            same = " = ".join(
                f"{made.names[i]} ({made.classes[made.labels[i]]})" for i in group
            )
            console.print(f"one mesh, several labels: {same}", style="yellow")
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
        measures: names of measures (see nextview-lab list measures), or MODULE:FUNCTION for your
            own; by default all that need only the depth.
        split: measure only this split.
        held_out: measure only objects that this model (name or card) held out of its training.
        objects: measure only this number of evenly spaced objects; a later run with twice the
            number includes the same objects.
        overwrite: recompute existing values.
    """
    select = some_objects(ViewStore.open(store), split, held_out, objects)
    steps = view_measures.measure(
        store,
        measures,
        **vars(workers),
        objects=select,
        overwrite=overwrite,
    )
    before, total = follow(steps, f"measuring {store.name}")
    say_done(store, "measured", before, total)
