"""What is not settled in a scene, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nextview.scene.next_view import FEWEST_HIDDEN, TABLE_CELL, TableGround
from nextview.scene.tracks import ENOUGH_VIEWS, Track
from nextview.scene.unexplained import UnexplainedPatch
from nextview.types import Float


@dataclass(frozen=True, eq=False)
class OpenPoint:
    """Something in a scene on which another view may help.

    Attributes:
        number: of the object that is not settled; None for a part of the table.
        place: its middle, (3,), world, metres; None if it is not known.
        why: the reason, in words.
    """

    number: int | None
    place: Float | None
    why: str

    def __repr__(self) -> str:
        """One line: ``3: its name is not confident, belief 0.731``."""
        return self.why if self.number is None else f"{self.number}: {self.why}"


def open_points(
    tracks: Sequence[Track],
    patches: Sequence[UnexplainedPatch],
    ground: TableGround | None,
    ground_seen: bool,
) -> tuple[OpenPoint, ...]:
    """List what is not settled: objects, unexplained points, hidden ground.

    Args:
        tracks: the objects.
        patches: parts of images that are neither ground nor an object.
        ground: top view of the table; None without an object.
        ground_seen: whether enough of the ground is visible to rule out further objects.
    """
    found = [
        OpenPoint(track.number, track.thing.object_frame.centre, _why(track))
        for track in sorted(tracks, key=lambda track: track.number)
        if not track.settled
    ]
    for patch in patches:
        area = 1e4 * patch.area
        why = f"{area:.0f} square centimetres in view are neither ground nor an object"
        found.append(OpenPoint(None, patch.points.mean(0), why))
    if ground is None:
        if not (patches or ground_seen):
            found.append(OpenPoint(None, None, "too little of the ground is seen"))
        return tuple(found)

    hidden = ground.largest_hidden
    if len(hidden) >= FEWEST_HIDDEN:
        area = 1e4 * len(hidden) * TABLE_CELL**2
        why = f"{area:.0f} square centimetres of the ground are hidden in all frames"
        found.append(OpenPoint(None, ground.points[hidden].mean(0), why))
    return tuple(found)


def _why(track: Track) -> str:
    """Reason why an object is not settled."""
    result = track.result
    if result is None:
        return "it was not compared with the things"
    if result.doubt:
        return result.doubt
    if result.answer is not None:
        return f"its name is not confident, belief {result.confidence:.3f}"
    if track.lately_named:
        return "it had a name before the last frame that shows it"
    if len(track.frames) < ENOUGH_VIEWS:
        return "it fits none of the things, in a single view"
    return "its name is not confident"
