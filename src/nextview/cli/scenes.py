"""``nextview scenes``: draw cluttered scenes."""

from pathlib import Path
from typing import Literal

from nextview.cli.progress import console
from nextview.cli.stores import Split, Workers, track_all
from nextview.data import scene_drawing
from nextview.errors import DatasetError

Level = Literal["light", "medium", "heavy"]


def scenes(
    meshes: Path,  # dataset folder, CLASS/train|test/MESH or CLASS/MESH
    out: Path,  # folder for the scenes; those that are there are kept
    /,
    # how much of the target shows, on the average over the 40 views: light 85 %, medium 65 %, heavy 45 %
    level: tuple[Level, ...] = ("light", "medium", "heavy"),
    scenes: int | None = None,  # how many at each level, of each split; by default one around each object
    split: Split | None = None,  # only this one
    # only around objects that the model of this card (NAME.json) calls held out of its training: scenes for learning
    # policies
    held_out: Path | None = None,
    seed: int = 0,  # decides which objects are targets, and all that stands around them
    workers: Workers = Workers(),
) -> None:
    """Draw cluttered scenes: a target on a table among other objects, boxes and walls that hide parts of it.

    Each scene is a small JSON file that names meshes and says where they stand; the same seed draws the same files.
    Resumes where it was. Objects of one split stand only among objects of that split. Render them with nextview render
    OUT STORE --meshes MESHES, and go on as with any other store.
    """
    total = len(scene_drawing.tasks(meshes, out, level, scenes, seed, split, held_out))
    drawn = scene_drawing.draw_scenes(meshes, out, level, scenes, seed, split, **vars(workers), held_out=held_out)
    failed = track_all(drawn, total, f"drawing {out.name}")
    if len(failed) == total:
        raise DatasetError(f"{out}: none of the {total} scenes can be drawn; see the reasons above")
    console.print(f"{out}: {total - len(failed)} scenes; next: nextview render {out} STORE --meshes {meshes}")
