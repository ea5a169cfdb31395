"""Recognise test objects through sensors, from weak to strong, with and without denoising.

    python benchmarks/robustness.py DATASET/ModelNet10 [--objects 60] [--sensors kinect:1 kinect:2] [--figure out.png]

"clean" is a render without any sensor. Every condition has the same objects, first views and draws. Prints accuracy
with its standard error, views, travel (cells), the calibration error of the belief at the end, and the share that is
wrong at a belief of the threshold.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import tyro

import nextview
from nextview import System, load_mesh
from nextview.cameras.sensors import SensedCamera, sensor_named
from nextview.cameras.simulated import SimulatedCamera
from nextview.cli.progress import track
from nextview.data.folders import Entry, list_dataset
from nextview.data.pool import WorkerDied, each
from nextview.metrics import calibration_error

SENSORS = (
    "clean",
    "none",
    *(f"{name}:{strength}" for name in ("kinect", "stereo", "setup", "wrist") for strength in (1, 2)),
)


@dataclass(frozen=True)
class Settings:
    """What is run.

    Attributes:
        dataset: folder in ModelNet's layout.
        objects: so many of the test split, spread over it.
        sensors: NAME or NAME:STRENGTH of each.
        policy: chooses the views.
        threshold: stop at this belief.
        max_views: or after so many views.
        seed: decides first views and all errors.
        workers: processes; one for each core by default.
        figure: draw accuracy and views against strength.
    """

    dataset: tyro.conf.Positional[Path]
    objects: int = 60
    sensors: tuple[str, ...] = SENSORS
    policy: str = "gain"
    threshold: float = 0.97
    max_views: int = 5
    seed: int = 0
    workers: int | None = None
    figure: Path | None = None


def conditions(sensors: tuple[str, ...]) -> Iterator[tuple[str, bool]]:
    """Sensors, and whether their frames are denoised; as they come too, where the sensor is noisy."""
    for text in sensors:
        yield text, text != "clean"
        if text != "clean" and sensor_named(text).step:
            yield text, False


@lru_cache(maxsize=1)
def system_of(policy: str, threshold: float, max_views: int) -> System:
    """The system, loaded once for each process."""
    return nextview.load(policy=policy, threshold=threshold, max_views=max_views, threads=1)


def episodes(settings: Settings, item: tuple[int, Entry]) -> list[tuple[bool, int, float, float]]:
    """Right, views, travel and confidence of one object in every condition."""
    i, entry = item
    system = system_of(settings.policy, settings.threshold, settings.max_views)
    mesh = load_mesh(entry.path)
    start = int(np.random.default_rng([settings.seed, i]).integers(len(system.sphere)))
    rows = []
    for text, denoise in conditions(settings.sensors):
        if text == "clean":
            camera = SimulatedCamera(mesh)
        else:
            camera = SensedCamera(mesh, sensor_named(text), np.random.default_rng([settings.seed, i, 1]), denoise)
        result = system.recognise(camera, start)
        rows.append((result.answer == entry.label, len(result.views), result.travel, result.confidence))
    return rows


def draw(table: dict[tuple[str, bool], tuple[float, ...]], path: Path) -> None:
    """Accuracy and views against the strength of each sensor."""
    import matplotlib
    from matplotlib.figure import Figure

    from nextview.report.style import SERIES, STYLE, to_png

    with matplotlib.rc_context(STYLE):
        figure = Figure((6.2, 2.6))
        left, right = figure.subplots(1, 2)
        names = list(dict.fromkeys(text.partition(":")[0] for text, _ in table if ":" in text))
        for name, colour in zip(names, SERIES, strict=False):
            for denoise, style in ((True, "o-"), (False, "o:")):
                some = [(t, v) for (t, d), v in table.items() if d == denoise and t.partition(":")[0] == name]
                if not some:
                    continue
                x = [0.0, *(float(t.partition(":")[2] or 1) for t, _ in some)]
                rows = np.array([table.get(("none", True), some[0][1]), *(v for _, v in some)])
                label = name + ("" if denoise else ", as it is")
                left.errorbar(
                    x,
                    rows[:, 0],
                    rows[:, 1] if denoise else None,
                    fmt=style,
                    color=colour,
                    ms=4,
                    capsize=2,
                    lw=1.4,
                    label=label,
                )
                right.plot(x, rows[:, 2], style, color=colour, ms=4, lw=1.4)
        left.set(xlabel="strength", ylabel="accuracy", ylim=(None, 1))
        right.set(xlabel="strength", ylabel="views")
        left.legend(fontsize=6.5)
        figure.tight_layout()
        to_png(figure, path)


def main(settings: Settings) -> None:
    for text in settings.sensors:
        if text != "clean":
            sensor_named(text)  # says what is wrong with it
    entries = [e for e in list_dataset(settings.dataset) if e.split == "test"]
    entries = entries[:: len(entries) // settings.objects][: settings.objects]
    found: list[list[tuple[bool, int, float, float]]] = []

    def run() -> Iterator[int]:
        for _, rows in each(partial(episodes, settings), list(enumerate(entries)), settings.workers):
            if isinstance(rows, WorkerDied):
                raise rows
            found.append(rows)
            yield len(found)

    track(run(), len(entries), "recognising")
    print(f"{len(entries)} test objects, policy {settings.policy}, threshold {settings.threshold}")
    print("| sensor | frames | accuracy | views | travel | calibration error | wrong and confident |")
    print("|---|---|---|---|---|---|---|")
    table = {}
    for condition, rows in zip(conditions(settings.sensors), zip(*found, strict=True), strict=True):
        right, views, travel, belief = np.array(rows, float).T
        error = float(np.sqrt(right.mean() * (1 - right.mean()) / len(right)))
        calibration = calibration_error(belief, right.astype(bool))
        sure = float(((belief >= settings.threshold) & (right == 0)).mean())
        table[condition] = (float(right.mean()), error, float(views.mean()))
        cells = [condition[0], "denoised" if condition[1] else "as it is", f"{right.mean():.3f} ({error:.3f})"]
        cells += [f"{views.mean():.2f}", f"{travel.mean():.2f}", f"{calibration:.3f}", f"{sure:.3f}"]
        print(f"| {' | '.join(cells)} |")
    if settings.figure:
        draw(table, settings.figure)


if __name__ == "__main__":
    main(tyro.cli(Settings))
