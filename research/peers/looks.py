"""What methods in another process share: they read looks, judge poses of scans, and answer.

``docs/submit.md`` says what the lines hold. This needs NumPy, SciPy, Pillow and trimesh, and no
nextview.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Sequence
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

DENSE = 20_000  # points of a scan, and of what is seen, that points of the other may be nearest to
SAMPLES = 2000  # points of a scan that are matched
JUDGED = 500  # points of the scan, and of what is seen, that judge a pose
ENOUGH = 100  # pixels of a view that is matched at all
STEPS = (
    20  # of a grid over what is seen, in whose cells the points of a view are averaged
)
FINEST = 0.001  # metres: the smallest step of that grid
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
class Seen:
    """What all views so far show of the thing.

    Attributes:
        views: with the points of each averaged in the cells of a grid.
        points: of all these views, (N, 3), metres, world.
        step: side of a cell, metres.
        judged: points that judge a pose, (at most JUDGED, 3), metres, world.
        tree: of at most DENSE points as they were measured.
    """

    views: tuple[View, ...]
    points: Float
    step: float
    judged: Float
    tree: cKDTree

    @classmethod
    def of(cls, views: Sequence[View]) -> Seen:
        """What some views show.

        Args:
            views: at least one, with a point or more each.
        """
        measured = np.concatenate([view.points for view in views])
        low, high = np.percentile(measured, (2, 98), axis=0)
        step = max(float(np.linalg.norm(high - low)) / STEPS, FINEST)
        even = tuple(View(averaged(view.points, step), view.camera) for view in views)
        points = np.concatenate([view.points for view in even])
        some = np.random.default_rng(0).permutation(measured)[:DENSE]
        return cls(even, points, step, some[:JUDGED], cKDTree(some))


@dataclass(frozen=True, eq=False)
class Scan:
    """Points that are spread evenly over a scan, in its own frame.

    Attributes:
        points: (SAMPLES, 3), metres, in random order.
        normals: outward unit vectors, (SAMPLES, 3).
        tree: of DENSE points.
    """

    points: Float
    normals: Float
    tree: cKDTree

    def facing(self, turn: Float, seen: Seen) -> Float:
        """The judging points that face a camera if the scan is turned and lies where it is seen;
        all where none does.

        Args:
            turn: from the scan's frame to the world, (3, 3).
            seen: where it lies.

        Returns:
            (at most JUDGED, 3), metres, in the scan's frame.
        """
        cameras = np.stack([view.camera for view in seen.views])
        towards = (cameras - seen.points.mean(0)) @ turn
        faces = (self.normals[:JUDGED] @ towards.T > 0).any(1)
        return self.points[:JUDGED][faces | ~faces.any()]

    def misfit(self, pose: Float, seen: Seen) -> float:
        """How far what is seen is from the scan, and the scan from what is seen, metres.

        The sum of two means of clipped distances. Of the points of the scan that face a camera
        the nearer half counts: something may stand before the others.

        Args:
            pose: from the scan's frame to the world, (4, 4).
            seen: where it lies.
        """
        turn, shift = pose[:3, :3], pose[:3, 3]
        there, _ = self.tree.query(
            (seen.judged - shift) @ turn, distance_upper_bound=FARTHEST
        )
        back, _ = seen.tree.query(
            self.facing(turn, seen) @ turn.T + shift, distance_upper_bound=FARTHEST
        )
        nearer = np.sort(back)[: (np.size(back) + 1) // 2]
        means = [np.minimum(each, FARTHEST).mean() for each in (there, nearer)]
        return float(sum(means))

    def best(self, poses: Iterable[Float], seen: Seen) -> Fit | None:
        """The pose with the least misfit; None without one.

        Args:
            poses: from the scan's frame to the world, (4, 4) each. Those that are not finite are
                left out.
            seen: where it lies.
        """
        fits = [Fit(self.misfit(p, seen), p) for p in poses if np.isfinite(p).all()]
        return min(fits, key=lambda fit: fit.misfit, default=None)


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose of a scan.

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
    points, faces = trimesh.sample.sample_surface(mesh, DENSE, seed=0)
    normals = mesh.face_normals[faces[:SAMPLES]]
    return Scan(np.asarray(points)[:SAMPLES], normals, cKDTree(points))


def averaged(points: Float, step: float) -> Float:
    """Means of the points in each cell of a grid, (M, 3), metres.

    Args:
        points: (N, 3), metres.
        step: side of a cell, metres.
    """
    cells = np.floor(points / step)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(cell.ravel(), weights=column) for column in points.T]
    return np.stack(sums, 1) / count[:, None]


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


def said_of(fits: dict[str, Fit]) -> dict[str, Any]:
    """The answer that names the scan that fits best; unknown without one.

    Args:
        fits: of the scans that fit anywhere, by name.
    """
    if not fits:
        return {"name": None, "confidence": 0.0, "confident": False}
    name, *others = sorted(fits, key=lambda each: fits[each].misfit)
    second = fits[others[0]].misfit if others else 2 * FARTHEST
    sure = 1 - fits[name].misfit / second if second > 0 else 0.0
    pose = fits[name].pose.tolist()
    return {"name": name, "confidence": sure, "confident": sure > SURE, "pose": pose}


def answer_looks(matcher: Callable[[Seen], Callable[[Scan], Fit | None]]) -> None:
    """Answer each line of the standard input, until it ends.

    The thing is named whose scan fits best, and the next view is the farthest from those so far.

    Args:
        matcher: takes what is seen, and returns what finds the best pose of a scan in it; None
            where it finds none.
    """
    views: list[View] = []
    taken: list[int] = []
    for look in map(json.loads, sys.stdin):
        if look["step"] == 1:
            views, taken = [], []
        taken.append(look["view"])
        views.append(view_of(look))

        shown = [view for view in views if len(view.points) >= ENOUGH]
        fits: dict[str, Fit] = {}
        if shown:
            fitted = matcher(Seen.of(shown))
            found = {name: fitted(scan_of(name)) for name in look["things"]}
            fits = {name: fit for name, fit in found.items() if fit is not None}
        answer = said_of(fits)
        if look["free"]:
            places = np.array(look["poses"])[:, :3, 3]
            gaps = np.linalg.norm(places[look["free"], None] - places[taken], axis=2)
            answer["next"] = look["free"][int(gaps.min(1).argmax())]
        print(json.dumps(answer), flush=True)
