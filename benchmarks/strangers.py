"""Whole episodes with all defaults: how often objects are named, named right, and called unknown.

    python -m benchmarks.strangers data/ModelNet10 --split test --draws 3 [--sensor wrist]
        [--aligned]
    python -m benchmarks.strangers data/PSB --objects 300 --every-second
    python -m benchmarks.strangers YCB --unit m [--models mine]
    python -m benchmarks.strangers data/ModelNet10 --split test --objects 60 --around heavy

Each object is turned about the vertical by a random angle, as real objects are, unless
``--aligned`` leaves it as its file has it. An episode begins at a random view. With ``--around``
the object stands among others of the folder, in drawn scenes of a level of clutter. "Most like"
also counts objects that were called unknown. ``--draws`` episodes are run with each object; each
has its own angle, first view and sensor noise.
"""

from pathlib import Path
from typing import Literal

import numpy as np
import tyro

import nextview
from nextview.benchmark.statistics import interval, resample
from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import track
from nextview.data.folders import Entry, list_dataset
from nextview.data.scene_drawing import Meshes, draw_scene
from nextview.errors import DatasetError
from nextview.geometry.observation import Camera
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import rotation_z
from nextview.session.session import FrameCamera
from nextview.simulation.robot_camera import Named, RobotCamera
from nextview.simulation.scene import build_scene
from nextview.simulation.sensed_camera import SensedCamera

BOOTSTRAP_SAMPLES = 1000
MOST_UNKNOWN_CLASSES = 5
REPORTED = ("unknown", "named right", "most like their class", "named and confident")


def main(
    meshes: tyro.conf.Positional[Path],
    models: str = "modelnet10",
    objects: int = 10**6,
    split: str | None = None,
    every_second: bool = False,
    sensor: str | None = None,
    around: Literal["light", "medium", "heavy"] | None = None,
    named: Named = "mask",
    unit: str | None = None,
    aligned: bool = False,
    draws: int = 1,
    unknown: float | None = None,
    seed: int = 0,
) -> None:
    """Run episodes with the objects of a folder and print what they ended with."""
    system = nextview.load(models=models, unknown=unknown)
    entries = [entry for entry in list_dataset(meshes) if split in (None, entry.split)]
    if every_second:
        # Every second class by the alphabet: the other classes chose the novelty score.
        judged = sorted({entry.label for entry in entries})[1::2]
        entries = [entry for entry in entries if entry.label in judged]

    places = {
        entry.name: entry.path.relative_to(meshes).as_posix() for entry in entries
    }
    others = Meshes(meshes, tuple(sorted(places.values())))
    chosen = np.sort(np.random.default_rng(seed).permutation(len(entries))[:objects])
    entries = [entries[i] for i in chosen]

    def camera_before(
        entry: Entry,
        draw: int,
        rng: np.random.Generator,
    ) -> Camera | FrameCamera | None:
        if around is not None:
            scene = f"{entry.name}@{around}-{draw}"
            try:
                layout = draw_scene(places[entry.name], others, around, seed, scene)
            except DatasetError:  # no scene of this level was found around the object
                return None
            return RobotCamera(build_scene(layout, meshes), sensor or "none", named)

        mesh = nextview.load_mesh(entry.path, unit=unit)
        if not aligned:
            mesh = rotated(mesh, rotation_z(rng.uniform(0, 2 * np.pi)))
        if sensor is None:
            return nextview.SimulatedCamera(mesh)
        return SensedCamera(mesh, sensor, rng)

    # One row of outcomes for each object; each holds the means over its episodes.
    rows = []
    labels = []

    def work():
        for done, entry in enumerate(entries, 1):
            outcomes = []
            for draw in range(draws):
                rng = np.random.default_rng([seed, done, draw])
                camera = camera_before(entry, draw, rng)
                if camera is None:
                    continue
                session = system.session_with(camera, None, int(rng.integers(2**32)))
                session.reachable = getattr(camera, "reachable", None)
                result = session.run(camera)
                most_like = entry.label == result.most_like
                named_right = most_like and not result.unknown
                sure = result.confident and not result.unknown
                outcomes.append(
                    (result.unknown, named_right, most_like, sure, len(result.views))
                )
            if outcomes:
                rows.append(np.mean(outcomes, axis=0))
                labels.append(entry.label)
            yield done

    track(work(), len(entries), f"episodes of {meshes.name}")
    table = np.array(rows)
    weights = resample(len(table), BOOTSTRAP_SAMPLES, np.random.default_rng(seed))
    low, high = interval(weights @ table / weights.sum(1, keepdims=True))

    print(f"{len(table)} objects, {draws} episodes each")
    for column, name in enumerate(REPORTED):
        mean = table[:, column].mean()
        print(f"{name:22} {mean:.3f} ({low[column]:.3f}-{high[column]:.3f})")
    print(f"{'views':22} {table[:, -1].mean():.2f}")

    of_class = np.array(labels)
    shares = {
        label: table[of_class == label, 0].mean() for label in sorted(set(labels))
    }
    most = sorted(shares, key=lambda label: -shares[label])[:MOST_UNKNOWN_CLASSES]
    print(
        "most often unknown: "
        + ", ".join(f"{label} {shares[label]:.3f}" for label in most)
    )


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
