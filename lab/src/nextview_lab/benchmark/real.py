"""What is said of real frames, each alone, against what is known of the things in them."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path

import numpy as np

from nextview.data.progress import TrackProgress, silently
from nextview.errors import DatasetError, NextviewError
from nextview.scene.scene import Scene
from nextview.session.system import System, load
from nextview.types import Float, Mask
from nextview_lab.benchmark.frame_answers import (
    FrameAnswer,
    check_table,
    evenly,
    looked_at,
    write_table,
)
from nextview_lab.benchmark.statistics import wilson
from nextview_lab.benchmark.text_tables import WrittenTable
from nextview_lab.data.metrics import add_s
from nextview_lab.data.real_frames import RealFrame, TrueThing, real_frames

SURFACE_POINTS = 4000  # on each scan
NEAR = (
    0.03  # metres between the middles of a posed scan and the true one, without pixels
)


@dataclass(frozen=True)
class RealThing:
    """A thing in a frame and an object that was found there: a row of the table.

    Attributes:
        folder: of the frame.
        frame: its name.
        number: of the thing in the frame, from 1; 0 for what is elsewhere.
        thing: its true name, "" without one.
        taught: whether this name is taught.
        pixels: that are known of it; None if none is.
        name: that the object has, or would most likely have; "" if nothing was found there.
        belief: in this name.
        named: whether it is called so; if not, it is called unknown.
        confident: whether the name is confident.
        right: whether the name is right, and its posed scan meets the thing.
        add_s: mean distance of the posed scan from the true one, millimetres; None if unknown.
        cpu: seconds that the frame took.
    """

    folder: str
    frame: str
    number: int = 0
    thing: str = ""
    taught: bool = False
    pixels: int | None = None
    name: str = ""
    belief: float = 0.0
    named: bool = False
    confident: bool = False
    right: bool = False
    add_s: float | None = None
    cpu: float | None = None


@dataclass(frozen=True)
class RealRun:
    """What was said of real frames.

    Attributes:
        rows: of the table of all things.
        left_out: why frames could not be looked at, by their names.
    """

    rows: tuple[RealThing, ...]
    left_out: dict[str, NextviewError]


def recognise_real(
    folder: Path,
    more: tuple[Path, ...] = (),
    /,
    out: Path = Path("real_frames.csv"),
    models: str = "ycb",
    intrinsics: tuple[float, float, float, float] | Path | None = None,
    depth_scale: float | None = None,
    first_label: int = 1,
    frames: int | None = None,
    overwrite: bool = False,
    track: TrackProgress = silently,
) -> RealRun:
    """Compare what is said of real frames with what is known of the things in them.

    Each frame is looked at by itself, without its pose and its colours. A name is right if the
    posed scan meets the pixels that are known of the thing or, if only its pose is known, if its
    middle is within 3 cm. What is known is read from truth.json, images of labels, or the files
    of BOP, YCB-Video and GraspNet: docs/your_camera.md. An interrupted run resumes.

    Args:
        folder: of frames, in any layout that nextview recognise reads.
        more: further folders.
        out: file to write, .csv: a line for each thing and each object that was found.
        models: what is taught: a bundled collection, or a folder of nextview learn.
        intrinsics: FX FY CX CY in pixels, or a camera file, for folders that have none.
        depth_scale: metres a step of the depth images, for folders that do not tell it.
        first_label: smallest number of a thing in images of labels, such as 2 in OCID.
        frames: number of frames of each folder, evenly spread, for a first try; by default all.
        overwrite: replace OUT.

    Returns:
        The table.

    Raises:
        DatasetError: a file is missing or damaged, or no frame can be looked at.
        ResultsError: ``out`` exists, or cannot be written.
        UsageError: an option makes no sense.
    """
    check_table(out, overwrite)
    system = load(models)
    there = [
        frame
        for each in (folder, *more)
        for frame in evenly(
            real_frames(each, intrinsics, depth_scale, first_label), frames
        )
    ]
    how = intrinsics, depth_scale
    with looked_at(out, models, system, there, how, track) as answers:
        clouds = surface_points(system)
        rows = [
            row
            for frame in there
            if (answer := answers.of(frame)) is not None or answers.refused(frame)
            for row in compared(frame, answer, clouds)
        ]
        if not rows:
            raise DatasetError(f"{folder}: no frame can be looked at{answers.why()}")
        head = (field.name for field in fields(RealThing))
        write_table(out, overwrite, head, map(astuple, rows))
    return RealRun(tuple(rows), answers.left_out)


def surface_points(system: System) -> dict[str, Float]:
    """Points on the scan of each thing that a system knows, (SURFACE_POINTS, 3), metres.

    Args:
        system: with things of known geometry.
    """
    surfaces = Scene(system).library.caster.surfaces
    rng = np.random.default_rng(0)
    return {one.name: one.sample(SURFACE_POINTS, rng) for one in surfaces}


def compared(
    frame: RealFrame,
    answer: FrameAnswer | None,
    clouds: Mapping[str, Float],
) -> list[RealThing]:
    """Compare what was found in a frame with what is known.

    Args:
        frame: the frame.
        answer: what was found in it; None if it was refused.
        clouds: points on the scans of what is taught, by name.

    Returns:
        A row for each object, and for each thing at which none was found; at least one.
    """
    things = dict(enumerate(frame.things(), 1))
    blank = RealThing(str(frame.folder), frame.name)
    if answer is not None:
        blank = replace(blank, cpu=answer.cpu)
    bare = {0: blank}
    for number, thing in things.items():
        bare[number] = replace(
            blank,
            number=number,
            thing=thing.name,
            taught=thing.name in clouds,
            pixels=None if thing.pixels is None else int(thing.pixels.sum()),
        )

    rows = []
    left = dict(things)
    found = () if answer is None else answer.objects
    for one in sorted(found, key=lambda one: not one.named):
        points = moved(clouds[one.name], one.matrix)
        met = {n: meeting(thing, points, frame, clouds) for n, thing in things.items()}
        own = left if one.named else things
        right = [n for n, thing in own.items() if thing.name == one.name and met[n]]
        at = right[0] if right else max(met, key=lambda n: met[n], default=0)
        pose = things[at].pose if right else None
        if right and one.named:
            del left[at]
        rows.append(
            replace(
                bare[at if met.get(at) else 0],
                name=one.name,
                belief=one.belief,
                named=one.named,
                confident=one.confident,
                right=bool(right),
                add_s=None
                if pose is None
                else 1000 * add_s(clouds[one.name], one.matrix, pose),
            )
        )
    told = {row.number for row in rows}
    return [*rows, *(bare[n] for n in things if n not in told)] or [blank]


def moved(points: Float, pose: Float) -> Float:
    """Points after a pose, (N, 3)."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def meeting(
    thing: TrueThing,
    points: Float,
    frame: RealFrame,
    clouds: Mapping[str, Float],
) -> int:
    """How many points of a posed scan meet a thing.

    If only the pose of the thing is known: 1 if the two middles are near each other, else 0.

    Args:
        thing: in the frame.
        points: in the camera, (N, 3), metres.
        frame: the frame.
        clouds: points on the scans of what is taught, by name.
    """
    if thing.pixels is not None:
        return pixels_met(points, frame.captured.intrinsics, thing.pixels)
    if thing.pose is None or thing.name not in clouds:
        return 0
    true = moved(clouds[thing.name], thing.pose)
    middles = [(each.min(0) + each.max(0)) / 2 for each in (points, true)]
    return int(np.linalg.norm(middles[0] - middles[1]) < NEAR)


def pixels_met(points: Float, intrinsics: Float, pixels: Mask) -> int:
    """How many points show in some of the pixels of a frame.

    Args:
        points: in the camera, (N, 3), metres.
        intrinsics: pinhole matrix, (3, 3), pixels, the middle of the first pixel at 0.
        pixels: (H, W) bool.
    """
    seen = points @ intrinsics.T
    columns, rows = np.floor(seen[:, :2] / seen[:, 2:] + 0.5).astype(int).T
    height, width = pixels.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    return int(pixels[rows[inside], columns[inside]].sum())


def real_table(rows: Sequence[RealThing]) -> WrittenTable:
    """A table of what was right, with a column for each folder.

    Args:
        rows: of all things.
    """
    folders = list(dict.fromkeys(row.folder for row in rows))
    groups = [[row for row in rows if row.folder == each] for each in folders]
    headings = [Path(each).name for each in folders]
    if len(folders) > 1:
        groups.append(list(rows))
        headings.append("all")
    columns = [_figures(group) for group in groups]
    return WrittenTable(
        "in brackets: 95 % intervals (Wilson)",
        ("each frame alone", *headings),
        tuple((name, *(column[name] for column in columns)) for name in columns[0]),
    )


def _figures(rows: Sequence[RealThing]) -> dict[str, str]:
    """The figures of some frames, by what they are."""
    named = [row for row in rows if row.named]
    right = [row for row in named if row.right]
    sure = [row for row in named if row.confident]
    frames = {(row.folder, row.frame): row.cpu for row in rows}
    seconds = [cpu for cpu in frames.values() if cpu is not None]

    def things(some: Sequence[RealThing], taught: bool) -> int:
        each = [row for row in some if row.number and row.taught == taught]
        return len({(row.folder, row.frame, row.number) for row in each})

    known = things(rows, True)
    low, high = wilson(len(right), known) if known else (0, 0)
    share = f", {len(right) / known:.2f} ({low:.2f} to {high:.2f})" if known else ""
    errors = [row.add_s for row in right if row.add_s is not None]
    return {
        "frames, refused": f"{len(frames)}, {len(frames) - len(seconds)}",
        "taught things in view": f"{known}",
        "right": f"{len(right)}{share}",
        "right and confident": f"{sum(row.right for row in sure)}",
        "wrong names": f"{len(named) - len(right)}",
        "wrong and confident": f"{sum(not row.right for row in sure)}",
        "strangers with pixels": f"{things(rows, False)}",
        "with a name": f"{things(named, False)}",
        "with a confident name": f"{things(sure, False)}",
        "ADD-S, mm (worst)": _median(errors),
        "CPU, s a frame (worst)": _median(seconds),
    }


def _median(values: Sequence[float]) -> str:
    """The median and the largest of some values."""
    return f"{np.median(values):.1f} ({max(values):.1f})" if values else "-"
