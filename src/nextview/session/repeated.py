"""A picture handed in twice, as a camera that hangs does: it is one piece of evidence, not two."""

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
# difference of the third rows of two poses that differ by a turn about the vertical alone
SAME_THIRD_ROW = 1e-4


def is_repeated(seen: Observation, earlier: Sequence[Observation]) -> bool:
    """Return whether an observation shows the picture of an earlier one.

    Args:
        seen: the observation.
        earlier: the earlier ones.

    Returns:
        True if it does.
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

    No two pictures of a depth camera are the same to the last bit. The true camera pose of such a
    frame is not known, so the earlier sighting stands for it.

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
    """Whether two observations of one depth show no two sides of a symmetric object.

    A render of one is the same to the bit after a turn about the vertical. Nothing else is, from
    another direction.
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
