"""Moments of a recording of cameras that stand still, at which the scene has changed."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from scipy import ndimage

from nextview.captured.frames import Capture, CapturedFrame
from nextview.errors import DatasetError, ObservationError
from nextview.sensing.frame import Frame
from nextview.sensing.registration import tolerance_of
from nextview.sensing.sighting import FEWEST_OBJECT_PIXELS

Moment = tuple[CapturedFrame, ...]


def still_moments(capture: Capture) -> tuple[Moment, ...]:
    """Return the moments at which the scene differs from the last one, and stands still.

    A moment is left out as long as nothing has changed, and while something moves, such as a hand
    that takes an object away: then the next moment differs from it. The last moment counts as
    still.

    Args:
        capture: of cameras that stand still; its images are read.

    Returns:
        The moments, in order; the first still one is among them. Moments whose images cannot be
        read are left out.
    """
    found: list[Moment] = []
    last: list[Frame] = []
    for (moment, frames), (_, after) in pairwise(_read_ahead(capture.moments)):
        if not _differ(frames, after) and (not last or _differ(last, frames)):
            found.append(moment)
            last = frames
    return tuple(found)


def _read_ahead(moments: Sequence[Moment]) -> Iterator[tuple[Moment, list[Frame]]]:
    """Yield the moments that can be read, with their frames; the last one twice."""
    read: tuple[Moment, list[Frame]] | None = None
    for moment in moments:
        try:
            read = moment, [captured.read(masked=False) for captured in moment]
        except (DatasetError, ObservationError):
            continue
        yield read
    if read is not None:
        yield read


def _differ(before: Sequence[Frame], after: Sequence[Frame]) -> bool:
    """Return True if a camera shows something else at another moment."""
    of_camera = {frame.camera: frame for frame in before}
    return any(
        has_changed(of_camera[frame.camera], frame)
        for frame in after
        if frame.camera in of_camera
    )


def has_changed(before: Frame, after: Frame) -> bool:
    """Return True if an object may have moved, appeared or gone between two frames.

    The depth of a connected part of the image, as large as the smallest object that is considered,
    has then changed by more than the noise.

    Args:
        before: a frame.
        after: another frame of the same size and pose.
    """
    noise = before.noise
    valid = (before.depth > 0) & (after.depth > 0)
    depth = np.minimum(before.depth, after.depth)
    limit = np.sqrt(2) * tolerance_of(depth, noise)
    changed = valid & (np.abs(after.depth - before.depth) > limit)

    # errors of neighbouring pixels are correlated
    grain = np.ones((2 * noise.grain + 1,) * 2, bool)
    parts, count = ndimage.label(ndimage.binary_opening(changed, grain))
    if count == 0:
        return False
    return bool(np.bincount(parts.ravel())[1:].max() >= FEWEST_OBJECT_PIXELS)
