"""Recognise test objects under every condition: sensors, noise, holes, wrong object frames,
pictures that lack a part.

    python -m benchmarks.conditions DATASET/ModelNet10 [--objects 150] [--models OLD modelnet10]
        [--figure out.png]

"clean" is a render without a sensor. The next conditions are renders with one error each, of the
strength that their name tells: depth noise and holes; a vertical that is wrong by 20 degrees, a
centre by 0.15 radii, a radius by a quarter; a quarter of the object's width or height cut off;
boxes that hide much of it. Then sensors. Every condition has the same objects, first views and
draws. Prints, for each condition: the share of the object that no box hides in the first view,
accuracy of the first view alone and at the end (95 % Wilson intervals), views, travel (cells), the
calibration error of the last belief, and the share that is wrong at a belief of the threshold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

import nextview
from benchmarks.shared import wilson
from nextview import Camera, Mesh, System, load_mesh
from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import track
from nextview.data.folders import Entry, list_dataset
from nextview.data.pool import WorkerDied, each
from nextview.sensing import ObjectFrame
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.sensor import RENDER, sensor_named
from nextview.simulation.simulated import SimulatedCamera
from nextview_lab.data.metrics import calibration_error

BOXES = 15.5
"""So many boxes on average leave about 57 % of an object visible; chosen on held-out training
objects.
"""


class QuarterCut(SensedCamera):
    """Lacks a quarter of the object's width, or height, in every picture."""

    def _cropped(
        self,
        depth: np.ndarray,
        mask: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        return super()._cropped(depth, mask, _Exactly(rng))


class _Exactly:
    """Draws sides at random, and of any range the top."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.integers = rng.integers

    def uniform(self, low: float, high: float) -> float:
        return high


def wrong_frame(
    tilt: float = 0.0,
    centre: float = 0.0,
    size: float = 1.0,
) -> Callable[..., SensedCamera]:
    """A camera that takes the object to lean by so many degrees, to be so many radii away and so
    much larger.
    """

    def make(mesh: Mesh, rng: np.random.Generator, denoise: bool) -> SensedCamera:
        camera = SensedCamera(mesh, RENDER, rng, denoise)
        towards = rng.normal(size=3)
        about = rng.uniform(0, 2 * np.pi)
        lean = Rotation.from_rotvec(
            [tilt * np.cos(about), tilt * np.sin(about), 0],
            degrees=True,
        ).as_matrix()
        off = centre * RENDER.radius * towards / np.linalg.norm(towards)
        camera.object_frame = ObjectFrame(off, size * RENDER.radius, lean)
        return camera

    return make


def through(**errors: float) -> Callable[..., SensedCamera]:
    """A render with errors."""
    return lambda mesh, rng, denoise: SensedCamera(
        mesh,
        replace(RENDER, **errors),
        rng,
        denoise,
    )


CONDITIONS: dict[str, Callable[..., Camera]] = {
    "clean": lambda mesh, rng, denoise: SimulatedCamera(mesh),
    "noise 0.01": through(noise=0.01 * RENDER.radius),
    "noise 0.02": through(noise=0.02 * RENDER.radius),
    "20 % holes": through(holes=0.2),
    "tilt 20": wrong_frame(tilt=20),
    "centre 0.15": wrong_frame(centre=0.15),
    "radius 1.25": wrong_frame(size=1.25),
    "quarter cut": lambda mesh, rng, denoise: QuarterCut(
        mesh,
        replace(RENDER, crop=0.25),
        rng,
        denoise,
    ),
    "boxes": through(boxes=BOXES),
}
NOISY = ("noise", "20 %", "kinect", "stereo", "wrist")
"""What conditions are called whose frames are also tried as they come, without denoising."""


@dataclass(frozen=True)
class Settings:
    """What is run.

    Attributes:
        dataset: folder in ModelNet's layout.
        objects: so many of a split, spread over it.
        conditions: of those above.
        sensors: NAME or NAME:STRENGTH of each.
        models: bundled models or folders with some, each with its own policy.
        policy: chooses the views.
        threshold: stop at this belief.
        max_views: or after so many views.
        split: test, or train for the objects that the recogniser holds out.
        raw: try noisy frames as they come, too.
        seed: decides first views and all errors.
        workers: processes; one for each core by default.
        figure: draw the accuracy of each condition.
    """

    dataset: tyro.conf.Positional[Path]
    objects: int = 150
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    sensors: tuple[str, ...] = (
        "kinect:1",
        "kinect:2",
        "stereo:1",
        "stereo:2",
        "setup:1",
        "wrist:1",
        "wrist:2",
    )
    models: tuple[str, ...] = ("modelnet10",)
    policy: str = "gain"
    threshold: float = 0.97
    max_views: int = 5
    split: str = "test"
    raw: bool = False
    seed: int = 0
    workers: int | None = None
    figure: Path | None = None


def rows_of(settings: Settings) -> Iterator[tuple[str, bool]]:
    """Conditions and sensors, and whether their frames are denoised."""
    for name in (*settings.conditions, *settings.sensors):
        yield name, True
        if settings.raw and name.startswith(NOISY):
            yield name, False


@lru_cache(maxsize=4)
def system_of(models: str, policy: str, threshold: float, max_views: int) -> System:
    """A system, loaded once for each process; a folder of models with a policy of its own takes
    that.
    """
    own = Path(models) / f"{policy}.json"
    chosen = str(own) if own.exists() else policy
    return nextview.load(
        models,
        policy=chosen,
        threshold=threshold,
        max_views=max_views,
        threads=1,
    )


def camera_of(name: str, mesh: Mesh, rng: np.random.Generator, denoise: bool) -> Camera:
    """A camera under a condition, or behind a sensor."""
    if name in CONDITIONS:
        return CONDITIONS[name](mesh, rng, denoise)
    return SensedCamera(mesh, sensor_named(name), rng, denoise)


def episodes(
    settings: Settings,
    item: tuple[int, Entry],
) -> list[list[tuple[float, ...]]]:
    """First view right, last belief right, views, travel, confidence, visible share: by models
    and condition.
    """
    i, entry = item
    mesh = load_mesh(entry.path)
    start = int(np.random.default_rng([settings.seed, i]).integers(40))
    found = []
    for models in settings.models:
        system = system_of(
            models,
            settings.policy,
            settings.threshold,
            settings.max_views,
        )
        rows = []
        for name, denoise in rows_of(settings):
            camera = camera_of(
                name,
                mesh,
                np.random.default_rng([settings.seed, i, 1]),
                denoise,
            )
            result = system.recognise(camera, start)
            first = (
                system.classes[int(result.views[0].alone.argmax())]
                if result.views[0].observation.seen
                else ""
            )
            shown = (
                camera.visible_share(system.sphere.poses[start])
                if isinstance(camera, SensedCamera)
                else 1.0
            )
            right = first == entry.label, result.answer == entry.label
            rows.append(
                (*right, len(result.views), result.travel, result.confidence, shown)
            )
        found.append(rows)
    return found


def draw(table: dict[str, dict[str, tuple[float, float, float]]], path: Path) -> None:
    """Accuracy and its interval by condition, denoised, one colour for each set of models."""
    import matplotlib
    from matplotlib.figure import Figure

    from nextview.session.style import FIGURE_STYLE, SERIES, to_png

    with matplotlib.rc_context(FIGURE_STYLE):
        figure = Figure((6.4, 4.6))
        axes = figure.subplots()
        for k, ((models, rows), colour) in enumerate(
            zip(table.items(), SERIES, strict=False)
        ):
            at = np.arange(len(rows)) + (k - (len(table) - 1) / 2) * 0.25
            value, low, high = np.array(list(rows.values())).T
            axes.hlines(at, low, high, lw=1.2, color=colour)
            axes.plot(value, at, "o", ms=4, color=colour, label=Path(models).name)
        axes.set(
            yticks=range(len(rows)),
            yticklabels=list(rows),
            xlabel="accuracy",
            xlim=(None, 1),
        )
        axes.invert_yaxis()
        axes.legend()
        figure.tight_layout()
        to_png(figure, path)


def main(settings: Settings) -> None:
    unknown = [name for name in settings.conditions if name not in CONDITIONS]
    if unknown:
        raise SystemExit(
            f"there is no condition {unknown[0]!r}; there are {', '.join(CONDITIONS)}"
        )
    for text in settings.sensors:
        sensor_named(text)  # says what is wrong with it
    entries = [e for e in list_dataset(settings.dataset) if e.split == settings.split]
    if settings.split == "train":
        kept = set(
            system_of(
                settings.models[0],
                settings.policy,
                0.97,
                5,
            ).models.recogniser.card.held_out
        )
        entries = [e for e in entries if e.name in kept]
    entries = entries[:: max(1, len(entries) // settings.objects)][: settings.objects]
    found: list[list[list[tuple[float, ...]]]] = []

    def run() -> Iterator[int]:
        for (_, entry), rows in each(
            partial(episodes, settings),
            list(enumerate(entries)),
            settings.workers,
        ):
            if isinstance(rows, WorkerDied):
                raise nextview.NextviewError(
                    f"{entry.path}: cannot be recognised ({rows})"
                )
            found.append(rows)
            yield len(found)

    track(run(), len(entries), "recognising")
    print(
        f"{len(entries)} {settings.split} objects, policy {settings.policy}, threshold"
        f" {settings.threshold}\n"
    )
    columns = (
        "condition",
        "models",
        "frames",
        "visible",
        "first view",
        "accuracy",
        "views",
        "travel",
    )
    columns += "calibration error", "wrong and confident"
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    # objects, models, conditions, numbers
    results = np.array(found, float)
    table = {}
    for j, (name, denoise) in enumerate(rows_of(settings)):
        for k, models in enumerate(settings.models):
            single, right, views, travel, belief, shown = results[:, k, j].T
            calibration = calibration_error(belief, right.astype(bool))
            sure = float(((belief >= settings.threshold) & (right == 0)).mean())
            cells = [
                name,
                Path(models).name,
                "denoised" if denoise else "as it is",
                f"{shown.mean():.2f}",
            ]
            for share in (single, right):
                low, high = wilson(int(share.sum()), len(share))
                cells.append(f"{share.mean():.3f} ({low:.3f}-{high:.3f})")
            cells += [
                f"{views.mean():.2f}",
                f"{travel.mean():.2f}",
                f"{calibration:.3f}",
                f"{sure:.3f}",
            ]
            print(f"| {' | '.join(cells)} |")
            if denoise:
                table.setdefault(models, {})[name] = (
                    float(right.mean()),
                    float(low),
                    float(high),
                )
    if settings.figure:
        draw(table, settings.figure)


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        main(tyro.cli(Settings))
