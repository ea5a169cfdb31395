"""The measures of the thesis's chapter 3, and one that it suggests, with what each needs and which
values are good.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from contourpy import LineType, contour_generator
from numpy.typing import NDArray
from scipy.fft import irfft, irfft2, rfft, rfft2

from nextview_lab.data.measures import MEASURES as BUILT_IN
from nextview_lab.data.measures import Measure, MeasuredView
from nextview_lab.data.surfaces import MeshView

CURVATURES = 32
"""Steps of the arc tangent of a curvature from 0 to infinity, half as wide at both ends: a flat
surface, whose deficits are rounding, is one level and no border of two."""
DEPTH_BIN = 0.01
"""Width of the depth histogram's bins, object radii: a hundred across the object's radius."""
GREYS = 256
"""Grey levels of the depth image that is described."""
ARM = 1 / 24
"""Length of outline on both sides of a point between which its turn is measured, sides of the
image. Over that much, 9 pixels of 224, the steps of pixels even out."""
TURN_ACCURACY = np.radians(5)
"""Standard deviation of the error with which a turn is taken to be known."""
TURNS = 360
"""Cells of the histogram of turns, once round."""
LIKED = 22.5
SPREAD = 45.0
"""Elevation that people like best, and the width of their liking, degrees (Secord et al. 2011,
after Blanz et al.).
"""
BASE = 0.05
DOWN = 0.7
"""What belongs to the base: the lowest part of the object's height, of surfaces that face down at
least so far: the cosine of 45 degrees."""
DIRECTION_ACCURACY = 0.1
"""Standard deviation of the error with which a direction is taken to be known, along each axis,
radians: 6 degrees.
"""
DIRECTIONS = 80
"""Cells of the histogram of directions along each of its two axes: 2 to one standard deviation."""
BACKGROUND = np.float32(1e30)
"""Inverse depth where nothing is seen: no step from there is less than one on the surface."""


def rated(
    needs: Literal["depth", "mesh"],
) -> Callable[[Callable[[Any], float]], Measure]:
    """What makes a measure of a function of a view."""
    return lambda function: Measure(function, needs)


def bits(shares: NDArray[np.floating]) -> float:
    """Shannon entropy of shares that add up to 1, bits (thesis, equation 3); 0 of none."""
    shares = shares[shares > 0]
    return float(-(shares * np.log2(shares)).sum()) if len(shares) else 0.0


@lru_cache(maxsize=2)
def _blur(cells: int, accuracy: float) -> NDArray[np.float64]:
    """A normal curve around the first of cells in a circle; ``accuracy`` is its standard deviation,
    in cells.
    """
    apart = np.minimum(np.arange(cells), cells - np.arange(cells))
    blur = np.exp(-((apart / accuracy) ** 2) / 2)
    return blur / blur.sum()


@rated("depth")
def view_area(view: MeasuredView) -> float:
    """Share of the image that shows the object: its projected area.

    Dutagaci et al. 2010 ("view area"), Secord et al. 2011 ("projected area"); thesis, section
    3.4.1.

    Returns:
        Between 0 and 1; the sphere around the object fills pi/4 of the image.
    """
    return len(view.depths) / view.depth.size


@rated("mesh")
def visible_area_ratio(view: MeshView) -> float:
    """Area of the surface that is seen, over the area of the whole surface; what is hidden of a
    face does not count.

    Plemenos and Benayada 1996, Polonsky et al. 2005 ("visibility ratio"), Dutagaci et al. 2010
    ("ratio of visible area"); thesis, section 3.4.1.

    Returns:
        Between 0 and 1: of a sphere from distance d, (1 - 1/d) / 2.
    """
    return min(float(view.seen_area.sum() / view.surface.areas.sum()), 1.0)


@rated("mesh")
def surface_visibility(view: MeshView) -> float:
    """Area of the faces of which anything is seen, over the area of all faces: the ratio of visible
    area by faces.

    Secord et al. 2011 ("surface visibility"), Dutagaci et al. 2010; thesis, section 3.4.1, by "the
    mesh area visible from a viewpoint". Large faces that are nearly hidden count whole, so it
    depends on how the mesh is cut.

    Returns:
        Between 0 and 1: 1/2 of a cube of which three sides are seen.
    """
    return float(view.surface.areas[view.pixels[0]].sum() / view.surface.areas.sum())


@rated("mesh")
def viewpoint_entropy(view: MeshView) -> float:
    """Shannon entropy of the shares that the faces have in the object's projected area.

    Vázquez et al. 2001, without their background; Dutagaci et al. 2010 ("surface area entropy");
    thesis, section 3.4.1 and equation 3. It counts faces as they are cut: cut each into four and it
    is 2 bits more, from everywhere.

    Returns:
        Bits; 0 where one face is seen or none.
    """
    pixels = view.pixels[1]
    return bits(pixels / pixels.sum()) if len(pixels) else 0.0


@rated("mesh")
def curvature_entropy(view: MeshView) -> float:
    """Shannon entropy of the distribution of Gaussian curvature over the visible surface.

    The curvature of a vertex is its angle deficit over a third of the area around it (thesis,
    equation 4, and ``Surface.gaussian``); each visible face gives a third of its visible area
    to each corner. A surface bends from not at all to beyond all bounds, so the histogram is of its
    arc tangent. Page et al. 2003, Polonsky et al. 2005 ("curvature entropy"). On smooth surfaces it
    depends little on how the mesh is cut; where faces are flat and edges sharp, a finer mesh has
    more flat vertices, and it falls.

    Returns:
        Bits; 0 on a sphere, and where nothing is seen.
    """
    surface, (faces, _) = view.surface, view.pixels
    curvature = surface.gaussian[surface.corners[faces]]
    level = (
        np.rint(np.arctan(curvature) * (2 * CURVATURES / np.pi)).astype(np.int64)
        + CURVATURES
    )
    weight = np.bincount(level.ravel(), np.repeat(view.seen_area, 3))
    return bits(weight / weight.sum()) if weight.sum() > 0 else 0.0


@rated("mesh")
def mean_curvature(view: MeshView) -> float:
    """Mean curvature, unsigned, integrated over the visible surface: how much it bends at its
    edges.

    Secord et al. 2011 ("mean curvature"); thesis, section 3.4.4; see ``Surface.mean_of_faces``.
    Concave and convex bends add up. A face that is half hidden has half of what its edges give it.

    Returns:
        Object radii: of a sphere of radius 1 from distance d, 2 pi (1 - 1/d).
    """
    return float((view.surface.mean_of_faces[view.pixels[0]] * view.seen_share).sum())


@rated("mesh")
def gaussian_curvature(view: MeshView) -> float:
    """Gaussian curvature, unsigned, integrated over the visible surface: how much it bends at its
    corners.

    Secord et al. 2011 ("Gaussian curvature"); thesis, section 3.4.4; see
    ``Surface.gaussian_of_faces``.

    Returns:
        Radians squared: of a sphere from distance d, 2 pi (1 - 1/d).
    """
    return float(
        (view.surface.gaussian_of_faces[view.pixels[0]] * view.seen_share).sum()
    )


@rated("depth")
def depth_distribution(view: MeasuredView) -> float:
    """One minus the sum of the squared normalised depth histogram, over the pixels that show the
    object.

    It is the chance that two of them lie at different depths. Secord et al. 2011 ("depth
    distribution"); thesis, equation 5.

    Returns:
        0 where all is at one depth or nothing is seen, less than 1.
    """
    if len(view.depths) == 0:
        return 0.0
    share = np.bincount((view.depths / DEPTH_BIN).astype(np.int64)) / len(view.depths)
    return float(1 - (share**2).sum())


@rated("depth")
def max_depth(view: MeasuredView) -> float:
    """The largest depth at which the object is seen, measured from its nearest visible point.

    Secord et al. 2011 ("maximum depth"); thesis, section 3.4.3.

    Returns:
        Object radii; 0 where nothing is seen.
    """
    return float(np.ptp(view.depths)) if len(view.depths) else 0.0


@rated("depth")
def fused_descriptor(view: MeasuredView) -> float:
    """Mean of variance, entropy and Vollath's autocorrelation of the depth image, each scaled to 0
    .. 1.

    Ding et al., as the thesis describes it (section 3.5): they predict surface complexity by these
    three. The image is 1 at the nearest visible point, 1/256 two object radii behind it, and 0
    where there is no object. The variance is divided by its largest value, 1/4; the entropy of the
    grey levels by 8 bits; Vollath's F4 (Vollath 1987), the sum of products of neighbours less that
    of neighbours but one along the rows, by the sum of squares.

    Returns:
        Between 0 and 1; 0 where nothing is seen.
    """
    n = view.depth.size
    if len(view.depths) == 0:
        return 0.0
    nearest = view.depths.min()
    level = np.rint(GREYS - (GREYS - 1) / 2 * (view.depths - nearest)).clip(1, GREYS)
    grey = level / GREYS
    image = np.zeros(view.near.shape)
    image[view.seen] = grey
    counts = np.bincount(level.astype(np.int64), minlength=GREYS + 1)
    counts[0] = n - len(level)
    total = grey.sum()
    squares = grey @ grey
    variance = squares / n - (total / n) ** 2
    nearer, farther = (
        np.einsum("hw,hw->", image[:, :-k], image[:, k:]) for k in (1, 2)
    )
    vollath = nearer - farther
    # The entropy of 257 levels can pass 8 bits by a hair.
    return float(
        (4 * variance + min(bits(counts / n) / 8, 1) + max(vollath, 0) / squares) / 3
    )


@rated("depth")
def silhouette_length(view: MeasuredView) -> float:
    """Length of the object's outline, holes included, in sides of the image.

    By Cauchy and Crofton: the length of a curve is half the mean number of times that lines cross
    it, over all lines. Counted over the lines through the pixels' centres in four directions, which
    is right within a few per cent where counting edge pixels is wrong by up to 41 % on slopes.
    Polonsky et al. 2005, Secord et al. 2011 ("silhouette length"); thesis, section 3.4.2.

    Returns:
        0 where nothing is seen.
    """
    seen = np.pad(view.seen, 1)
    straight = np.count_nonzero(seen[1:] != seen[:-1]) + np.count_nonzero(
        seen[:, 1:] != seen[:, :-1]
    )
    diagonal = np.count_nonzero(seen[1:, 1:] != seen[:-1, :-1]) + np.count_nonzero(
        seen[1:, :-1] != seen[:-1, 1:]
    )
    # Lines along the diagonals are 1/sqrt(2) pixels apart; the four directions share pi.
    return float(np.pi / 8 * (straight + diagonal / np.sqrt(2)) / max(view.depth.shape))


@rated("depth")
def silhouette_entropy(view: MeasuredView) -> float:
    """Shannon entropy of the distribution of turns along the object's outline, holes included.

    At every pixel's length of outline, the angle between what comes before and what comes after;
    their histogram is blurred by the accuracy of an angle, whose own entropy is taken off again, so
    that no border between two cells decides. Page et al. 2003, Polonsky et al. 2005 ("silhouette
    entropy"); thesis, section 3.4.2: the curvature entropy of the silhouette.

    Returns:
        Bits; 0 for a circle, which turns everywhere alike, but for its pixels, and where nothing is
        seen.
    """
    if len(view.depths) == 0:
        return 0.0
    arm = ARM * max(view.depth.shape)
    seen = np.pad(view.seen, 1).astype(np.float64)
    outlines: Any = contour_generator(
        z=seen,
        line_type=LineType.ChunkCombinedOffset,
    ).lines(0.5)
    (points,), (offsets,) = outlines
    turns = _turns(points, offsets.astype(np.int64), arm)
    counts = np.bincount(
        np.rint((turns / (2 * np.pi) + 0.5) * TURNS).astype(np.int64) % TURNS,
        minlength=TURNS,
    )
    blur = _blur(TURNS, TURN_ACCURACY * TURNS / (2 * np.pi))
    spread = irfft(rfft(counts) * rfft(blur))
    return max(bits(spread / spread.sum()) - bits(blur), 0.0)


def _turns(
    points: NDArray[np.float64],
    offsets: NDArray[np.int64],
    arm: float,
) -> NDArray[np.float64]:
    """Signed turns along closed outlines, (n,) radians, at every pixel's length of them.

    Outline i has the points (P, 2) from offset i up to offset i + 1; its last is its first.
    """
    step = np.sqrt((np.diff(points, axis=0) ** 2).sum(1))
    # also from one outline to the next, where nobody looks
    along = np.concatenate([[0], np.cumsum(step)])
    begin = along[offsets[:-1]]
    length = along[offsets[1:] - 1] - begin
    n = np.maximum(length.astype(np.int64), 8)
    first = np.cumsum(n) - n
    of = np.repeat(np.arange(len(n)), n)
    i = np.arange(len(of)) - first[of]
    at = begin[of] + i * (length / n)[of]
    places = np.interp(at, along, points[:, 0]) + 1j * np.interp(
        at,
        along,
        points[:, 1],
    )
    # Nothing is smaller than a few pixels: on a short outline the arms are a quarter of it.
    k = np.maximum(np.minimum(n // 4, round(arm)), 1)[of]
    ahead, behind = (places[first[of] + (i + way) % n[of]] for way in (k, -k))
    return np.angle((ahead - places) * np.conj(places - behind))


@rated("depth")
def above_preference(view: MeasuredView) -> float:
    """How near the view is to the elevation that people choose: a normal curve about 22.5 degrees
    above the horizon.

    Secord et al. 2011 ("above preference": mean 3/8 pi from the pole, standard deviation pi/4);
    thesis, section 3.4.5. It knows nothing of the object, but where nothing is seen there is
    nothing to like.

    Returns:
        1 at that elevation, less above and below; 0 where nothing is seen.
    """
    if len(view.depths) == 0:
        return 0.0
    up = view.pose[2, 3] / np.linalg.norm(view.pose[:3, 3])
    elevation = np.degrees(np.arcsin(np.clip(up, -1, 1)))
    return float(np.exp(-(((elevation - LIKED) / SPREAD) ** 2) / 2))


@rated("mesh")
def base_avoidance(view: MeshView) -> float:
    """Share of the visible pixels that do not show the object's base: the underside of its lowest
    part.

    Secord et al. 2011 ("base"), turned round so that more is better; thesis, section 3.4.5. The
    base is seen from below the horizon only: from the 40 views this is 1 always, or nearly.

    Returns:
        Between 0 and 1; 0 where nothing is seen.
    """
    surface, (faces, pixels) = view.surface, view.pixels
    if len(faces) == 0:
        return 0.0
    normals = surface.normals[faces]
    # A face's own normal may point either way; what counts is the side that the camera is on.
    towards = (
        (view.pose[:3, 3] - surface.vertices[surface.faces[faces]].mean(1)) * normals
    ).sum(1)
    down = -normals[:, 2] * np.sign(towards)
    heights = surface.vertices[:, 2]
    low = heights.min()
    high = heights.max()
    base = (down > DOWN) & (
        heights[surface.faces[faces]].max(1) < low + BASE * (high - low)
    )
    return float(1 - pixels[base].sum() / pixels.sum())


@rated("depth")
def gradient_entropy(view: MeasuredView) -> float:
    """What the view tells of the directions in which the surface faces, bits.

    The gradient of the inverse depth is the same all over a plane: together with its value it is
    the plane's normal, whatever the slant. The normals of all visible pixels are laid out in an
    equal-area map, as a histogram that is blurred by the accuracy of a direction. Its entropy, less
    that of the blur itself, is what a look at one random pixel tells of the surface there. It is
    the same for a plane seen from the front and at a slant, 0, and is made by directions that
    differ. Holes and the background do not count.

    Returns:
        Bits: 0 for a plane, or where nothing is seen; 1 for two that are seen equally large.
    """
    a, b, c = visible_normals(view)
    if len(c) == 0:
        return 0.0
    # Lambert's map: the hemisphere that faces the camera is the disc of radius sqrt(2), the other
    # lies around it.
    outward = DIRECTIONS / 4 * np.sqrt(2 / np.maximum(1 + c, 1e-6))
    across, down = (
        (slope * outward + DIRECTIONS / 2).astype(np.int64).clip(0, DIRECTIONS - 1)
        for slope in (a, b)
    )
    counts = np.bincount(across * DIRECTIONS + down, minlength=DIRECTIONS**2).reshape(
        DIRECTIONS,
        DIRECTIONS,
    )
    blur = _blur(DIRECTIONS, DIRECTION_ACCURACY * DIRECTIONS / 4)
    spread = irfft2(rfft2(counts) * rfft2(np.outer(blur, blur)))
    return max(bits(spread / spread.sum()) - 2 * bits(blur), 0.0)


def visible_normals(view: MeasuredView) -> NDArray[np.float32]:
    """Unit normals of the visible pixels in the camera's axes, (3, n) float32, away from the
    camera.

    From the inverse depth's change to the neighbour at which it changes less, which lies on the
    same surface. Pixels without a neighbour to the side, or above and below, are left out.
    """
    if len(view.depths) == 0:
        return np.zeros((3, 0), np.float32)
    inverse = np.full(view.near.shape, BACKGROUND)
    np.divide(1, view.near, out=inverse, where=view.seen, casting="same_kind")
    a, b = (_change(inverse, axis) for axis in (1, 0))
    known = view.seen & (np.maximum(np.abs(a), np.abs(b)) < BACKGROUND / 2)
    a = a[known] * np.float32(view.intrinsics[0, 0])
    b = b[known] * np.float32(view.intrinsics[1, 1])
    (rows, columns), (fx, _, cx), (_, fy, cy) = view.box, *view.intrinsics[:2]
    x = ((np.arange(columns.start, columns.stop) + 0.5 - cx) / fx).astype(np.float32)
    y = ((np.arange(rows.start, rows.stop) + 0.5 - cy) / fy).astype(np.float32)
    x, y = (np.broadcast_to(slopes, known.shape)[known] for slopes in (x, y[:, None]))
    normals = np.stack([a, b, inverse[known] - a * x - b * y])
    return normals / np.sqrt((normals**2).sum(0))


def _change(inverse: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """To the next pixel along an axis, or from the one before, whichever is less; huge where
    neither is seen.
    """
    back = [slice(None)] * 2
    on = [slice(None)] * 2
    back[axis], on[axis] = slice(None, -1), slice(1, None)
    step = np.diff(inverse, axis=axis)
    change = np.full(inverse.shape, BACKGROUND)
    change[*back] = step
    np.copyto(change[*on], step, where=np.abs(step) <= np.abs(change[*on]))
    return change


MEASURES = BUILT_IN | {
    name: value for name, value in globals().items() if isinstance(value, Measure)
}
