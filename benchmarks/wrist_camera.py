"""Recognise objects on a table with a simulated camera on a robot's wrist: noise, holes, the table in the picture.

    python benchmarks/wrist_camera.py DATASET/ModelNet10 [--objects 50] [--noise 0.002] [--holes 0.05]

Test objects are scaled to a radius of 12 cm and put on a table, turned at random. The camera (640 x 480) stands 0.6 m
from the object. The pipeline is told which way is up and nothing else: it finds the table, the object, its centre and
its size; where the arm cannot go it is not sent. Prints how many are right, how many wrong but confident, views, and
the milliseconds of an update.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.spatial.transform import Rotation

import nextview
from nextview import Mesh, Session, System, load_mesh
from nextview.cli.progress import track
from nextview.data.folders import list_dataset
from nextview.sensing import Frame, ObservedObject
from nextview.viewsphere import look_at_origin

INTRINSICS = np.array([[600.0, 0, 322], [0, 602.0, 238], [0, 0, 1]])
"""OpenCV's convention: the first pixel's centre is at 0."""
SHAPE = 480, 640
NEAREST = 0.2
"""Depth below which the sensor sees nothing, metres."""
CLEARANCE = 0.04
"""Height over the table below which the arm does not go, metres."""


@dataclass(frozen=True)
class Settings:
    """What is run.

    Attributes:
        dataset: folder in ModelNet's layout.
        objects: so many of the test split, spread over it.
        radius: of the objects, metres.
        distance: of the camera from the object's centre, metres.
        noise: standard deviation of the depth, metres.
        holes: share of the pixels without depth.
        denoise: as in ``ObservedObject``.
        masked: hand in the true mask.
        threshold: stop at this belief.
        max_views: or after so many views.
        seed: decides poses, noise and first views.
    """

    dataset: tyro.conf.Positional[Path]
    objects: int = 50
    radius: float = 0.12
    distance: float = 0.6
    noise: float = 0.002
    holes: float = 0.05
    denoise: bool = True
    masked: bool = False
    threshold: float = 0.97
    max_views: int = 5
    seed: int = 0


class Wrist:
    """A depth camera over a table of 1.2 x 1.2 m at z = 0 with an object on it, and a floor below."""

    def __init__(self, mesh: Mesh, settings: Settings, rng: np.random.Generator) -> None:
        self.settings, self.rng = settings, rng
        turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
        vertices = settings.radius * mesh.vertices @ turn.T
        vertices += [*rng.uniform(-0.05, 0.05, 2), -vertices[:, 2].min()]
        self.centre = (vertices.min(0) + vertices.max(0)) / 2
        square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
        faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, vertices.astype(np.float32), np.ascontiguousarray(mesh.faces, np.int32))
        TriangleMesh(self._scene, (0.6 * square).astype(np.float32), faces)
        TriangleMesh(self._scene, (4 * square - [0, 0, 0.75]).astype(np.float32), faces)

    def pose(self, elevation: float, azimuth: float) -> np.ndarray:
        """Near the object, aimed a little beside it, not level."""
        pose = look_at_origin(elevation, azimuth, self.settings.distance)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("xyz", self.rng.normal(0, [0.03, 0.03, 0.1])).as_matrix()
        pose[:3, 3] += self.centre + self.rng.normal(0, 0.01, 3)
        pose[2, 3] = max(pose[2, 3], CLEARANCE)
        return pose

    def frame(self, pose: np.ndarray) -> Frame:
        """What the sensor gives from a pose."""
        height, width = SHAPE
        column, row = np.meshgrid(np.arange(width), np.arange(height))
        rays = np.stack(
            [(column - INTRINSICS[0, 2]) / INTRINSICS[0, 0], (row - INTRINSICS[1, 2]) / INTRINSICS[1, 1], 0 * row + 1],
            -1,
        )
        directions = (rays.reshape(-1, 3) @ pose[:3, :3].T).astype(np.float32)
        origins = np.tile(pose[:3, 3].astype(np.float32), (len(directions), 1))
        hits = self._scene.run(origins, directions, output=1)
        depth = np.where(hits["primID"] >= 0, hits["tfar"], np.nan).reshape(SHAPE)
        mask = ((hits["geomID"] == 0) & (hits["primID"] >= 0)).reshape(SHAPE)
        depth[depth < NEAREST] = np.nan
        depth = depth + self.settings.noise * self.rng.normal(size=SHAPE)
        depth[self.rng.random(SHAPE) < self.settings.holes] = np.nan
        return Frame(depth, INTRINSICS, pose, mask if self.settings.masked else None)


def run_object(camera: Wrist, system: System, settings: Settings, start: int) -> tuple[Session, list[float]]:
    """The session at its end, and the milliseconds of each update. What is timed is what a user writes."""
    thing = ObservedObject(denoise=settings.denoise, life_size=False)
    session = system.session(object=thing, distance=settings.distance)
    session.reachable = lambda pose: pose[2, 3] >= CLEARANCE
    pose, took = camera.pose(*np.radians(system.sphere.angles(start))), []
    while not session.done:
        frame = camera.frame(pose)
        begun = time.perf_counter()
        session.update(frame)
        took.append(1e3 * (time.perf_counter() - begun))
        pose = session.target
    return session, took


def main(settings: Settings) -> None:
    entries = [e for e in list_dataset(settings.dataset) if e.split == "test"]
    entries = entries[:: len(entries) // settings.objects][: settings.objects]
    system = nextview.load(policy="gain", threshold=settings.threshold, max_views=settings.max_views, threads=1)
    rows, milliseconds, doubted, wrong = [], [], [], []

    def each():
        for i, entry in enumerate(entries):
            rng = np.random.default_rng([settings.seed, i])
            camera = Wrist(load_mesh(entry.path), settings, rng)
            session, took = run_object(camera, system, settings, int(rng.integers(len(system.sphere))))
            result = session.result
            right, found = result.answer == entry.label, session.object.object_frame
            off = np.linalg.norm(found.centre - camera.centre) / settings.radius
            views = len(result.views)
            rows.append((right, result.confident, result.confidence, views, off, found.radius / settings.radius))
            milliseconds.extend(took[1:] if i == 0 else took)
            doubted.extend(doubt.name for view in result.views for doubt in view.doubts)
            if not right:
                wrong.append(f"{entry.path.stem}: {result} from {[view.index for view in result.views]}")
            yield i + 1

    track(each(), len(entries), "recognising")
    right, confident, belief, views, off, size = np.array(rows, float).T
    print(
        f"{int(right.sum())} of {len(rows)} right, {int((confident * (1 - right)).sum())} wrong but stopped by the "
        f"threshold (it decays), {int(((belief >= settings.threshold) * (1 - right)).sum())} wrong at a belief of "
        f"{settings.threshold}, {views.mean():.2f} views; an update takes {np.median(milliseconds):.1f} ms (99 %: "
        f"{np.percentile(milliseconds, 99):.1f} ms); centre off by {np.median(off):.3f} radii (90 %: "
        f"{np.percentile(off, 90):.3f}), radius {np.median(size):.3f} of the true (10 to 90 %: "
        f"{np.percentile(size, 10):.3f} to {np.percentile(size, 90):.3f})"
    )
    print(f"frames doubted: {len(doubted)} of {int(views.sum())} {sorted(set(doubted))}")
    print("\n".join(wrong))


if __name__ == "__main__":
    main(tyro.cli(Settings))
