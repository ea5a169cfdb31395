"""Name the likely mistake behind an observation that cannot be right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.observation import Observation
from nextview.sensing.frame import AXES

Float = NDArray[np.float64]

SAMPLE = 500
"""Pixels that are looked at."""
FEWEST = 20
"""Pixels with a depth below which nothing is seen."""
OUTERMOST = 1.15
"""How far from the origin a surface may be, object radii: 1, and what an estimated centre and radius may be off."""
INNERMOST = 0.4
"""How far from the origin the outermost of what is seen has to be."""
CONTRADICTION = 0.2
"""Share of the surface seen in one view of which another view says that it is not there, from which they contradict."""


@dataclass(frozen=True)
class Doubt:
    """Something that is likely to be wrong.

    Attributes:
        name: of the mistake: "nothing seen", "opengl axes", "ros axes", "inverse pose", "scale", "outside" or
            "contradiction".
        message: one sentence for the user.
    """

    name: str
    message: str


def check_observation(observation: Observation) -> list[Doubt]:
    """What is likely to be wrong with an observation; usually nothing. Takes less than a millisecond.

    What no camera can give, such as a pose that is not rigid, was refused when the observation was made.

    The object fills most of the unit sphere about the origin and nothing of it is outside. Where that is not so, the
    usual mistakes are undone one after the other: the one without which it would be so is named.
    """
    depth, pose = observation.depth, np.asarray(observation.pose, np.float64)
    seen = np.flatnonzero(depth)
    if len(seen) < FEWEST:
        return [
            Doubt(
                "nothing seen",
                f"only {len(seen)} pixels have a depth: is the object in the picture, and the depth in object radii?",
            )
        ]
    rows, columns = np.divmod(seen[:: max(1, len(seen) // SAMPLE)], depth.shape[1])
    k = observation.intrinsics
    z = depth[rows, columns].astype(np.float64)
    x, y = (columns + 0.5 - k[0, 2]) / k[0, 0] * z, (rows + 0.5 - k[1, 2]) / k[1, 1] * z
    points = np.stack([x, y, z], 1)
    if _plausible(points, pose):
        return []
    return [_diagnose(points, pose)]


def _reach(points: Float, pose: Float) -> float:
    """How far from the origin the outermost points are, but for two in a hundred that a sensor may have made up."""
    squares = ((points @ pose[:3, :3].T + pose[:3, 3]) ** 2).sum(1)
    rank = int(0.98 * (len(squares) - 1))
    return float(np.sqrt(np.partition(squares, rank)[rank]))


def _plausible(points: Float, pose: Float) -> bool:
    return INNERMOST < _reach(points, pose) < OUTERMOST


def _diagnose(points: Float, pose: Float) -> Doubt:
    """The mistake without which the points would lie in the unit sphere."""
    reach, distance = _reach(points, pose), float(np.linalg.norm(pose[:3, 3]))
    if reach < INNERMOST:
        return Doubt(
            "scale",
            f"all that is seen lies within {reach:.2g} object radii of the object's centre: lengths in metres? Divide "
            "depth and camera position by the object radius",
        )
    for name, said in (("opengl", "OpenGL's (x right, y up, z backward)"), ("ros", "a ROS body's (x forward, z up)")):
        turned = pose.copy()
        turned[:3, :3] = pose[:3, :3] @ AXES[name]
        if _plausible(points, turned):
            return Doubt(
                f"{name} axes",
                f"the view looks away from the object: the camera's axes are {said}, OpenCV's (x right, y down, z "
                "forward) are expected",
            )
    inverse = np.asarray(np.linalg.inv(pose), np.float64)
    if _plausible(points, inverse):
        return Doubt("inverse pose", "the pose is inverse: camera-to-world is expected, this is world-to-camera")
    middle = float(np.median(np.linalg.norm(points, axis=1)))
    factor = distance / middle if middle > 0 else 1.0
    for scale in factor * np.array([1, 0.9, 0.8, 1.1, 1.2]):
        if _plausible(points * scale, pose):
            return Doubt(
                "scale",
                f"the depth is {1 / scale:.2g} times what the camera's distance of {distance:.2g} object radii asks "
                "for: one of them in metres? Both are expected in object radii",
            )
        scaled = pose.copy()
        scaled[:3, 3] /= scale
        if _plausible(points, scaled):
            return Doubt(
                "scale",
                f"the camera's distance of {distance:.2g} is {scale:.2g} times what the depth asks for: in metres? "
                "Both are expected in object radii",
            )
    return Doubt(
        "outside",
        f"the surface that is seen reaches {reach:.2g} object radii from the object's centre, more than 1: a wrong "
        "pose, centre or radius, or more in the picture than the object?",
    )


def check_views(first: Observation, second: Observation) -> list[Doubt]:
    """Whether two views of one object contradict each other's geometry; usually not.

    A surface that one view saw has to be seen in the other, or be hidden there. Where the other looks through it the
    two contradict: a wrong pose, or the object has moved.
    """
    share = max(_seen_through(first, second), _seen_through(second, first))
    if share < CONTRADICTION:
        return []
    return [
        Doubt(
            "contradiction",
            f"two views contradict each other: {share:.0%} of the surface that one saw is missing in the other: a "
            "wrong pose, or the object has moved",
        )
    ]


def _seen_through(first: Observation, second: Observation) -> float:
    """Share of the surface in the first view, within the second's picture, through which the second looks."""
    seen = np.flatnonzero(first.depth)
    if len(seen) == 0 or not second.depth.any():
        return 0.0
    rows, columns = np.divmod(seen[:: max(1, len(seen) // SAMPLE)], first.depth.shape[1])
    k = first.intrinsics
    z = first.depth[rows, columns].astype(np.float64)
    points = np.stack([(columns + 0.5 - k[0, 2]) / k[0, 0] * z, (rows + 0.5 - k[1, 2]) / k[1, 1] * z, z], 1)
    points = points @ first.pose[:3, :3].T + first.pose[:3, 3]
    points = (points - second.pose[:3, 3]) @ second.pose[:3, :3]
    points = points[points[:, 2] > 0.1]
    if len(points) == 0:
        return 1.0
    k, (height, width) = second.intrinsics, second.depth.shape
    column = np.floor(points[:, 0] / points[:, 2] * k[0, 0] + k[0, 2]).astype(np.int64)
    row = np.floor(points[:, 1] / points[:, 2] * k[1, 1] + k[1, 2]).astype(np.int64)
    margin = max(2, width // 50)  # what the object frame may be off
    inside = (column >= margin) & (column < width - margin) & (row >= margin) & (row < height - margin)
    if not inside.any():
        return 0.0
    column, row, depth = column[inside], row[inside], points[inside, 2]
    missing = np.ones(len(depth), bool)
    for dy in (-margin, 0, margin):
        for dx in (-margin, 0, margin):
            there = second.depth[row + dy, column + dx]
            missing &= (there == 0) | (there > depth + 0.1)
    return float(missing.mean())
