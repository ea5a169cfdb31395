"""A method in another process for nextview-lab submit (docs/submit.md): ICP with NumPy and SciPy
alone.

    nextview-lab submit ARCHIVE icp.json --command "python examples/icp_method.py SCANS" \
        --name "plain ICP" --version 1 --blind

It matches the points of all views so far with each scan, in 24 orientations, and names the scan
that fits best. Its next view is the one that is farthest from those it had. SCANS holds NAME.ply.
"""

import json
import sys
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

TURNS = Rotation.create_group("O").as_matrix()
clouds = {
    p.stem: trimesh.load(p).sample(500, seed=0) for p in Path(sys.argv[1]).glob("*.ply")
}
trees = {name: cKDTree(cloud) for name, cloud in clouds.items()}


def misfit(name, seen, pose):
    """Mean distances of points from a scan, and of its nearer half from them, metres."""
    there, _ = trees[name].query((seen - pose[:3, 3]) @ pose[:3, :3])
    back, _ = cKDTree(seen).query(clouds[name] @ pose[:3, :3].T + pose[:3, 3])
    return there.mean() + np.sort(back)[:250].mean()


def fitted(name, seen):
    """The best pose of a scan, and its misfit."""
    poses = np.tile(np.eye(4), (len(TURNS), 1, 1))
    poses[:, :3, :3] = TURNS
    poses[:, :3, 3] = seen.mean(0) - TURNS @ clouds[name].mean(0)
    pose = min(poses, key=lambda each: misfit(name, seen, each))
    for _ in range(15):
        nearest = clouds[name][
            trees[name].query((seen - pose[:3, 3]) @ pose[:3, :3])[1]
        ]
        turn, _ = Rotation.align_vectors(seen - seen.mean(0), nearest - nearest.mean(0))
        pose[:3, :3] = turn.as_matrix()
        pose[:3, 3] = seen.mean(0) - pose[:3, :3] @ nearest.mean(0)
    return misfit(name, seen, pose), name, pose


for look in map(json.loads, sys.stdin):
    if look["step"] == 1:
        points, taken = np.zeros((0, 3)), []
    taken.append(look["view"])
    poses, k = np.array(look["poses"]), np.array(look["intrinsics"])
    depth = np.asarray(Image.open(look["depth"])) * look["metres_per_unit"]
    rows, columns = np.nonzero((np.asarray(Image.open(look["mask"])) > 0) & (depth > 0))
    z, pose = depth[rows, columns], poses[look["view"]]
    x, y = (columns - k[0, 2]) * z / k[0, 0], (rows - k[1, 2]) * z / k[1, 1]
    points = np.vstack([points, np.stack([x, y, z], 1) @ pose[:3, :3].T + pose[:3, 3]])

    answer = {"name": None, "confidence": 0.0, "confident": False}
    if len(points) > 100:
        seen = np.random.default_rng(0).permutation(points)[:300]
        known = [name for name in look["things"] if name in clouds]
        found = sorted((fitted(name, seen) for name in known), key=lambda each: each[0])
        (best, name, pose), second = found[0], found[1][0]
        sure = 1 - best / second
        answer = {"name": name, "confidence": sure, "confident": bool(sure > 0.5)}
        answer["pose"] = pose.tolist()
    if look["free"]:
        gaps = np.linalg.norm(
            poses[look["free"], None, :3, 3] - poses[taken, :3, 3], axis=2
        )
        answer["next"] = look["free"][int(gaps.min(1).argmax())]
    print(json.dumps(answer), flush=True)
