"""Why a thing that is believed is not to be acted on yet: "this thing in this pose" is in doubt."""

from collections.abc import Callable, Sequence

import numpy as np

from nextview.recognition.model_card import Symmetry
from nextview.recognition.poses import UNKNOWN_TURN, PoseCandidate, uncertainty_of
from nextview.things.verifier import Verified

# share of what should be visible of the scan, past which cameras see what is behind
MOST_SEEN_BEHIND = 0.1
FEWEST_PIXELS = 350  # that show a thing whose shape can be told
# of the deviation that an orientation has of which nothing is known, from which on it is not known
UNKNOWN_PART = 0.75


def doubt_of(
    found: Verified,
    poses: Sequence[PoseCandidate],
    pixels: int,
    stranger: Callable[[], float],
) -> str:
    """Say why the likeliest hypothesis is in doubt, however strongly it is believed.

    Args:
        found: what was found of some views.
        poses: that the object may have, the likeliest first.
        pixels: of a frame that show it, in the frame that shows most of it.
        stranger: gives the log-odds of a stranger of its shape against the thing, nats; asked only
            where nothing else is in doubt.

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
        return f"its orientation is known to ± {degrees:.0f}° only"
    if stranger() > 0:
        return "its scan fits better if it is stretched"
    return ""


def unknown_turn(symmetries: Sequence[Symmetry]) -> float:
    """Standard deviation from which on the orientation of a thing is not known, degrees.

    A thing of four equal sides is never off by more than 45 degrees, and by 26 in the mean square
    where nothing is known of it.

    Args:
        symmetries: of the thing.
    """
    order = max((one.order for one in symmetries), default=1)
    of_nothing = 180 / max(order, 1) / np.sqrt(3)
    return float(min(UNKNOWN_TURN, UNKNOWN_PART * of_nothing))
