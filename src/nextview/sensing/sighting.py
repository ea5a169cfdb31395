"""Sightings of an object in single frames, and the object frame estimated from all of them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from nextview.errors import ObservationError
from nextview.sensing.facets import SIZE, Facets, fit_facets
from nextview.sensing.frame import Frame, within
from nextview.sensing.noise import Noise
from nextview.sensing.object_frame import ObjectFrame, enclose
from nextview.sensing.planes import Plane
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float, Mask

FEWEST_OBJECT_PIXELS = 60  # least number of pixels of an object in a frame
GROUP_GAP = 6  # pixels between isolated groups of facets
TOO_LITTLE = "too little is seen of the object"


@dataclass(frozen=True, eq=False)
class Sighting:
    """The object in one frame, with the noise of the frame.

    Attributes:
        frame: its pose is shifted so that the object coincides with earlier frames.
        noise: of the frame.
        facets: the object's surface, camera frame.
        mask: of the object, (H, W) bool.
        hull: vertices of its convex hull, world, (K, 3), metres.
        plane: the support plane, if it is visible.
        shift: applied to the pose, (3,), metres.
        warnings: about the frame, independent of the object.
    """

    frame: Frame
    noise: Noise
    facets: Facets
    mask: Mask
    hull: Float
    plane: Plane | None
    shift: Float = field(default_factory=lambda: np.zeros(3))
    warnings: tuple[ViewWarning, ...] = ()

    @property
    def frame_as_given(self) -> Frame:
        """Frame with its original pose."""
        return self.frame.shifted(-self.shift) if self.shift.any() else self.frame

    def shifted(self, shift: Float) -> Sighting:
        """Return the sighting with its pose shifted in the world, (3,), metres."""
        plane = self.plane
        return replace(
            self,
            frame=self.frame.shifted(shift),
            hull=self.hull + shift,
            plane=plane
            and replace(plane, offset=plane.offset - float(plane.normal @ shift)),
            shift=self.shift + shift,
        )


def sighting_of(
    frame: Frame,
    mask: Mask,
    plane: Plane | None,
    noise: Noise,
    denoise: bool = True,
) -> Sighting:
    """Fit the surface of the object to its pixels.

    Args:
        frame: the frame.
        mask: the object's pixels, (H, W) bool.
        plane: support plane of the object; None if it is not visible.
        noise: of the frame's depth.
        denoise: smooth depth, fill holes and drop flying pixels.

    Raises:
        ObservationError: too little of the object is visible.
    """
    if np.count_nonzero(mask) < FEWEST_OBJECT_PIXELS:
        raise ObservationError(TOO_LITTLE)

    part = within(mask, 2)
    corner = (part[0].start, part[1].start)
    coarse = max(1, max(mask[part].shape) // SIZE)
    facets = fit_facets(
        frame.depth[part],
        mask[part],
        frame.intrinsics,
        corner,
        denoise,
        coarse,
        noise,
    )
    if denoise and len(facets.planes):
        facets = facets.some(_in_large_groups(facets, noise, coarse))
    if len(facets.planes) * coarse**2 < FEWEST_OBJECT_PIXELS:
        raise ObservationError(TOO_LITTLE)

    pose = frame.camera_to_world
    # for the convex hull
    few = slice(None, None, max(1, len(facets.planes) // 3000))
    points = facets.some(few).points @ pose[:3, :3].T + pose[:3, 3]
    with suppress(QhullError):  # coplanar points are used as they are
        points = points[ConvexHull(points).vertices]
    return Sighting(frame, noise, facets, mask, points, plane)


def _in_large_groups(facets: Facets, noise: Noise, coarse: int) -> Mask:
    """Return which facets are not in an isolated group that is small or far away, (N,) bool.

    A fragment of the background, or of an edge, would determine the radius of the object. Groups
    are apart by some pixels, or by as much in depth. No part of an object is further behind the
    largest one, or in front of it, than that is wide.
    """
    depth = facets.points[:, 2]
    step = GROUP_GAP * float(facets.pitch.mean())
    step += float(np.median(4 * noise.at(depth) * depth)) / coarse
    at = (
        facets.rows // coarse // GROUP_GAP,
        facets.columns // coarse // GROUP_GAP,
        (np.log(depth / depth.min()) / step).astype(np.int64),
    )
    at = tuple(index - index.min() for index in at)
    cells = np.zeros([int(index.max()) + 1 for index in at], bool)
    cells[at] = True
    group = ndimage.label(cells, np.ones((3, 3, 3)))[0][at]
    counts = np.bincount(group)
    main = int(counts.argmax())
    width = np.linalg.norm(np.ptp(facets.points[group == main], axis=0))
    away = np.asarray(ndimage.median(depth, group, np.arange(len(counts))))
    near = np.abs(away - away[main]) < width
    # one facet in a hundred
    return np.asarray(near[group] & (counts[group] >= 0.01 * len(group)))


def object_frame_of(sightings: Sequence[Sighting], axes: Float) -> ObjectFrame:
    """Estimate centre and radius from all frames that show enough of the object.

    Args:
        sightings: of the object, at least one.
        axes: rows x, y and z (up) of the object frame, (3, 3).

    Raises:
        ObservationError: the visible part of the object has no extent.
    """
    shown = np.array([np.count_nonzero(sighting.mask) for sighting in sightings])
    # frames that show little of the object say nothing of its size
    enough = shown >= 0.1 * shown.max()
    pairs = zip(sightings, enough, strict=True)
    points = np.concatenate([sighting.hull for sighting, counts in pairs if counts])

    # Height of the planes below the object, as they may be slightly tilted.
    here = points.mean(0)
    heights = [
        axes[2] @ here - plane.height(here) / (plane.normal @ axes[2])
        for plane in (sighting.plane for sighting in sightings)
        if plane is not None
    ]
    floor = float(np.median(heights)) if heights else None
    return enclose(points, axes, floor)
