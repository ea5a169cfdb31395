"""A method in another process for nextview submit (docs/submit.md): GICP of small_gicp.

    pip install numpy scipy pillow trimesh small_gicp
    nextview submit ARCHIVE gicp.json --command "python research/peers/gicp_method.py SCANS" \
        --name "GICP of small_gicp" --version 1 --blind

It registers the points of all views so far with each scan, from the 60 orientations of an
icosahedron, and names the scan that fits best, both ways. Its next view is the one that is farthest
from those it had. SCANS holds NAME.ply, metres.

Segal et al., "Generalized-ICP", RSS 2009; Koide, "small_gicp", JOSS 2024. The distances have the
ratio of the defaults of ``small_gicp.align``, which are in metres of streets. It runs in an
environment of its own, without nextview.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import small_gicp
from looks import Fit, Float, Scan, View, answer_looks, thinned
from scipy.spatial.transform import Rotation

STEP = 0.004  # metres between points that are registered
REACH = 4 * STEP  # metres: points that are farther apart are no pair
SETTLED = 1e-5  # metres that a last step moves
TURNS = Rotation.create_group("I").as_matrix()
LIMIT = 10_000  # points that are thinned on a grid of STEP


@cache
def prepared(scan: Scan) -> tuple[small_gicp.PointCloud, small_gicp.KdTree]:
    """A scan as small_gicp registers it."""
    return small_gicp.preprocess_points(scan.points, downsampling_resolution=STEP)


def starts(scan: Scan, views: Sequence[View]) -> list[Float]:
    """A pose for each turn, where the centre of what faces the cameras is that of what is seen."""
    seen = thinned(views, LIMIT).mean(0)
    poses = np.tile(np.eye(4), (len(TURNS), 1, 1))
    for pose, turn in zip(poses, TURNS, strict=True):
        pose[:3, :3] = turn
        facing = scan.points[scan.facing(turn, views)]
        pose[:3, 3] = seen - turn @ facing.mean(0)
    return list(poses)


def fitted(scan: Scan, views: Sequence[View]) -> Fit:
    """The best pose of a scan in some views."""
    cloud, tree = prepared(scan)
    points = thinned(views, LIMIT)
    seen, _ = small_gicp.preprocess_points(points, downsampling_resolution=STEP)
    poses = []
    for start in starts(scan, views):
        found = small_gicp.align(
            cloud,
            seen,
            tree,
            np.linalg.inv(start),
            registration_type="GICP",
            max_correspondence_distance=REACH,
            translation_epsilon=SETTLED,
        )
        poses.append(np.linalg.inv(found.T_target_source))
    misfits = [scan.misfit(pose, views) for pose in poses]
    best = int(np.argmin(misfits))
    return Fit(misfits[best], poses[best])


if __name__ == "__main__":
    answer_looks(fitted)
