"""What methods in another process share: they read looks, judge poses of scans, and answer.

``docs/submit.md`` says what the lines hold. This needs NumPy, SciPy, Pillow and trimesh, and no
nextview.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

Float = NDArray[np.float64]

SAMPLES = 2000  # points on each scan
JUDGED = 500  # points of the scan, and of what is seen, that judge a pose
ENOUGH = 100  # points that are matched at all
FARTHEST = 0.01  # metres: what is farther from its nearest point counts as so far
SURE = 0.5  # confidence that a robot acts on


@dataclass(frozen=True, eq=False)
class View:
    """What one view shows of the thing.

    Attributes:
        points: (N, 3), metres, world.
        camera: where it was taken from, (3,), metres, world.
    """

    points: Float
    camera: Float


@dataclass(frozen=True, eq=False)
class Scan:
    """Points that are spread evenly over a scan, in its own frame.

    Attributes:
        points: (SAMPLES, 3), metres.
        normals: outward unit vectors, (SAMPLES, 3).
        tree: of the points.
    """

    points: Float
    normals: Float
    tree: cKDTree

    def facing(self, turn: Float, views: Sequence[View]) -> NDArray[np.bool_]:
        """Which points face a camera when the scan is turned and lies where the views look.

        Args:
            turn: from the scan's frame to the world, (3, 3).
            views: at least one.
        """
        centre = np.concatenate([view.points for view in views]).mean(0)
        cameras = np.stack([view.camera for view in views]) - centre
        return (self.normals @ turn.T @ cameras.T > 0).any(1)

    def misfit(self, pose: Float, views: Sequence[View]) -> float:
        """How far what is seen is from the scan, and the scan from what is seen, metres.

        The sum of two means of clipped distances. Of the points of the scan that face a camera
        the nearer half counts: something may stand before the others.

        Args:
            pose: from the scan's frame to the world, (4, 4).
            views: at least one.
        """
        seen = thinned(views, JUDGED)
        turn, shift = pose[:3, :3], pose[:3, 3]
        there, _ = self.tree.query((seen - shift) @ turn)
        faces = self.facing(turn, views)[:JUDGED]
        back, _ = cKDTree(seen).query(self.points[:JUDGED][faces] @ turn.T + shift)
        nearer = np.sort(back)[: (np.size(back) + 1) // 2]
        means = [np.minimum(each, FARTHEST).mean() for each in (there, nearer)]
        return float(sum(means))


@dataclass(frozen=True, eq=False)
class Fit:
    """The best pose of a scan.

    Attributes:
        misfit: of the scan at it, metres.
        pose: from the scan's frame to the world, (4, 4).
    """

    misfit: float
    pose: Float


@cache
def scan_of(name: str) -> Scan:
    """The scan NAME.ply in the folder that the command line names."""
    mesh = trimesh.load(Path(sys.argv[1]) / f"{name}.ply")
    points, faces = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    points = np.asarray(points)
    return Scan(points, mesh.face_normals[faces], cKDTree(points))


def thinned(views: Sequence[View], count: int) -> Float:
    """So many points of all views, always the same ones, (at most COUNT, 3)."""
    points = np.concatenate([view.points for view in views])
    return np.random.default_rng(0).permutation(points)[:count]


def view_of(look: dict[str, Any]) -> View:
    """What a look shows of the thing."""
    depth = np.asarray(Image.open(look["depth"])) * look["metres_per_unit"]
    mask = np.asarray(Image.open(look["mask"])) > 0
    rows, columns = np.nonzero(mask & (depth > 0))
    rays = np.linalg.inv(look["intrinsics"]) @ [columns, rows, np.ones(len(rows))]
    pose = np.array(look["poses"][look["view"]])
    return View(
        (rays * depth[rows, columns]).T @ pose[:3, :3].T + pose[:3, 3], pose[:3, 3]
    )


def answer_looks(fitted: Callable[[Scan, Sequence[View]], Fit]) -> None:
    """Answer each line of the standard input, until it ends.

    The thing is named whose scan fits best, and the next view is the farthest from those so far.

    Args:
        fitted: finds the best pose of a scan in all views so far.
    """
    views: list[View] = []
    taken: list[int] = []
    for look in map(json.loads, sys.stdin):
        if look["step"] == 1:
            views, taken = [], []
        taken.append(look["view"])
        views.append(view_of(look))

        answer: dict[str, Any] = {"name": None, "confidence": 0.0, "confident": False}
        shown = [view for view in views if len(view.points) >= ENOUGH]
        if shown:
            fits = {name: fitted(scan_of(name), shown) for name in look["things"]}
            name, second = sorted(fits, key=lambda each: fits[each].misfit)[:2]
            sure = 1 - fits[name].misfit / fits[second].misfit
            answer = {"name": name, "confidence": sure, "confident": sure > SURE}
            answer["pose"] = fits[name].pose.tolist()
        if look["free"]:
            places = np.array(look["poses"])[:, :3, 3]
            gaps = np.linalg.norm(places[look["free"], None] - places[taken], axis=2)
            answer["next"] = look["free"][int(gaps.min(1).argmax())]
        print(json.dumps(answer), flush=True)
