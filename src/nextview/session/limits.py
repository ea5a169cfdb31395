"""Exclude candidate views that are unsafe according to the frames."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.checks import number, one_line
from nextview.errors import UsageError
from nextview.sensing.object_frame import ObjectFrame
from nextview.session.surroundings import Surroundings
from nextview.types import Float, Mask

LOWEST_VIEW = 0.08
"""Metres above the support plane: clearance for a wrist camera, its mount and the gripper."""
GRAZING = 0.1
"""Least height above the support plane as a share of the distance to the object, about 6 degrees.

From a lower viewpoint the plane degenerates to a line.
"""
HIGHEST = 2.0
"""Metres above the support plane: beyond the reach of most robots."""
MOST_METRES = 10.0
"""Larger heights and clearances are likely to be in another unit."""
VIEW_CLEARANCE = 0.1  # metres between the camera and what the frames show
TOO_LOW = "too low"
TOO_HIGH = "too high"
TOO_NEAR = "too near to something"
BEHIND_SOMETHING = "behind something"
BEHIND_WALL = "behind a wall"


@dataclass(frozen=True)
class Limits:
    """Limits on the camera positions of a session or a scene; the defaults suit most robots.

    Heights are measured from the support plane, if it is known. Surfaces in the frames exclude
    views if the object rests on a support plane. In a gripper or on a turntable
    (``ObservedObject(support=False)``) the surroundings move relative to the object, and only an
    explicit clearance is applied.

    Attributes:
        min_height: least height of the camera above the support plane, metres. By default 0.08, and
            a tenth of the camera's distance from the object.
        max_height: largest height of the camera above the support plane, metres; infinity for no
            limit. By default 2, or the greatest height of the camera so far.
        clearance: least distance between the camera and any surface in the frames, except the
            object and the support plane, metres. Views behind walls and other objects are excluded
            too. 0 disables these tests. By default 0.1.
    """

    min_height: float | None = None
    max_height: float | None = None
    clearance: float | None = None

    def __post_init__(self) -> None:
        if self.min_height is not None:
            number(
                self.min_height,
                "the least height of a camera, metres,",
                most=MOST_METRES,
            )
        if self.max_height is not None and self.max_height != np.inf:
            what = "the greatest height of a camera, metres, or infinity for none,"
            number(
                self.max_height,
                what,
                most=MOST_METRES,
                above=self.min_height or 0.0,
            )
        if self.clearance is not None:
            number(self.clearance, "the clearance of a camera, metres,", 0, MOST_METRES)

    @classmethod
    def none(cls) -> "Limits":
        """Return limits that allow every camera position."""
        return cls(min_height=-1e6, max_height=np.inf, clearance=0.0)

    def reasons(
        self,
        poses: Float,
        around: ObjectFrame,
        surroundings: Sequence[Surroundings],
        rests: bool = True,
    ) -> NDArray[np.str_]:
        """Return the reason why each candidate is excluded.

        Args:
            poses: of the candidates, camera-to-world, metres, (V, 4, 4).
            around: frame of the object, or of all objects of a scene, which the camera looks at.
            surroundings: of the object in each frame, at least one.
            rests: whether it rests on a support plane, so that its surroundings rest, too.

        Returns:
            (V,) of ``TOO_LOW``, ``TOO_HIGH``, ``TOO_NEAR``, ``BEHIND_SOMETHING``, ``BEHIND_WALL``,
            or "" for allowed candidates.
        """
        places = poses[:, :3, 3]
        found = np.full(len(poses), "", f"<U{len(TOO_NEAR)}")
        for reason, holds in self._occupied(places, around, surroundings, rests):
            found[holds] = reason

        planes = [shown.plane for shown in surroundings if shown.plane is not None]
        if not planes:
            return found

        height = np.median([plane.height(places) for plane in planes], axis=0)
        away = np.linalg.norm(places - around.centre, axis=1)
        lowest = (
            np.maximum(LOWEST_VIEW, GRAZING * away)
            if self.min_height is None
            else self.min_height
        )
        highest = self.max_height
        if highest is None:
            stood = [shown.frame.camera_to_world[:3, 3] for shown in surroundings]
            highest = max(HIGHEST, float(np.max(planes[-1].height(np.array(stood)))))
        found[height < lowest] = TOO_LOW
        found[height > highest] = TOO_HIGH
        return found

    def _occupied(
        self,
        places: Float,
        around: ObjectFrame,
        surroundings: Sequence[Surroundings],
        rests: bool,
    ) -> list[tuple[str, Mask]]:
        """Return reasons and excluded positions from the frames; later entries take precedence."""
        clearance = self.clearance
        if clearance is None:
            clearance = VIEW_CLEARANCE if rests else 0.0
        if clearance == 0:
            return []

        nothing = np.zeros(len(places), bool)
        walls = nothing
        near = nothing
        free = nothing
        hidden = nothing
        for shown in surroundings:
            for wall in shown.walls:
                if not any(other.shows_behind(wall) for other in surroundings):
                    walls = walls | (wall.height(places) < clearance)
            near = near | shown.is_near(places, around, clearance)
            looked_through, not_seen = shown.look_at(places, around, clearance / 2)
            free = free | looked_through
            hidden = hidden | not_seen
        return [
            (BEHIND_SOMETHING, hidden & ~free),
            (BEHIND_WALL, walls),
            (TOO_NEAR, near),
        ]


def checked_limits(given: Limits) -> Limits:
    """Return limits passed in by a user.

    Raises:
        UsageError: they are none.
    """
    if not isinstance(given, Limits):
        raise UsageError(
            f"limits are a nextview.session.limits.Limits, not {one_line(repr(given))}"
        )
    return given


def in_words(reasons: Sequence[str]) -> str:
    """Summarise the excluded candidates: ``12 too low, 3 behind a wall``."""
    counts = Counter(reason for reason in reasons if reason)
    return ", ".join(f"{count} {reason}" for reason, count in counts.most_common())
