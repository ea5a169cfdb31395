"""Immutable state of a scene; each frame creates a new one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from nextview.checks import number_of
from nextview.geometry.axes import upright_axes
from nextview.scene.next_view import TableGround
from nextview.scene.objects import SceneObject, objects_of
from nextview.scene.unexplained import UnexplainedPatch, ground_seen, unexplained
from nextview.sensing.known_frames import NEAR_RANGE
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.sensing.tabletop import TableTop
from nextview.sensing.view_warning import ViewWarning
from nextview.things.world import World

EMPTY_WARNING = ViewWarning("empty", "nothing stands on the plane in this frame")
UNSEEN_GROUND = ViewWarning(
    "ground unseen",
    "no object is found, but less than half of the ground is seen: something may stand there",
)


@dataclass(frozen=True, eq=False)
class SceneState:
    """State of a scene after some frames.

    Attributes:
        world: what explains the frames.
        region: search region; None for everywhere.
        tops: support surfaces of each frame.
        objects: the objects, in the order in which they were found.
        ruled_out: names that objects cannot have, with the reasons, by their numbers.
    """

    world: World
    region: Box | None = None
    tops: tuple[TableTop, ...] = ()
    objects: tuple[SceneObject, ...] = ()
    ruled_out: Mapping[int, Mapping[str, str]] = field(default_factory=dict)

    def with_objects(self, ruled_out: Mapping[int, Mapping[str, str]]) -> SceneState:
        """Return the scene with the objects that its world shows.

        Args:
            ruled_out: names that objects cannot have, with the reasons, by their numbers.
        """
        objects = objects_of(self.world, self.tops, ruled_out)
        return replace(self, objects=objects, ruled_out=ruled_out)

    def with_room(self) -> SceneState:
        """Return the scene with room for another frame, if need be without an earlier one."""
        number = self.world.redundant()
        if number is None:
            return self
        tops = tuple(top for k, top in enumerate(self.tops) if k != number)
        return replace(self, world=self.world.without_view(number), tops=tops)

    @cached_property
    def ground(self) -> TableGround | None:
        """Top view of the table, and what of it is hidden; None without an object."""
        return TableGround.of(self.tops, self.objects) if self.objects else None

    @cached_property
    def unexplained(self) -> list[UnexplainedPatch]:
        """Points that are neither ground nor an object."""
        return unexplained(self.world, self.tops, self.region)

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
        corners = [one.seen_points for one in self.objects]
        corners = corners or [patch.points for patch in self.unexplained]
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
        left_out = len(self.tops[-1].seen.carried_by_none) if self.tops else 0
        if left_out:
            things = number_of(left_out, "thing")
            what = f"left out: {things} standing on nothing visible"
            remarks.append(ViewWarning("left out", what, holds=False))

        if self.unexplained:
            area = 1e4 * sum(patch.area for patch in self.unexplained)
            what = f"{area:.0f} square centimetres in view are neither ground nor an object"
            why = "is the ground another plane, or did the segmentation miss things?"
            remarks.append(ViewWarning("unexplained", f"{what}: {why}", holds=False))
        if remarks and not self.objects:
            depth = self.tops[-1].frame.depth
            middle = float(np.median(depth[depth > 0]))
            what = f"no object is found, and the depth has a median of {middle:.2g} m:"
            remarks.append(ViewWarning("unit", f"{what} is its unit right?", False))
        elif self.tops and not self.objects:
            remarks.append(EMPTY_WARNING if self.ground_seen else UNSEEN_GROUND)
        return (*remarks, *self._near_and_small())

    def _near_and_small(self) -> list[ViewWarning]:
        """Warn if all that is seen is both too near and too small for what is known.

        Either alone may be right: a camera for short distances, or a table of small strangers.
        """
        if not self.objects:
            return []
        middle = self.tops[-1].frame.depth_range[1]
        largest = max(float(np.linalg.norm(one.size)) for one in self.objects)
        smallest = 2 * float(self.world.library.radii.min())
        # a thing may be seen from its small end
        if not NEAR_RANGE[1] <= middle < NEAR_RANGE[0] or largest > smallest / 2:
            return []
        message = (
            f"the depth has a median of {100 * middle:.0f} cm, and the largest object in sight"
            f" measures {100 * largest:.1f} cm, the smallest known one {100 * smallest:.1f} cm: is"
            " the depth several times too small, as by a wrong depth scale?"
        )
        return [ViewWarning("unit", message, holds=False)]
