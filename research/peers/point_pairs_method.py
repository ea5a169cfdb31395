"""A method in another process for nextview-lab submit (docs/submit.md): OpenCV's point-pair
features.

    pip install numpy scipy pillow trimesh opencv-contrib-python-headless
    nextview-lab submit ARCHIVE pairs.json --name "point pairs of OpenCV" --version 1 --blind \
        --command "python research/peers/point_pairs_method.py SCANS"

It matches the points of all views so far, with their normals, with each scan, refines the poses
that have most votes by OpenCV's ICP, and names the scan that fits best, both ways. Its next view is
the one that is farthest from those it had. SCANS holds NAME.ply, metres.

Drost et al., "Model globally, match locally", CVPR 2010. The settings are those of OpenCV's
introduction to surface matching and its sample ppf_load_match, but for the sampling of the scans,
which is coarser, for the time it takes; no result was looked at before. ``research/point_pairs.py``
is the same detector with another refinement, as a recogniser inside nextview. This runs in an
environment of its own, without it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from looks import Fit, Float, Scan, Seen, View, answer_looks
from numpy.typing import NDArray

Cloud = NDArray[np.float32]  # points in UNIT and unit normals, (N, 6)

# metres, as in OpenCV's samples: in metres its detector would average poses that are up to 10 cm
# apart, in whatever rotation
UNIT = 0.001

# OpenCV recommends 0.025 to 0.05. At 0.1 the scan of a box is learnt in 0.4 s, at 0.07 in 28 s, as
# all pairs of two faces are alike
SAMPLING_STEP = 0.1  # of the points of a scan, sides of the box around them
DISTANCE_STEP = (
    0.05  # of distances between points; OpenCV 5.0 ignores it, for SAMPLING_STEP
)
ANGLES = 30  # steps of a full turn
SCENE_STEP = 0.05  # of the points that are seen, sides of the box around them
REFERENCES = 1 / 10  # share of these, of which each votes
REFINED = 2  # poses of each thing, those with most votes
ICP = (100, 0.005, 2.5, 8)  # iterations, tolerance, rejection in deviations, levels
NEIGHBOURS = 12  # points that a normal is found from


@cache
def detector(scan: Scan) -> cv2.ppf_match_3d_PPF3DDetector:
    """A detector that is trained on a scan."""
    trained = cv2.ppf_match_3d_PPF3DDetector(SAMPLING_STEP, DISTANCE_STEP, ANGLES)
    trained.trainModel(as_cloud(scan.points, scan.normals))
    return trained


def as_cloud(points: Float, normals: Float) -> Cloud:
    """Points in metres with normals as OpenCV reads them."""
    return np.concatenate([points / UNIT, normals], 1).astype(np.float32)


def with_normals(view: View) -> Cloud:
    """The points of a view, with normals towards the camera."""
    points = (view.points / UNIT).astype(np.float32)
    neighbours = min(NEIGHBOURS, len(points))
    camera = tuple(view.camera / UNIT)
    _, cloud = cv2.ppf_match_3d.computeNormalsPC3d(points, neighbours, True, camera)
    return cloud


def moved(cloud: Cloud, pose: Float) -> Cloud:
    """A cloud at a pose of UNIT."""
    points, normals = np.split(cloud.astype(np.float64), 2, axis=1)
    there = [points @ pose[:3, :3].T + pose[:3, 3], normals @ pose[:3, :3].T]
    return np.concatenate(there, 1).astype(np.float32)


def in_metres(pose: Float) -> Float:
    """A pose of UNIT in metres, (4, 4)."""
    metres = pose.copy()
    metres[:3, 3] *= UNIT
    return metres


def matcher(seen: Seen) -> Callable[[Scan], Fit | None]:
    """What finds the best pose of a scan where it is seen, refined or as the votes have it."""
    cloud = np.concatenate([with_normals(view) for view in seen.views])
    icp = cv2.ppf_match_3d_ICP(*ICP)

    def fitted(scan: Scan) -> Fit | None:
        surface = as_cloud(scan.points, scan.normals)
        poses = []
        for found in detector(scan).match(cloud, REFERENCES, SCENE_STEP)[:REFINED]:
            pose = np.array(found.pose)
            # what is seen is moved onto the scan, as only a part of the scan is seen
            back = np.linalg.inv(pose)
            _, _, step = icp.registerModelToScene(moved(cloud, back), surface)
            poses += [pose, np.linalg.inv(step @ back)]
        return scan.best(map(in_metres, poses), seen)

    return fitted


if __name__ == "__main__":
    answer_looks(matcher)
