"""How often the usual mistakes are noticed in a first view, and how often correct use is alarmed.

    python benchmarks/misuse.py DATASET/ModelNet10 [--objects 150] [--views 8]

Views of test objects in random directions are handed in as they should be, and with each mistake. Prints the share
that is doubted by ``check_observation``, or refused before, and the share where the mistake is named; for pairs of
views what ``check_views`` doubts; and the time that they take.
"""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from nextview import Observation, SimulatedCamera, load_mesh
from nextview.cli.ending import orderly_end
from nextview.cli.progress import track
from nextview.data.folders import list_dataset
from nextview.depth import FARTHEST
from nextview.errors import ObservationError
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


def mistakes(o: Observation) -> dict[str, tuple[str, dict]]:
    """Mistakes: what the doubt is called, or a word of the refusal; and what changes in the observation."""
    made: dict[str, tuple[str, dict]] = {
        "correct": ("", {}),
        "empty": ("nothing seen", {"depth": np.zeros_like(o.depth)}),
        "OpenGL axes": ("opengl axes", {"pose": o.pose @ FLIP}),
        "inverse pose": ("inverse pose", {"pose": np.linalg.inv(o.pose)}),
        "pose not rigid": ("not rigid", {"pose": o.pose @ np.diag([1.1, 1, 1, 1.0])}),
    }
    for r in RADII:
        made[f"depth in metres, radius {r} m"] = "scale", {"depth": o.depth * r}
        made[f"all in metres, radius {r} m"] = "scale", {"depth": o.depth * r, "pose": position_scaled(o.pose, r)}
        name = "millimetres" if 2 * 1000 * r > FARTHEST else "scale"
        made[f"depth in millimetres, radius {r} m"] = name, {"depth": o.depth * 1000 * r}
    return made


def judge(observation: Observation, change: dict) -> str:
    """The name of the doubt, or the sentence of the refusal; empty if there is neither."""
    try:
        doubts = check_observation(replace(observation, **change))
    except ObservationError as refused:
        return str(refused)
    return doubts[0].name if doubts else ""


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
                for mistake, (name, change) in mistakes(observation).items():
                    begun = time.perf_counter()
                    said = judge(observation, change)
                    took["correct" if mistake == "correct" else "a mistake"].append(time.perf_counter() - begun)
                    noticed[mistake].append(bool(said))
                    named[mistake].append(name in said if name else not said)
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
    with orderly_end("run it again"):
        main(tyro.cli(Settings))
