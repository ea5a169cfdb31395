"""``nextview-lab scenes``: generate random cluttered tables or rooms."""

from pathlib import Path
from typing import Literal

from nextview.cli.common_options import NamedSplit, Unit, Workers
from nextview.cli.progress import console, track_all
from nextview.errors import DatasetError, UsageError
from nextview_lab.data import room_drawing, scene_drawing

ClutterLevel = Literal["light", "medium", "heavy"]


def scenes(
    meshes: Path,
    out: Path,
    /,
    levels: tuple[ClutterLevel, ...] = ("light", "medium", "heavy"),
    scenes: int | None = None,
    split: NamedSplit | None = None,
    held_out: str | None = None,
    room: bool = False,
    unit: Unit | None = None,
    seed: int = 0,
    workers: Workers = Workers(),
) -> None:
    """Generate random scenes: a target among clutter on a table, or rooms.

    Each scene is a small JSON file with meshes and their poses; the same seed gives the same
    files. An interrupted run resumes. Objects of different splits are never mixed in a scene.
    Render the scenes with nextview-lab render OUT STORE --meshes MESHES, and use the store like any
    other.

    With --room a scene is a room as seen by a mobile robot: floor, walls, background furniture,
    life-size objects on the floor or on a table, and a level camera. A RoomCamera renders its
    frames (docs/cluttered_scenes.md).

    Args:
        meshes: dataset folder, CLASS/train|test/MESH or CLASS/MESH.
        out: folder of the scenes; existing scenes are kept.
        levels: clutter levels: the visible share of the target is 85 % (light), 65 % (medium) or
            45 % (heavy), averaged over the 40 views.
        scenes: number of scenes per level and split; by default one for each object.
        split: generate only scenes of this split.
        held_out: use only target objects that this model (name or card) held out of its training.
        room: generate rooms; without --unit, the ModelNet10 classes are scaled to usual sizes.
        unit: for rooms: unit of length of the mesh files; small objects then lie on a table, in any
            resting pose.
        seed: seed of the targets and the clutter.
    """
    if room:
        if held_out is not None or levels != ("light", "medium", "heavy"):
            raise UsageError(
                "--levels and --held-out are for cluttered tables, not for --room"
            )
        _draw_rooms(meshes, out, scenes, split, unit, seed, workers)
        return

    if unit is not None:
        raise UsageError(
            "--unit is for --room: on cluttered tables lengths are in object radii"
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


def _draw_rooms(
    meshes: Path,
    out: Path,
    rooms: int | None,
    split: str | None,
    unit: str | None,
    seed: int,
    workers: Workers,
) -> None:
    total = len(room_drawing.room_tasks(meshes, out, rooms, seed, split))
    drawn = room_drawing.draw_rooms(
        meshes,
        out,
        rooms,
        seed,
        split,
        unit,
        **vars(workers),
    )
    failed = track_all(drawn, total, f"drawing {out.name}")

    if len(failed) == total:
        raise DatasetError(
            f"{out}: none of the {total} rooms can be drawn; see the reasons above"
        )

    console.print(
        f"{out}: {total - len(failed)} rooms; next: frames of them, docs/cluttered_scenes.md#rooms"
    )
