"""Recognise test objects from renders with noise and holes, with and without denoising.

    python benchmarks/noisy_depth.py DATASET/ModelNet10 [--objects 150] [--policy gain]

The camera is as in training, the object's centre and radius are known; the noise is Gaussian, the holes are single
pixels. Prints accuracy, views and how many were wrong although the belief reached the threshold.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import nextview
from nextview import Observation, SimulatedCamera, load_mesh
from nextview.cli.progress import track
from nextview.data.folders import list_dataset
from nextview.sensing import Frame, ObjectFrame, ObservedObject

CASES = ((0.0, 0.0), (0.005, 0.0), (0.01, 0.0), (0.02, 0.0), (0.0, 0.2), (0.01, 0.2))
"""Standard deviation of the depth in object radii, and share of the pixels that are missing."""
KNOWN = ObjectFrame(np.zeros(3), 1.0, np.eye(3))


@dataclass(frozen=True)
class Settings:
    """What is run.

    Attributes:
        dataset: folder in ModelNet's layout.
        objects: so many of the test split, spread over it.
        policy: chooses the views.
        threshold: stop at this belief.
        max_views: or after so many views.
        seed: decides first views and noise.
    """

    dataset: tyro.conf.Positional[Path]
    objects: int = 150
    policy: str = "gain"
    threshold: float = 0.97
    max_views: int = 5
    seed: int = 0


class NoisyCamera:
    """A simulated camera with noise and holes, with the sensor's way to an observation behind it."""

    def __init__(self, camera: SimulatedCamera, noise: float, holes: float, denoise: bool, seed: list[int]) -> None:
        self.camera, self.noise, self.holes, self.denoise = camera, noise, holes, denoise
        self.rng = np.random.default_rng(seed)

    def observe(self, pose: np.ndarray) -> Observation:
        """Look from a camera-to-world pose in the object frame."""
        clean = self.camera.observe(pose)
        depth = np.where(clean.depth > 0, clean.depth + self.noise * self.rng.normal(size=clean.depth.shape), np.nan)
        depth[self.rng.random(depth.shape) < self.holes] = np.nan
        thing = ObservedObject(known=KNOWN, support=False, denoise=self.denoise, life_size=False)
        return thing.add(Frame(depth, clean.intrinsics, pose, pixel_centre=0.5))


def main(settings: Settings) -> None:
    entries = [e for e in list_dataset(settings.dataset) if e.split == "test"]
    entries = entries[:: len(entries) // settings.objects][: settings.objects]
    system = nextview.load(
        policy=settings.policy, threshold=settings.threshold, max_views=settings.max_views, threads=1
    )
    found: dict[tuple, list[tuple]] = {}

    def each():
        for i, entry in enumerate(entries):
            camera = SimulatedCamera(load_mesh(entry.path))
            start = int(np.random.default_rng([settings.seed, i]).integers(len(system.sphere)))
            for noise, holes in CASES:
                for denoise in (False, True):
                    noisy = NoisyCamera(camera, noise, holes, denoise, [settings.seed, i])
                    result = system.recognise(noisy, start)
                    right = result.answer == entry.label
                    sure = result.confidence >= settings.threshold and not right
                    found.setdefault((noise, holes, denoise), []).append((right, len(result.views), sure))
            yield i + 1

    track(each(), len(entries), "recognising")
    print(f"{len(entries)} test objects, policy {settings.policy}, threshold {settings.threshold}")
    for (noise, holes, denoise), rows in found.items():
        right, views, sure = np.mean(rows, 0)
        print(
            f"noise {noise:5.3f} radii, holes {holes:4.0%}, {'denoised' if denoise else 'as it is':8s}: "
            f"accuracy {right:.3f}, views {views:.2f}, wrong at a belief of {settings.threshold}: {sure:.3f}"
        )


if __name__ == "__main__":
    main(tyro.cli(Settings))
