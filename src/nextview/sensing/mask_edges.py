"""Remove pixels at the edge of a mask that belong to the background."""

import numpy as np
from scipy.ndimage import binary_erosion, label, minimum_filter, uniform_filter

from nextview.sensing.frame import holes_of, within
from nextview.sensing.noise import Noise
from nextview.types import Float32, Mask

EDGE_ERROR = 6  # pixels, largest error of a mask's edge
# largest relative depth step between neighbouring pixels of one surface, in addition to THICK
NEIGHBOUR_STEP = 0.01
THICK = 0.004  # metres
SQUARE_WIDTH = 5  # pixels, side of the square of neighbours


def trimmed(depth: Float32, mask: Mask, noise: Noise, high: Mask | None = None) -> Mask:
    """Return the pixels of a mask that are connected to its interior without a depth step.

    Up to EDGE_ERROR pixels at the edge of a mask may show the background, or flying pixels in front
    of it. The interior starts at that distance from the edge; in an object that is too thin, at the
    distance that leaves a third of its pixels. From there the mask grows back across small depth
    steps: by EDGE_ERROR pixels, and without limit over ``high`` pixels, as chair legs are as thin
    as an edge. Parts that are ``high`` behind a step and wider than EDGE_ERROR are kept.

    Args:
        depth: metres, (H, W), 0 without valid depth.
        mask: (H, W) bool.
        noise: of the depth, which adds to the steps within one surface.
        high: pixels clearly above the support plane, (H, W) bool.

    Returns:
        The remaining pixels, (H, W) bool.
    """
    measured = mask & (depth > 0)
    part = within(measured)
    if not measured[part].size:
        return mask
    own = measured[part]
    z = depth[part].astype(np.float64)
    # 2.5 standard deviations from the mean of the neighbours
    step = np.maximum(NEIGHBOUR_STEP * z + THICK, 2.5 * noise.at(z) * z**2)
    whole = np.pad(mask[part] | holes_of(own) & (z == 0), 1)
    for width in range(EDGE_ERROR, 0, -1):
        inside = binary_erosion(whole, np.ones((3, 3), bool), width)[1:-1, 1:-1] & own
        if 3 * inside.sum() >= own.sum():
            break
    else:
        return mask
    found = inside
    if high is not None:
        far = (
            z
            - minimum_filter(np.where(own, z, np.inf), 3, mode="constant", cval=np.inf)
            > step
        )
        near = own & high[part] & ~far
        # behind a depth step, but wider than the edge of a mask, such as the handle of a mug
        wide = binary_erosion(np.pad(near, 1), np.ones((3, 3), bool), EDGE_ERROR // 2)[
            1:-1,
            1:-1,
        ]
        part_of, count = label(near | inside)
        reached = np.zeros(count + 1, bool)
        reached[part_of[inside | wide]] = True
        found = reached[part_of]
    depth_there = z.astype(np.float32)
    left = own & ~found
    for _ in range(EDGE_ERROR):
        share = uniform_filter(found.astype(np.float32), SQUARE_WIDTH, mode="constant")
        total = uniform_filter(found * depth_there, SQUARE_WIDTH, mode="constant")
        usual = total / np.maximum(share, np.float32(1e-6))
        joins = left & (share > 1e-3) & (np.abs(depth_there - usual) < step)
        if not joins.any():
            break
        found |= joins
        left &= ~joins
    trimmed_mask = np.zeros_like(mask)
    trimmed_mask[part] = found
    return trimmed_mask
