"""Detect repeated images, as from a camera that hangs: they are one piece of evidence, not two."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import angle_between, direction_of
from nextview.sensing.frame import Frame
from nextview.sensing.plausibility import check_views
from nextview.sensing.view_warning import ViewWarning
from nextview.session.episode import VISITED_ANGLE

if TYPE_CHECKING:
    from nextview.sensing.observed_object import ObjectState

ADVICE = (
    "this picture was handed in before, to the last bit, "
    "and counts once: does the camera hang?"
)
REPEATED = ViewWarning("repeated", ADVICE)
# tolerance for the third rows of two poses that differ only by a rotation about the vertical
SAME_THIRD_ROW = 1e-4


def is_repeated(seen: Observation, earlier: Sequence[Observation]) -> bool:
    """Return True if an observation repeats the image of an earlier one.

    Args:
        seen: the observation.
        earlier: the earlier observations.
    """
    return any(
        np.array_equal(one.depth, seen.depth) and _is_one_picture(one, seen)
        for one in earlier
    )


def after_repeated(
    state: "ObjectState",
    frame: Frame,
    first: int,
) -> "ObjectState | None":
    """Return the state of an object after a frame that repeats an earlier one.

    No two images of a depth camera are bitwise identical, so such a frame was not captured at its
    stated pose. The earlier sighting is used in its place.

    Args:
        state: before the frame.
        frame: the frame.
        first: index of the first sighting to compare with.

    Returns:
        The state; None if the frame is no repetition.
    """
    for sighting, seen in list(zip(state.sightings, state.observations, strict=True))[
        first:
    ]:
        if frame.pose is not None and np.array_equal(sighting.frame.depth, frame.depth):
            return replace(
                state,
                sightings=(*state.sightings, sighting),
                observations=(*state.observations, seen),
                warnings=(REPEATED,),
            )
    return None


def _is_one_picture(first: Observation, second: Observation) -> bool:
    """Return True if two observations with the same depth are the same image.

    Two renders of a symmetric object may also be identical, but only after a rotation about the
    vertical.
    """
    if not first.seen:
        return False
    near = (
        angle_between(direction_of(first.pose), direction_of(second.pose))
        <= VISITED_ANGLE
    )
    return bool(
        near
        or not np.allclose(first.pose[2], second.pose[2], atol=SAME_THIRD_ROW)
        or check_views(first, second)
    )
