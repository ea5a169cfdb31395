"""Point-pair features as a recogniser of taught things, on the same frames as the package's own.

    python -m research.point_pairs YCB [--things mug bowl ...] [--draws 1 2 3] [--every 1]
        [--poses thrown] [--any-orientation]

Drost et al., "Model globally, match locally: Efficient and robust 3D object recognition", CVPR
2010, as OpenCV's contributed module ``ppf_match_3d`` has it: ``pip install './research[ppf]'``. Its
ICP leads what is flat astray, so that poses are refined here, point to plane. It knows the same
surfaces, and gets the same pixels of the thing, in metres, as the package's verifier. It makes no
use of the plane that a thing stands on, nor of features, nor of what is seen beside the thing.
Every known thing is matched with what was seen. The best poses by votes are refined, and the thing
is named whose surface lies nearest to what was seen. The steps of its samples were chosen on draw
0, which is none of those that judge.

A recogniser of this kind takes the place of the package's own in sessions and ``recognise``:

    nextview.load(recogniser=PointPairs(surfaces))

Prints what both name right from one view, the share of these whose pose is right (ADD-S below a
tenth of the diameter, in the camera's frame), and the seconds of CPU of a frame. OpenCV uses one
thread.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from research.extras import require

require("ppf")

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.shared import markdown, progress
from benchmarks.verified_things import (
    Episode,
    Poses,
    Setting,
    Taught,
    judged,
    moved,
    shown,
)
from nextview.cli.exit_status import orderly_end
from nextview.errors import UsageError
from nextview.geometry.observation import Observation
from nextview.recognition.poses import PoseCandidate
from nextview.recognition.protocol import JointBelief
from nextview.things.depth_view import depth_view
from nextview.things.surface import Surface
from nextview.things.taught import TaughtThings

Float = NDArray[np.float64]
Cloud = NDArray[np.float32]  # points and unit normals, (N, 6), metres

MODEL_POINTS = 2500  # on each surface, before the detector thins them
# rows and columns of pixels that are chosen over the outline of what is seen
SCENE_SIDE = 48
NEIGHBOURS = 12  # points that a normal is found from
SAMPLING_STEP = 0.09  # of the samples, sides of the box around the model
DISTANCE_STEP = 0.05  # of distances between points, in diameters
ANGLES = 30  # steps of a full turn
REFERENCES = 0.2  # share of the points that are seen, of which each votes
REFINED = 3  # poses of each thing
STEPS = 10  # of a refinement
FEWEST = 6  # points near a surface that a step needs
DAMPING = 1e-6
FARTHEST = 0.01  # metres: what is farther from a thing counts as so far
# metres of mean distance that make a thing less likely by a factor of e
SOFTNESS = 0.0005


@dataclass(frozen=True, eq=False)
class Match:
    """How well a thing explains what was seen.

    Attributes:
        distance: mean distance of what was seen to the thing, metres, of points that are farther
            than FARTHEST as if they were so far.
        pose: from the frame of its scan to that of what was seen, (4, 4).
    """

    distance: float
    pose: Float


class PointPairs:
    """Recognises things by point-pair features.

    Attributes:
        classes: names of the things.
    """

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        """Learn the point pairs of all surfaces.

        Args:
            surfaces: of the things, metres.
        """
        self.surfaces = tuple(surfaces)
        self.classes = tuple(surface.name for surface in surfaces)
        clouds = [model_cloud(surface) for surface in surfaces]
        self._surfaces = [TangentPlanes.of(cloud) for cloud in clouds]
        self._detectors = [trained(cloud) for cloud in clouds]

    def belief(self, observations: Sequence[Observation]) -> JointBelief:
        """How likely each thing is, and its pose, by all views of an object.

        Args:
            observations: the views, in one object frame, of known scale.
        """
        seen = np.concatenate(
            [scene_cloud(observation) for observation in observations]
        )
        matches = [self._match(thing, seen) for thing in range(len(self.classes))]
        distances = np.array([match.distance for match in matches])
        likelihood = np.exp(-(distances - distances.min()) / SOFTNESS)
        belief = likelihood / likelihood.sum()

        best = int(belief.argmax())
        surface = self.surfaces[best]
        pose = PoseCandidate(
            surface.name,
            best,
            matches[best].pose,
            1.0,
            vertices=surface.vertices,
            faces=surface.faces,
        )
        return JointBelief(belief, poses=(pose,))

    def _match(self, thing: int, seen: Cloud) -> Match:
        """Match one thing with what was seen."""
        found = self._detectors[thing].match(seen, REFERENCES, DISTANCE_STEP)[:REFINED]
        poses = [np.array(one.pose, np.float64) for one in found]
        if not poses:
            return Match(FARTHEST, np.eye(4))

        surface = self._surfaces[thing]
        matches = [
            surface.refined(pose, seen[:, :3].astype(np.float64)) for pose in poses
        ]
        return min(matches, key=lambda match: match.distance)


@dataclass(frozen=True, eq=False)
class TangentPlanes:
    """Points of a surface, and the planes through them that touch it.

    Attributes:
        points: (N, 3), metres.
        normals: unit vectors, (N, 3).
        tree: of the points.
    """

    points: Float
    normals: Float
    tree: cKDTree

    @classmethod
    def of(cls, cloud: Cloud) -> TangentPlanes:
        """Those of a cloud."""
        points, normals = np.split(cloud.astype(np.float64), 2, axis=1)
        return cls(points, normals, cKDTree(points))

    def refined(self, pose: Float, seen: Float) -> Match:
        """Move the surface towards what was seen, point to plane, in some steps."""
        for _ in range(STEPS):
            here, height, normals, near = self._beside(pose, seen)
            if near.sum() < FEWEST:
                break
            moves = np.concatenate([np.cross(here, normals), normals], 1)[near]
            left = moves.T @ moves + DAMPING * np.eye(6)
            turn, shift = np.split(np.linalg.solve(left, moves.T @ height[near]), 2)
            step = np.eye(4)
            step[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
            step[:3, 3] = shift
            pose = pose @ np.linalg.inv(step)

        _, height, _, near = self._beside(pose, seen)
        distance = np.where(near, np.minimum(np.abs(height), FARTHEST), FARTHEST)
        return Match(float(distance.mean()), pose)

    def _beside(
        self,
        pose: Float,
        seen: Float,
    ) -> tuple[Float, Float, Float, NDArray[np.bool_]]:
        """What was seen in the frame of the surface, how far it is off the nearest plane, the
        normal of that, and whether it is near.
        """
        here = (seen - pose[:3, 3]) @ pose[:3, :3]
        far, nearest = self.tree.query(here)
        normals = self.normals[nearest]
        height = ((self.points[nearest] - here) * normals).sum(1)
        return here, height, normals, far < FARTHEST


def model_cloud(surface: Surface) -> Cloud:
    """Points that are spread evenly over a surface, with its normals."""
    rng = np.random.default_rng(0)
    corners = surface.vertices[
        surface.faces[surface.triangles_by_area(MODEL_POINTS, rng)]
    ]
    shares = rng.dirichlet(np.ones(3), MODEL_POINTS)
    points = (shares[..., None] * corners).sum(1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-30
    return np.concatenate([points, normals], 1).astype(np.float32)


def trained(cloud: Cloud) -> cv2.ppf_match_3d_PPF3DDetector:
    """A detector of one thing."""
    detector = cv2.ppf_match_3d_PPF3DDetector(SAMPLING_STEP, DISTANCE_STEP, ANGLES)
    detector.trainModel(cloud)
    return detector


def scene_cloud(observation: Observation) -> Cloud:
    """The points of the thing that a view shows, with normals towards the camera, object frame."""
    view = depth_view(observation, SCENE_SIDE)
    if view is None:
        return np.zeros((0, 6), np.float32)

    points = view.thing_points.astype(np.float64)
    near = points[cKDTree(points).query(points, min(NEIGHBOURS, len(points)))[1]]
    spread = near - near.mean(1, keepdims=True)
    normals = np.linalg.eigh(spread.swapaxes(1, 2) @ spread)[1][:, :, 0]
    away = ((view.origin - points) * normals).sum(1) < 0
    normals[away] *= -1
    return np.concatenate([points, normals], 1).astype(np.float32)


@dataclass(frozen=True)
class Compared:
    """One frame, recognised in both ways.

    Attributes:
        right: whether point pairs, and our verification, name the thing.
        posed: whether its pose is right; None where the name is not.
        seconds: of CPU.
    """

    right: tuple[bool, bool]
    posed: tuple[bool | None, bool | None]
    seconds: tuple[float, float]


def compared(
    pairs: PointPairs,
    things: TaughtThings,
    taught: Taught,
    some: NDArray[np.int64],
    episode: Episode,
) -> Compared:
    """Recognise the thing of an episode from its first view in both ways."""
    begun = time.process_time()
    found = pairs.belief(episode.observations[:1])
    seconds = time.process_time() - begun
    named = int(some[found.belief.argmax()]) == episode.thing
    posed = None
    if named:
        surface = taught.surfaces[episode.thing]
        posed = (
            add_s(surface, taught.points[episode.thing], found.poses[0].pose, episode)
            < 0.1
        )

    ours = judged(things, taught, some, episode, 1)
    own_posed = None if ours.add_s is None else ours.add_s < 0.1
    return Compared((named, ours.right), (posed, own_posed), (seconds, ours.seconds))


def add_s(surface: Surface, points: Float, pose: Float, episode: Episode) -> float:
    """Mean distance of points at a pose to those at the true one, in the camera's frame, diameters.

    So errors of the camera's place do not count, as they do not for the verification.
    """
    scene = episode.observations[0].scene
    metres = episode.observations[0].radius
    assert scene is not None
    assert metres is not None
    camera = scene.pose.copy()
    camera[:3, 3] *= metres
    true = moved(points, episode.in_cameras[0])
    here = moved(points, np.linalg.inv(camera) @ pose)
    return float(cKDTree(true).query(here)[0].mean()) / surface.diameter


def table(results: Sequence[Compared]) -> str:
    """The results as a table."""
    columns = (
        "",
        "named right",
        "ADD-S < 0.1 d of these",
        "s of CPU a frame: median, worst",
    )
    rows = []
    for row, name in enumerate(("point pairs", "nextview")):
        seconds = [result.seconds[row] for result in results]
        posed = [
            result.posed[row] for result in results if result.posed[row] is not None
        ]
        cells = (
            name,
            f"{np.mean([result.right[row] for result in results]):.3f}",
            f"{np.mean(posed):.3f}" if posed else "-",
            f"{np.median(seconds):.2f}, {max(seconds):.2f}",
        )
        rows.append(cells)
    return markdown(columns, rows)


def main(
    scans: tyro.conf.Positional[Path],
    things: tuple[str, ...] = (),
    models: str = "ycb",
    draws: tuple[int, ...] = (1,),
    every: int = 1,
    sensor: str = "wrist",
    poses: Poses = "scanned",
    any_orientation: bool = False,
) -> None:
    """Show things, and recognise each in both ways.

    Args:
        scans: folder of the scans.
        things: those that are known and shown; all of the memory by default.
        models: memory of the things.
        draws: numbers of the draws; each is another azimuth, view and noise.
        every: show every so many of the things only.
        sensor: what the views are taken with.
        poses: show things as they were scanned, as they fall, or as people stand them up.
        any_orientation: show things that hang in a room, turned at random about all axes.
    """
    cv2.setNumThreads(1)
    taught = Taught.load(models, scans)
    strange = sorted(set(things) - set(taught.names))
    if strange:
        raise UsageError(f"{models}: knows nothing called {strange[0]}")
    some = np.array(
        [k for k, name in enumerate(taught.names) if not things or name in things]
    )

    begun = time.process_time()
    pairs = PointPairs([taught.surfaces[k] for k in some])
    learned = time.process_time() - begun
    setting = Setting(sensor, 1, poses, 0, any_orientation)
    known = taught.things(some)
    if any_orientation:
        known = known.in_any_orientation()
    results = []
    for draw in draws:
        for thing in progress(some[draw % every :: every], f"draw {draw}"):
            episode = shown(taught, int(thing), draw, setting)
            results.append(compared(pairs, known, taught, some, episode))

    print(
        f"{len(results)} frames of {len(some)} things; point pairs learned in {learned:.0f} s"
    )
    print(table(results))


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
