"""Resample the object in a frame to the input of the networks: level, from three object radii."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.geometry.camera import pinhole
from nextview.geometry.viewsphere import CAMERA_DISTANCE
from nextview.sensing.facets import SIZE, Facets
from nextview.sensing.object_frame import ObjectFrame
from nextview.sensing.observation import Observation
from nextview.sensing.sighting import Sighting
from nextview.types import Float, Float32, Index

# largest half width of a rendered sensor pixel, as a share of the image, to limit the run time
WIDEST_FACET = 1 / 16
# depth range of facets of one surface, object radii; of these the one nearest to a pixel is shown
SURFACE_LAYER = 0.03


def observation_of(
    sighting: Sighting,
    object_frame: ObjectFrame,
    life_size: bool = True,
) -> Observation:
    """Resample a sighting of the object.

    Args:
        sighting: of the object in the frame.
        object_frame: latest object frame.
        life_size: whether the radius is evidence of the class.

    Returns:
        The view from three object radii, in the direction of the camera.
    """
    pose = object_frame.pose_in_object(sighting.frame.camera_to_world)
    depth, facet = look_again(sighting.facets, pose, object_frame.radius, SIZE)

    return Observation(
        depth,
        virtual_pose(pose),
        pinhole(SIZE, CAMERA_DISTANCE),
        object_frame.radius if life_size else None,
        _resampled(sighting.frame.image, sighting.facets, facet),
        sighting,
        object_frame,
        colour=_resampled(sighting.frame.colour, sighting.facets, facet),
    )


def virtual_pose(pose: Float) -> Float:
    """Return the level pose, (4, 4), at the networks' distance in a camera's direction."""
    position = pose[:3, 3]
    outward = position / np.linalg.norm(position) if position.any() else -pose[:3, 2]
    right = np.array([-outward[1], outward[0], 0.0])
    if (
        np.hypot(right[0], right[1]) < 1e-6
    ):  # from directly above, keep the camera's own x axis
        right = pose[:3, 0] - (pose[:3, 0] @ outward) * outward
    right /= np.linalg.norm(right)
    virtual = np.eye(4)
    virtual[:3, :3] = np.stack([right, np.cross(-outward, right), -outward], 1)
    virtual[:3, 3] = CAMERA_DISTANCE * outward
    return virtual


def look_again(
    facets: Facets,
    pose: Float,
    radius: float,
    size: int,
) -> tuple[Float32, Index]:
    """Render facets from the virtual pose.

    Each facet is drawn where the virtual camera sees it. A pixel shows the nearest surface, at the
    depth where its own ray meets the plane of the facet, so that planes remain planes.

    Args:
        facets: the facets.
        pose: of the original camera, (4, 4), object frame, object radii.
        radius: of the object, metres.
        size: side of the image, pixels.

    Returns:
        Depth, (size, size) float32, object radii, and the facet of each pixel, int64, -1 for none.
    """
    target = virtual_pose(pose)
    focal = pinhole(size, CAMERA_DISTANCE)[0, 0]
    turn = target[:3, :3].T @ pose[:3, :3]
    shift = target[:3, :3].T @ (pose[:3, 3] - target[:3, 3])
    seen_from = facets.points[:, 2] / radius  # depth in the sensor's own image
    points = facets.points @ (turn.T / radius) + shift
    # n . P = 1 in the sensor's frame; P = turn^T (P' - shift), so n' . P' = 1 + n' . shift.
    normals = facets.planes @ (radius * turn.T)
    offset = 1 + normals @ shift
    z = points[:, 2]
    # object radii; the object is between 2 and 4
    front = np.flatnonzero((z > 0.5) & (z < 100))
    x, y = focal * points[front, :2].T / z[front] + size / 2
    # A facet is as wide as a sensor pixel, in pixels of this image, and slightly wider if it is
    # inclined. Half widths are limited to WIDEST_FACET, for sensors inside the object.
    half = (
        np.clip(
            0.6 * focal * facets.pitch.mean() * seen_from[front] / z[front],
            0.5,
            WIDEST_FACET * size,
        )
        + 0.05
    )
    # First column and row whose centres the facet covers
    left, top = (
        np.clip(np.ceil(at - half - 0.5), -size, size).astype(np.int64) for at in (x, y)
    )
    layer = (z[front] / SURFACE_LAYER).astype(np.int64) << 48 | front
    best = np.full(size * size, np.iinfo(np.int64).max)
    covered = range(int(2 * half.max()) + 1) if len(front) else range(0)
    for down in covered:
        row = top + down
        dy = np.abs(row + 0.5 - y)
        some = np.flatnonzero((dy <= half) & (row >= 0) & (row < size))
        for right in covered:
            column = left[some] + right
            dx = np.abs(column + 0.5 - x[some])
            hit = np.flatnonzero((dx <= half[some]) & (column >= 0) & (column < size))
            it = some[hit]
            key = layer[it] | ((dx[hit] + dy[it]) * 64).astype(np.int64) << 32
            np.minimum.at(best, row[it] * size + column[hit], key)
    shown = np.flatnonzero(best < np.iinfo(np.int64).max)
    facet = np.full(size * size, -1)
    facet[shown] = chosen = best[shown] & 0xFFFFFFFF
    slopes = (np.arange(size) + 0.5 - size / 2) / focal
    normal_x, normal_y, normal_z = normals.T.copy()
    towards = (
        normal_x[chosen] * slopes[shown % size]
        + normal_y[chosen] * slopes[shown // size]
        + normal_z[chosen]
    )
    with np.errstate(divide="ignore"):
        meets = offset[chosen] / towards
    depth = np.zeros(size * size, np.float32)
    # The depth of a plane seen edge-on diverges within a pixel, so it is limited.
    depth[shown] = np.where(np.abs(meets - z[chosen]) < SURFACE_LAYER, meets, z[chosen])
    return depth.reshape(size, size), facet.reshape(size, size)


def _resampled(
    picture: NDArray[np.uint8] | None,
    facets: Facets,
    facet: Index,
) -> NDArray[np.uint8] | None:
    """Sample the image of a frame, (H, W) or (H, W, 3), at the visible facets, (S, S)."""
    if picture is None:
        return None
    shown = np.zeros((*facet.shape, *picture.shape[2:]), np.uint8)
    hit = facet >= 0
    shown[hit] = picture[facets.rows[facet[hit]], facets.columns[facet[hit]]]
    return shown
