"""All that a scene knows after some frames; each frame makes another one of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nextview.checks import number_of
from nextview.scene.changes import CameraError
from nextview.scene.next_view import FEWEST_HIDDEN, TableGround, is_sure
from nextview.scene.tracks import Track
from nextview.scene.unexplained import UnexplainedPatch, ground_seen, unexplained
from nextview.sensing.object_frame import Box
from nextview.sensing.tabletop import TableTop
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float

# objects that are verified in a frame at most, those with the most pixels first
MOST_VERIFIED = 20
EMPTY_WARNING = ViewWarning("empty", "nothing stands on the plane in this frame")
UNSEEN_GROUND = ViewWarning(
    "ground unseen",
    "no object is found, but less than half of the ground is seen: something may stand there",
)


@dataclass(frozen=True, eq=False)
class SceneState:
    """A scene after some frames.

    Attributes:
        region: where is looked; None: everywhere.
        tops: what each frame shows on the plane.
        tracks: the objects.
        cameras: by how much the pose of each frame is off, as far as the objects tell.
        touching: numbers of all pairs of objects that touch, the smaller number first.
        next_number: of the next object that is found.
        left_unknown: how many small objects of the last frame were not verified.
    """

    region: Box | None = None
    tops: tuple[TableTop, ...] = ()
    tracks: tuple[Track, ...] = ()
    cameras: tuple[CameraError, ...] = ()
    touching: frozenset[tuple[int, int]] = frozenset()
    next_number: int = 1
    left_unknown: int = 0

    @cached_property
    def unexplained(self) -> list[UnexplainedPatch]:
        """What is neither ground nor an object."""
        return unexplained(self.tops, self.tracks, self.region)

    @cached_property
    def ground_seen(self) -> bool:
        """Whether so much of the ground is seen that nothing else can stand there."""
        return ground_seen(self.tops, self.region)

    @cached_property
    def settled(self) -> bool:
        """Whether more views would tell little, by one frame at least."""
        if self.unexplained or not all(is_sure(track) for track in self.tracks):
            return False
        if not self.tracks:
            return self.ground_seen
        ground = TableGround.of(self.tops, self.tracks)
        return ground.largest_hidden < FEWEST_HIDDEN

    @property
    def around(self) -> Float:
        """Corners of all that is found, or else of what is unexplained, (N, 3), world, metres."""
        of_objects = [one.hull for each in self.tracks for one in each.thing.sightings]
        corners = of_objects or [patch.points for patch in self.unexplained]
        return np.concatenate([np.zeros((0, 3)), *corners])

    @property
    def remarks(self) -> tuple[ViewWarning, ...]:
        """What the frames leave open, or that nothing is there; none before the first frame."""
        remarks = []
        if self.left_unknown:
            small = number_of(self.left_unknown, "small object")
            what = f"{small} left unknown: at most {MOST_VERIFIED} objects are verified in a frame"
            remarks.append(
                ViewWarning("left unknown", f"{what}, the largest first", holds=False)
            )

        left_out = len(self.tops[-1].carried_by_none) if self.tops else 0
        if left_out:
            things = number_of(left_out, "thing")
            what = f"{things} in the last frame left out: no surface that is seen carries them"
            remarks.append(ViewWarning("left out", what, holds=False))

        if self.unexplained:
            area = 1e4 * sum(patch.area for patch in self.unexplained)
            what = f"{area:.0f} square centimetres in view are neither ground nor an object"
            why = "is the ground another plane, or is much of a thing not told apart?"
            remarks.append(ViewWarning("unexplained", f"{what}: {why}", holds=False))
        elif self.tops and not self.tracks and not left_out:
            remarks.append(EMPTY_WARNING if self.ground_seen else UNSEEN_GROUND)
        return tuple(remarks)
