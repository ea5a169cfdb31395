"""Mistakes of a camera that are the same in all frames of a capture.

Pictures that are flipped, a wrong focal length, and poses of a place beside the camera: each moves
all that is seen with the camera, so that frames from different sides contradict each other.
"""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from nextview.captured.shifted_poses import FEWER_CONTRADICTIONS, LEAST_OVERLAP
from nextview.sensing.agreement import SHARP, Agreement, SurfaceView, compare
from nextview.types import Float

# share of the points that is contradicted from which a mistake of the camera is searched for
LEAST_CAMERA_CONTRADICTION = 0.05
FLIPS = {
    "flipped left to right": (-1.0, 1.0, 1.0),
    "flipped top to bottom": (1.0, -1.0, 1.0),
    "upside down, turned by half a turn": (-1.0, -1.0, 1.0),
}
"""What becomes of the axes of a camera whose pictures are flipped."""
# logarithms of the factors that are tried first, from a half to twice
FOCAL_STEPS = 0.05 * np.arange(-14, 15)
FINER_STEPS = 0.0125 * np.arange(-3, 4)  # around the best of them
LEAST_FOCAL_CHANGE = 0.05  # part of the focal length; less is a matter of calibration
LEAST_OFFSET = 0.02  # metres; less is a matter of calibration
FIRST_STEP = 0.03  # metres of the search for an offset
MOST_TRIALS = 120  # offsets that are tried
MOST_FITTED = 20  # frames by which an offset is fitted, evenly spread
FEWEST_STANDING = 10  # points of a frame whose middle tells where its object is
# part of the largest singular value below which an offset has no effect in that direction
NOT_OBSERVED = 1e-2


def find_camera_mistake(
    views: Sequence[SurfaceView],
    poses: Float,
    intrinsics: Float,
) -> str:
    """Return what is wrong with the camera of some frames, in words; "" if nothing.

    Args:
        views: N frames.
        poses: of their cameras, camera-to-world, (N, 4, 4), metres.
        intrinsics: pinhole matrix of the frames, for the sentence, pixels, (3, 3).
    """
    as_read = compare(views, poses, sharpness=SHARP)
    if 1 - as_read.share < LEAST_CAMERA_CONTRADICTION:
        return ""
    return _flip(views, poses, as_read) or _focal_length(
        views,
        poses,
        as_read,
        float(intrinsics[0, 0]),
    )


def find_offset(views: Sequence[SurfaceView], poses: Float) -> str:
    """Where cameras stand beside their poses, the end of a sentence; "" if that explains nothing.

    Args:
        views: N frames.
        poses: of their cameras, camera-to-world, (N, 4, 4), metres.
    """
    as_read = compare(views, poses, sharpness=SHARP)
    if 1 - as_read.share < LEAST_CAMERA_CONTRADICTION:
        return ""

    offset = _fitted_offset(views, poses)
    distance = float(np.linalg.norm(offset))
    if distance < LEAST_OFFSET or not _explains(
        compare(views, _moved(poses, offset), sharpness=SHARP),
        as_read,
    ):
        return ""
    where = ", ".join(f"{value:+.2f}" for value in offset)
    return (
        f"the camera stands some {100 * distance:.0f} cm beside its poses, the same way in all"
        f" frames ({where} m along its axes x right, y down, z forward): is the hand-eye"
        " calibration missing or wrong?"
    )


def _explains(without: Agreement, as_read: Agreement) -> bool:
    """Whether frames contradict each other much less without a mistake than as they were read."""
    fewer = 1 - without.share <= FEWER_CONTRADICTIONS * (1 - as_read.share)
    return fewer and without.judged >= LEAST_OVERLAP * as_read.judged


def _flip(views: Sequence[SurfaceView], poses: Float, as_read: Agreement) -> str:
    """How the pictures are flipped, in words; "" if they are not."""
    best = ""
    least = 1.0
    for name, signs in FLIPS.items():
        without = compare(views, poses @ np.diag([*signs, 1.0]), sharpness=SHARP)
        if _explains(without, as_read) and 1 - without.share < least:
            best = f"the depth images are {name}"
            least = 1 - without.share
    return best


def _focal_length(
    views: Sequence[SurfaceView],
    poses: Float,
    as_read: Agreement,
    given: float,
) -> str:
    """By how much the focal length, pixels, is wrong, in words; "" if it is not."""
    times = 1.0
    for steps in (FOCAL_STEPS, FINER_STEPS):
        factors = times * np.exp(steps)
        found = [_with_focal_length(views, poses, factor) for factor in factors]
        times = float(factors[int(np.argmax([each.share for each in found]))])

    wrong = 1 / times - 1
    if abs(wrong) < LEAST_FOCAL_CHANGE or not _explains(
        _with_focal_length(views, poses, times),
        as_read,
    ):
        return ""
    what = "long" if wrong > 0 else "short"
    percent = f"the focal length is some {100 * abs(wrong):.0f} % too {what}"
    pixels = f"{given:.0f} pixels, about {times * given:.0f} fit"
    return f"{percent} ({pixels}): are these the intrinsics of another camera or picture size?"


def _with_focal_length(
    views: Sequence[SurfaceView],
    poses: Float,
    times: float,
) -> Agreement:
    changed = [view.with_focal_length(times) for view in views]
    return compare(changed, poses, sharpness=SHARP)


def _moved(poses: Float, offset: Float) -> Float:
    """Poses of cameras that stand beside them, by an offset along their own axes, (3,), metres."""
    moved = poses.copy()
    moved[:, :3, 3] += poses[:, :3, :3] @ offset
    return moved


def _fitted_offset(views: Sequence[SurfaceView], poses: Float) -> Float:
    """Return the offset along the cameras' axes, (3,), metres, with fewest contradictions."""
    few = np.unique(
        np.linspace(0, len(views) - 1, min(len(views), MOST_FITTED)).astype(int)
    )
    some = [views[i] for i in few]

    def contradicted(offset: Float) -> float:
        moved = _moved(poses[few], offset)
        return (
            2 - compare(some, moved).share - compare(some, moved, sharpness=SHARP).share
        )

    start = min((_offset_of_middles(views, poses), np.zeros(3)), key=contradicted)
    simplex = start + np.vstack([np.zeros(3), FIRST_STEP * np.eye(3)])
    found = minimize(
        contradicted,
        start,
        method="Nelder-Mead",
        options={"maxfev": MOST_TRIALS, "initial_simplex": simplex},
    )
    return np.asarray(found.x, np.float64)


def _offset_of_middles(views: Sequence[SurfaceView], poses: Float) -> Float:
    """Return the offset, (3,), metres, that brings the object's middles closest together.

    Least squares in the place w of the object and the offset d, with w - R d = R c + t for the
    middle c that a camera of the pose (R, t) sees. Cameras see the near side of the object: that is
    an error along their axes.
    """
    matrix = []
    middles = []
    for view, pose in zip(views, poses, strict=True):
        points = view.points[view.standing]
        if len(points) >= FEWEST_STANDING:
            rotation = pose[:3, :3]
            matrix.append(np.hstack([np.eye(3), -rotation]))
            middles.append(rotation @ np.median(points, axis=0) + pose[:3, 3])

    if len(matrix) < 2:
        return np.zeros(3)
    solution = np.linalg.lstsq(
        np.vstack(matrix),
        np.concatenate(middles),
        rcond=NOT_OBSERVED,
    )[0]
    return solution[3:]
