"""Is a view from another distance better shown as it is, or as it would be from the distance of training?

    python benchmarks/virtual_view.py DATASET/ModelNet10 [--objects 150] [--views 3]

Clean views of test objects from several distances, each zoomed until the unit sphere fills the image. Prints how often
the recogniser names the object in a single view: as seen from there; and as ``ObservedObject`` shows it, from three
radii.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import nextview
from nextview import SimulatedCamera, load_mesh
from nextview.cli.ending import orderly_end
from nextview.cli.progress import track
from nextview.data.folders import list_dataset
from nextview.sensing import Frame, ObjectFrame, ObservedObject
from nextview.viewsphere import look_at_origin

DISTANCES = (2.0, 3.0, 5.0, 8.0)
KNOWN = ObjectFrame(np.zeros(3), 1.0, np.eye(3))


@dataclass(frozen=True)
class Settings:
    """What is run.

    Attributes:
        dataset: folder in ModelNet's layout.
        objects: so many of the test split, spread over it.
        views: of each, drawn from the 40.
        seed: draws them.
    """

    dataset: tyro.conf.Positional[Path]
    objects: int = 150
    views: int = 3
    seed: int = 0


def main(settings: Settings) -> None:
    entries = [e for e in list_dataset(settings.dataset) if e.split == "test"]
    entries = entries[:: len(entries) // settings.objects][: settings.objects]
    system = nextview.load(threads=1)
    recogniser, sphere = system.models.recogniser, system.sphere
    right = defaultdict(list)

    def each():
        for i, entry in enumerate(entries):
            mesh = load_mesh(entry.path)
            views = np.random.default_rng([settings.seed, i]).integers(len(sphere), size=settings.views)
            for distance in DISTANCES:
                camera = SimulatedCamera(mesh, distance=distance)
                for view in views:
                    elevation, azimuth = np.radians(sphere.angles(int(view)))
                    seen = camera.observe(look_at_origin(elevation, azimuth, distance))
                    thing = ObservedObject(known=KNOWN, support=False, denoise=False, life_size=False)
                    frame = Frame(seen.depth, seen.intrinsics, seen.pose, pixel_centre=0.5)
                    for way, observation in (("as seen", seen), ("from three radii", thing.add(frame))):
                        answer = recogniser.classes[int(recogniser([observation]).logits.argmax())]
                        right[distance, way].append(answer == entry.label)
            yield i + 1

    track(each(), len(entries), "recognising")
    for (distance, way), answers in right.items():
        print(f"from {distance} radii, {way:16s}: {np.mean(answers):.3f} of {len(answers)} views")


if __name__ == "__main__":
    with orderly_end("run it again"):
        main(tyro.cli(Settings))
