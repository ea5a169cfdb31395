"""How often the usual mistakes are noticed in a first view, and how often correct use is alarmed.

    python benchmarks/misuse.py DATASET/ModelNet10 [--objects 150] [--views 8]

Views of test objects in random directions are handed in as they should be, and with each mistake. Prints the share
that ``check_observation`` doubts and the share where it names the mistake; for pairs of views what ``check_views``
doubts; and the time that they take.
"""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from nextview import Observation, SimulatedCamera, load_mesh
from nextview.cli.progress import track
from nextview.data.folders import list_dataset
from nextview.sensing import check_observation, check_views
from nextview.viewsphere import look_at_origin

RADII = (0.05, 0.12, 0.3)
"""Radii of the objects whose lengths are left in metres."""
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Settings:
    """What is run.

    Attributes:
        dataset: folder in ModelNet's layout.
        objects: so many of the test split, spread over it.
        views: of each.
        seed: decides the directions.
    """

    dataset: tyro.conf.Positional[Path]
    objects: int = 150
    views: int = 8
    seed: int = 0


def position_scaled(pose: np.ndarray, scale: float) -> np.ndarray:
    pose = pose.copy()
    pose[:3, 3] *= scale
    return pose


def mistakes(o: Observation) -> dict[str, tuple[Observation, str]]:
    """Observations with one mistake each, and the name under which it should be doubted."""
    made = {
        "correct": (o, ""),
        "empty": (replace(o, depth=np.zeros_like(o.depth)), "nothing seen"),
        "OpenGL axes": (replace(o, pose=o.pose @ FLIP), "opengl axes"),
        "inverse pose": (replace(o, pose=np.linalg.inv(o.pose)), "inverse pose"),
        "pose not rigid": (replace(o, pose=o.pose @ np.diag([1.1, 1, 1, 1.0])), "not rigid"),
    }
    for r in RADII:
        made[f"depth in metres, radius {r} m"] = (replace(o, depth=(o.depth * r).astype(np.float32)), "scale")
        made[f"all in metres, radius {r} m"] = (
            replace(o, depth=(o.depth * r).astype(np.float32), pose=position_scaled(o.pose, r)), "scale",
        )  # fmt: skip
        name = "nothing seen" if 4 * 1000 * r > 50 else "scale"
        made[f"depth in millimetres, radius {r} m"] = (replace(o, depth=(o.depth * 1000 * r).astype(np.float32)), name)
    return made


def main(settings: Settings) -> None:
    entries = [e for e in list_dataset(settings.dataset) if e.split == "test"]
    entries = entries[:: len(entries) // settings.objects][: settings.objects]
    noticed, named, contradicted = defaultdict(list), defaultdict(list), defaultdict(list)
    took: dict[str, list[float]] = defaultdict(list)

    def each():
        for i, entry in enumerate(entries):
            rng = np.random.default_rng([settings.seed, i])
            camera = SimulatedCamera(load_mesh(entry.path))
            before = None
            for _ in range(settings.views):
                elevation, azimuth = np.arcsin(rng.uniform(-0.2, 1)), rng.uniform(0, 2 * np.pi)
                distance = rng.uniform(2.5, 4)
                observation = camera.observe(look_at_origin(elevation, azimuth, distance))
                for mistake, (wrong, name) in mistakes(observation).items():
                    begun = time.perf_counter()
                    doubts = check_observation(wrong)
                    took["correct" if mistake == "correct" else "a mistake"].append(time.perf_counter() - begun)
                    noticed[mistake].append(bool(doubts))
                    named[mistake].append([d.name for d in doubts] == [name] * bool(name))
                if before is not None:
                    begun = time.perf_counter()
                    contradicted["correct"].append(bool(check_views(before, observation)))
                    took["two views"].append(time.perf_counter() - begun)
                    # The azimuth's sign is wrong; the pose is that of the view before; the object was turned over.
                    mirrored = look_at_origin(elevation, -azimuth, distance)
                    contradicted["wrong sign of azimuth"].append(
                        bool(check_views(before, replace(observation, pose=mirrored)))
                    )
                    contradicted["pose of the view before"].append(
                        bool(check_views(before, replace(observation, pose=before.pose)))
                    )
                before = observation
            yield i + 1

    track(each(), len(entries), "looking")
    print(f"{len(entries)} objects x {settings.views} views")
    for mistake in noticed:
        print(f"{mistake:35s} doubted {np.mean(noticed[mistake]):.4f}  named {np.mean(named[mistake]):.4f}")
    for mistake in contradicted:
        print(f"two views, {mistake:24s} doubted {np.mean(contradicted[mistake]):.4f}")
    for what, seconds in took.items():
        print(f"{what}: median {1e3 * np.median(seconds):.2f} ms")


if __name__ == "__main__":
    main(tyro.cli(Settings))
