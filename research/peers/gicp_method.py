"""A method in another process for nextview-lab submit (docs/submit.md): GICP of small_gicp.

    pip install numpy scipy pillow trimesh small_gicp
    nextview-lab submit ARCHIVE gicp.json --command "python research/peers/gicp_method.py SCANS" \
        --name "GICP of small_gicp" --version 1 --blind

It registers the points of all views so far with each scan, from those 6 of the 60 orientations of
an icosahedron that fit best, and names the scan that fits best, both ways. Its next view is the one
that is farthest from those it had. SCANS holds NAME.ply, metres.

Segal et al., "Generalized-ICP", RSS 2009; Koide, "small_gicp", JOSS 2024. The distances have the
ratio of the defaults of ``small_gicp.align``, which are in metres of streets. It runs in an
environment of its own, without nextview.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import small_gicp
from looks import STEPS, Fit, Float, Scan, Seen, answer_looks
from scipy.spatial.transform import Rotation

# the ratios of the defaults of small_gicp.align: points 0.25 m apart, pairs up to 1 m, and a last
# step of 1 mm
REACH = 4  # steps between points, beyond which two points are no pair
SETTLED = 0.004  # steps that a last move goes
TURNS = Rotation.create_group("I").as_matrix()
REGISTERED = 6  # of the turns, those that fit best


@cache
def prepared(scan: Scan) -> tuple[small_gicp.PointCloud, small_gicp.KdTree]:
    """A scan as small_gicp registers it, with as many steps along it as along what is seen."""
    step = float(np.linalg.norm(np.ptp(scan.points, axis=0))) / STEPS
    return small_gicp.preprocess_points(scan.points, downsampling_resolution=step)


def starts(scan: Scan, seen: Seen) -> list[Float]:
    """Poses that have the centre of what faces the cameras at that of what is seen, best first."""
    centre = seen.points.mean(0)
    poses = np.tile(np.eye(4), (len(TURNS), 1, 1))
    for pose, turn in zip(poses, TURNS, strict=True):
        pose[:3, :3] = turn
        pose[:3, 3] = centre - turn @ scan.facing(turn, seen).mean(0)
    return sorted(poses, key=lambda pose: scan.misfit(pose, seen))[:REGISTERED]


def matcher(seen: Seen) -> Callable[[Scan], Fit | None]:
    """What finds the best pose of a scan where it is seen."""
    source, _ = small_gicp.preprocess_points(
        seen.points, downsampling_resolution=seen.step
    )

    def fitted(scan: Scan) -> Fit | None:
        target, tree = prepared(scan)
        poses = []
        for start in starts(scan, seen):
            found = small_gicp.align(
                target,
                source,
                tree,
                np.linalg.inv(start),
                registration_type="GICP",
                max_correspondence_distance=REACH * seen.step,
                translation_epsilon=SETTLED * seen.step,
            )
            poses.append(np.linalg.inv(found.T_target_source))
        return scan.best(poses, seen)

    return fitted


if __name__ == "__main__":
    answer_looks(matcher)
