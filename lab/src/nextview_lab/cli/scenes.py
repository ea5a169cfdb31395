"""``nextview-lab scenes``: generate random cluttered tables and rooms."""

from pathlib import Path

from nextview.cli.common_options import NamedSplit, Unit, Workers
from nextview.cli.progress import console, track_all
from nextview.errors import DatasetError, UsageError
from nextview_lab.data import scene_drawing
from nextview_lab.worlds.scene_layout import CLUTTER_LEVELS, ROOM


def scenes(
    meshes: Path,
    out: Path,
    /,
    levels: tuple[str, ...] = tuple(CLUTTER_LEVELS),
    scenes: int | None = None,
    split: NamedSplit | None = None,
    held_out: str | None = None,
    unit: Unit | None = None,
    seed: int = 0,
    workers: Workers = Workers(),
) -> None:
    """Generate random scenes: a target among clutter on a table, or in a room.

    Each scene is a small JSON file with meshes and their poses; the same seed gives the same
    files. An interrupted run resumes. Objects of different splits are never mixed in a scene.
    Render the scenes with nextview-lab render OUT STORE --meshes MESHES, and use the store like any
    other.

    With --levels room a scene is a room as seen by a mobile robot: floor, walls, furniture,
    life-size objects on the floor or on a table, and a level camera. A RoomCamera renders its
    frames (docs/cluttered_scenes.md).

    Args:
        meshes: dataset folder, CLASS/train|test/MESH or CLASS/MESH.
        out: folder of the scenes; existing scenes are kept.
        levels: light, medium, heavy or room: the visible share of the target is 85 % (light), 65 %
            (medium) or 45 % (heavy), averaged over the 40 views; in a room, things are life-size.
        scenes: number of scenes per level and split; by default one for each object.
        split: generate only scenes of this split.
        held_out: use only target objects that this model (name or card) held out of its training.
        unit: for rooms: unit of length of the mesh files; small objects then lie on a table, in any
            resting pose. Without it, the ModelNet10 classes are scaled to usual sizes.
        seed: seed of the targets and the clutter.
    """
    if unit is not None and levels != (ROOM,):
        raise UsageError(
            "--unit is for --levels room: on cluttered tables lengths are in object radii"
        )
    total = len(scene_drawing.tasks(meshes, out, levels, scenes, seed, split, held_out))
    drawn = scene_drawing.draw_scenes(
        meshes,
        out,
        levels,
        scenes,
        seed,
        split,
        **vars(workers),
        held_out=held_out,
        unit=unit,
    )

    failed = track_all(drawn, total, f"drawing {out.name}")
    if len(failed) == total:
        raise DatasetError(
            f"{out}: none of the {total} scenes can be drawn; see the reasons above"
        )
    console.print(
        f"{out}: {total - len(failed)} scenes; next: nextview-lab render {out} STORE"
        f" --meshes {meshes}"
    )
