"""``nextview scenes``: draw cluttered scenes, or rooms."""

from pathlib import Path
from typing import Literal

from nextview.cli.common_options import NamedSplit, Unit, Workers
from nextview.cli.progress import console, track_all
from nextview.data import room_drawing, scene_drawing
from nextview.errors import DatasetError, UsageError

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
    """Draw cluttered scenes around targets on a table, or rooms.

    Each scene is a small JSON file that names meshes and says where they stand; the same seed draws
    the same files. An interrupted run resumes. Objects of one split stand only among objects of
    that split. Render them with nextview render OUT STORE --meshes MESHES, and go on as with any
    other store.

    With --room a scene is a room as a mobile robot sees it: floor, walls, furniture in the
    background, objects of life size on the floor or on a table, and a level camera. A RoomCamera
    renders its frames (docs/scenes.md).

    Args:
        meshes: dataset folder, CLASS/train|test/MESH or CLASS/MESH.
        out: folder of the scenes; existing scenes are kept.
        levels: levels of clutter: the visible share of the target is 85 % (light), 65 % (medium) or
            45 % (heavy), averaged over the 40 views.
        scenes: number of scenes at each level and of each split; by default one around each object.
        split: draw only scenes of this split.
        held_out: draw only scenes around objects that this model (name or card) held out of its
            training.
        room: draw rooms; without --unit, with ModelNet10's classes at usual sizes.
        unit: for rooms: unit of length of the mesh files; small objects then lie on a table, in any
            resting pose.
        seed: seed of the targets and of everything around them.
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
        f"{out}: {total - len(failed)} scenes; next: nextview render {out} STORE --meshes {meshes}"
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
        f"{out}: {total - len(failed)} rooms; next: frames of them, docs/scenes.md#rooms"
    )
