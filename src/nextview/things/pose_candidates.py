"""What was found of poses, as a result gives it: each pose once, with how sure it is."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nextview.geometry.observation import Observation
from nextview.recognition.poses import PoseCandidate, distinct
from nextview.things.depth_view import DepthView, depth_view
from nextview.things.registration import pose_covariances
from nextview.things.taught import TaughtThings
from nextview.things.verifier import FINE_SIDE, Verified, Verifier
from nextview.types import Index

CAMERA_DIRECTIONS = 3  # along each of which a camera's place errs
LEAST_PROBABILITY = 0.01  # of a pose that is named beside the likeliest one


def candidates_of(
    things: TaughtThings,
    found: Verified,
    observations: Sequence[Observation],
    labels: NDArray[np.integer],
) -> tuple[tuple[PoseCandidate, ...], float]:
    """The poses that a thing may have, the likeliest first, in the object frame.

    Args:
        things: what found them.
        found: what they found.
        observations: the views that they were asked with.
        labels: class of each of the things, (T,).

    Returns:
        Different poses of one or several things, also those in which a nearly symmetric thing looks
        almost the same; and by how much errors of the cameras' places displace them all,
        millimetres, one standard deviation.
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
    """By how much errors of the cameras' places displace a pose, millimetres; 0 for exact ones."""
    if all(observation.exact for observation in observations):
        return 0.0
    variances = CAMERA_DIRECTIONS * verifier.prior.displaced(views) ** 2
    return float(1000 * np.sqrt(variances.sum()) / len(views))


def _deviations(
    verifier: Verifier,
    found: Verified,
    views: Sequence[DepthView],
    rows: Index,
) -> list[tuple[float, float]]:
    """Standard deviations of turn, degrees, and place, millimetres, of some hypotheses."""
    alignment = found.alignment(rows, verifier)
    covariances = pose_covariances(verifier.caster, alignment, views, verifier.prior)
    turns = np.degrees(np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2)))
    places = 1000 * np.sqrt(np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2))
    return list(zip(turns.tolist(), places.tolist(), strict=True))
