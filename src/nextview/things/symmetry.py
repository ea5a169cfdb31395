"""Symmetries of a surface: axes about which it can be turned and stays the same.

A turn is a symmetry where the surface and its turned copy are nowhere farther apart than a
tolerance, as in the BOP toolkit (Hodan et al., "BOP Challenge 2020 on 6D Object Localization",
ECCV workshops 2020: the Hausdorff distance is below the larger of 15 mm and a tenth of the
diameter). Its tolerance is that of people who look at pictures; the one here is what a depth camera
can tell apart.
"""

from collections.abc import Iterable, Sequence
from fractions import Fraction

import numpy as np
from scipy.spatial import QhullError, cKDTree

from nextview.recognition.model_card import Symmetry
from nextview.things.surface import Surface
from nextview.types import Float, Mask

# metres: three deviations of edges that a stereo camera sees at arm's length
LEAST_TOLERANCE = 0.005
SYMMETRY_TOLERANCE = 0.02  # of the diameter: a camera stands farther from a large thing
COMPARED_SHARE = 0.95  # share of the surface that has to be that near: scans have spurs
HIGHEST_ORDER = 8
# of a full turn, that are tried for a symmetry of any angle
ANY_TURNS = np.arange(1, 24, 2) / 48
SYMMETRY_POINTS = 20_000  # of the surface that is compared with
TURNED_POINTS = 500  # of its turned copy
STEP_ACROSS = np.radians(5)  # between axes that are tried across one of a symmetry
AXIS_TOLERANCE = np.radians(20)  # axes within this angle are one


def find_symmetries(surface: Surface) -> tuple[Symmetry, ...]:
    """Find the axes and orders of a surface's symmetries.

    The candidate axes pass through the centroid of the surface, which every symmetry leaves fixed.
    They are the axes of the file, the principal axes and those of the smallest bounding box. If the
    surface is symmetric by any angle about one axis, only one of the axes perpendicular to it is
    returned, because the others follow.

    Args:
        surface: of a thing.

    Returns:
        Its symmetries: first those of any angle, then the others by their order.
    """
    rng = np.random.default_rng(0)
    whole = surface.sample(SYMMETRY_POINTS, rng)
    centroid = whole.mean(0)
    whole -= centroid
    tree = cKDTree(whole)
    points = surface.sample(TURNED_POINTS, rng) - centroid
    tolerance = _tolerance(surface)

    found = []
    for axis in _axes(surface, whole):
        order, deviation = _order(tree, points, axis, tolerance)
        if order != 1:
            found.append((order, deviation, axis))
    if _is_ball([axis for order, _, axis in found if order == 0]):
        return tuple(_symmetry(axis, 0) for axis in np.eye(3))

    found.sort(key=lambda item: (item[0] != 0, -item[0], item[1]))
    symmetries = _distinct((axis, order) for order, _, axis in found)
    if len(symmetries) == 1:
        symmetries += _half_turn_across(
            tree,
            points,
            np.array(symmetries[0].axis),
            tolerance,
        )
    return tuple(symmetries)


def coincide(surface: Surface, motions: Float) -> Mask:
    """Whether a surface and its moved copies are the same to a depth camera.

    Args:
        surface: of a thing.
        motions: of the copies, in the frame of the surface, (N, 4, 4), metres.

    Returns:
        (N,) bool.
    """
    rng = np.random.default_rng(0)
    tree = cKDTree(surface.sample(SYMMETRY_POINTS, rng))
    points = surface.sample(TURNED_POINTS, rng)
    there = points @ motions[:, :3, :3].swapaxes(1, 2) + motions[:, None, :3, 3]
    back = (points - motions[:, None, :3, 3]) @ motions[:, :3, :3]
    apart = np.stack([tree.query(moved)[0] for moved in (there, back)])
    worst = np.quantile(apart, COMPARED_SHARE, axis=2).max(0)
    return np.asarray(worst < _tolerance(surface))


def _tolerance(surface: Surface) -> float:
    """Distance of two surfaces that a depth camera does not see, metres."""
    return max(LEAST_TOLERANCE, SYMMETRY_TOLERANCE * surface.diameter)


def _half_turn_across(
    tree: cKDTree,
    points: Float,
    axis: Float,
    tolerance: float,
) -> list[Symmetry]:
    """A symmetry of half a turn about an axis across another one; its direction may be any."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    angles = np.arange(0, np.pi, STEP_ACROSS)[:, None]
    across = np.cos(angles) * first + np.sin(angles) * np.cross(axis, first)
    deviations = [_deviation(tree, points, direction, 0.5) for direction in across]

    best = int(np.argmin(deviations))
    return [_symmetry(across[best], 2)] if deviations[best] < tolerance else []


def _is_ball(axes: Sequence[Float]) -> bool:
    """Whether some axes of symmetries of any angle are not all one."""
    return any(abs(axis @ axes[0]) < np.cos(AXIS_TOLERANCE) for axis in axes)


def _axes(surface: Surface, points: Float) -> Float:
    """Unit vectors that are tried, (N, 3)."""
    principal = np.linalg.eigh(np.cov(points.T))[1].T
    return np.concatenate([np.eye(3), principal, _box_axes(surface)])


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
    tree: cKDTree,
    points: Float,
    axis: Float,
    tolerance: float,
) -> tuple[int, float]:
    """The highest order of a symmetry about an axis, and how exact it is, metres.

    The order is 0 for any angle, and 1 for none.
    """
    deviations: dict[Fraction, float] = {}
    found = (1, np.inf)
    for order in range(2, HIGHEST_ORDER + 1):
        # A turn back is as good as one forth.
        turns = [Fraction(k, order) for k in range(1, order // 2 + 1)]
        for turn in turns:
            if turn not in deviations:
                deviations[turn] = _deviation(tree, points, axis, float(turn))
        worst = max(deviations[turn] for turn in turns)
        if worst < tolerance:
            found = (order, worst)

    if max(deviations.values()) < tolerance:
        worst = max(_deviation(tree, points, axis, turn) for turn in ANY_TURNS)
        if worst < tolerance:
            return 0, worst
    return found


def _deviation(tree: cKDTree, points: Float, axis: Float, turn: float) -> float:
    """How far a surface and its copy, by a part of a full turn, are apart, metres."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(2 * np.pi * turn * axis).as_matrix()
    return float(np.quantile(tree.query(points @ rotation.T)[0], COMPARED_SHARE))


def _distinct(found: Iterable[tuple[Float, int]]) -> list[Symmetry]:
    """The symmetries about different axes, of those that are sorted by what they tell."""
    kept: list[Symmetry] = []
    across = False  # whether an axis across one of any angle is there already
    for axis, order in found:
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
