"""Poses of frames of an object on a turntable that rotates in even steps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from nextview.captured.folders import (
    INTRINSICS,
    is_capture,
)
from nextview.captured.frames import (
    MILLIMETRES,
    Capture,
    CapturedFrame,
    DepthFile,
    read_table,
)
from nextview.errors import DatasetError, ObservationError
from nextview.geometry.axes import upright_axes
from nextview.geometry.viewsphere import rotation_z
from nextview.sensing import Frame, ObservedObject
from nextview.sensing.object_frame import smallest_circle
from nextview.types import Float

# rounds of the fit; points per frame; share of the nearest points that is used
ROUNDS = 40
TURN_POINTS = 800
CLOSEST_TURN = 0.7
# compared frames are a sixth of a turn, or one step, apart
TURN_PARTS = 6
# largest distance of this share of the frames, relative to the object radius, in addition to noise
AGREE = 0.008
AGREEING_SHARE = 0.8


def is_turntable(folder: Path) -> bool:
    """Return True if a folder contains depth images and intrinsics, but no poses."""
    return (
        (folder / INTRINSICS).exists()
        and next(folder.glob("*.png"), None) is not None
        and not is_capture(folder)
    )


def read_turntable(folder: Path, turn: str) -> Capture:
    """Read the frames of an object on a turntable that made one full turn in even steps.

    The axis is the normal of the support plane at the position where the surfaces of neighbouring
    frames agree best; its foot is the origin of the world frame.

    Args:
        folder: depth images in millimetres, in the order of their names, and the pinhole matrix.
        turn: "ccw" or "cw", as seen from above.

    Returns:
        The frames with their poses.

    Raises:
        DatasetError: the frames do not agree, or one does not show an object on a plane.
    """
    k = read_table(folder / INTRINSICS, "the pinhole matrix", 3)
    way = 1 if turn == "ccw" else -1
    frames = [
        CapturedFrame(path.stem, DepthFile(path), MILLIMETRES, k, np.eye(4))
        for path in sorted(folder.glob("*.png"))
    ]
    shown = []
    for frame in frames:
        thing = ObservedObject(alone=True)
        try:
            thing.add(Frame(frame.read().depth, k))
        except ObservationError as error:
            raise DatasetError(f"{frame.depth}: {error}") from None
        shown.append(thing.sightings[0])
    plane = np.median(
        [[*s.plane.normal, s.plane.offset] for s in shown if s.plane is not None],
        0,
    )
    axes = upright_axes(plane[:3], np.array([0, 0, -1.0]))
    few = [
        np.linspace(0, len(s.facets.planes) - 1, TURN_POINTS).astype(int) for s in shown
    ]
    clouds = [
        (s.facets.points[f] @ axes.T, s.facets.planes[f] @ axes.T)
        for s, f in zip(shown, few, strict=True)
    ]
    axis, apart = _fit(clouds, way)
    _, other = _fit(clouds, -way)
    if np.median(other) < 0.6 * np.median(apart):
        raise DatasetError(
            f"{folder}: its frames agree if the thing turned the other way, not {turn}"
        )
    radius = (
        np.ptp(np.concatenate([points[:, :2] for points, _ in clouds]), axis=0).max()
        / 2
    )
    z = float(np.median([np.median(s.facets.points[:, 2]) for s in shown]))
    noise = float(np.median([s.noise.at(z) for s in shown])) * z**2
    # includes the pair of the last and the first frame
    worst = max(np.quantile(apart, AGREEING_SHARE), apart[-1] / 3)
    if worst > AGREE * radius + noise:
        what = f"what a frame and the next show does not agree ({1000 * worst:.1f} mm apart)"
        raise DatasetError(
            f"{folder}: {what}: equal steps through a full circle, in the order of the names?"
        )
    posed = []
    for i, frame in enumerate(frames):
        back = rotation_z(2 * np.pi * -way * i / len(frames))
        pose = np.eye(4)
        pose[:3, :3] = back @ axes
        pose[:3, 3] = back @ [*-axis, plane[3]]
        posed.append(replace(frame, pose=pose))
    notes = (f"{len(posed)} even steps {turn}",)
    return Capture(
        folder,
        "turntable",
        tuple(posed),
        (0.0, 0.0, 1.0),
        notes,
        object_is_world=True,
    )


def _fit(clouds: list[tuple[Float, Float]], way: int) -> tuple[Float, Float]:
    """Return the axis position in the plane, (2,), and distances of neighbouring frames, (N,).

    Point-to-plane least squares with an upright axis: each point is moved onto the plane of its
    nearest neighbour.
    """
    n = len(clouds)
    axis = smallest_circle(np.concatenate([points[::7, :2] for points, _ in clouds]))[0]
    turns = [rotation_z(2 * np.pi * -way * i / n) for i in range(n)]
    apart = np.zeros(n)

    turned = [
        (p @ r.T, q @ r.T / np.linalg.norm(q, axis=1)[:, None])
        for (p, q), r in zip(clouds, turns, strict=True)
    ]
    trees = [cKDTree(points) for points, _ in turned]
    pairs = [
        (i, (i + gap) % n)
        for gap in sorted({max(1, n // TURN_PARTS), 1})
        for i in range(n)
    ]
    for _ in range(ROUNDS):
        rows = list[Float]()
        wanted = list[Float]()

        for i, j in pairs:
            p, _ = turned[i]
            q, normals = turned[j]
            shift = (turns[i] - turns[j])[:, :2]
            distance, nearest = trees[j].query(p - shift @ axis)
            close = distance <= np.quantile(distance, CLOSEST_TURN)
            near = np.asarray(nearest)[close]
            rows.append(normals[near] @ shift)
            wanted.append((normals[near] * (p[close] - q[near])).sum(1))
            if j == (i + 1) % n:
                apart[i] = np.median(np.abs(wanted[-1] - rows[-1] @ axis))

        before = axis
        axis = np.linalg.lstsq(
            np.concatenate(rows),
            np.concatenate(wanted),
            rcond=None,
        )[0]
        if np.linalg.norm(axis - before) < 1e-6:
            break
    return axis, apart
