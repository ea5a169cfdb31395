"""How hypotheses stand on the ground: none reaches through it, and few float or would fall over."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.things.depth_view import DepthView
from nextview.things.registration import SUNK, Alignment, scan_errors
from nextview.things.surface import SurfaceCaster
from nextview.types import Float, Mask

# radians beyond a half turn in which nothing supports a thing that stands: its centroid lies on an
# edge of what touches the ground, and is not known exactly
LARGEST_OVERHANG = 0.2


@dataclass(frozen=True, eq=False)
class Stability:
    """How H hypotheses stand on the ground, up to noise, tilt and errors of the scans.

    Attributes:
        below: share of the surface that lies below the ground, (H,) float64, 0 to 1.
        depth: of the lowest point below the ground, (H,) float64, metres; 0 where nothing lies
            below it.
        stands: whether it touches the ground, and would not fall over, (H,) bool; True where no
            view shows the ground.
    """

    below: Float
    depth: Float
    stands: Mask


def standing(
    caster: SurfaceCaster,
    alignment: Alignment,
    views: Sequence[DepthView],
    tilt: float,
) -> Stability:
    """Measure what of hypotheses lies below the ground, visible or not, and which of them stand.

    Where views disagree on the ground, the lowest counts: the others show the top of something that
    stands around the thing.

    Args:
        caster: of all surfaces.
        alignment: the hypotheses, in a frame that is level.
        views: the views that show the ground, or not.
        tilt: standard deviation of the vertical, radians.

    Returns:
        How they stand; nothing speaks against any of them where no view shows the ground.
    """
    below = np.zeros(len(alignment))
    stands = np.ones(len(alignment), bool)
    depth = np.zeros(len(alignment))
    grounds = [view for view in views if view.ground is not None]
    if not grounds:
        return Stability(below, depth, stands)

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
        below[row] = surface.vertex_shares[heights < -allowed].sum()
        if below[row]:
            depth[row] = -heights.min()
        turned = alignment.rotations[row] @ (surface.hull - surface.centroid).T
        stands[row] = heights.min() < allowed and is_stable(turned, float(allowed))
    return Stability(below, depth, stands)


def is_stable(corners: Float, slack: float) -> bool:
    """Whether a body would stay as it stands: its centroid lies above what touches the ground.

    Args:
        corners: of its convex hull, from its centroid, z up, (3, N), metres.
        slack: height below which a corner may touch the ground, metres.
    """
    x, y = corners[:2, corners[2] < corners[2].min() + slack]
    around = np.sort(np.arctan2(y, x))
    gaps = np.diff(np.append(around, around[0] + 2 * np.pi))
    return bool(gaps.max() <= np.pi + LARGEST_OVERHANG)


def ground_height(view: DepthView) -> float:
    """Height of the ground of a view that shows it, below the middle of the object frame."""
    assert view.ground is not None
    return -view.ground.offset / float(view.ground.normal[2])
