"""Machine parts whose symmetries are known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from nextview.types import Float
from nextview_lab.worlds.solids import Solid, extruded, joined, moved, ring_points

X, Y, Z = np.eye(3).tolist()


@dataclass(frozen=True, eq=False)
class Part:
    """A machine part.

    Attributes:
        solid: vertices, (V, 3), millimetres, and triangles, (F, 3).
        symmetries: axis and order of each, which generate all; order 0 for any angle.
    """

    solid: Solid
    symmetries: tuple[tuple[Sequence[float], int], ...] = ()


def rectangle(left: float, low: float, right: float, high: float) -> Float:
    """Corners of a rectangle, (4, 2)."""
    return np.array([[left, low], [right, low], [right, high], [left, high]])


def around(count: int, circle: float, radius: float) -> list[Float]:
    """The outlines of so many holes on a circle."""
    return [
        ring_points(radius, 16, (circle * np.cos(angle), circle * np.sin(angle)))
        for angle in np.arange(count) / count * 2 * np.pi
    ]


def keyed(bore: float, width: float, depth: float) -> Float:
    """The outline of a bore with a keyway on the side of +x."""
    corner = np.arcsin(width / 2 / bore)
    angles = np.linspace(corner, 2 * np.pi - corner, 40)
    arc = bore * np.c_[np.cos(angles), np.sin(angles)]
    return np.r_[arc, [[bore + depth, -width / 2], [bore + depth, width / 2]]]


def toothed(teeth: int, outside: float, depth: float) -> Float:
    """The outline of a gear."""
    angles = (np.arange(4 * teeth) + 0.5) / (4 * teeth) * 2 * np.pi
    radii = np.where(np.arange(4 * teeth) % 4 < 2, outside, outside - depth)
    return np.c_[radii * np.cos(angles), radii * np.sin(angles)]


def bent(first: float, second: float, width: float, holes: Sequence[Float]) -> Solid:
    """An L bracket of 2.5 mm sheet; the holes are in its first leg."""
    thick = 2.5
    flat = extruded([rectangle(0, 0, first, width), *holes], thick)
    upright = extruded([rectangle(0, 0, thick, width)], second - thick)
    return joined([flat, moved(upright, by=(0, 0, thick))])


def parts() -> dict[str, Part]:
    """The parts by their names."""
    six = [ring_points(40, 64), ring_points(10, 48), *around(6, 28, 4)]
    four = [ring_points(30, 64), ring_points(9, 48), *around(4, 21, 3.5)]
    hub = extruded([ring_points(18, 64), ring_points(10, 48)], 18)
    wheel = [toothed(20, 30, 4), keyed(9, 6, 3)]
    boss = extruded([ring_points(16, 64), keyed(9, 6, 3)], 10)
    nut = extruded([ring_points(9.8, 6), ring_points(5, 48)], 8)
    head = extruded([ring_points(11, 6)], 8)
    shank = extruded([ring_points(5.5, 48)], 45)
    flat = np.arccos(0.6)
    angles = np.linspace(flat, 2 * np.pi - flat, 60)
    milled = [8 * np.c_[np.cos(angles), np.sin(angles)]]
    cube = trimesh.creation.box((16, 16, 16))
    diagonal = (np.array(X) + Z) / np.sqrt(2)
    return {
        "flange_of_six": Part(
            joined([extruded(six, 8), moved(hub, by=(0, 0, 8))]), ((Z, 6),)
        ),
        "flat_flange": Part(extruded(four, 10), ((Z, 4), (X, 2))),
        "gear_with_keyway": Part(
            joined([extruded(wheel, 12), moved(boss, by=(0, 0, 12))])
        ),
        "bracket": Part(bent(20, 14, 12, [ring_points(2.2, 16, (12, 6))])),
        "equal_bracket": Part(bent(20, 20, 12, []), ((diagonal, 2),)),
        "die": Part(
            (np.asarray(cube.vertices), np.asarray(cube.faces, np.int32)),
            ((X, 4), (Y, 4), (Z, 4)),
        ),
        "hex_nut": Part(nut, ((Z, 6), (X, 2))),
        "hex_bolt": Part(joined([head, moved(shank, by=(0, 0, 8))]), ((Z, 6),)),
        "shaft_with_flat": Part(extruded(milled, 50), ((X, 2),)),
    }


def turns_of(part: Part) -> Float:
    """All rotations that leave a part as it is, (N, 3, 3); none has a symmetry of any angle."""
    steps = [
        Rotation.from_rotvec(2 * np.pi / order * np.array(axis)).as_matrix()
        for axis, order in part.symmetries
    ]
    turns = [np.eye(3)]
    for turn in turns:  # it grows
        for step in steps:
            new = turn @ step
            if not any(np.abs(new - other).max() < 1e-6 for other in turns):
                turns.append(new)
    return np.stack(turns)


def degrees_off(found: Float, true: Float, turns: Float) -> float:
    """Angle between two rotations but for some turns of the thing, degrees."""
    traces = np.einsum("ij,nij->n", true.T @ found, turns)
    return float(np.degrees(np.arccos(np.clip((traces.max() - 1) / 2, -1, 1))))
