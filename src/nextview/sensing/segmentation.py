"""Which pixels of a frame show the object: in a mask, in a region, or standing on a plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nextview.errors import ObservationError
from nextview.sensing import clusters
from nextview.sensing.clusters import Footprint
from nextview.sensing.convex_pieces import STANDS
from nextview.sensing.facets import Noise
from nextview.sensing.frame import WHOLE, Frame, Part, within
from nextview.sensing.mask_edges import trimmed
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.sensing.planes import Plane, sample
from nextview.sensing.sighting import FEWEST_OBJECT_PIXELS
from nextview.types import Float, Index, Mask

# metres between the camera and the point that names an object: nothing nearer can be measured
NEAREST_POINT = 0.01
AHEAD = 16  # half the width of the middle of the picture, as a part of the picture
# times the radius of a known object within which its pixels lie
SPHERE_MARGIN = 1.02


def inside_box(frame: Frame, box: Box) -> Mask:
    """Return the pixels whose positions lie in an upright box.

    Args:
        frame: the frame.
        box: the box.

    Returns:
        The pixels, (H, W) bool.
    """
    inside = frame.depth > 0
    for axis, low, high in zip(box.axes, box.low, box.high, strict=True):
        position = frame.along(axis)
        inside &= (position >= low) & (position <= high)
    return inside


def inside_sphere(
    frame: Frame,
    centre: Float,
    radius: float,
    part: Part = WHOLE,
) -> Mask:
    """Return the pixels whose positions lie in a sphere.

    Args:
        frame: the frame.
        centre: of the sphere, world, (3,), metres.
        radius: of the sphere, metres.
        part: rows and columns to compute.

    Returns:
        The pixels of the part, (H, W) bool.
    """
    x, y, z = (
        frame.along(axis, float(-at), part)
        for axis, at in zip(np.eye(3), centre, strict=True)
    )
    return (frame.depth[part] > 0) & (x * x + y * y + z * z < radius**2)


def above_plane(frame: Frame, plane: Plane, noise: Noise, part: Part = WHOLE) -> Mask:
    """Return the pixels that are higher above a plane than the noise explains.

    Args:
        frame: the frame.
        plane: the plane.
        noise: of the frame.
        part: rows and columns to compute.

    Returns:
        The pixels of the part, (H, W) bool.
    """
    depth = frame.depth[part]
    height = frame.along(plane.normal, plane.offset, part)
    least = np.float32(0.003) * depth
    high = (height > least) & (depth > 0)

    # Noise moves a point along its ray: it rises by so much as the ray does.
    a, b, c = (frame.camera_to_world[:3, :3].T @ plane.normal).astype(np.float32)
    x = frame.rays[0][part[1]]
    y = frame.rays[1][part[0]]
    most_noise = 4 * float(noise.sigmas.max(initial=0.0))
    steepest = float(
        np.abs(a) * np.abs(x).max() + np.abs(b) * np.abs(y).max() + np.abs(c)
    )
    unsure = height < least + np.float32(most_noise * steepest) * depth**2
    unsure &= high

    rows, columns = np.divmod(np.flatnonzero(unsure), high.shape[1])
    z = depth[rows, columns]
    rise = np.abs((a * x)[columns] + (b * y + c)[rows])
    high[rows, columns] = height[rows, columns] > z * (
        4 * noise.at(z) * z * rise + 0.003
    )
    return high


def inside_mask(
    frame: Frame,
    given: Mask,
    plane: Plane | None,
    noise: Noise,
) -> Mask:
    """The pixels of a mask without the background at its edge and the support plane.

    Args:
        frame: the frame.
        given: the mask, (H, W) bool.
        plane: that the object stands on; None if it is not seen.
        noise: of the frame.
    """
    if plane is None:
        return trimmed(frame.depth, given, noise)

    high = frame.along(plane.normal, plane.offset) > STANDS * frame.depth
    mask = trimmed(frame.depth, given, noise, high)
    part = within(mask)
    above = mask.copy()
    above[part] &= above_plane(frame, plane, noise, part)
    # a plane may lie above what is hidden or flat
    return above if 2 * np.count_nonzero(above) > np.count_nonzero(mask) else mask


def inside_region(
    frame: Frame,
    known: ObjectFrame,
    box: Box | None,
    plane: Plane | None,
    noise: Noise,
) -> Mask:
    """The pixels in the box or the sphere of an object whose place is known, (H, W) bool.

    Args:
        frame: the frame.
        known: the object frame.
        box: that the object fills; None for the sphere of the object frame.
        plane: that the object stands on; None if it is not seen.
        noise: of the frame.

    Raises:
        ObservationError: too little is seen there.
    """
    if box is None:
        mask = inside_sphere(frame, known.centre, SPHERE_MARGIN * known.radius)
    else:
        mask = inside_box(frame, box)
    if plane is not None:
        mask &= above_plane(frame, plane, noise)
    if np.count_nonzero(mask) < FEWEST_OBJECT_PIXELS:
        raise ObservationError(
            "nothing is seen where the object should be: a wrong pose, or a wrong box?"
        )
    return mask


def place_ahead(frame: Frame) -> Float:
    """Return the median position in the middle of the picture, (3,), world, metres."""
    height, width = frame.shape
    down = height // AHEAD + 1
    across = width // AHEAD + 1
    depth = frame.depth[
        height // 2 - down : height // 2 + down,
        width // 2 - across : width // 2 + across,
    ]
    if not depth.any():
        depth = frame.depth
    pose = frame.camera_to_world
    return pose[:3, 3] + float(np.median(depth[depth > 0])) * pose[:3, 2]


def distance_to_object(
    frame: Frame,
    above: Mask,
    ground: Float,
    axes: Float,
    noise: Noise,
    point: Float | None,
) -> float:
    """Return the distance from the camera to the object before it is segmented, metres.

    Args:
        frame: the frame.
        above: pixels above the support plane, (H, W) bool.
        ground: points of the plane that are seen, along x and y of the axes, (M, 2), metres.
        axes: rows x, y and z (up), (3, 3).
        noise: of the frame.
        point: that selects the object, (3,), world, metres; None for what the camera is aimed at.

    Raises:
        ObservationError: the point is in the camera.
    """
    camera = frame.camera_to_world[:3, 3]
    if point is not None:
        distance = float(np.linalg.norm(point - camera))
        if distance < NEAREST_POINT:
            raise ObservationError(
                f"the object's point is {distance:.2g} m from the camera: of the world?"
            )
        return distance

    points = sample(frame, above, noise).points
    points = points[clusters.on_ground(points @ axes[:2].T, ground)]
    points = points if len(points) else place_ahead(frame)[None]
    return float(np.median(np.linalg.norm(points - camera, axis=1)))


def cluster_at_point(
    footprints: Sequence[Footprint],
    labels: Sequence[Index],
    point: Float,
) -> int:
    """The cluster nearest to a point, in the last frame if the nearest of all is not seen there.

    Args:
        footprints: of all frames.
        labels: the cluster of each of their pairs, (K,) each.
        point: (2,), cells.
    """
    target = clusters.nearest(footprints, labels, point)
    if target in labels[-1]:
        return target
    return clusters.nearest(footprints[-1:], labels[-1:], point)


def cluster_seen_before(
    footprints: Sequence[Footprint],
    labels: Sequence[Index],
    chosen: Sequence[Mask],
    centre: Float,
    radius: float,
) -> int:
    """The cluster that most cells of the object belong to; 0 if the last frame shows none.

    Args:
        footprints: of all frames.
        labels: the cluster of each of their pairs, (K,) each.
        chosen: which pairs of the earlier frames are of the object, (K,) bool each.
        centre: of the object as it is known so far, (2,), cells.
        radius: of the object, cells.
    """
    earlier = zip(labels[:-1], chosen, strict=True)
    votes = [now[then] for now, then in earlier]
    count = np.bincount(np.concatenate([[0], *votes]).astype(int))
    count[0] = 0
    here = labels[-1]
    if not count.any():
        return clusters.nearest(footprints[-1:], labels[-1:], centre)
    target = int(count.argmax())
    if target in here:
        return target

    # what was found was a part: the whole stands in the same place
    off = np.linalg.norm(footprints[-1].cells + 0.5 - centre, axis=1)
    there = here[(off < radius) & (here > 0)]
    return int(np.bincount(there).argmax()) if len(there) else 0


def join_other_sides(
    labels: Sequence[Index],
    chosen: Sequence[Mask],
    target: int,
) -> None:
    """Give other sides of the object its label, in place.

    What was the object in an earlier frame, and is never seen beside the cluster that is the object
    now, is another side of it.

    Args:
        labels: the cluster of each pair, (K,) for each frame.
        chosen: which pairs of the earlier frames are of the object, (K,) bool each.
        target: label of the object.
    """
    for now, then in zip(labels, chosen, strict=False):
        was = int(np.bincount(now[then], minlength=1).argmax())
        if was and not any(was in label and target in label for label in labels):
            for label in labels:
                label[label == was] = target
