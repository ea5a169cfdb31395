"""What is not settled in a scene, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nextview.scene.next_view import (
    FEWEST_HIDDEN,
    SOME_POINTS,
    TABLE_CELL,
    TableGround,
    outline_of,
)
from nextview.scene.objects import SceneObject
from nextview.scene.unexplained import UnexplainedPatch
from nextview.types import Float


@dataclass(frozen=True, eq=False)
class OpenPoint:
    """Something in a scene on which another view may help.

    Attributes:
        number: of the object that is not settled; None for a part of the table.
        place: its middle, (3,), world, metres; None if it is not known.
        why: the reason, in words.
        in_sight: whether a view that is left would show it.
    """

    number: int | None
    place: Float | None
    why: str
    in_sight: bool = True

    def __repr__(self) -> str:
        """One line: ``3: few pixels show it; no view is left that shows it``."""
        why = (
            self.why if self.in_sight else f"{self.why}; no view is left that shows it"
        )
        return why if self.number is None else f"{self.number}: {why}"


def open_points(
    objects: Sequence[SceneObject],
    patches: Sequence[UnexplainedPatch],
    ground: TableGround | None,
    ground_seen: bool,
    cameras: Float,
) -> tuple[OpenPoint, ...]:
    """List what is not settled: objects, unexplained points, hidden ground.

    Args:
        objects: that were found.
        patches: parts of images that are neither ground nor an object.
        ground: top view of the table; None without an object.
        ground_seen: whether enough of the ground is visible to rule out further objects.
        cameras: positions of the views that are left, (K, 3), world.
    """
    found = []
    for one in objects:
        if not one.settled:
            shown = _in_sight(ground, outline_of(one), cameras)
            why = one.doubt or "no taught thing fits it; it is seen in one view only"
            found.append(OpenPoint(one.number, one.place, why, shown))
    for patch in patches:
        area = 1e4 * patch.area
        why = f"{area:.0f} square centimetres in view are neither ground nor an object"
        few = patch.points[:: max(1, len(patch.points) // SOME_POINTS)]
        shown = _in_sight(ground, few, cameras)
        found.append(OpenPoint(None, patch.points.mean(0), why, shown))
    if ground is None:
        if not (patches or ground_seen):
            why = "too little of the ground is seen"
            found.append(OpenPoint(None, None, why, len(cameras) > 0))
        return tuple(found)

    hidden = ground.largest_hidden
    if len(hidden) >= FEWEST_HIDDEN:
        area = 1e4 * len(hidden) * TABLE_CELL**2
        why = f"{area:.0f} square centimetres of the ground are hidden in all frames"
        shown = any(ground.visible(camera)[hidden].any() for camera in cameras)
        found.append(OpenPoint(None, ground.points[hidden].mean(0), why, shown))
    return tuple(found)


def _in_sight(ground: TableGround | None, points: Float, cameras: Float) -> bool:
    """Return True if any of some points, (N, 3), would be visible from any camera, (K, 3)."""
    if ground is None:
        return len(cameras) > 0
    return any(ground.past_others(camera, points).any() for camera in cameras)
