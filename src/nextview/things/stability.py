"""Physical plausibility of hypotheses: penetration of the ground, floating, and toppling.

A thing at rest touches its support, and its centroid lies above the contact area. It touches the
ground or other things: measured points beside its outline, which belong to others, lie on its
surface. Unobserved space below it may also contain a support.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.things.depth_view import ELSEWHERE, HIDING, HIDING_NOISE, DepthView
from nextview.things.ground import Ground
from nextview.things.registration import SUNK, Alignment, Rendered, scan_errors
from nextview.things.surface import SurfaceCaster
from nextview.things.verification import PixelModel
from nextview.types import Float, Index, Mask

# largest gap between contact directions beyond a half turn, radians: the centroid of a standing
# thing may lie on an edge of the contact area, and is not known exactly
LARGEST_OVERHANG = 0.2
# pixels around an outline in which cameras mix the depths of both sides
MIXED = PixelModel().edge
# offset of a ray from a hull corner towards the centre, relative to their distance
WITHIN = 0.05
FEWEST_TOUCHED = 2  # fewest pixels that show a support


@dataclass(frozen=True, eq=False)
class Stability:
    """Stability of H hypotheses on the ground, up to noise, tilt and errors of the scans.

    Attributes:
        below: share of the surface below the ground, (H,) float64, 0 to 1.
        depth: depth of the lowest point below the ground, (H,) float64, metres; 0 if no point lies
            below it.
        stands: whether the hypothesis touches the ground and does not topple, (H,) bool; True if no
            view shows the ground.
    """

    below: Float
    depth: Float
    stands: Mask

    def select(self, rows: Index) -> "Stability":
        """Select hypotheses.

        Args:
            rows: indices, (N,).

        Returns:
            Stability of the selected hypotheses.
        """
        return Stability(self.below[rows], self.depth[rows], self.stands[rows])


def standing(
    caster: SurfaceCaster,
    alignment: Alignment,
    views: Sequence[DepthView],
    tilt: float,
) -> Stability:
    """Measure how far hypotheses penetrate the ground, and which of them stand on it.

    If views disagree on the ground, the lowest plane counts: the others show the top of something
    beside the thing. A thing may stand on the ground that is seen beside it, or on the floor.

    Args:
        caster: all surfaces.
        alignment: the hypotheses, in a level frame.
        views: the views, with or without a ground.
        tilt: standard deviation of the vertical, radians.

    Returns:
        Stability of the hypotheses; all are stable if no view shows the ground.
    """
    below = np.zeros(len(alignment))
    depth = np.zeros(len(alignment))
    planes = lowest_planes(views)
    if not planes:
        return Stability(below, depth, np.ones(len(alignment), bool))

    floor = planes[0]
    away = min(float(v.origin @ v.origin) for v in views if v.floor is floor)
    noise = floor.noise * away
    stands = np.zeros(len(alignment), bool)
    ups = alignment.rotations[:, 2]
    above = alignment.centres[:, 2] - floor.height
    for thing in np.unique(alignment.things):
        surface = caster.surfaces[thing]
        slack = float(np.linalg.norm([SUNK, noise, tilt * surface.radius]))
        allowed = slack + float(scan_errors(surface.radius))
        rows = np.flatnonzero(alignment.things == thing)
        corners = ups[rows] @ (surface.hull - surface.centre).T + above[rows, None]
        bottom = corners.min(1)
        for row in rows[bottom < -allowed]:
            heights = (surface.vertices - surface.centre) @ ups[row] + above[row]
            below[row] = surface.vertex_shares[heights < -allowed].sum()
            depth[row] = -heights.min()
        rises = np.array([plane.height - floor.height for plane in planes])
        touches = bottom < allowed
        touches |= (np.abs(bottom[:, None] - rises) < allowed).any(1)
        for at in np.flatnonzero(touches):
            low = surface.hull[corners[at] < bottom[at] + allowed] - surface.centroid
            stands[rows[at]] = is_stable(alignment.rotations[rows[at]] @ low.T)
    return Stability(below, depth, stands)


def carried(
    caster: SurfaceCaster,
    alignment: Alignment,
    views: Sequence[DepthView],
    rendered: Sequence[Rendered],
    rows: Index,
) -> Mask:
    """Find the hypotheses that other things support, among some that do not stand on the ground.

    Supporting points are measured outside the outlines of a hypothesis and lie on its surface,
    within the noise, the error of the scan and the mixed pixels of the camera.

    Args:
        caster: all surfaces.
        alignment: the hypotheses, in a level frame.
        views: views of the thing.
        rendered: rendering of the hypotheses in each view.
        rows: indices of the hypotheses to be examined.

    Returns:
        Whether others support each hypothesis, (H,) bool; False for those that are not examined.
    """
    stable = np.zeros(len(alignment), bool)
    for row in rows:
        one = alignment.select(np.array([row]))
        low = _underside(caster, one)
        of_others = []
        of_ground = []
        for number, view in enumerate(views):
            displaced = one.cameras[0, number]
            beside = ~np.isfinite(rendered[number].depth[row])
            touched, level = _touched(caster, one, displaced, view, beside)
            of_others.append(touched[~level])
            of_ground.append(touched[level])
            low = low[~_seen_empty(low + displaced, view)]

        others = np.concatenate(of_others)
        seen = np.concatenate([others, *of_ground])
        below = np.count_nonzero(seen[:, 2] < 0)
        if len(others) < FEWEST_TOUCHED or below < FEWEST_TOUCHED:
            continue
        around = np.concatenate([seen, low - _centroid(caster, one)])
        stable[row] = is_stable(around.T)
    return stable


def _centroid(caster: SurfaceCaster, one: Alignment) -> Float:
    """Centroid of one hypothesis, (3,), metres."""
    surface = caster.surfaces[one.things[0]]
    return one.centres[0] + one.rotations[0] @ (surface.centroid - surface.centre)


def _touched(
    caster: SurfaceCaster,
    one: Alignment,
    displaced: Float,
    view: DepthView,
    beside: Mask,
) -> tuple[Float, Mask]:
    """Points of other objects in one view that touch the surface of a hypothesis.

    Args:
        caster: all surfaces.
        one: the hypothesis.
        displaced: its displacement in the view, (3,), metres.
        view: the view.
        beside: pixels in which the hypothesis is absent, (P,).

    Returns:
        Points relative to the centroid of the hypothesis, (N, 3), metres, and whether each belongs
        to the ground, (N,).
    """
    surface = caster.surfaces[one.things[0]]
    others = beside & (view.kind == ELSEWHERE) & (view.edge > MIXED)
    others &= (view.depth > 0) & np.isfinite(view.depth)
    depth = view.depth[others].astype(np.float64)
    points = view.origin + view.rays[others] * depth[:, None] - displaced
    # distance of the pixels beside the outline from it: the ignored pixels and the grid spacing
    apart = (view.step.max() + MIXED) * view.pitch * depth
    errors = SUNK + scan_errors(surface.radius) + HIDING_NOISE * view.noise[others]
    reach = np.asarray(np.hypot(apart, errors), np.float64)

    own = (points - one.centres[0]) @ one.rotations[0] + surface.centre
    low = surface.vertices.min(0)
    high = surface.vertices.max(0)
    near = ((own > low - reach[:, None]) & (own < high + reach[:, None])).all(1)
    off, _ = surface.nearby.query(own[near])
    touching = np.flatnonzero(near)[off < reach[near] + surface.spacing]
    return points[touching] - _centroid(caster, one), view.level[others][touching]


def _underside(caster: SurfaceCaster, one: Alignment) -> Float:
    """Hull corners of a hypothesis without any part of it below them, (N, 3), metres."""
    surface = caster.surfaces[one.things[0]]
    down = -one.rotations[0, 2]
    # avoids rays along a vertical side
    inwards = WITHIN * (surface.centre - surface.hull)
    starts = (surface.hull + inwards + SUNK * down).astype(np.float32)
    rays = np.tile(down.astype(np.float32), (len(starts), 1, 1))
    free = ~np.isfinite(caster.depths(int(one.things[0]), starts, rays)[:, 0])
    corners = (surface.hull[free] - surface.centre) @ one.rotations[0].T
    return corners + one.centres[0]


def _seen_empty(corners: Float, view: DepthView) -> Mask:
    """Corners, (N, 3), metres, below which a view observes free space, (N,) bool."""
    below = (corners - (0, 0, SUNK) - view.origin) @ view.camera_axes
    slopes = (view.rays @ view.camera_axes).reshape(*view.shape, 3)
    ahead = np.maximum(below[:, 2], 1e-6)
    column = _nearest(slopes[0, :, 0], below[:, 0] / ahead)
    row = _nearest(slopes[:, 0, 1], below[:, 1] / ahead)
    inside = (column >= 0) & (row >= 0)
    pixel = np.where(inside, row * view.shape[1] + column, 0)
    apart = np.hypot(HIDING, HIDING_NOISE * view.noise[pixel])
    empty = (view.kind[pixel] == ELSEWHERE) & (view.depth[pixel] > ahead + apart)
    return np.asarray(inside & empty, bool)


def _nearest(grid: Float, values: Float) -> Index:
    """Index of the nearest of some ascending slopes for each value; -1 beyond their ends."""
    middles = (grid[1:] + grid[:-1]) / 2
    inside = (values >= grid[0]) & (values <= grid[-1])
    return np.where(inside, np.searchsorted(middles, values), -1)


def is_stable(touching: Float) -> bool:
    """Whether a body keeps its pose: its centroid lies above its contact area.

    Args:
        touching: contact points relative to the centroid, horizontal coordinates first, (2 or 3,
            N), metres.

    Returns:
        True if it does not topple.
    """
    x, y = touching[:2]
    around = np.sort(np.arctan2(y, x))
    gaps = np.diff(np.append(around, around[0] + 2 * np.pi))
    return bool(gaps.max() <= np.pi + LARGEST_OVERHANG)


def lowest_planes(views: Sequence[DepthView]) -> list[Ground]:
    """Return the lowest floor of some views, and the lowest ground if that is another plane.

    Args:
        views: the views, with or without a ground.

    Returns:
        The floor first; empty if no view shows the ground.
    """
    floors = [view.floor for view in views if view.floor is not None]
    grounds = [view.ground for view in views if view.ground is not None]
    if not floors:
        return []
    floor = min(floors, key=lambda plane: plane.height)
    ground = min(grounds, key=lambda plane: plane.height)
    return [floor] if floor.height >= ground.height else [floor, ground]
