"""Remove pixels at the edge of a mask that belong to the background."""

import numpy as np
from scipy.ndimage import binary_erosion, label, minimum_filter, uniform_filter

from nextview.sensing.facets import Noise
from nextview.sensing.frame import holes_of, within
from nextview.types import Float32, Mask

EDGE_ERROR = 6  # a segmenter's edge may be off by so many pixels
# neighbouring pixels of one surface differ by at most this part of their depth, and THICK
NEIGHBOUR_STEP = 0.01
THICK = 0.004  # metres
NOISE_STEP = 2.5  # standard deviations by which a pixel may differ from the mean of its neighbours
SQUARE_WIDTH = 5  # pixels across the square of these


def trimmed(depth: Float32, mask: Mask, noise: Noise, high: Mask | None = None) -> Mask:
    """The pixels of a mask that hang together with its inside without a step in depth, (H, W) bool.

    Up to EDGE_ERROR pixels at the edge of a mask may show the background, or hang in the air before
    it. The inside is what is farther from the edge; of a thing that is too thin for that, as much
    farther as leaves a third of it. From there the mask grows back over pixels as near as their
    neighbours: EDGE_ERROR pixels, and as far as they are ``high`` over the support plane, for the
    legs of a chair are as thin as an edge. What is ``high`` behind a step, and wider than
    EDGE_ERROR, is kept.

    Args:
        depth: metres, (H, W), 0 where nothing was measured.
        mask: (H, W) bool.
        noise: of the depth: pixels of one surface differ by it, too.
        high: pixels that show no edge of what lies on the plane, (H, W) bool.
    """
    measured = mask & (depth > 0)
    part = within(measured)
    if not measured[part].size:
        return mask
    own = measured[part]
    z = depth[part].astype(np.float64)
    step = np.maximum(NEIGHBOUR_STEP * z + THICK, NOISE_STEP * noise.at(z) * z**2)
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
        # behind a step in depth, but wider than the edge of a mask: a handle beside its mug
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
