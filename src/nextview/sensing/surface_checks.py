"""Refuse a first frame whose pose or depth its surfaces contradict.

By a wrong pose the largest plane in view leans, and depth that is measured along the rays shows no
plane where there is one.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from nextview.errors import ObservationError
from nextview.sensing import planes
from nextview.sensing.frame import Frame
from nextview.sensing.mistakes import mistakes_in_poses
from nextview.sensing.planes import TILT, Plane, Samples, find_plane, steep
from nextview.types import Float

# radians by which a plane may be less level by one mistake than by another that explains it as well
AS_LEVEL = np.radians(3.0)
# share of the samples on a plane from which no other plane holds twice as many
LARGE_SHARE = 1 / 3
# mistakes that turn a plane as an inverse pose does, or not at all
PLACE_ALONE = ("inverse rotation", "inverse translation")


def refuse_mistakes(
    frame: Frame,
    samples: Samples,
    plane: Plane | None,
    up: Float | None,
) -> None:
    """Refuse a frame whose pose is wrong, or whose depth is a range, by its surfaces.

    Args:
        frame: the frame.
        samples: of the surfaces in it.
        plane: of these, the one that things stand on; None if none is level.
        up: direction against gravity, (3,), world; None if it is not known.

    Raises:
        ObservationError: the pose is wrong, or the depth is measured along the rays.
    """
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
    """Refuse a frame that fits a plane better if its depth is taken along each ray."""
    if planes.lies_better_as_range(frame, plane, level, rng, up):
        raise ObservationError(
            "the depth is measured along the rays, a range: give it along the optical axis"
        )


def _share(plane: Plane | None, samples: Samples) -> float:
    """Share of the samples that lie on a plane."""
    return 0.0 if plane is None else float(plane.holds(samples).mean())


def _refuse_wrong_pose(
    frame: Frame,
    samples: Samples,
    least: float,
    up: Float,
    rng: Generator,
) -> None:
    """Refuse a frame whose largest plane holds more than a share, and would be level otherwise."""
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

    Floors and tables are level and walls upright. A plane that leans in between indicates a wrong
    pose; so does one that is level but lies over the camera. A wall indicates nothing: seen from
    the side it would pass for a floor.

    Args:
        plane: the largest plane in view.
        pose: camera-to-world, (4, 4).
        up: direction against gravity, (3,).

    Returns:
        The mistake, in words, or all that explain the plane as well; None if there is none.
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
    # One frame may be explained by several: which of them it is, a level plane does not tell.
    least = np.cos(np.arccos(min(most, 1.0)) + AS_LEVEL)
    return "; or ".join(name for name, rise in rises.items() if rise >= least) + "?"
