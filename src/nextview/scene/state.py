"""Immutable state of a scene; each frame creates a new one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nextview.checks import number_of
from nextview.geometry.axes import upright_axes
from nextview.scene.changes import CameraError
from nextview.scene.next_view import TableGround
from nextview.scene.objects import SceneObject
from nextview.scene.unexplained import UnexplainedPatch, ground_seen, unexplained
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.sensing.tabletop import TableTop
from nextview.sensing.view_warning import ViewWarning
from nextview.session.tracks import Track

# largest number of objects verified per frame, those with the most pixels first
MOST_VERIFIED = 20
EMPTY_WARNING = ViewWarning("empty", "nothing stands on the plane in this frame")
UNSEEN_GROUND = ViewWarning(
    "ground unseen",
    "no object is found, but less than half of the ground is seen: something may stand there",
)


@dataclass(frozen=True, eq=False)
class SceneState:
    """State of a scene after some frames.

    Attributes:
        region: search region; None for everywhere.
        tops: support surfaces of each frame.
        tracks: the objects.
        cameras: error of the pose of each frame.
        touching: numbers of all pairs of objects that touch, the smaller number first.
        next_number: number of the next new object.
        left_unknown: number of small objects in the last frame that were not verified.
    """

    region: Box | None = None
    tops: tuple[TableTop, ...] = ()
    tracks: tuple[Track, ...] = ()
    cameras: tuple[CameraError, ...] = ()
    touching: frozenset[tuple[int, int]] = frozenset()
    next_number: int = 1
    left_unknown: int = 0

    @property
    def objects(self) -> tuple[SceneObject, ...]:
        """The objects as users see them, in the order in which they were found."""
        tracks = sorted(self.tracks, key=lambda track: track.number)
        return tuple(SceneObject.of(track, self.touching) for track in tracks)

    @cached_property
    def ground(self) -> TableGround | None:
        """Top view of the table, and what of it is hidden; None without an object."""
        return TableGround.of(self.tops, self.tracks) if self.tracks else None

    @cached_property
    def unexplained(self) -> list[UnexplainedPatch]:
        """Points that are neither ground nor an object."""
        return unexplained(self.tops, self.tracks, self.region)

    @cached_property
    def ground_seen(self) -> bool:
        """True if enough of the ground is visible to rule out further objects."""
        return ground_seen(self.tops, self.region)

    @property
    def around(self) -> ObjectFrame | None:
        """What views are taken of; None before the first frame.

        The objects together; or else unexplained points, the region, or the ground.
        """
        if not self.tops:
            return None
        of_objects = [one.hull for each in self.tracks for one in each.thing.sightings]
        corners = of_objects or [patch.points for patch in self.unexplained]
        if not corners and self.region is not None:
            corners = [np.stack([self.region.low, self.region.high]) @ self.region.axes]
        if not corners:
            corners = [self.tops[-1].seen.surface_samples.points]
        points = np.concatenate(corners)
        middle = (points.min(0) + points.max(0)) / 2
        radius = float(np.linalg.norm(points - middle, axis=1).max())
        return ObjectFrame(middle, radius, upright_axes(self.tops[0].up))

    @property
    def remarks(self) -> tuple[ViewWarning, ...]:
        """Open issues, or a remark that nothing was found; empty before the first frame."""
        remarks = []
        if self.left_unknown:
            small = number_of(self.left_unknown, "small object")
            what = f"{small} left unknown: at most {MOST_VERIFIED} objects are verified in a frame"
            remarks.append(
                ViewWarning("left unknown", f"{what}, the largest first", holds=False)
            )

        left_out = len(self.tops[-1].seen.carried_by_none) if self.tops else 0
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
