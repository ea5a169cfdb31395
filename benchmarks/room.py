"""Recognise objects in rooms: by the aim of the camera alone, by a point or by a mask, through a
good and a poor camera.

    nextview-lab scenes ModelNet10 rooms --levels room --split train --scenes 60
    python -m benchmarks.room rooms ModelNet10 out [--mistakes page]

    nextview-lab scenes YCB tables --levels room --unit m --scenes 40
    python -m benchmarks.room tables YCB out-ycb --models ycb --by point mask

Each room is looked at from its first view on, with all defaults, until the session is done. By
"pose" nothing is said but where the camera is and that it is aimed at the object. The point lies
beside the object's centre by a fiftieth of the camera's distance, one standard deviation along each
horizontal axis. The mask is two pixels too wide. Frames are 16-bit millimetres, and their poses are
right. The good camera is the sensor "stereo", like a RealSense D435 (standard deviation of the
depth 0.6 mm at 0.4 m); the poor one, "stereo:2", has twice its errors: noise, edges, holes, flying
pixels.

OUT holds a small file an episode; a run that was stopped goes on where it was. Printed is, for each
way and camera, the share that is named right (95 % Wilson interval), called unknown, named wrong
with confidence; the share without any frame that was taken in, and with one that was refused; the
share whose radius is within 15 % of the truth; and the views taken. ``--mistakes`` draws every
mistaken episode on a page, sorted by cause.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal, get_args
from zlib import crc32

import numpy as np
import tyro
from msgspec import Struct
from scipy.ndimage import binary_dilation

import nextview
from benchmarks.room_pictures import Picture, write_page
from benchmarks.shared import markdown, wilson
from nextview import System
from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import track
from nextview.data.pool import WorkerDied, each
from nextview.errors import DatasetError, NextviewError, ObservationError, UsageError
from nextview.files import check_new, only_one, read_record, write_record
from nextview.sensing import Frame, ObservedObject
from nextview.session.session import Session
from nextview.simulation.sensor import Sensor, sensor_named
from nextview.types import Mask
from nextview_lab.worlds.scene import TargetScene, build_scene
from nextview_lab.worlds.scene_cameras import RoomCamera
from nextview_lab.worlds.scene_layout import SceneLayout

By = Literal["pose", "point", "mask"]

POINT_OFF = 0.02  # standard deviation of the point, as a part of the camera's distance
MASK_WIDER = 2  # pixels
MOST_LOOKS = 8  # frames of an episode, those that are refused among them
SAME_SIZE = 0.15  # relative error of the radius up to which the size is right
ANOTHER = 0.5  # of what was taken less is the object's, where another thing was taken
WHOLE = 0.8  # share of the object's pixels that is taken, and of those taken that are the object's

CAUSES = (
    "refused",
    "another thing was taken",
    "too much was taken",
    "a part was taken",
    "the size is wrong",
    "called unknown",
    "named wrong",
)


class Outcome(Struct, frozen=True, forbid_unknown_fields=True):
    """How an episode ended.

    Attributes:
        room: its name.
        label: the class, or the thing, that it shows.
        by: how the object was said.
        sensor: NAME or NAME:STRENGTH.
        answer: what it was called; None for nothing.
        most_like: what it is most like.
        confident: whether the answer is.
        unknown: whether it was called unknown.
        views: frames that were taken in.
        refused: what was said of each other frame.
        warnings: by their names, of all frames.
        ratio: radius as it was found, as a part of the true one; None without a frame.
        taken: of the worst frame: share of the object's pixels that were taken for it.
        own: of the same: share of the pixels taken that are the object's.
    """

    room: str
    label: str
    by: str
    sensor: str
    answer: str | None
    most_like: str | None
    confident: bool
    unknown: bool
    views: int
    refused: tuple[str, ...]
    warnings: tuple[str, ...]
    ratio: float | None
    taken: float
    own: float

    @property
    def right(self) -> bool:
        """Whether it was named right."""
        return self.answer == self.label

    @property
    def right_size(self) -> bool:
        """Whether the radius is right."""
        return self.ratio is not None and abs(self.ratio - 1) <= SAME_SIZE

    @property
    def cause(self) -> str:
        """Why it was not named right, one of CAUSES; "" if it was."""
        if self.right:
            return ""
        if not self.views:
            return "refused"
        if self.own < ANOTHER:
            return "another thing was taken"
        if self.own < WHOLE:
            return "too much was taken"
        if self.taken < WHOLE:
            return "a part was taken"
        if not self.right_size:
            return "the size is wrong"
        return "called unknown" if self.unknown else "named wrong"


class Settings(Struct, frozen=True, forbid_unknown_fields=True):
    """What the episodes of a folder have in common.

    Attributes:
        models: whose classes, or things, are recognised.
        seed: of points and of noise.
    """

    models: str
    seed: int


@dataclass(frozen=True)
class Job:
    """One episode.

    Attributes:
        room: file of the room.
        meshes: folder of its meshes.
        by: how the object is said.
        sensor: NAME or NAME:STRENGTH.
        settings: of all episodes.
        out: its file.
    """

    room: Path
    meshes: Path
    by: By
    sensor: str
    settings: Settings
    out: Path


@lru_cache(maxsize=1)
def system_of(models: str) -> System:
    """A system, loaded once for each process."""
    return nextview.load(models, threads=1)


@lru_cache(maxsize=1)
def room_of(file: Path, meshes: Path) -> tuple[SceneLayout, TargetScene]:
    """A room, built once for the episodes in it."""
    layout = SceneLayout.load(file)
    return layout, build_scene(layout, meshes)


@dataclass(frozen=True)
class Look:
    """One frame of an episode, and which of its pixels show the object; ``error`` is why it was
    refused, or "".
    """

    frame: Frame
    shown: Mask
    error: str


def episode(job: Job) -> tuple[SceneLayout, Session, list[Look]]:
    """Run an episode."""
    layout, room = room_of(job.room, job.meshes)
    sensor = sensor_named(job.sensor)
    if not isinstance(sensor, Sensor):
        raise UsageError(f"{job.sensor}: a camera in a room is one sensor, no mix")
    seed = job.settings.seed
    camera = RoomCamera(room, sensor, seed)

    pose = layout.first_pose
    distance = float(np.linalg.norm(pose[:3, 3]))
    rng = np.random.default_rng([seed, crc32(layout.name.encode())])
    point = np.append(rng.normal(0, POINT_OFF * distance, 2), 0.0)
    thing = ObservedObject(point=point) if job.by == "point" else ObservedObject()
    session = system_of(job.settings.models).session(object=thing, distance=distance)
    session.reachable = camera.reachable

    looks: list[Look] = []
    while not session.done and len(looks) < MOST_LOOKS:
        frame, shown = camera.look(pose)
        mask = (
            binary_dilation(shown, iterations=MASK_WIDER) if job.by == "mask" else None
        )
        handed = Frame(frame.depth, frame.intrinsics, pose, mask=mask, pixel_centre=0.5)
        try:
            session.update(handed)
            looks.append(Look(handed, shown, ""))
        # UsageError: what was found is larger than the distance at which to stand
        except (ObservationError, UsageError) as error:
            looks.append(Look(handed, shown, str(error)))
            if not session.views:
                break
            session.failed()
        if not session.done:
            pose = session.target
    return layout, session, looks


def outcome(job: Job) -> Outcome:
    """Run an episode, and say how it ended."""
    layout, session, looks = episode(job)
    result = session.result if session.views else None
    accepted = [look for look in looks if not look.error]
    shares = [
        shares_of(look.shown, sighting.mask)
        for look, sighting in zip(accepted, session.object.sightings, strict=True)
    ]
    taken, own = min(shares, key=lambda pair: pair[0] * pair[1], default=(0.0, 0.0))
    radius = session.object.object_frame.radius if accepted else None
    return Outcome(
        room=layout.name,
        label=layout.label,
        by=job.by,
        sensor=job.sensor,
        answer=None if result is None else result.answer,
        most_like=None if result is None else result.most_like,
        confident=result is not None and bool(result.confident),
        unknown=result is not None and bool(result.unknown),
        views=len(accepted),
        refused=tuple(look.error for look in looks if look.error),
        warnings=tuple(
            warning.name for view in session.views for warning in view.warnings
        ),
        ratio=None if radius is None else radius / (layout.metres or 1.0),
        taken=taken,
        own=own,
    )


def shares_of(shown: Mask, found: Mask) -> tuple[float, float]:
    """Share of the object's pixels that were found, and share of those found that are its own."""
    both = np.count_nonzero(shown & found)
    return both / max(np.count_nonzero(shown), 1), both / max(
        np.count_nonzero(found),
        1,
    )


def done_or_run(job: Job) -> None:
    """Run an episode into its file."""
    write_record(job.out, outcome(job))


def jobs_of(
    rooms: Path,
    meshes: Path,
    out: Path,
    settings: Settings,
    by: Sequence[By],
    sensors: Sequence[str],
) -> list[Job]:
    """All episodes, the cheap way first: all of one room after each other."""
    files = sorted(
        path for path in rooms.rglob("*.json") if not path.name.startswith(".")
    )
    if not files:
        raise DatasetError(
            f"{rooms}: holds no rooms; nextview-lab scenes --levels room draws some"
        )
    return [
        Job(
            file,
            meshes,
            way,
            sensor,
            settings,
            out / sensor.replace(":", "_") / way / file.name,
        )
        for file in files
        for sensor in sensors
        for way in by
    ]


def table(
    found: Sequence[Outcome],
    sensors: Sequence[str],
    by: Sequence[By],
) -> str:
    """The results as a table."""
    columns = (
        "camera, by",
        "episodes",
        "right",
        "unknown",
        "confident and wrong",
        "no frame taken in",
        "a frame refused",
        "radius within 15 %",
        "views",
    )
    rows = []
    for sensor in sensors:
        for way in by:
            some = [o for o in found if (o.sensor, o.by) == (sensor, way)]
            right = sum(o.right for o in some)
            low, high = wilson(right, len(some))
            shares = (
                [o.unknown for o in some],
                [o.confident and not o.right for o in some],
                [not o.views for o in some],
                [bool(o.refused) for o in some],
                [o.right_size for o in some],
            )
            cells = [f"{np.mean(share):.3f}" for share in shares]
            views = np.mean([o.views for o in some])
            named = f"{right / len(some):.3f} ({low:.2f}-{high:.2f})"
            rows.append((f"{sensor}, {way}", len(some), named, *cells, f"{views:.2f}"))
    return markdown(columns, rows)


def causes(found: Sequence[Outcome]) -> Iterator[str]:
    """How many mistakes have which cause."""
    for cause in CAUSES:
        some = [o for o in found if o.cause == cause]
        if some:
            names = ", ".join(f"{o.label} ({o.sensor} {o.by})" for o in some[:6])
            yield f"{cause}: {len(some)}: {names}{', ...' if len(some) > 6 else ''}"


def pictures(jobs: Sequence[Job]) -> Iterator[Picture]:
    """The worst frame of each mistaken episode, which is run again."""
    for job in jobs:
        ended = read_record(job.out, Outcome, "an episode", DatasetError)
        if not ended.cause:
            continue
        _, session, looks = episode(job)
        masks = iter([sighting.mask for sighting in session.object.sightings])
        frames = [
            (look, np.zeros_like(look.shown) if look.error else next(masks))
            for look in looks
        ]
        if ended.views:
            frames = [pair for pair in frames if not pair[0].error]
        look, found = min(
            frames, key=lambda pair: np.prod(shares_of(pair[0].shown, pair[1]))
        )
        called = ended.answer or (
            look.error if not ended.views else f"unknown, most like {ended.most_like}"
        )
        title = f"{ended.room} by {ended.by}, {ended.sensor}"
        size = "" if ended.ratio is None else f", radius {ended.ratio:.2f}"
        sure = ", confident" if ended.confident else ""
        yield Picture(
            ended.cause,
            title,
            f"{called}{sure}{size}",
            look.frame,
            look.shown,
            found,
        )


def main(
    rooms: tyro.conf.Positional[Path],
    meshes: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    by: tuple[By, ...] = get_args(By),
    sensors: tuple[str, ...] = ("stereo", "stereo:2"),
    models: str = "modelnet10",
    seed: int = 0,
    workers: int = 1,
    mistakes: Path | None = None,
) -> None:
    """Recognise the objects in some rooms, and print how it went.

    Args:
        rooms: folder that nextview-lab scenes --levels room drew.
        meshes: folder of the meshes that they are made of.
        out: folder of the episodes; those that are there are not run again.
        by: how the object is said.
        sensors: cameras, NAME or NAME:STRENGTH.
        models: bundled models, or a folder with some.
        seed: of points and of noise.
        workers: processes; 0 to work in this one.
        mistakes: folder to draw, with a page of all mistaken episodes.
    """
    if mistakes is not None:
        check_new(mistakes, folder=True)
    for sensor in sensors:
        sensor_named(sensor)  # says what is wrong with it
    settings = Settings(models, seed)
    record = out / "settings.json"
    with only_one(out):
        if not record.exists():
            check_new(out, folder=True)
            write_record(record, settings)
        if (
            read_record(record, Settings, "settings of episodes", DatasetError)
            != settings
        ):
            raise UsageError(f"{out}: holds episodes of other models or another seed")

        jobs = jobs_of(rooms, meshes, out, settings, by, sensors)
        left = [job for job in jobs if not job.out.exists()]
        before = len(jobs) - len(left)

        def run() -> Iterator[int]:
            done = each(partial(done_or_run), left, workers)
            for number, (job, died) in enumerate(done, before + 1):
                if isinstance(died, WorkerDied):
                    raise NextviewError(f"{job.room}: cannot be recognised ({died})")
                yield number

        track(run(), len(jobs), "recognising")
    found = [read_record(job.out, Outcome, "an episode", DatasetError) for job in jobs]
    print(table(found, sensors, by), "", *causes(found), sep="\n")
    if mistakes is not None:
        write_page(mistakes, pictures(jobs), CAUSES)


if __name__ == "__main__":
    with orderly_end("what is done is kept; run again to go on"):
        tyro.cli(main)
