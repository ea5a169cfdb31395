"""Candidate poses of a result: each distinct pose once, with its probability and uncertainty."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nextview.geometry.observation import Observation
from nextview.recognition.poses import PoseCandidate, distinct
from nextview.things.depth_view import DepthView, depth_view
from nextview.things.registration import CameraStands, pose_covariances
from nextview.things.taught import TaughtThings
from nextview.things.verifier import FINE_SIDE, Verified, Verifier
from nextview.types import Index

CAMERA_DIRECTIONS = 3  # axes along which the position of a camera is uncertain
LEAST_PROBABILITY = 0.01  # smallest probability of a pose beside the likeliest one


def candidates_of(
    things: TaughtThings,
    found: Verified,
    observations: Sequence[Observation],
    labels: NDArray[np.integer],
) -> tuple[tuple[PoseCandidate, ...], float]:
    """Candidate poses of an object in the object frame, the likeliest first.

    Args:
        things: the taught things.
        found: verification of the views.
        observations: the verified views.
        labels: class of each of the things, (T,).

    Returns:
        Distinct poses of one or several things, including those that differ by a near symmetry; and
        the standard deviation of their common displacement by errors of the camera positions,
        millimetres.
    """
    shown = [depth_view(observation, FINE_SIDE) for observation in observations]
    views = [view for view in shown if view is not None]
    candidates = []
    for thing, pose, probability, displacements in zip(
        found.things,
        found.poses,
        found.probabilities,
        found.cameras,
        strict=True,
    ):
        surface = things.verifier.caster.surfaces[thing]
        candidate = PoseCandidate(
            thing=surface.name,
            label=int(labels[thing]),
            pose=pose,
            probability=float(probability),
            centre=surface.centroid,
            vertices=surface.vertices,
            faces=surface.faces,
            symmetry=things.symmetries[thing],
            displacements=displacements,
        )
        candidates.append(candidate)

    rows = [
        row
        for row in distinct(candidates)
        if row == 0 or candidates[row].probability > LEAST_PROBABILITY
    ]
    total = sum(candidates[row].probability for row in rows)
    deviations = _deviations(things.verifier, found, views, np.array(rows))
    kept = []
    for row, (degrees, millimetres) in zip(rows, deviations, strict=True):
        share = candidates[row].probability / total
        candidate = replace(
            candidates[row],
            probability=share,
            degrees=degrees,
            millimetres=millimetres,
        )
        kept.append(candidate)
    return tuple(kept), _camera_error(things.verifier, observations, views)


def _camera_error(
    verifier: Verifier,
    observations: Sequence[Observation],
    views: Sequence[DepthView],
) -> float:
    """Standard deviation of a pose due to errors of the camera positions, millimetres.

    It is 0 for exact cameras.
    """
    if all(observation.exact for observation in observations):
        return 0.0
    stands = CameraStands.of(views)
    displaced = verifier.prior.displaced(views)[stands.first] * stands.counts
    variances = CAMERA_DIRECTIONS * displaced**2
    return float(1000 * np.sqrt(variances.sum()) / len(views))


def _deviations(
    verifier: Verifier,
    found: Verified,
    views: Sequence[DepthView],
    rows: Index,
) -> list[tuple[float, float]]:
    """Standard deviations of rotation, degrees, and translation, millimetres, of hypotheses."""
    alignment = found.alignment(rows, verifier)
    covariances = pose_covariances(verifier.caster, alignment, views, verifier.prior)
    turns = np.degrees(np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2)))
    places = 1000 * np.sqrt(np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2))
    return list(zip(turns.tolist(), places.tolist(), strict=True))
