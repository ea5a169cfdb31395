"""A method in another process for nextview submit (docs/submit.md): OpenCV's point-pair features.

    pip install numpy scipy pillow trimesh opencv-contrib-python-headless
    nextview submit ARCHIVE pairs.json --name "point pairs of OpenCV" --version 1 --blind \
        --command "python research/peers/point_pairs_method.py SCANS"

It matches the points of all views so far, with their normals, with each scan, refines the poses
that have most votes by OpenCV's ICP, and names the scan that fits best, both ways. Its next view is
the one that is farthest from those it had. SCANS holds NAME.ply, metres.

Drost et al., "Model globally, match locally", CVPR 2010. No setting is tuned.
``research/point_pairs.py`` is the same detector with another refinement, as a recogniser inside
nextview. This runs in an environment of its own, without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from looks import Fit, Float, Scan, View, answer_looks
from numpy.typing import NDArray

Cloud = NDArray[np.float32]  # points and unit normals, (N, 6), metres

SAMPLING_STEP = 0.05  # of the samples, sides of the box around them
DISTANCE_STEP = 0.05  # of distances between points, in diameters
ANGLES = 30  # steps of a full turn
REFERENCES = 0.2  # share of the points that are seen, of which each votes
GRID = 0.003  # metres: points of a view in one cell are averaged
NEIGHBOURS = 12  # points that a normal is found from
REFINED = 5  # poses of each thing


@cache
def detector(scan: Scan) -> cv2.ppf_match_3d_PPF3DDetector:
    """A detector that is trained on a scan."""
    trained = cv2.ppf_match_3d_PPF3DDetector(SAMPLING_STEP, DISTANCE_STEP, ANGLES)
    trained.trainModel(as_cloud(scan.points, scan.normals))
    return trained


def as_cloud(points: Float, normals: Float) -> Cloud:
    """Points with normals as OpenCV reads them."""
    return np.concatenate([points, normals], 1).astype(np.float32)


def with_normals(view: View) -> Cloud:
    """What a view shows, averaged in the cells of a grid, with normals towards the camera."""
    cells = np.floor(view.points / GRID)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(cell.ravel(), weights=each) for each in view.points.T]
    points = (np.stack(sums, 1) / count[:, None]).astype(np.float32)
    neighbours = min(NEIGHBOURS, len(points))
    camera = tuple(view.camera)
    _, cloud = cv2.ppf_match_3d.computeNormalsPC3d(points, neighbours, True, camera)
    return cloud


def moved(cloud: Cloud, pose: Float) -> Cloud:
    """A cloud at a pose."""
    points, normals = np.split(cloud.astype(np.float64), 2, axis=1)
    return as_cloud(points @ pose[:3, :3].T + pose[:3, 3], normals @ pose[:3, :3].T)


def fitted(scan: Scan, views: Sequence[View]) -> Fit:
    """The best pose of a scan in some views, refined or as the votes have it."""
    seen = np.concatenate([with_normals(view) for view in views])
    surface = as_cloud(scan.points, scan.normals)
    icp = cv2.ppf_match_3d_ICP(100, 0.005, 2.5, 8)
    poses = []
    for found in detector(scan).match(seen, REFERENCES, DISTANCE_STEP)[:REFINED]:
        pose = np.array(found.pose)
        # what is seen is moved onto the scan, as only a part of the scan is seen
        back = np.linalg.inv(pose)
        _, _, step = icp.registerModelToScene(moved(seen, back), surface)
        poses += [pose, np.linalg.inv(step @ back)]
    misfits = [scan.misfit(pose, views) for pose in poses]
    best = int(np.argmin(misfits))
    return Fit(misfits[best], poses[best])


if __name__ == "__main__":
    answer_looks(fitted)
