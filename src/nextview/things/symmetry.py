"""Rotational symmetries of a surface: axes and angles that map it to itself.

A rotation is a symmetry if hardly any of the visible surface deviates from the rotated surface.
The tolerance is a small part of the diameter plus the error of the surface: an exact mesh maps to
itself to within its facets, a scan to within its errors. The rotation that fits best measures this
error, so that the tolerance does not grow with the misfit of the rotation that is tested. The
criterion is the area of the deviating parts, not a quantile, which would miss a hole or a keyway.
The BOP toolkit (Hodan et al., "BOP Challenge 2020 on 6D Object Localization", ECCV workshops 2020)
uses the larger of 15 mm and a tenth of the diameter, the tolerance of people who look at pictures;
a depth camera resolves the holes of a flange.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import QhullError, cKDTree
from scipy.spatial.transform import Rotation

from nextview.geometry.ray_caster import embree_scene
from nextview.recognition.model_card import Symmetry
from nextview.things.surface import Surface
from nextview.things.visible_points import spread_directions
from nextview.types import Float, Mask

# relative to the diameter: facets of a circle with 16 corners, and the resolution of a camera at
# five radii
SYMMETRY_TOLERANCE = 0.01
# tolerance of most of a scan, in errors of the surface, as for bulges and seams
USUAL_ERRORS = 8.0
# tolerance of all but MOVED_SHARE, as for the inside of a cup that no scanner reaches
LOCAL_ERRORS = 100.0
# largest error about one axis, in errors of the surface: the scan of a lid is worse than of a side
AXIS_ERRORS = 6.0
LARGEST_LOCAL_ERROR = 0.09  # of the diameter
# share of the surface that may exceed it: the walls of a keyway are twice as much of a gear
MOVED_SHARE = 0.0075
# largest median distance of a surface from its rotated copy, relative to the diameter, and largest
# share that is farther away than usual; of a near symmetry a part of the thing deviates
MEDIAN_BOUNDS = {"same": 0.01, "nearly": 0.025}
BESIDE_BOUNDS = {"same": 0.1, "nearly": 0.15}
HIGHEST_ORDER = 40  # highest order of a symmetry, such as the number of teeth of a gear
# powers of primes up to the highest order
POWERS = (2, 3, 4, 5, 7, 8, 9, 11, 13, 16, 17, 19, 23, 25, 27, 29, 31, 32, 37)
# tested rotations for continuous symmetry, in full turns
ANY_TURNS = np.arange(23, 0, -2) / 48
# sample points of the surface, whose triangles are candidates for the nearest one
SAMPLE_POINTS = 20_000
COPIED_POINTS = 3000  # visible sample points of the rotated copy
GUESSED_POINTS = 400  # of these, points of a quick test that rejects most rotations
# share of them that lies near the surface even for an inaccurate axis
GUESSED_SHARE = 0.9
GUESSED_DISTANCE = 0.06  # distance that counts as near, relative to the diameter
# multiple of the bounds beyond which the quick test decides
CLEARLY_BESIDE = 1.5
NEAREST_TRIANGLES = 4  # candidate triangles of each point
FITTED_STEPS = 5  # steps of the fit of a rotated copy
REFINED_STEPS = 2  # further steps after a fit of few points
# weight of the prior of a tilt that the surface does not determine
FREE_TILT = 1e-3
# full turns: far from the rotations of symmetries of order 2, 3 and 4
TELLING_TURN = 0.37
LEAST_APART = 1e-9  # metres
SEEN_FROM = 48  # directions from which the visibility of a point is tested
ABOVE = 1e-3  # offset of a visible point from the surface, relative to the diameter
MOST_AXES = 3  # most reported axes: all others of a cube follow from three
# step between candidate axes perpendicular to an axis of symmetry
STEP_ACROSS = np.radians(5)
AXIS_TOLERANCE = np.radians(20)  # axes within this angle are duplicates
SAME_CANDIDATE = np.radians(1)  # candidate axes within this angle are duplicates


def find_symmetries(surface: Surface) -> tuple[Symmetry, ...]:
    """Find the axes and orders of a surface's symmetries.

    The candidate axes pass through the centroid of the surface, which every symmetry leaves fixed.
    They are the axes of the file, the principal axes and those of the smallest bounding box; each
    is refined to the best fit of the rotated copy. If the surface has a continuous symmetry about
    one axis, only one of the perpendicular axes is returned, because the others follow.

    Args:
        surface: surface of a thing.

    Returns:
        Its symmetries: continuous ones first, then the others by their order.
    """
    compared = _compared(surface)
    found = _found(compared, "same")
    if _is_ball([axis for axis, order in found if order == 0]):
        return tuple(_symmetry(axis, 0) for axis in np.eye(3))
    symmetries = _distinct(found)
    if len(symmetries) == 1:
        symmetries += _half_turn_across(compared, np.array(symmetries[0].axis))
    return tuple(symmetries)


def find_near_symmetries(surface: Surface) -> tuple[Symmetry, ...]:
    """Find axes about which a rotated surface looks almost the same.

    Views that do not show the differences leave the choice between these poses open.

    Args:
        surface: surface of a thing.

    Returns:
        Axes and orders, including those of exact symmetries.
    """
    return tuple(_distinct(_found(_compared(surface), "nearly")))


# at most a tiny, or a small, part of the surface deviates
Kind = Literal["same", "nearly"]


@dataclass(frozen=True, eq=False)
class _Turned:
    """Comparison of a surface with its rotated copy.

    Attributes:
        median: median distance of the points of the copy from the surface, metres.
        fits: whether the rotation is a symmetry of the requested kind.
        axis: axis of the rotation after the fit, (3,).
    """

    median: float
    fits: bool
    axis: Float


@dataclass(frozen=True, eq=False)
class _Motion:
    """A rotation about an axis that passes near the centroid.

    Attributes:
        rotation: the rotation about the centroid.
        shift: displacement after it, (3,), metres.
    """

    rotation: Rotation
    shift: Float

    def apply(self, points: Float) -> Float:
        """Move points, (N, 3), metres."""
        return np.asarray(self.rotation.apply(points) + self.shift)


@dataclass(frozen=True, eq=False)
class _Guess:
    """A rotated copy of few points after the fit.

    Attributes:
        motion: rotation and displacement of the copy; None if none near the rotation makes it fit.
        distances: distances of the points from the surface, (N,), relative to the diameter.
        median: their median.
    """

    motion: _Motion | None
    distances: Float
    median: float


class _Compared:
    """A surface, prepared for comparisons with rotated copies of its visible part.

    Its centroid is the origin. Comparisons are cached: orders share rotations, and exact and near
    symmetries share guesses.

    The target is the whole surface: a point inside a pipe may come to lie where no camera reaches.
    """

    def __init__(self, surface: Surface) -> None:
        rng = np.random.default_rng(0)
        self.diameter = surface.diameter
        self._triangles = surface.triangles_by_area(SAMPLE_POINTS, rng)
        self._corners = (
            surface.vertices[surface.faces].astype(np.float64) - surface.centroid
        )
        shares = rng.dirichlet(np.ones(3), SAMPLE_POINTS)
        self._points = np.einsum("nk,nki->ni", shares, self._corners[self._triangles])
        corners = self._corners[self._triangles]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(across, axis=1, keepdims=True)
        self._normals = across / lengths.clip(1e-30)

        self._visible = self._points[self._seen(surface)]
        self._tree = cKDTree(self._points)
        self.axes = _axes(surface)
        self._known = dict[tuple[bytes, float], _Guess]()
        self._exactly = dict[tuple[bytes, float], tuple[_Motion, Float]]()

    def _seen(self, surface: Surface) -> Mask:
        """Points that a camera outside can see, (N,), as opposed to faces inside a solid."""
        scene = embree_scene(
            [(self._corners.reshape(-1, 3), _each_on_its_own(surface))]
        )
        above = ABOVE * self.diameter * self._normals
        left = np.arange(len(self._points))  # invisible so far

        for direction in spread_directions(SEEN_FROM):
            side = np.sign(self._normals[left] @ direction)[:, None]
            hidden = scene.run(
                (self._points[left] + side * above[left]).astype(np.float32),
                np.tile(direction.astype(np.float32), (len(left), 1)),
                output=1,
            )["primID"]
            left = left[hidden >= 0]
            if not len(left):
                break

        seen = np.ones(len(self._points), bool)
        seen[left] = False
        return seen if seen.any() else ~seen

    def error_about(self, axes: Sequence[Float], turns: Iterable[float]) -> float:
        """Error of the surface, relative to the diameter, as rotations about some axes show it.

        It is the smallest median distance of any of the rotations, but not much larger than the
        smallest about all candidate axes: if one rotation is exact, so is the surface.

        Args:
            axes: unit vectors, (3,) each.
            turns: angles, full turns.
        """
        least = self._least_median(axes, turns)
        return min(least, AXIS_ERRORS * self._error)

    @cached_property
    def _error(self) -> float:
        """Smallest median distance of any rotation about a candidate axis."""
        return self._least_median(self.axes, map(_telling, POWERS))

    def _least_median(self, axes: Sequence[Float], turns: Iterable[float]) -> float:
        guesses = [self._guess(axis, turn) for turn in turns for axis in axes]
        return min(guess.median for guess in guesses)

    def turned(self, axis: Float, turn: float, error: float, kind: Kind) -> _Turned:
        """Compare with the copy that is rotated about an axis.

        Args:
            axis: unit vector, (3,).
            turn: angle, full turns.
            error: error of the surface, relative to the diameter.
            kind: kind of symmetry.
        """
        guess = self._guess(axis, turn)
        beside = max(
            guess.median / MEDIAN_BOUNDS[kind],
            _beside(guess.distances, error) / BESIDE_BOUNDS[kind],
        )
        if guess.motion is None or beside > CLEARLY_BESIDE:
            return _Turned(guess.median * self.diameter, False, axis)
        if kind == "nearly" and beside * CLEARLY_BESIDE < 1:
            return _Turned(guess.median * self.diameter, True, _axis_of(guess.motion))

        key = (axis.tobytes(), turn)
        if key not in self._exactly:
            some = self._visible[: COPIED_POINTS // 3]
            motion = self._fitted(guess.motion, axis, some, REFINED_STEPS)
            copied = motion.apply(self._visible[:COPIED_POINTS])
            self._exactly[key] = motion, self._distances(copied)

        motion, distances = self._exactly[key]
        median = float(np.median(distances))
        fits = (
            median < MEDIAN_BOUNDS[kind]
            and _beside(distances, error) < BESIDE_BOUNDS[kind]
        )
        if kind == "same":
            local = min(SYMMETRY_TOLERANCE + LOCAL_ERRORS * error, LARGEST_LOCAL_ERROR)
            fits = fits and bool((distances > local).mean() < MOVED_SHARE)
        return _Turned(median * self.diameter, fits, _axis_of(motion))

    def _guess(self, axis: Float, turn: float) -> _Guess:
        """Rotate few points about an axis, and fit the axis."""
        key = (axis.tobytes(), turn)
        if key not in self._known:
            motion = _Motion(Rotation.from_rotvec(2 * np.pi * turn * axis), np.zeros(3))
            few = self._visible[:GUESSED_POINTS]
            distances = np.asarray(self._tree.query(motion.apply(few))[0])
            distances = distances / self.diameter
            near = np.quantile(distances, GUESSED_SHARE) <= GUESSED_DISTANCE
            if near:
                motion = self._fitted(motion, axis, few)
                distances = self._distances(motion.apply(few))
            self._known[key] = _Guess(
                motion if near else None,
                distances,
                float(np.median(distances)),
            )
        return self._known[key]

    def _fitted(
        self,
        motion: _Motion,
        axis: Float,
        points: Float,
        steps: int = FITTED_STEPS,
    ) -> _Motion:
        """Fit tilt and displacement of the axis, without further rotation about it.

        Point-to-plane registration of some points, (N, 3), with the nearest sample points;
        deviating parts have little weight. A detail that breaks a symmetry, such as a keyway,
        displaces the centroid from the axis of the rest.
        """
        first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        first /= np.linalg.norm(first)
        across = np.stack([first, np.cross(axis, first)])
        for _ in range(steps):
            copy = motion.apply(points)
            apart, nearest = self._tree.query(copy)
            normals = self._normals[nearest]
            along = np.einsum("ni,ni->n", self._points[nearest] - copy, normals)
            weights = np.asarray(
                1 / (1 + (apart / (np.median(apart) + LEAST_APART)) ** 2)
            )
            # Tilts are in radians, displacements in diameters.
            moving = np.c_[
                np.cross(copy, normals) @ across.T,
                self.diameter * normals @ across.T,
            ]
            left = (moving * weights[:, None]).T @ moving
            # The tilt of a ball is undetermined, and so is the displacement of a plane.
            left += FREE_TILT * weights.sum() * self.diameter**2 * np.eye(4)
            change = np.linalg.solve(left, moving.T @ (weights * along))
            tilt = Rotation.from_rotvec(change[:2] @ across)
            shift = tilt.apply(motion.shift) + self.diameter * change[2:] @ across
            motion = _Motion(tilt * motion.rotation, shift)
        return motion

    def _distances(self, points: Float) -> Float:
        """Distances of points from the surface, (N,), relative to the diameter."""
        nearest = self._tree.query(points, k=NEAREST_TRIANGLES)[1]
        corners = self._corners[self._triangles[nearest]]
        return _from_triangles(points[:, None], corners).min(1) / self.diameter


@lru_cache(maxsize=1)
def _compared(surface: Surface) -> _Compared:
    """A surface prepared for comparisons with its rotated copies; the last one is cached."""
    return _Compared(surface)


def _beside(distances: Float, error: float) -> float:
    """Share of distances that are larger than usual for a surface with this error."""
    return float((distances > SYMMETRY_TOLERANCE + USUAL_ERRORS * error).mean())


def _axis_of(motion: _Motion) -> Float:
    """Axis of a rotation, unit vector, (3,)."""
    vector = motion.rotation.as_rotvec()
    return np.asarray(vector / np.linalg.norm(vector))


def _each_on_its_own(surface: Surface) -> NDArray[np.int32]:
    """Triangles, (F, 3), without shared corners."""
    return np.arange(3 * len(surface.faces), dtype=np.int32).reshape(-1, 3)


def _from_triangles(points: Float, corners: Float) -> Float:
    """Distances of points, (N, 1, 3), from triangles, (N, K, 3, 3): (N, K)."""
    # Coordinates come first, each in an array of its own: that is three times as fast.
    point = np.moveaxis(points, -1, 0).copy()
    first, second, third = np.moveaxis(corners, (-2, -1), (0, 1)).copy()
    edge, other = second - first, third - first
    normal = _cross(edge, other)
    square = np.maximum(_dot(normal, normal), 1e-30)
    to_point = point - first
    # Barycentric coordinates of the foot of the perpendicular.
    along = _dot(_cross(to_point, other), normal) / square
    across = _dot(_cross(edge, to_point), normal) / square
    inside = (along >= 0) & (across >= 0) & (along + across <= 1)
    above = np.abs(_dot(to_point, normal)) / np.sqrt(square)

    beside = np.full(above.shape, np.inf)
    for start, end in ((first, second), (second, third), (third, first)):
        side = end - start
        from_start = point - start
        length = np.maximum(_dot(side, side), 1e-30)
        apart = from_start - np.clip(_dot(from_start, side) / length, 0, 1) * side
        beside = np.minimum(beside, np.sqrt(_dot(apart, apart)))
    return np.where(inside, above, beside)


def _dot(first: Float, second: Float) -> Float:
    """Dot products of vectors whose coordinates come first, (3, ...)."""
    x, y, z = first * second
    return np.asarray(x + y + z)


def _cross(first: Float, second: Float) -> Float:
    """Cross products of vectors whose coordinates come first, (3, ...)."""
    (a, b, c), (x, y, z) = first, second
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x])


def _half_turn_across(compared: _Compared, axis: Float) -> list[Symmetry]:
    """Find a two-fold symmetry about an axis perpendicular to another one."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    angles = np.arange(0, np.pi, STEP_ACROSS)[:, None]
    across = list(np.cos(angles) * first + np.sin(angles) * np.cross(axis, first))
    error = compared.error_about(across, [0.5])
    turned = [compared.turned(direction, 0.5, error, "same") for direction in across]

    best = min(turned, key=lambda one: (not one.fits, one.median))
    return [_symmetry(best.axis, 2)] if best.fits else []


def _is_ball(axes: Sequence[Float]) -> bool:
    """Whether the axes of continuous symmetries differ."""
    return any(abs(axis @ axes[0]) < np.cos(AXIS_TOLERANCE) for axis in axes)


def _found(
    compared: _Compared,
    kind: Kind,
) -> list[tuple[Float, int]]:
    """Axes and orders of a kind of symmetry: continuous first, then by order, then by accuracy."""
    found = []
    for axis in compared.axes:
        order, deviation, fitted = _order(compared, axis, kind)
        if order != 1:
            found.append((order, deviation, fitted))
        if kind == "same" and _is_ball([axis for order, _, axis in found if not order]):
            break  # all axes of a ball are equivalent

    found.sort(key=lambda item: (item[0] != 0, -item[0], item[1]))
    return [(axis, order) for order, _, axis in found]


def _axes(surface: Surface) -> list[Float]:
    """Candidate axes, unit vectors, (3,) each."""
    tried: list[Float] = []
    for axis in np.concatenate([np.eye(3), _box_axes(surface), _principal(surface)]):
        if all(abs(axis @ other) < np.cos(SAME_CANDIDATE) for other in tried):
            tried.append(axis)
    return tried


def _principal(surface: Surface) -> Float:
    """Principal axes of a surface, (3, 3), exact even if two moments nearly agree."""
    corners = surface.vertices[surface.faces].astype(np.float64) - surface.centroid
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(across, axis=1)
    total = corners.sum(1)
    moments = np.einsum("f,fki,fkj->ij", areas, corners, corners)
    moments += np.einsum("f,fi,fj->ij", areas, total, total)
    return np.linalg.eigh(moments)[1].T


def _box_axes(surface: Surface) -> Float:
    """Axes of the smallest bounding box of a surface, (N, 3); none for a flat surface."""
    from trimesh.bounds import oriented_bounds

    try:
        to_box = oriented_bounds(surface.vertices)[0]
    except (
        QhullError,
        ValueError,
    ):  # coplanar or nearly coplanar points
        return np.zeros((0, 3))
    return np.asarray(to_box, np.float64)[:3, :3]


def _order(
    compared: _Compared,
    axis: Float,
    kind: Kind,
) -> tuple[int, float, Float]:
    """Highest order of a symmetry about an axis, its median distance, metres, and the axis.

    The order is 0 for a continuous symmetry, and 1 for none.
    """
    # Of candidates that end in one axis, the worst may be too far off to show the error.
    alike = np.abs(np.array(compared.axes) @ axis) > np.cos(AXIS_TOLERANCE)
    axes = [one for one, is_near in zip(compared.axes, alike, strict=True) if is_near]
    error = compared.error_about(axes, map(_telling, POWERS))
    largest = compared.turned(axis, float(ANY_TURNS[0]), error, kind)
    if largest.fits:
        worst = _worst(compared, largest.axis, ANY_TURNS, error, kind)
        if worst is not None:
            return 0, worst, largest.axis

    # Rotations by 1/4 and 1/3 of a full turn generate one by 1/12: powers of primes are tested,
    # then their products.
    tried = {
        power: compared.turned(axis, _telling(power), error, kind) for power in POWERS
    }
    possible = {power: turned for power, turned in tried.items() if turned.fits}
    if not possible:
        return 1, np.inf, axis
    fitted = min(possible.values(), key=lambda turned: turned.median).axis
    for order in _orders(math.lcm(*possible)):
        # Rotations in both directions are equivalent.
        turns = _tellingly(np.arange(1, order // 2 + 1) / order)
        worst = _worst(compared, fitted, turns, error, kind)
        if worst is not None:
            return order, worst, fitted
    return 1, np.inf, axis


def _telling(order: int) -> float:
    """The rotation of an order that lower orders are least likely to allow, full turns."""
    steps = [step for step in range(1, order) if np.gcd(step, order) == 1]
    return float(_tellingly(np.array(steps) / order)[0])


def _tellingly(turns: Float) -> Float:
    """Rotations, (N,), sorted by how likely they are to refute a symmetry."""
    return turns[np.abs(turns - TELLING_TURN).argsort(kind="stable")]


def _orders(whole: int) -> Sequence[int]:
    """Candidates of the highest order, highest first: divisors of the product of those found."""
    return [order for order in range(HIGHEST_ORDER, 1, -1) if whole % order == 0]


def _worst(
    compared: _Compared,
    axis: Float,
    turns: Float,
    error: float,
    kind: Kind,
) -> float | None:
    """Largest median distance of some rotations, metres; None if one of them is no symmetry."""
    worst = 0.0
    for turn in turns.tolist():
        turned = compared.turned(axis, turn, error, kind)
        if not turned.fits:
            return None
        worst = max(worst, turned.median)
    return worst


def _distinct(found: Iterable[tuple[Float, int]]) -> list[Symmetry]:
    """Symmetries about different axes, from a list that is sorted by importance."""
    kept: list[Symmetry] = []
    across = False  # whether an axis perpendicular to a continuous one is in the list
    for axis, order in found:
        if len(kept) == MOST_AXES:
            break
        alike = np.abs([axis @ np.array(other.axis) for other in kept])
        if (alike > np.cos(AXIS_TOLERANCE)).any():
            continue
        if order and any(other.order == 0 for other in kept):
            if across:
                continue
            across = True
        kept.append(_symmetry(axis, order))
    return kept


def _symmetry(axis: Float, order: int) -> Symmetry:
    """A symmetry in the format of cards; the longest component of its axis is positive."""
    longest = axis[np.abs(axis).argmax()]
    x, y, z = np.round(axis * np.sign(longest) / np.linalg.norm(axis), 6).tolist()
    return Symmetry((x, y, z), order)
