"""How far hypotheses reach through what the thing stands on: nothing can be there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.things.depth_view import DepthView
from nextview.things.registration import SUNK, Alignment, scan_errors
from nextview.things.surface import SurfaceCaster
from nextview.types import Float


@dataclass(frozen=True, eq=False)
class BelowGround:
    """What of H hypotheses lies below the ground, beyond noise, tilt and errors of the scans.

    Attributes:
        share: of the surface, (H,) float64, 0 to 1.
        depth: of the lowest point below the ground, (H,) float64, metres; 0 where nothing lies
            below it.
    """

    share: Float
    depth: Float


def below_ground(
    caster: SurfaceCaster,
    alignment: Alignment,
    views: Sequence[DepthView],
    tilt: float,
) -> BelowGround:
    """Measure what of hypotheses lies below the ground, visible or not.

    Where views disagree on the ground, the lowest counts: the others show the top of something that
    stands around the thing.

    Args:
        caster: of all surfaces.
        alignment: the hypotheses, in a frame that is level.
        views: the views that show the ground, or not.
        tilt: standard deviation of the vertical, radians.

    Returns:
        Zeros where no view shows the ground.
    """
    share = np.zeros(len(alignment))
    depth = np.zeros(len(alignment))
    grounds = [view for view in views if view.ground is not None]
    if not grounds:
        return BelowGround(share, depth)

    lowest = min(grounds, key=ground_height)
    assert lowest.ground is not None
    noise = lowest.ground.noise * float(lowest.origin @ lowest.origin)
    for row, thing in enumerate(alignment.things):
        surface = caster.surfaces[thing]
        turn = alignment.rotations[row, 2]
        above = alignment.centres[row, 2] - ground_height(lowest)
        heights = (surface.vertices - surface.centre) @ turn + above
        slack = np.linalg.norm([SUNK, noise, tilt * surface.radius])
        allowed = slack + scan_errors(surface.radius)
        share[row] = surface.vertex_shares[heights < -allowed].sum()
        if share[row]:
            depth[row] = -heights.min()
    return BelowGround(share, depth)


def ground_height(view: DepthView) -> float:
    """Height of the ground of a view that shows it, below the middle of the object frame."""
    assert view.ground is not None
    return -view.ground.offset / float(view.ground.normal[2])
