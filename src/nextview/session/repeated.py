"""Detect repeated observations: they are one piece of evidence, not two."""

from collections.abc import Sequence

import numpy as np

from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import angle_between, direction_of
from nextview.sensing.plausibility import check_views
from nextview.session.episode import VISITED_ANGLE

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
