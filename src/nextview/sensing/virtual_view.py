"""Look at the facets of an object as the networks were taught to: upright, centred, from three object radii."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.observation import pinhole
from nextview.sensing.facets import Facets
from nextview.viewsphere import DISTANCE

Float = NDArray[np.float64]

NEAREST, FARTHEST = 0.5, 100.0
"""Depth of what can be shown, object radii; all of the object is between 2 and 4."""
WIDEST = 1 / 16
"""Half the width of what one pixel of the sensor shows here at most, as a part of the image: it bounds the time."""
LAYER = 0.03
"""Facets that lie within so many object radii of depth are of one surface, where the nearest to a pixel is shown."""


def virtual_pose(pose: Float) -> Float:
    """Where the networks would have looked from: in the camera's direction, at their distance, horizon level.

    Args:
        pose: camera-to-world, (4, 4), OpenCV axes, object frame, object radii.

    Returns:
        (4, 4) float64.
    """
    position = pose[:3, 3]
    outward = position / np.linalg.norm(position) if position.any() else -pose[:3, 2]
    right = np.array([-outward[1], outward[0], 0.0])
    if np.hypot(right[0], right[1]) < 1e-6:  # straight above: keep the camera's own right
        right = pose[:3, 0] - (pose[:3, 0] @ outward) * outward
    right /= np.linalg.norm(right)
    virtual = np.eye(4)
    virtual[:3, :3] = np.stack([right, np.cross(-outward, right), -outward], 1)
    virtual[:3, 3] = DISTANCE * outward
    return virtual


def look_again(facets: Facets, pose: Float, radius: float, size: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """The depth image of the facets from the virtual pose.

    The sensor was at another distance, seldom level, and aimed beside the centre. Each facet is cast where the virtual
    camera sees it; a pixel shows the nearest surface, at the depth where its own ray meets the facet's plane, so that
    planes stay planes.

    Args:
        facets: in the camera's frame, metres.
        pose: of the camera that saw them, camera-to-world, (4, 4), object frame, object radii.
        radius: object radius, metres.
        size: side of the image.

    Returns:
        Depth, (size, size) float32, object radii, 0 = nothing; and the facet seen in each pixel, int64, -1 for none.
    """
    target = virtual_pose(pose)
    focal = pinhole(size, DISTANCE)[0, 0]
    turn = target[:3, :3].T @ pose[:3, :3]
    shift = target[:3, :3].T @ (pose[:3, 3] - target[:3, 3])
    points = facets.points / radius
    seen_from = points[:, 2]  # depth in the sensor's own image
    points = points @ turn.T + shift
    # n . P = 1 in the sensor's frame; P = turn^T (P' - shift), so n' . P' = 1 + n' . shift.
    normals = facets.planes * radius @ turn.T
    offset = 1 + normals @ shift
    z = points[:, 2]
    front = np.flatnonzero((z > NEAREST) & (z < FARTHEST))
    x, y = focal * points[front, :2].T / z[front] + size / 2
    # A facet is as wide as a sensor's pixel: so many pixels here, half to each side; somewhat more where it is turned.
    # A sensor that stands within the object has wider ones; they fill gaps no farther than WIDEST.
    half = np.clip(0.6 * focal * facets.pitch.mean() * seen_from[front] / z[front], 0.5, WIDEST * size) + 0.05
    # The first column and row whose centres it covers:
    left, top = (np.clip(np.ceil(at - half - 0.5), -size, size).astype(np.int64) for at in (x, y))
    layer = (z[front] / LAYER).astype(np.int64) << 48 | front
    best = np.full(size * size, np.iinfo(np.int64).max)
    across = range(int(2 * half.max()) + 1) if len(front) else range(0)
    for down in across:
        row = top + down
        dy = np.abs(row + 0.5 - y)
        some = np.flatnonzero((dy <= half) & (row >= 0) & (row < size))
        for right in across:
            column = left[some] + right
            dx = np.abs(column + 0.5 - x[some])
            hit = np.flatnonzero((dx <= half[some]) & (column >= 0) & (column < size))
            it = some[hit]
            key = layer[it] | ((dx[hit] + dy[it]) * 64).astype(np.int64) << 32
            np.minimum.at(best, row[it] * size + column[hit], key)
    shown = np.flatnonzero(best < np.iinfo(np.int64).max)
    facet = np.full(size * size, -1)
    facet[shown] = best[shown] & 0xFFFFFFFF
    chosen = facet[shown]
    rays = np.stack([(shown % size + 0.5) / focal, (shown // size + 0.5) / focal, np.ones(len(shown))], 1)
    rays[:, :2] -= size / 2 / focal
    with np.errstate(divide="ignore"):
        meets = offset[chosen] / (normals[chosen] * rays).sum(1)
    # A plane seen edge-on runs away within a pixel: stay near the facet.
    near = np.abs(meets - z[chosen]) < LAYER
    depth = np.zeros(size * size, np.float32)
    depth[shown] = np.where(near, meets, z[chosen])
    return depth.reshape(size, size), facet.reshape(size, size)
