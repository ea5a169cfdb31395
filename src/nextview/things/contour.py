"""Where the contours of hypotheses lie in a depth image, against where they are expected.

A wall or a plate that moves along itself looks the same, but for its contour. Along the normal of
an expected contour, in the image, depth steps from that of the thing to what is behind it. Where it
does is found as the shift that explains the pixels along the normal best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from nextview.sensing.noise import LEAST_ERROR
from nextview.sensing.view import View
from nextview.things.library import Hypotheses, Library
from nextview.things.score import FARTHEST, LEFT_OVER, OUTLIER, PIXEL_GAIN, cast
from nextview.types import Float, Float32, Index, Mask

ACROSS = 32  # pixels of the image that shows a hypothesis, along each side
NEAREST = (
    1.2  # radii in front of the camera, within which a thing is too near to be shown
)
BORDER = 1.15  # width of this image, over that of a sphere around the thing
MOST_POINTS = 48  # of a contour
FEWEST_POINTS = 4  # of a contour that tells where it is
SHIFTS = 7  # steps by which a contour is searched, each way
DEEP = 6  # steps inside of a contour that are compared
LEAST_STEP = 1.0  # pixels of the view
SHOWN = 2  # of the three steps on each side of a contour that show thing and background
EDGE_ERROR = 1.5  # pixels: standard deviation of a contour
ALIKE_EDGES = 1.5  # neighbouring points of a contour whose errors are alike
THICKNESS = (
    0.03  # radii within which a pixel shows the surface of a pose that is not final
)


@dataclass(frozen=True, eq=False)
class _Contours:
    """Points of the contours of M hypotheses as they are expected, N in all.

    Attributes:
        row: number of the hypothesis of each, (N,) int64.
        places: column and row in the view, (N, 2) float64, pixels.
        normals: outwards in the image, (N, 2) float64.
        step: along the normal, (N,) float64, pixels.
        depth: at the contour, (N,) float32, metres.
        inner: depth at each step into the thing, (N, DEEP) float32, metres.
        thick: whether the thing reaches as deep, (N, DEEP) bool.
    """

    row: Index
    places: Float
    normals: Float
    step: Float
    depth: Float32
    inner: Float32
    thick: Mask


def contour_equations(
    library: Library,
    view: View,
    some: Hypotheses,
    reach: Float,
    alone: bool = False,
) -> tuple[Float, Float]:
    """Return the normal equations of contours for a small motion of each hypothesis.

    Args:
        library: the things.
        view: the view.
        some: M hypotheses.
        reach: how far each may be from where it is expected, (M,), metres.
        alone: whether a contour ends, too, where nothing is measured: that is far away, or in the
            shadow of the thing, and of nothing else.

    Returns:
        Left side, (M, 6, 6), and right side, (M, 6), float64: rotation about the centre and shift,
        world axes, over the variance of the errors of a contour; zero where no contour is found.
    """
    axes, place = view.camera[:3, :3], view.camera[:3, 3]
    middle = (some.centres - place) @ axes
    contours = _expected(library, view, some, middle, reach)
    shift, found = _found(library, view, some, contours, alone)
    found &= np.bincount(contours.row[found], minlength=len(some))[contours.row] >= (
        FEWEST_POINTS
    )

    camera = view.frame.pinhole
    row = contours.row[found]
    normals = contours.normals[found]
    depth = contours.depth[found].astype(np.float64)
    slope = (contours.places[found] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    rays = np.column_stack([slope, np.ones(len(row))])
    # what moves along its ray stays in the image
    towards = np.column_stack([normals, -(slope * normals).sum(1)])
    jacobian = np.concatenate(
        [np.cross(rays * depth[:, None] - middle[row], towards), towards], 1
    )
    pixel = depth / camera.fx
    error = np.hypot(EDGE_ERROR, contours.step[found] / np.sqrt(12)) * pixel
    weighted = jacobian / (ALIKE_EDGES * error**2)[:, None]
    left = np.zeros((len(some), 6, 6))
    right = np.zeros((len(some), 6))
    np.add.at(left, row, weighted[:, :, None] * jacobian[:, None])
    np.add.at(right, row, weighted * (shift[found] * pixel)[:, None])

    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = axes
    return turn @ left @ turn.T, right @ turn.T


@dataclass(frozen=True, eq=False)
class _Images:
    """Small images that show M hypotheses, each in the middle of its own.

    Attributes:
        x: slope x/z of each column, (M, ACROSS) float64.
        y: slope y/z of each row, (M, ACROSS) float64.
        depth: (M, ACROSS, ACROSS) float32, metres; infinite where nothing shows.
        away: distance of each hypothesis along the axis of the camera, (M,), metres.
    """

    x: Float
    y: Float
    depth: Float32
    away: Float

    @classmethod
    def of(
        cls, library: Library, view: View, some: Hypotheses, middle: Float
    ) -> _Images:
        """Render hypotheses with middles in the axes of the camera, (M, 3), metres."""
        radius = library.radii[some.things] * some.sizes.max(1)
        away = np.maximum(middle[:, 2], NEAREST * radius)
        half = BORDER * radius / np.sqrt(away**2 - radius**2)
        lines = half[:, None] * np.linspace(-1, 1, ACROSS)
        x, y = (middle[:, side, None] / away[:, None] + lines for side in (0, 1))
        _, depth, _ = cast(
            library, view, some, x.astype(np.float32), y.astype(np.float32)
        )
        return cls(x, y, depth.reshape(len(some), ACROSS, ACROSS), away)


def _expected(
    library: Library, view: View, some: Hypotheses, middle: Float, reach: Float
) -> _Contours:
    """Find where contours of hypotheses are expected.

    Args:
        library: the things.
        view: the view.
        some: M hypotheses.
        middle: of each in the axes of the camera, (M, 3), metres.
        reach: how far each may be from there, (M,), metres.
    """
    images = _Images.of(library, view, some, middle)
    shown = np.isfinite(images.depth)
    edge = shown & ~ndimage.minimum_filter(shown, (1, 3, 3), mode="constant")
    row, line, column = np.nonzero(edge)
    # as many of each hypothesis, evenly
    counts = np.bincount(row, minlength=len(some))
    rank = np.arange(len(row)) - (np.cumsum(counts) - counts)[row]
    few = np.minimum(counts, MOST_POINTS)[row]
    kept = (rank + 1) * few // counts[row] > rank * few // counts[row]
    row, line, column = row[kept], line[kept], column[kept]

    smooth = ndimage.gaussian_filter(shown.astype(np.float32), (0, 1, 1))
    slopes = [np.asarray(np.gradient(smooth, axis=axis)) for axis in (2, 1)]
    normals = -np.stack([one[row, line, column] for one in slopes], 1, dtype=np.float64)
    steep = np.linalg.norm(normals, axis=1) + 1e-6
    normals /= steep[:, None]
    # the contour lies between the last pixel that shows the thing and the next one
    beyond = np.clip((smooth[row, line, column] - 0.5) / steep, -0.5, 1.0)
    camera = view.frame.pinhole
    pitch = camera.fx * (images.x[row, 1] - images.x[row, 0])
    places = beyond[:, None] * pitch[:, None] * normals
    places[:, 0] += camera.fx * images.x[row, column] + camera.cx
    places[:, 1] += camera.fy * images.y[row, line] + camera.cy

    step = np.maximum(reach / images.away * camera.fx / SHIFTS, LEAST_STEP)[row]
    deep = (np.arange(DEEP) + 0.5) * (step / pitch)[:, None] - beyond[:, None]
    into = [
        np.rint(at[:, None] - deep * normals[:, side, None])
        .astype(int)
        .clip(0, ACROSS - 1)
        for at, side in ((line, 1), (column, 0))
    ]
    inner = images.depth[row[:, None], into[0], into[1]]
    return _Contours(
        row,
        places,
        normals,
        step,
        images.depth[row, line, column],
        np.where(np.isfinite(inner), inner, 0),
        np.logical_and.accumulate(np.isfinite(inner), axis=1),
    )


def _found(
    library: Library, view: View, some: Hypotheses, contours: _Contours, alone: bool
) -> tuple[Float, Mask]:
    """Return how far outwards each point of a contour is seen, pixels, and whether it is, (N,)."""
    steps = np.arange(-SHIFTS - DEEP, SHIFTS + DEEP)  # along the normal, outwards
    shifts = np.arange(-SHIFTS, SHIFTS + 1)
    # how deep each step lies within the contour after each shift; negative outside, (S, K)
    depths = shifts[:, None] - 1 - steps
    along = (steps + 0.5) * contours.step[:, None]
    at = np.floor(
        contours.places[:, None] + along[..., None] * contours.normals[:, None]
    )
    column, line = np.moveaxis(at, 2, 0).astype(int)
    height, width = view.frame.shape
    inside = (column >= 0) & (column < width) & (line >= 0) & (line < height)
    column, line = column.clip(0, width - 1), line.clip(0, height - 1)
    measured = np.where(inside, view.depth[line, column], 0)
    carries = inside & view.surface[line, column]

    depth = contours.depth[:, None]
    noise = view.noise.at(np.maximum(depth, 0.1)) * depth**2
    sigma = np.hypot(noise, LEAST_ERROR * depth).astype(np.float32)
    pose = THICKNESS * library.radii[some.things[contours.row], None]
    margin = (FARTHEST * np.hypot(sigma, pose)).astype(np.float32)

    # after each shift, (N, S, K)
    deep = depths.clip(0, DEEP - 1)
    counted = contours.thick[:, deep] & (depths >= 0) & (depths < DEEP)
    off = measured[:, None] - contours.inner[:, deep]
    got = (measured > 0)[:, None]
    near = np.abs(off) < margin[..., None]
    on = got & near & ~carries[:, None]
    through = got & ((off > margin[..., None]) | (near & carries[:, None]))
    likely = np.log(np.exp(-((off / sigma[..., None]) ** 2) / 2) + np.exp(OUTLIER))
    gain = np.where(on, likely + PIXEL_GAIN, np.where(through, OUTLIER, 0))
    # what goes on beyond the contour is not explained
    beside = (np.abs(measured - depth) < margin) & (measured > 0) & ~carries
    left = (beside[:, None] & (depths < 0)).sum(2)
    total = (gain * counted).sum(2) + LEFT_OVER * left

    best = total.argmax(1)
    each = np.arange(len(best))
    close = np.abs(depths + 0.5) < 3
    behind = (measured > depth + margin) | (carries & (measured > depth - margin))
    if alone:
        behind |= inside & (measured == 0)
    shows = (on & counted & close)[each, best].sum(1) >= SHOWN
    ends = (behind[:, None] & (depths < 0) & close)[each, best].sum(1) >= SHOWN
    shift = shifts[best] * contours.step
    return shift, shows & ends & (np.abs(shifts[best]) < SHIFTS)
