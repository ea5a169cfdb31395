"""``nextview scenes`` and ``nextview measure``: what stands around objects, and measures of their views."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from nextview.cli.progress import console, follow
from nextview.cli.stores import Split, Workers, track_all
from nextview.data import measuring, scene_drawing
from nextview.data.splits import some_objects
from nextview.data.store import ViewStore
from nextview.errors import DatasetError
from nextview.geometry.mesh import MAX_FACES

Level = Literal["light", "medium", "heavy"]


def scenes(
    meshes: Path,
    out: Path,
    /,
    level: tuple[Level, ...] = ("light", "medium", "heavy"),
    scenes: int | None = None,
    split: Split | None = None,
    held_out: Path | None = None,
    seed: int = 0,
    workers: Workers = Workers(),
) -> None:
    """Draw cluttered scenes: a target on a table among other objects, boxes and walls that hide parts of it.

    Each scene is a small JSON file that names meshes and says where they stand; the same seed draws the same files.
    Resumes where it was. Objects of one split stand only among objects of that split. Render them with nextview render
    OUT STORE --meshes MESHES, and go on as with any other store.

    Args:
        meshes: dataset folder, CLASS/train|test/MESH or CLASS/MESH.
        out: folder for the scenes; those that are there are kept.
        level: how much of the target shows, on the average over the 40 views: light 85 %, medium 65 %, heavy 45 %.
        scenes: how many at each level, of each split; by default one around each object.
        split: only this one.
        held_out: only around objects that the model of this card (NAME.json) calls held out of its training: scenes for
            learning policies.
        seed: decides which objects are targets, and all that stands around them.
        workers: who does the work.
    """
    total = len(scene_drawing.tasks(meshes, out, level, scenes, seed, split, held_out))
    drawn = scene_drawing.draw_scenes(meshes, out, level, scenes, seed, split, **vars(workers), held_out=held_out)
    failed = track_all(drawn, total, f"drawing {out.name}")
    if len(failed) == total:
        raise DatasetError(f"{out}: none of the {total} scenes can be drawn; see the reasons above")
    console.print(f"{out}: {total - len(failed)} scenes; next: nextview render {out} STORE --meshes {meshes}")


def measure(
    store: Path,
    meshes: Path | None = None,
    /,
    measures: tuple[str, ...] = (),
    max_faces: int = MAX_FACES,
    split: Split | None = None,
    held_out: str | None = None,
    objects: int | None = None,
    workers: Workers = Workers(),
    overwrite: bool = False,
) -> None:
    """Compute view measures of every rendered object and keep them in the store. Resumes where it was.

    Args:
        store: view store made by nextview render.
        meshes: the dataset folder that it was rendered from: measures that need the mesh find there which face each
            pixel shows.
        measures: names (see nextview list measures), all, or MODULE:FUNCTION for one of your own; by default all that
            need the depth alone, or with MESHES all.
        max_faces: of a mesh, as for nextview render.
        split: only this split.
        held_out: only the objects that this model, bundled or a card (NAME.json), calls held out of its training.
        objects: only so many of these, spread evenly; twice as many later hold the same.
        workers: who does the work.
        overwrite: measure anew what is there.
    """
    select = some_objects(ViewStore.open(store), split, held_out, objects)
    on = workers.workers, workers.scheduler
    follow(measuring.measure(store, measures, *on, meshes, max_faces, select, overwrite), f"measuring {store.name}")
