"""Reasons not to act yet on the likeliest hypothesis, a thing in a pose, despite its belief."""

from collections.abc import Callable, Sequence

import numpy as np

from nextview.recognition.model_card import Symmetry
from nextview.recognition.poses import UNKNOWN_TURN, PoseCandidate, uncertainty_of
from nextview.things.verifier import Verified

# share of the visible pixels of a scan that may show something behind it
MOST_SEEN_BEHIND = 0.1
FEWEST_PIXELS = 350  # fewest pixels from which a shape can be recognised
# share of the deviation of a uniformly random orientation, from which it counts as unknown
UNKNOWN_PART = 0.75
ORIENTATION_DOUBT = "its orientation is known to"  # how this doubt begins


def doubt_of(
    found: Verified,
    poses: Sequence[PoseCandidate],
    pixels: int,
    stranger: Callable[[], float],
) -> str:
    """Explain why the likeliest hypothesis is in doubt, even if the belief in it is high.

    Args:
        found: verification of the views.
        poses: candidate poses of the object, the likeliest first.
        pixels: number of pixels of the object in the frame that shows most of it.
        stranger: returns the log-odds of a stranger of the same shape against the thing, nats;
            called only if there is no other doubt.

    Returns:
        The reason in words; "" if there is none.
    """
    below = 1000 * float(found.below[0])
    behind = float(found.seen_behind[0])
    own = [one for one in poses if one.thing == poses[0].thing]
    degrees = uncertainty_of(own).degrees
    if below:
        return f"its scan would reach {below:.0f} mm below the ground"
    if not (found.stands[0] or found.carried[0]):
        return "its scan would not stand on what is seen below it"
    if pixels < FEWEST_PIXELS:
        return f"only {pixels} pixels show it"
    if behind >= MOST_SEEN_BEHIND:
        return f"the camera sees past {100 * behind:.0f} % of its scan"
    if degrees >= unknown_turn(own[0].symmetry or ()):
        return f"{ORIENTATION_DOUBT} ± {degrees:.0f}° only"
    if stranger() > 0:
        return "its scan fits better if it is stretched"
    return ""


def unknown_turn(symmetries: Sequence[Symmetry]) -> float:
    """Standard deviation from which the orientation of a thing counts as unknown.

    A symmetry of order 4 limits the error to 45 degrees; a uniformly random orientation then has a
    root mean square error of 26 degrees.

    Args:
        symmetries: symmetries of the thing.

    Returns:
        Standard deviation, degrees.
    """
    order = max((one.order for one in symmetries), default=1)
    of_nothing = 180 / max(order, 1) / np.sqrt(3)
    return float(min(UNKNOWN_TURN, UNKNOWN_PART * of_nothing))
