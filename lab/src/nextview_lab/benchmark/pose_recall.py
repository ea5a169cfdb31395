"""Errors of poses modulo symmetries, and the share of objects that are found within thresholds.

MSSD and MSPD as in Hodan et al., "BOP Challenge 2020 on 6D Object Localization", ECCV workshops
2020, section 2.2, and in bop_toolkit, whose figures are the official ones. VSD, the third error of
BOP, needs renders and is left to bop_toolkit. Poses go from the model to the camera; lengths are in
millimetres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from nextview.types import Float, Floats
from nextview_lab.benchmark.bop_dataset import BopModelInfo

PART_STEPS = np.arange(1, 11)
MSSD_PARTS = PART_STEPS / 20  # of the diameter
MSPD_PIXELS = 5.0 * PART_STEPS  # of an image of MSPD_WIDTH
MSPD_WIDTH = 640
# largest way of a point between two turns of a symmetry by any angle, parts of its distance from
# the axis, as in bop_toolkit
SYMMETRY_STEP = 0.01


def add_s(points: Float, pose: Float, true: Float) -> float:
    """Return the mean distance of points in a pose from the nearest points in the true pose.

    Args:
        points: of the surface, (N, 3).
        pose: (4, 4).
        true: pose, (4, 4).
    """
    here, there = (points @ one[:3, :3].T + one[:3, 3] for one in (pose, true))
    return float(np.mean(cKDTree(there).query(here)[0]))


def symmetries_of(info: BopModelInfo) -> Float:
    """All transforms after which a model looks the same, the identity first.

    Turns by any angle about an axis become steps, see ``SYMMETRY_STEP``.

    Args:
        info: of the model.

    Returns:
        (S, 4, 4) float64, millimetres, in the model's frame.
    """
    discrete = np.array(
        [np.eye(4), *(np.reshape(one, (4, 4)) for one in info.symmetries_discrete)],
        np.float64,
    )
    steps = int(np.ceil(np.pi / SYMMETRY_STEP))
    turns = [np.eye(4)]

    for one in info.symmetries_continuous:
        axis = np.array(one.axis, np.float64) / np.linalg.norm(one.axis)
        offset = np.array(one.offset, np.float64)
        for step in range(1, steps):
            turn = np.eye(4)
            angle = 2 * np.pi * step / steps
            turn[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
            turn[:3, 3] = offset - turn[:3, :3] @ offset
            turns.append(turn)

    return (np.array(turns)[:, None] @ discrete).reshape(-1, 4, 4)


def mssd(pose: Floats, true: Floats, vertices: Floats, symmetries: Floats) -> float:
    """Maximum symmetry-aware surface distance of two poses.

    Args:
        pose: estimated, (4, 4), millimetres.
        true: (4, 4), millimetres.
        vertices: of the model, (V, 3), millimetres.
        symmetries: of the model, (S, 4, 4), millimetres, the identity among them.

    Returns:
        The least largest distance of a vertex from its place, millimetres.
    """
    here = _moved(vertices, pose)
    return min(
        float(np.linalg.norm(here - _moved(vertices, true @ symmetry), axis=1).max())
        for symmetry in symmetries
    )


def mspd(
    pose: Floats,
    true: Floats,
    vertices: Floats,
    symmetries: Floats,
    intrinsics: Floats,
) -> float:
    """Maximum symmetry-aware projection distance of two poses.

    Args:
        pose: estimated, (4, 4), millimetres.
        true: (4, 4), millimetres.
        vertices: of the model, (V, 3), millimetres.
        symmetries: of the model, (S, 4, 4), millimetres, the identity among them.
        intrinsics: pinhole matrix, (3, 3), pixels.

    Returns:
        The least largest distance of a vertex from its place in the image, pixels; inf where a
        vertex of the estimated pose is not before the camera.
    """
    placed = _moved(vertices, pose)
    if (placed[:, 2] <= 0).any():
        return float("inf")
    here = _projected(placed, intrinsics)
    return min(
        float(
            np.linalg.norm(
                here - _projected(_moved(vertices, true @ symmetry), intrinsics), axis=1
            ).max()
        )
        for symmetry in symmetries
    )


def _moved(points: Floats, pose: Floats) -> Float:
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3], np.float64)


def _projected(points: Float, intrinsics: Floats) -> Float:
    """Pixels of points in the camera's frame, (N, 2)."""
    pixels = points @ np.asarray(intrinsics).T
    return np.asarray(pixels[:, :2] / pixels[:, 2:], np.float64)


def matched(errors: Floats, scores: Sequence[float], below: float) -> list[int]:
    """Which object each found pose is a hit of: the best score chooses first.

    Args:
        errors: of each found pose and each object of one model in one image, (E, G).
        scores: of the found poses, (E,).
        below: an error is a hit if it is less.

    Returns:
        The number of an object for each found pose, -1 for none; an object is hit once.
    """
    errors = np.array(errors, np.float64)
    hits = [-1] * len(errors)
    for row in sorted(range(len(errors)), key=lambda row: -scores[row]):
        if not errors.shape[1]:
            break
        best = int(errors[row].argmin())
        if errors[row, best] < below:
            hits[row] = best
            errors[:, best] = np.inf
    return hits


@dataclass(frozen=True)
class Hits:
    """How many of some objects are found, by each threshold.

    Attributes:
        objects: how many there are.
        mssd: how many are found within each of ``MSSD_PARTS``, (10,) float64.
        mspd: how many are found within each of ``MSPD_PIXELS``, (10,) float64.
    """

    objects: int
    mssd: Float
    mspd: Float

    def __add__(self, other: "Hits") -> "Hits":
        return Hits(
            self.objects + other.objects,
            self.mssd + other.mssd,
            self.mspd + other.mspd,
        )

    @property
    def average_mssd(self) -> float:
        """Recall by MSSD, mean over the thresholds, 0 to 1; NaN without objects."""
        return _share(self.mssd, self.objects)

    @property
    def average_mspd(self) -> float:
        """Recall by MSPD, mean over the thresholds, 0 to 1; NaN without objects."""
        return _share(self.mspd, self.objects)

    @property
    def average(self) -> float:
        """Mean of both, 0 to 1; NaN without objects."""
        return (self.average_mssd + self.average_mspd) / 2


def _share(found: Float, objects: int) -> float:
    return float(np.mean(found)) / objects if objects else float("nan")


NO_HITS = Hits(0, np.zeros(10), np.zeros(10))


def hits_of(
    surface: Floats,
    projection: Floats,
    scores: Sequence[float],
    counts: Sequence[bool],
    diameter: float,
    width: int,
) -> Hits:
    """The objects of one model in one image that are found.

    Args:
        surface: MSSD of each found pose and each object, (E, G), millimetres.
        projection: MSPD of the same, (E, G), pixels.
        scores: of the found poses, (E,).
        counts: whether each object counts, (G,); others are neither found nor missed.
        diameter: of the model, millimetres.
        width: of the image, pixels.
    """

    def found(errors: Floats, limits: Floats) -> Float:
        of_those = np.reshape(errors, (len(scores), len(counts)))[
            :, np.array(counts, bool)
        ]
        hits = [matched(of_those, scores, float(limit)) for limit in limits]
        return np.array([sum(hit >= 0 for hit in each) for each in hits], np.float64)

    return Hits(
        sum(counts),
        found(surface, diameter * MSSD_PARTS),
        found(projection, width / MSPD_WIDTH * MSPD_PIXELS),
    )
