"""What whole episodes say of objects: of known classes, or of none; "most like" counts what is unknown too.

    python benchmarks/strangers.py data/ModelNet10 --split test --objects 250 [--sensor wrist] [--around heavy]
    python benchmarks/strangers.py data/PSB --objects 300 --every-second; YCB --unit m [--models mine]

With all defaults, from a random first view; ``--around``: each among others of the folder, in drawn scenes of a level.
"""

from pathlib import Path
from typing import Literal

import numpy as np
import tyro

import nextview
from nextview.cli.progress import track
from nextview.data.folders import list_dataset
from nextview.data.scene_drawing import Meshes, draw_scene
from nextview.errors import DatasetError
from nextview.simulation.robot_camera import Named, RobotCamera
from nextview.simulation.scene import build_scene
from nextview.simulation.sensed_camera import SensedCamera


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
    seed: int = 0,
) -> None:
    system, rng = nextview.load(models=models), np.random.default_rng(seed)
    entries = [e for e in list_dataset(meshes) if split in (None, e.split)]
    if every_second:  # of the classes, by the alphabet: the others chose the score
        judged = sorted({e.label for e in entries})[1::2]
        entries = [e for e in entries if e.label in judged]
    place = {e.name: e.path.relative_to(meshes).as_posix() for e in entries}
    others = Meshes(meshes, tuple(sorted(place.values())))
    entries = [entries[i] for i in np.sort(rng.permutation(len(entries))[:objects])]
    found = []

    def work():
        for done, entry in enumerate(entries, 1):
            own = np.random.default_rng([seed, done])
            if around is None:
                mesh = nextview.load_mesh(entry.path, unit=unit)
                camera = nextview.SimulatedCamera(mesh) if sensor is None else SensedCamera(mesh, sensor, own)
            else:
                try:
                    layout = draw_scene(place[entry.name], others, around, seed, f"{entry.name}@{around}-0")
                except DatasetError:  # no scene of this level is found around it
                    continue
                camera = RobotCamera(build_scene(layout, meshes), sensor or "none", named)
            session = system.session_with(camera, None, int(own.integers(2**32)))
            session.reachable = getattr(camera, "reachable", None)
            result = session.run(camera)
            right = entry.label == result.most_like
            found.append((not result.unknown, result.confident, right and not result.unknown, right, len(result.views)))
            yield done

    track(work(), len(entries), f"episodes of {meshes.name}")
    shown = "{:.3f} named, {:.3f} named and confident, {:.3f} right, {:.3f} most like their class; {:.2f} views"
    print(f"{len(found)} objects: " + shown.format(*np.mean(found, 0)))


if __name__ == "__main__":
    tyro.cli(main)
