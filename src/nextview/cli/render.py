"""``nextview render``: every view of every object of a dataset, into one store."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from nextview.cli.recognise import Unit
from nextview.errors import DatasetError
from nextview.mesh_format import MAX_FACES


def render(
    dataset: tyro.conf.Positional[Path],
    store: tyro.conf.Positional[Path],
    /,
    sphere: Literal["40", "12"] = "40",
    azimuths: int | None = None,
    size: int = 224,
    split: Literal["train", "test"] | None = None,
    stretch: float = 0.0,
    turn: bool = False,
    unit: Unit | None = None,
    sensor: str | None = None,
    held_out: Path | None = None,
    meshes: Path | None = None,
    max_faces: int = MAX_FACES,
    seed: int = 0,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Render a dataset folder (CLASS/train|test/MESH or CLASS/MESH) into a view store. Resumes where it was.

    A folder of worlds (nextview worlds) makes a store too: of what shows of each target, and of the scene around it.

    Args:
        dataset: folder of meshes, or of worlds.
        store: the store to make or to complete.
        sphere: viewpoints.
        azimuths: views on each ring, if not the sphere's own.
        size: side of the images, pixels.
        split: only this split.
        stretch: scale each axis of each mesh by a random factor between 1/(1 + STRETCH) and 1 + STRETCH.
        turn: turn each mesh about the vertical by a random angle.
        unit: of length in the mesh files, so that the store knows how large the objects are (ModelNet: inch). Not
            known by default; a store that was made without can be told later.
        sensor: look through a sensor with all its errors: kinect, stereo, setup, wrist, none, or a mix of all that is
            drawn anew for each object; or NAME:STRENGTH (docs/your_camera.md). Clean renders if not given.
        held_out: only the objects that the model of this card (NAME.json) calls held out of its training.
        meshes: of worlds: the folder of the meshes that they are made of.
        max_faces: leave out a mesh of more triangles, or a file of more than 60 bytes for each of these.
        seed: decides the stretch and the turn of each mesh, and the errors of a sensor.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler to use instead, as tcp://HOST:8786.
    """
    from dataclasses import replace

    from nextview.cli.progress import console, track
    from nextview.data.rendering import Deform, entries_of
    from nextview.data.rendering import render as render_dataset
    from nextview.data.store import ViewStore
    from nextview.viewsphere import ViewSphere

    views = ViewSphere.named(sphere)
    if azimuths is not None:
        views = replace(views, azimuths=azimuths)
    total = len(entries_of(dataset, split, held_out, meshes))
    try:
        before = int(ViewStore.open(store).done.sum())
    except DatasetError:
        before = 0  # there is none yet, or rendering mends it or says what is wrong
    new = Deform(stretch, turn)
    jobs = render_dataset(
        dataset, store, views, size, seed, new, split, unit, workers, scheduler, max_faces, sensor, held_out, meshes
    )
    track((before + n for n, _ in enumerate(jobs, 1)), total, f"rendering {store.name}", before, len(views))

    made = ViewStore.open(store)
    for reason in made.failures.values():
        console.print(f"left out: {reason}", style="yellow", highlight=False)
    labels = [made.classes[label] for label in made.labels]
    duplicates = made.duplicates
    if duplicates:
        console.print(f"{sum(map(len, duplicates)) - len(duplicates)} meshes are byte-identical copies of another one")
    for group in duplicates:
        if len({labels[i] for i in group}) > 1:
            same = " = ".join(f"{made.names[i]} ({labels[i]})" for i in group)
            console.print(f"one mesh, several labels: {same}", style="yellow", highlight=False)
    done = int(made.done.sum())
    console.print(f"{store}: {done} of {total} objects, {len(views)} views each")
    if not done:
        raise DatasetError(f"{store}: none of the {total} meshes can be used; see the reasons above")
