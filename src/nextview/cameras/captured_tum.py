"""Captured views in the layout of the TUM RGB-D benchmark (Sturm et al., IROS 2012): lists of images and of poses,
each with its time, and the pose nearest in time belongs to an image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nextview.arguments import takes_paths
from nextview.cameras.captured_frame import CapturedFrame
from nextview.errors import DatasetError

Float = NDArray[np.float64]

PER_METRE = 5000.0
"""Steps of the depth images."""
TOGETHER = 0.02
"""Seconds that an image and its pose, or depth and colour, may be apart."""


@takes_paths("folder")
def read_tum(folder: Path, intrinsics: Float | None) -> tuple[list[CapturedFrame], list[str]]:
    """The views of one recording.

    A mask of the object may lie in mask/, under the name of the depth image.

    Args:
        folder: with depth.txt and groundtruth.txt; colour images of rgb.txt are used if it is there.
        intrinsics: (3, 3); the layout has none.

    Returns:
        The views, and what was left out.

    Raises:
        DatasetError: a list is missing or damaged, or there are no intrinsics.
    """
    if intrinsics is None:
        raise DatasetError(
            f"{folder}: the intrinsics are missing, which this layout does not hold; put the pinhole matrix into "
            "camera-intrinsics.txt or give --intrinsics FX FY CX CY (TUM's recordings: 525 525 319.5 239.5)"
        )
    times, depths = _list(folder / "depth.txt")
    moments, poses = _trajectory(folder / "groundtruth.txt")
    colour_times, colours = _list(folder / "rgb.txt") if (folder / "rgb.txt").exists() else (np.zeros(0), [])
    at, near = nearest_in_time(times, moments)
    colour_at, colour_near = nearest_in_time(times, colour_times)
    frames = []
    for i in np.flatnonzero(near):
        depth, mask = folder / depths[i], folder / "mask" / Path(depths[i]).name
        image = folder / colours[colour_at[i]] if colour_near[i] else None
        pose = poses[at[i]]
        name = Path(depths[i]).stem
        frames.append(
            CapturedFrame(name, depth, 1 / PER_METRE, intrinsics, pose, mask if mask.exists() else None, image)
        )
    if not frames:
        raise DatasetError(
            f"{folder}: no image of depth.txt has a pose in groundtruth.txt within {TOGETHER} s; are the times of one "
            "clock, in seconds?"
        )
    lost = len(times) - len(frames)
    return frames, [f"{lost} depth images have no pose within {TOGETHER} s and are left out"] if lost else []


def nearest_in_time(times: Float, others: Float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """For each of some times, (N,) seconds, the index of the nearest of others, (M,), and whether it is near enough."""
    if len(others) == 0:
        return np.zeros(len(times), np.int64), np.zeros(len(times), bool)
    order = np.argsort(others)
    after = np.searchsorted(others[order], times).clip(1, max(len(others) - 1, 1))
    pair = order[np.stack([after - 1, np.minimum(after, len(others) - 1)])]
    gap = np.abs(others[pair] - times)
    which = gap.argmin(0)
    # Times have microseconds; a gap of just the limit counts.
    return pair[which, np.arange(len(times))], gap.min(0) <= TOGETHER + 1e-6


def _lines(path: Path, columns: int, what: str) -> list[list[str]]:
    """The words of each line that is no comment."""
    try:
        lines = [(n, line.split()) for n, line in enumerate(path.read_text().splitlines(), 1)]
    except FileNotFoundError:
        raise DatasetError(f"{path}: there is no such file; it lists {what}") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: not a text file") from None
    kept = [(n, words) for n, words in lines if words and not words[0].startswith("#")]
    for n, words in kept:
        if len(words) != columns:
            raise DatasetError(f"{path}: line {n} has {len(words)} words; it lists {what}, {columns} words a line")
    if not kept:
        raise DatasetError(f"{path}: lists nothing; it should list {what}")
    return [words for _, words in kept]


def _numbers(path: Path, words: list[list[str]]) -> Float:
    try:
        values = np.array(words, np.float64)
    except ValueError as error:
        raise DatasetError(f"{path}: a number is expected ({error})") from None
    if not np.isfinite(values).all():
        raise DatasetError(f"{path}: holds NaN or infinity; remove these lines")
    return values


def _list(path: Path) -> tuple[Float, list[str]]:
    lines = _lines(path, 2, "times and names of images")
    return _numbers(path, [words[:1] for words in lines])[:, 0], [words[1] for words in lines]


def _trajectory(path: Path) -> tuple[Float, Float]:
    """Times, (N,) seconds, and camera-to-world poses, (N, 4, 4)."""
    values = _numbers(path, _lines(path, 8, "times, positions and quaternions (x, y, z, w)"))
    length = np.linalg.norm(values[:, 4:], axis=1)
    if (np.abs(length - 1) > 0.01).any():
        worst = float(length[np.abs(length - 1).argmax()])
        raise DatasetError(f"{path}: a quaternion has the length {worst:.3g}, not 1")
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(values[:, 4:]).as_matrix()
    poses[:, :3, 3] = values[:, 1:4]
    return values[:, 0], poses
