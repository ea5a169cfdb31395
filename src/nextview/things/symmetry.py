"""Symmetries of a surface: axes about which it can be turned and stays the same.

A turn is a symmetry where hardly any of the surface lies beside its turned copy. How far beside is
a small part of the diameter, and as much more as the surface itself is inexact: an exact mesh comes
back to itself to within its facets, a scan to within its errors, and these show in the median of
the distances. What remains is judged by its area and not by a quantile that a hole or a keyway
escapes. The BOP toolkit (Hodan et al., "BOP Challenge 2020 on 6D Object Localization", ECCV
workshops 2020) allows the larger of 15 mm and a tenth of the diameter everywhere, which is the
tolerance of people who look at pictures; a depth camera sees the holes of a flange.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import QhullError, cKDTree
from scipy.spatial.transform import Rotation

from nextview.geometry.ray_caster import embree_scene
from nextview.recognition.model_card import Symmetry
from nextview.things.surface import Surface
from nextview.things.view_templates import spread_directions
from nextview.types import Float, Mask

# of the diameter: facets of a circle with 16 corners, and what a camera sees from five radii away
SYMMETRY_TOLERANCE = 0.01
# of the diameter, median distance of a surface from its turned copy
SAME_MEDIAN = 0.01
# median distances that a tenth of a scan may be off, as by bulges and seams
USUAL_ERRORS = 8.0
USUAL_SHARE = 0.1
# and that hardly any of it may be off, as the inside of a cup that no scanner looks into
LOCAL_ERRORS = 40.0
LARGEST_LOCAL_ERROR = 0.08  # of the diameter
MOVED_SHARE = 0.0075  # hardly any: the walls of a keyway are twice as much of a gear
# the same of near symmetries, after which a part of a thing is elsewhere
NEAR_MEDIAN = 0.025
NEAR_SHARE = 0.15
HIGHEST_ORDER = 40  # of a symmetry: as many teeth as a gear has
# powers of primes up to that
POWERS = (2, 3, 4, 5, 7, 8, 9, 11, 13, 16, 17, 19, 23, 25, 27, 29, 31, 32, 37)
# of a full turn, that are tried for a symmetry of any angle
ANY_TURNS = np.arange(23, 0, -2) / 48
# of the surface: what is near is looked for among the triangles that they are on
SAMPLE_POINTS = 20_000
COPIED_POINTS = 3000  # of its turned copy
GUESSED_POINTS = 400  # of it, that show quickly that a turn is no symmetry
# of these, that lie near the surface however badly the axis is known
GUESSED_SHARE = 0.9
GUESSED_DISTANCE = 0.06  # of the diameter, that is near
NEAREST_TRIANGLES = 4  # among which the nearest one is looked for
FITTED_STEPS = 5  # in which a turned copy is moved to where it fits
# share of the weights that holds a tilt of which the surface says nothing
FREE_TILT = 1e-3
LEAST_APART = 1e-9  # metres
SEEN_FROM = 48  # directions from one of which a point has to be seen to count
ABOVE = 1e-3  # of the diameter, that it is seen from above the surface
MOST_AXES = 3  # that are named: all others of a cube follow from three
STEP_ACROSS = np.radians(5)  # between axes that are tried across one of a symmetry
AXIS_TOLERANCE = np.radians(20)  # axes within this angle are one
SAME_CANDIDATE = np.radians(1)  # axes to be tried within this angle are one


def find_symmetries(surface: Surface) -> tuple[Symmetry, ...]:
    """Find the axes and orders of a surface's symmetries.

    The candidate axes pass through the centroid of the surface, which every symmetry leaves fixed.
    They are the axes of the file, the principal axes and those of the smallest bounding box; each
    is corrected to where the turned copy fits best. If the surface is symmetric by any angle about
    one axis, only one of the axes perpendicular to it is returned, because the others follow.

    Args:
        surface: of a thing.

    Returns:
        Its symmetries: first those of any angle, then the others by their order.
    """
    compared = _Compared(surface)
    found = _found(compared, surface, "same")
    if _is_ball([axis for axis, order in found if order == 0]):
        return tuple(_symmetry(axis, 0) for axis in np.eye(3))
    symmetries = _distinct(found)
    if len(symmetries) == 1:
        symmetries += _half_turn_across(compared, np.array(symmetries[0].axis))
    return tuple(symmetries)


def find_near_symmetries(surface: Surface) -> tuple[Symmetry, ...]:
    """Find axes about which a surface can be turned and hardly looks different.

    Views that do not show where it differs leave open which of these poses it has.

    Args:
        surface: of a thing.

    Returns:
        Axes and orders as those of symmetries, which are among them.
    """
    return tuple(_distinct(_found(_Compared(surface), surface, "nearly")))


@dataclass(frozen=True, eq=False)
class _Turned:
    """A surface beside its turned copy.

    Attributes:
        median: distance of the points of the copy from the surface, metres.
        same: whether hardly any of it lies beside.
        nearly: whether little of it lies beside.
        axis: about which it was turned, corrected to where it fits best, (3,).
    """

    median: float
    same: bool
    nearly: bool
    axis: Float


class _Compared:
    """What can be seen of a surface, which its turned copies are compared with.

    Its centroid is the origin.
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

        seen = self._seen(surface)
        self._triangles = self._triangles[seen]
        self._points = self._points[seen]
        self._normals = self._normals[seen]
        self._tree = cKDTree(self._points)

    def _seen(self, surface: Surface) -> Mask:
        """Which of the points a camera can see from outside, (N,): not faces inside of a solid."""
        scene = embree_scene(
            [(self._corners.reshape(-1, 3), _each_on_its_own(surface))]
        )
        seen = np.zeros(len(self._points), bool)
        above = ABOVE * self.diameter * self._normals
        for direction in spread_directions(SEEN_FROM):
            side = np.sign(self._normals @ direction)[:, None]
            hidden = scene.run(
                (self._points + side * above).astype(np.float32),
                np.tile(direction.astype(np.float32), (len(self._points), 1)),
                output=1,
            )["primID"]
            seen |= hidden < 0
        return seen if seen.any() else ~seen

    def turned(self, axis: Float, turn: float) -> _Turned:
        """Compare with the copy that is turned about an axis by a part of a full turn."""
        rotation = Rotation.from_rotvec(2 * np.pi * turn * axis)
        guess = self._tree.query(rotation.apply(self._points[:GUESSED_POINTS]))[0]
        if np.quantile(guess, GUESSED_SHARE) > GUESSED_DISTANCE * self.diameter:
            return _Turned(float(np.median(guess)), False, False, axis)

        rotation = self._fitted(rotation, axis)
        distances = self._distances(rotation.apply(self._points[:COPIED_POINTS]))
        distances /= self.diameter
        median = float(np.median(distances))
        usual = SYMMETRY_TOLERANCE + USUAL_ERRORS * median
        local = min(SYMMETRY_TOLERANCE + LOCAL_ERRORS * median, LARGEST_LOCAL_ERROR)
        beside = float((distances > usual).mean())
        same = (
            median < SAME_MEDIAN
            and beside < USUAL_SHARE
            and (distances > local).mean() < MOVED_SHARE
        )
        nearly = median < NEAR_MEDIAN and beside < NEAR_SHARE
        vector = rotation.as_rotvec()
        return _Turned(
            median * self.diameter,
            bool(same),
            nearly,
            vector / np.linalg.norm(vector),
        )

    def _fitted(self, rotation: Rotation, axis: Float) -> Rotation:
        """Tilt a turned copy to where it fits best, without turning it farther about the axis.

        Point to plane, by the nearest sampled points; what lies beside hardly counts.
        """
        points = self._points[: COPIED_POINTS // 3]
        first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        first /= np.linalg.norm(first)
        across = np.stack([first, np.cross(axis, first)])
        for _ in range(FITTED_STEPS):
            copy = rotation.apply(points)
            apart, nearest = self._tree.query(copy)
            normals = self._normals[nearest]
            along = np.einsum("ni,ni->n", self._points[nearest] - copy, normals)
            weights = np.asarray(
                1 / (1 + (apart / (np.median(apart) + LEAST_APART)) ** 2)
            )
            tilting = np.cross(copy, normals) @ across.T
            left = (tilting * weights[:, None]).T @ tilting
            # Of a ball nothing is drawn anywhere.
            left += FREE_TILT * weights.sum() * self.diameter**2 * np.eye(2)
            change = np.linalg.solve(left, tilting.T @ (weights * along))
            rotation = Rotation.from_rotvec(change @ across) * rotation
        return rotation

    def _distances(self, points: Float) -> Float:
        """Distances of points from the surface, (N,), metres."""
        nearest = self._tree.query(points, k=NEAREST_TRIANGLES)[1]
        corners = self._corners[self._triangles[nearest]]
        return _from_triangles(points[:, None], corners).min(1)


def _each_on_its_own(surface: Surface) -> NDArray[np.int32]:
    """Triangles, (F, 3), of as many corners one after the other."""
    return np.arange(3 * len(surface.faces), dtype=np.int32).reshape(-1, 3)


def _from_triangles(points: Float, corners: Float) -> Float:
    """Distances of points, (N, 1, 3), from triangles, (N, K, 3, 3): (N, K)."""
    first = corners[..., 0, :]
    edges = corners[..., 1:, :] - corners[..., :1, :]
    normal = np.cross(edges[..., 0, :], edges[..., 1, :])
    square = np.maximum((normal**2).sum(-1), 1e-30)
    to_point = points - first
    # Barycentric coordinates of the foot of the perpendicular.
    second = (np.cross(to_point, edges[..., 1, :]) * normal).sum(-1) / square
    third = (np.cross(edges[..., 0, :], to_point) * normal).sum(-1) / square
    inside = (second >= 0) & (third >= 0) & (second + third <= 1)
    above = np.abs((to_point * normal).sum(-1)) / np.sqrt(square)

    beside = np.full(above.shape, np.inf)
    for start, end in ((0, 1), (1, 2), (2, 0)):
        edge = corners[..., end, :] - corners[..., start, :]
        from_start = points - corners[..., start, :]
        length = np.maximum((edge**2).sum(-1), 1e-30)
        share = np.clip((from_start * edge).sum(-1) / length, 0, 1)
        apart = np.linalg.norm(from_start - share[..., None] * edge, axis=-1)
        beside = np.minimum(beside, apart)
    return np.where(inside, above, beside)


def _half_turn_across(compared: _Compared, axis: Float) -> list[Symmetry]:
    """A symmetry of half a turn about an axis across another one; its direction may be any."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    angles = np.arange(0, np.pi, STEP_ACROSS)[:, None]
    across = np.cos(angles) * first + np.sin(angles) * np.cross(axis, first)
    turned = [compared.turned(direction, 0.5) for direction in across]

    best = min(turned, key=lambda one: (not one.same, one.median))
    return [_symmetry(best.axis, 2)] if best.same else []


def _is_ball(axes: Sequence[Float]) -> bool:
    """Whether some axes of symmetries of any angle are not all one."""
    return any(abs(axis @ axes[0]) < np.cos(AXIS_TOLERANCE) for axis in axes)


def _found(
    compared: _Compared,
    surface: Surface,
    kind: Literal["same", "nearly"],
) -> list[tuple[Float, int]]:
    """Axes and orders of a kind of symmetry: any angle first, then high orders, then exact ones."""
    found = []
    for axis in _axes(surface):
        order, deviation, fitted = _order(compared, axis, kind)
        if order != 1:
            found.append((order, deviation, fitted))
        if kind == "same" and _is_ball([axis for order, _, axis in found if not order]):
            break  # no axis of a ball differs from another one

    found.sort(key=lambda item: (item[0] != 0, -item[0], item[1]))
    return [(axis, order) for order, _, axis in found]


def _axes(surface: Surface) -> list[Float]:
    """Unit vectors that are tried, (3,) each."""
    tried: list[Float] = []
    for axis in np.concatenate([np.eye(3), _box_axes(surface), _principal(surface)]):
        if all(abs(axis @ other) < np.cos(SAME_CANDIDATE) for other in tried):
            tried.append(axis)
    return tried


def _principal(surface: Surface) -> Float:
    """The principal axes of a surface, (3, 3), exactly: also where two moments nearly agree."""
    corners = surface.vertices[surface.faces].astype(np.float64) - surface.centroid
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(across, axis=1)
    total = corners.sum(1)
    moments = np.einsum("f,fki,fkj->ij", areas, corners, corners)
    moments += np.einsum("f,fi,fj->ij", areas, total, total)
    return np.linalg.eigh(moments)[1].T


def _box_axes(surface: Surface) -> Float:
    """The axes of the smallest box around a surface, (N, 3); none of a flat surface."""
    from trimesh.bounds import oriented_bounds

    try:
        to_box = oriented_bounds(surface.vertices)[0]
    except (
        QhullError,
        ValueError,
    ):  # of points in one plane, and of such that nearly are
        return np.zeros((0, 3))
    return np.asarray(to_box, np.float64)[:3, :3]


def _order(
    compared: _Compared,
    axis: Float,
    kind: Literal["same", "nearly"],
) -> tuple[int, float, Float]:
    """The highest order of a symmetry about an axis, how exact it is, metres, and the axis.

    The order is 0 for any angle, and 1 for none.
    """
    worst = _all_same(compared, axis, ANY_TURNS, kind)
    if worst is not None:
        return 0, worst.median, worst.axis

    # Turns by 1/4 and 1/3 of a full one make one by 1/12: powers of primes are tried, and of what
    # they make up the highest order first.
    finest = {
        power: getattr(compared.turned(axis, 1 / power), kind) for power in POWERS
    }
    for order in range(HIGHEST_ORDER, 1, -1):
        if not all(same for power, same in finest.items() if _part(power, order)):
            continue
        # A turn back is as good as one forth.
        worst = _all_same(compared, axis, np.arange(order // 2, 0, -1) / order, kind)
        if worst is not None:
            return order, worst.median, worst.axis
    return 1, np.inf, axis


def _part(power: int, order: int) -> bool:
    """Whether a power of a prime is one of the factors of an order that have no part in common."""
    return order % power == 0 and np.gcd(power, order // power) == 1


def _all_same(
    compared: _Compared,
    axis: Float,
    turns: Float,
    kind: Literal["same", "nearly"],
) -> _Turned | None:
    """The largest of some turns, with the worst median, where all are symmetries; else None."""
    largest = compared.turned(axis, float(turns[0]))
    if not getattr(largest, kind):
        return None
    worst = largest.median
    for turn in turns[1:]:
        other = compared.turned(largest.axis, float(turn))
        if not getattr(other, kind):
            return None
        worst = max(worst, other.median)
    return _Turned(worst, largest.same, largest.nearly, largest.axis)


def _distinct(found: Iterable[tuple[Float, int]]) -> list[Symmetry]:
    """The symmetries about different axes, of those that are sorted by what they tell."""
    kept: list[Symmetry] = []
    across = False  # whether an axis across one of any angle is there already
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
    """A symmetry as cards hold it; its axis has a positive longest component."""
    longest = axis[np.abs(axis).argmax()]
    x, y, z = np.round(axis * np.sign(longest) / np.linalg.norm(axis), 6).tolist()
    return Symmetry((x, y, z), order)
