"""What is said of objects that nobody taught, and of known ones, in whole episodes.

    python -m nextview_lab.studies.strangers data/ModelNet10 --split test --draws 3
        [--sensor wrist] [--aligned]
    python -m nextview_lab.studies.strangers data/PSB --objects 300 --every-second
    python -m nextview_lab.studies.strangers YCB --unit m [--models mine]

Printed is how often whole episodes with all defaults end with a name, the right one, or "unknown".
Each object is turned about the vertical by a random angle, as real objects are, unless
``--aligned`` leaves it as its file has it. An episode begins at a random view. "Most like" also
counts objects that were called unknown. ``--draws`` episodes are run with each object; each has its
own angle, first view and sensor noise.
"""

from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.progress import track

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import console
from nextview.data.folders import list_dataset
from nextview.geometry.resting import rotated
from nextview.geometry.viewsphere import rotation_z
from nextview.simulation.sensed_camera import SensedCamera
from nextview.types import Float
from nextview_lab.benchmark.statistics import interval, resample

BOOTSTRAP_SAMPLES = 1000
MOST_UNKNOWN_CLASSES = 5
REPORTED = ("unknown", "named right", "most like their class", "named and confident")


def episodes(
    meshes: tyro.conf.Positional[Path],
    models: str = "modelnet10",
    objects: int = 10**6,
    split: str | None = None,
    every_second: bool = False,
    sensor: str | None = None,
    unit: str | None = None,
    aligned: bool = False,
    draws: int = 1,
    unknown: float | None = None,
    seed: int = 0,
) -> None:
    """Run episodes with the objects of a folder and print what they ended with.

    Args:
        meshes: folder of the objects.
        models: that recognise them.
        objects: so many, drawn.
        split: only the objects of this one.
        every_second: only every second class by the alphabet.
        sensor: that looks at them; none by default.
        unit: of the meshes.
        aligned: do not turn the objects.
        draws: episodes with each object.
        unknown: significance level of the test for unknown objects.
        seed: of all draws.
    """
    system = nextview.load(models=models, unknown=unknown)
    entries = [entry for entry in list_dataset(meshes) if split in (None, entry.split)]
    if every_second:
        # Every second class by the alphabet: the other classes chose the novelty score.
        judged = sorted({entry.label for entry in entries})[1::2]
        entries = [entry for entry in entries if entry.label in judged]

    chosen = np.sort(np.random.default_rng(seed).permutation(len(entries))[:objects])
    entries = [entries[i] for i in chosen]

    rows = []
    every = track(entries, f"episodes of {meshes.name}", console=console)
    for number, entry in enumerate(every, 1):
        mesh = nextview.load_mesh(entry.path, unit=unit)
        outcomes = [
            _outcome(system, mesh, entry.label, sensor, aligned, [seed, number, draw])
            for draw in range(draws)
        ]
        rows.append(np.mean(outcomes, axis=0))
    print(f"{len(rows)} objects, {draws} episodes each")
    _print_out(np.array(rows), np.array([entry.label for entry in entries]), seed)


def _outcome(
    system: nextview.System,
    mesh: nextview.Mesh,
    label: str,
    sensor: str | None,
    aligned: bool,
    seed: list[int],
) -> tuple[float, ...]:
    """Run an episode: 0 or 1 for each of ``REPORTED``, and the number of views."""
    rng = np.random.default_rng(seed)
    if not aligned:
        mesh = rotated(mesh, rotation_z(rng.uniform(0, 2 * np.pi)))
    camera = (
        nextview.SimulatedCamera(mesh)
        if sensor is None
        else SensedCamera(mesh, sensor, rng)
    )
    session = system.session_with(camera, None, int(rng.integers(2**32)))
    result = session.run(camera)

    most_like = label == result.most_like
    named = not result.unknown
    reported = (
        result.unknown,
        most_like and named,
        most_like,
        result.confident and named,
    )
    return *reported, len(result.views)


def _print_out(table: Float, labels: NDArray[np.str_], seed: int) -> None:
    """Print means with their intervals, and the classes that are most often unknown.

    Args:
        table: outcomes of each object, means over its episodes, (N, 5).
        labels: classes of the objects, (N,).
        seed: of the intervals.
    """
    weights = resample(len(table), BOOTSTRAP_SAMPLES, np.random.default_rng(seed))
    low, high = interval(weights @ table / weights.sum(1, keepdims=True))
    for column, name in enumerate(REPORTED):
        mean = table[:, column].mean()
        print(f"{name:22} {mean:.3f} ({low[column]:.3f}-{high[column]:.3f})")
    print(f"{'views':22} {table[:, -1].mean():.2f}")

    shares = {label: table[labels == label, 0].mean() for label in np.unique(labels)}
    most = sorted(shares, key=lambda label: -shares[label])[:MOST_UNKNOWN_CLASSES]
    print(
        "most often unknown: "
        + ", ".join(f"{label} {shares[label]:.3f}" for label in most)
    )


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(episodes)
