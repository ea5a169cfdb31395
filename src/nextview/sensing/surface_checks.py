"""Reject a first frame whose pose or depth is contradicted by its surfaces.

With a wrong pose, the largest visible plane is tilted. If depth is measured along the rays, planes
are curved.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from nextview.errors import ObservationError
from nextview.sensing import planes
from nextview.sensing.frame import Frame
from nextview.sensing.mistakes import mistakes_in_poses
from nextview.sensing.planes import TILT, Plane, Samples, find_plane, steep
from nextview.sensing.segmented_frame import SegmentedFrame
from nextview.types import Float

# radians, difference of tilt within which two mistakes explain a plane equally well
AS_LEVEL = np.radians(3.0)
# share of the samples on a plane such that no other plane can have twice as many
LARGE_SHARE = 1 / 3
# mistakes that rotate a plane like an inverse pose, or not at all
PLACE_ALONE = ("inverse rotation", "inverse translation")


def refuse_mistakes(
    seen: SegmentedFrame, plane: Plane | None, up: Float | None
) -> None:
    """Reject a frame with a wrong pose, or with range instead of depth, by its surfaces.

    Args:
        seen: the frame with its surfaces.
        plane: the support plane; None if no surface is level.
        up: direction against gravity, (3,), world; None if it is not known.

    Raises:
        ObservationError: the pose is wrong, or the depth is measured along the rays.
    """
    frame = seen.frame
    samples = seen.surface_samples
    rng = np.random.default_rng(0)
    level = samples if up is None else samples.some(~steep(samples, up))
    if up is not None and _share(plane, level) < LARGE_SHARE:
        _refuse_wrong_pose(frame, samples, 2 * _share(plane, level), up, rng)
    _refuse_range(frame, plane, level, rng, up)


def _refuse_range(
    frame: Frame,
    plane: Plane | None,
    level: Samples,
    rng: Generator,
    up: Float | None,
) -> None:
    """Reject a frame that fits a plane better with its depth read as range along each ray."""
    if planes.lies_better_as_range(frame, plane, level, rng, up):
        raise ObservationError(
            "the depth is measured along the rays, a range: give it along the optical axis"
        )


def _share(plane: Plane | None, samples: Samples) -> float:
    """Return the share of the samples on a plane."""
    return 0.0 if plane is None else float(plane.holds(samples).mean())


def _refuse_wrong_pose(
    frame: Frame,
    samples: Samples,
    least: float,
    up: Float,
    rng: Generator,
) -> None:
    """Reject a frame if a large plane would be level with another reading of the pose."""
    largest = find_plane(samples, rng)
    if largest is None:
        return
    mistake = _mistake_in_pose(largest, frame.camera_to_world, up)
    if mistake and largest.holds(samples).mean() > least:
        raise ObservationError(
            f"the largest plane in view is not level: {mistake} Or up is another direction"
        )


def _mistake_in_pose(plane: Plane, pose: Float, up: Float) -> str | None:
    """Return the mistake in a pose without which the largest plane would be level.

    Floors and tables are level and walls are vertical. A plane at an angle in between indicates a
    wrong pose, and so does a level plane above the camera. A vertical plane indicates nothing: with
    a rotated pose it could be a floor.

    Args:
        plane: the largest plane in view.
        pose: camera-to-world, (4, 4).
        up: direction against gravity, (3,).

    Returns:
        The mistake, in words, or all mistakes that explain the plane equally well; None if there is
        none.
    """
    if plane.normal @ up > TILT or abs(plane.normal @ up) < np.sqrt(1 - TILT**2):
        return None

    seen = pose[:3, :3].T @ plane.normal
    rises = {
        mistake.sentence: float(mistake.right_pose(pose)[:3, :3] @ seen @ up)
        for mistake in mistakes_in_poses()
        if mistake.name not in PLACE_ALONE
    }
    most = max(rises.values())
    if most <= TILT:
        return None
    # A level plane does not distinguish between mistakes that explain it equally well.
    least = np.cos(np.arccos(min(most, 1.0)) + AS_LEVEL)
    return "; or ".join(name for name, rise in rises.items() if rise >= least) + "?"
