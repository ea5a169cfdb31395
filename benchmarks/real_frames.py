"""Real frames of things on a table, one view each: what scenes say of them, and single things.

    python -m benchmarks.real_frames alone FOLDER [--models ycb] [--show] [--network CARD]
    python -m benchmarks.real_frames taught FOLDER SCANS [--models ycb] [--network CARD]

No camera pose is known: up is the normal of the table. Nothing is drawn at random. ``--network``
is the card of a network of ``nextview-lab train segmentation`` in place of the bundled one.

``alone``: each frame is given to a scene of its own. FOLDER holds one of

- a folder for each frame: depth.png (uint16, millimetres; scale.json has metres a step, if it is
  another one) and K.json (fx, fy, cx, cy, with the middle of the first pixel at 0). truth.json
  beside them lists by the frame's name what is in it and taught, as {"name", "column", "row"}: a
  pixel on the thing. Without it, nothing in the frames is taught;
- NAME.depth.png (uint16, millimetres), NAME.labels.png (uint8, the label of each pixel) and
  names.txt, a line for each label, the first for the background.

An object that a scene finds belongs to a thing if it holds more of its labelled pixels (those
within 8 of a given pixel) than any other object. Printed are a row for the taught things, of which
a thing without an object and one in a frame without a table are not right, and a row for the other
objects: strangers, and fragments of things. Their right answer is "unknown". With ``--show`` each
confident wrong name is printed.

``taught``: FOLDER holds frames with labels. SCANS holds the scans of the things that the memory
knows, in metres, by their names. Each thing is selected
once by a point, the median of the positions under its label, and once by its label as a mask.
Printed are the answer by outline and size alone and with the geometry, whether the thing is among
the first three, the belief in the answer, its residual, and the intersection over union of the
label with the outline of the posed scan (of the true thing, if it is among the hypotheses; what
stands before it is not taken off). Labels of few pixels are left out.
"""

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image
from tyro.extras import subcommand_cli_from_dict

import nextview
from benchmarks.shared import (
    camera_matrix,
    frame_in,
    markdown,
    mesh_of,
    progress,
    scans_of,
    share,
)
from nextview.errors import ObservationError, UsageError
from nextview.geometry.observation import Observation
from nextview.scene.objects import UNKNOWN_NAME
from nextview.segmentation.instances import LearnedSegmenter, Segmenter
from nextview.sensing import Frame, ObservedObject
from nextview.things.memory import TaughtRecogniser
from nextview.things.surface import Surface
from nextview.things.taught import TaughtThings
from nextview.things.verifier import Verified
from nextview.types import Mask

# of the camera of the PoseCNN demo: fx, fy, cx, cy
INTRINSICS = (618.017, 618.003, 312.377, 232.375)
LEAST_PIXELS = 200  # of a label
NEAR_PIXELS = 8  # of a given pixel, that are still on the thing


@dataclass(frozen=True)
class Named:
    """What a thing in a frame was called.

    Attributes:
        frame: name of the frame.
        thing: its label.
        by: how it was given: by a point or by a mask.
        by_outline: the answer by outline and size alone.
        answer: the answer with the geometry.
        among_three: whether the thing is among the first three.
        confidence: belief in the answer.
        residual: how badly the likeliest hypothesis explains the view.
        overlap: of the outline of the posed scan with the label.
        seconds: of CPU for the geometry.
    """

    frame: str
    thing: str
    by: str
    by_outline: str
    answer: str
    among_three: bool
    confidence: float
    residual: float
    overlap: float
    seconds: float


@dataclass(frozen=True)
class LabelledFrame:
    """A frame, and which taught things are in it.

    Attributes:
        name: of the frame.
        frame: without a pose.
        things: name of each taught thing and its pixels, (H, W) bool; not all of them, where the
            truth is a point.
    """

    name: str
    frame: Frame
    things: Sequence[tuple[str, Mask]]


@dataclass(frozen=True)
class Answer:
    """What a scene says of a taught thing, or of an object that is none.

    Attributes:
        name: that it is given; None for a thing that was not found.
        confident: whether the name is confident.
        right: whether it is the right answer; for a stranger that is "unknown".
    """

    name: str | None
    confident: bool
    right: bool

    @property
    def sure_and_wrong(self) -> bool:
        """Whether a confident name is wrong."""
        return self.confident and not self.right


def memory_with_surfaces(models: str, scans: Path) -> TaughtThings:
    """A memory, and the surfaces of all that it knows."""
    recogniser = TaughtRecogniser(models, threads=1)
    assert recogniser.card.memory is not None
    names = [thing.name for thing in recogniser.card.memory.things]
    whole = [
        Surface.from_mesh(mesh_of(path), path.stem) for path in scans_of(scans, names)
    ]
    return TaughtThings(recogniser, [surface.simplified() for surface in whole])


def outline(
    things: TaughtThings,
    found: Verified,
    hypothesis: int,
    view: Observation,
    frame: Frame,
) -> Mask:
    """The pixels of a frame in which the scan of a hypothesis shows."""
    assert view.scene is not None
    assert view.radius is not None
    caster = things.verifier.caster
    pose = found.poses[hypothesis]
    turn = pose[:3, :3]
    place = pose[:3, 3] + found.cameras[hypothesis, 0]

    rows, columns = np.indices(frame.shape)
    focal = frame.intrinsics[[0, 1], [0, 1]]
    x = (columns + 0.5 - frame.intrinsics[0, 2]) / focal[0]
    y = (rows + 0.5 - frame.intrinsics[1, 2]) / focal[1]
    rays = (
        np.stack([x, y, np.ones(frame.shape)], -1).reshape(-1, 3)
        @ view.scene.pose[:3, :3].T
    )

    origin = (view.scene.pose[:3, 3] * view.radius - place) @ turn
    thing = found.things[hypothesis : hypothesis + 1]
    depth, _ = caster.cast(
        thing,
        origin[None].astype(np.float32),
        (rays @ turn)[None].astype(np.float32),
    )
    return np.isfinite(depth[0]).reshape(frame.shape)


def name_one(
    things: TaughtThings,
    name: str,
    label: Mask,
    frame: Frame,
    given: dict[str, str],
    segmentation: Segmenter | None = None,
) -> Named | None:
    """Name the thing of a label, which is given by a point or by a mask; None where it is not
    found.
    """
    by = str(given["by"])
    shown = label & (frame.depth > 0)
    point = np.median(frame.positions(*np.nonzero(shown)), axis=0)
    place = point if by == "point" else None
    thing = ObservedObject(up=None, point=place, segmentation=segmentation)
    masked = frame.with_mask(shown)
    seen = frame if by == "point" else masked
    try:
        view = thing.add(seen)
    except ObservationError as error:
        print(f"{given['name']} {name} by {by}: {error}")
        return None

    begun = time.process_time()
    found = things([view])
    seconds = time.process_time() - begun

    number = things.names.index(name)
    own = np.flatnonzero(found.things == number)
    hypothesis = int(own[0]) if len(own) else 0
    posed = outline(things, found, hypothesis, view, frame)
    return Named(
        frame=str(given["name"]),
        thing=name,
        by=by,
        by_outline=things.names[found.by_outline.argmax()],
        answer=things.names[found.belief.argmax()],
        among_three=number in np.argsort(-found.belief)[:3],
        confidence=float(found.belief.max()),
        residual=found.residual,
        overlap=float((posed & label).sum() / (posed | label).sum()),
        seconds=seconds,
    )


def named_in(
    things: TaughtThings,
    path: Path,
    names: list[str],
    intrinsics: NDArray[np.float64],
    segmentation: Segmenter | None = None,
) -> Iterator[Named]:
    """All things of one frame, by a point and by a mask."""
    frame = Frame(np.asarray(Image.open(path)), intrinsics)
    labels = labels_of(path)
    for number, name in enumerate(names[1:], 1):
        label = labels == number
        if (label & (frame.depth > 0)).sum() < LEAST_PIXELS or name not in things.names:
            continue
        for by in ("point", "mask"):
            found = name_one(
                things,
                name,
                label,
                frame,
                {"name": path.name.split(".")[0], "by": by},
                segmentation,
            )
            if found is not None:
                yield found


def labels_of(path: Path) -> NDArray[np.uint8]:
    """What each pixel of a depth image shows, (H, W), by the image of labels beside it."""
    labels = path.with_name(path.name.replace("depth", "labels"))
    return np.asarray(Image.open(labels))


def taught(
    folder: tyro.conf.Positional[Path],
    scans: tyro.conf.Positional[Path],
    models: str = "ycb",
    intrinsics: tuple[float, float, float, float] = INTRINSICS,
    network: Path | None = None,
) -> None:
    """Name the things in all frames of a folder, and print what was found.

    Args:
        folder: of the frames.
        scans: folder of the scans.
        models: memory of the things.
        intrinsics: of the camera: fx, fy, cx, cy, pixels.
        network: card of a segmentation network; None for the bundled one.
    """
    things = memory_with_surfaces(models, scans)
    names = (folder / "names.txt").read_text().split()
    matrix = camera_matrix(*intrinsics)

    learned = None if network is None else LearnedSegmenter(network)
    found: list[Named] = []
    paths = sorted(folder.glob("*.depth.png"))
    print(
        "| frame | thing | given by | by outline | verified | belief | residual | overlap |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for path in paths:
        for each in named_in(things, path, names, matrix, learned):
            found.append(each)
            said = f"{each.by_outline} | {each.answer} | {each.confidence:.2f}"
            print(
                f"| {each.frame} | {each.thing} | {each.by} | {said} | {each.residual:.2f} |"
                f" {each.overlap:.2f} |"
            )

    print()
    for by in ("point", "mask"):
        some = [each for each in found if each.by == by]
        by_outline = sum(each.by_outline == each.thing for each in some)
        right = sum(each.answer == each.thing for each in some)
        three = sum(each.among_three for each in some)
        overlap = np.mean([each.overlap for each in some])
        slowest = 1000 * max(each.seconds for each in some)
        print(
            f"by {by}: of {len(some)} things {by_outline} named right by outline, {right} with the"
            f" geometry, {three} among the first three; mean overlap {overlap:.2f}; at most"
            f" {slowest:.0f} ms of CPU for the geometry"
        )


def frames_in(
    folder: Path, intrinsics: tuple[float, float, float, float]
) -> list[LabelledFrame]:
    """All frames of a folder.

    Args:
        folder: in one of the two layouts.
        intrinsics: of frames with labels, which have none of their own: fx, fy, cx, cy, pixels.

    Raises:
        UsageError: it holds no frame.
    """
    found = []
    for path in sorted(folder.glob("*.depth.png")):
        frame = Frame(np.asarray(Image.open(path)), camera_matrix(*intrinsics))
        labels = labels_of(path)
        names = (folder / "names.txt").read_text().split()
        things = [
            (names[number], labels == number)
            for number in np.unique(labels[labels > 0])
        ]
        found.append(LabelledFrame(path.name.split(".")[0], frame, things))

    truth = folder / "truth.json"
    points = json.loads(truth.read_text()) if truth.exists() else {}
    for path in sorted(path.parent for path in folder.glob("*/depth.png")):
        frame = frame_in(path)
        things = [
            (point["name"], around(point["row"], point["column"], frame.shape))
            for point in points.get(path.name, ())
        ]
        found.append(LabelledFrame(path.name, frame, things))
    if not found:
        raise UsageError(
            f"{folder}: holds no NAME.depth.png and no folder with a depth.png"
        )
    return found


def around(row: int, column: int, shape: tuple[int, int]) -> Mask:
    """The pixels near a pixel, (H, W)."""
    rows, columns = np.indices(shape)
    return np.hypot(rows - row, columns - column) <= NEAR_PIXELS


def answers(
    things: Sequence[tuple[str, Mask]], objects: Sequence[tuple[str, bool, Mask]]
) -> tuple[list[Answer], list[Answer]]:
    """Compare what a scene says of one frame with the truth.

    Args:
        things: name of each taught thing and its pixels, (H, W).
        objects: name of each object of the scene, whether it is confident, and mask.

    Returns:
        The answers for the taught things, and for all objects that belong to none of them.
    """
    known = []
    owned = set()
    for true, pixels in things:
        shared = [int((mask & pixels).sum()) for _, _, mask in objects]
        if not any(shared):
            known.append(Answer(None, False, False))
            continue
        owner = int(np.argmax(shared))
        name, confident, _ = objects[owner]
        owned.add(owner)
        known.append(Answer(name, confident, name == true))

    others = [
        Answer(name, confident, name == UNKNOWN_NAME)
        for number, (name, confident, _) in enumerate(objects)
        if number not in owned
    ]
    return known, others


def row(what: str, told: Sequence[Answer]) -> tuple[object, ...]:
    """A row of the table: what it is about, how many there are, and the shares."""
    total = len(told)
    return (
        what,
        total,
        share(sum(one.right for one in told), total),
        share(sum(one.name == UNKNOWN_NAME for one in told), total),
        share(sum(one.sure_and_wrong for one in told), total),
    )


def alone(
    folder: tyro.conf.Positional[Path],
    models: str = "ycb",
    intrinsics: tuple[float, float, float, float] = INTRINSICS,
    show: bool = False,
    network: Path | None = None,
) -> None:
    """Name everything in the frames of a folder, each frame alone, and count what is right.

    Args:
        folder: of the frames.
        models: memory of the things.
        intrinsics: of frames with labels: fx, fy, cx, cy, pixels.
        show: whether each confident wrong name is printed.
        network: card of a segmentation network; None for the bundled one.
    """
    system = nextview.load(models=models)
    learned = None if network is None else LearnedSegmenter(network)
    frames = frames_in(folder, intrinsics)
    refused = 0
    known: list[Answer] = []
    others: list[Answer] = []
    rows = []
    for one in progress(frames, f"frames of {folder.name}"):
        scene = nextview.Scene(system, up=None, segmentation=learned)
        try:
            scene.update(one.frame)
        except ObservationError as error:
            refused += 1
            print(f"{one.name}: {error}")
        things = [(name, mask) for name, mask in one.things if name in system.classes]
        objects = [
            (each.name, each.confident, next(iter(each.pixels.values())))
            for each in scene.objects
        ]
        of_things, of_others = answers(things, objects)
        known += of_things
        others += of_others
        true = [
            *(name for name, _ in things),
            *("none that was taught" for _ in of_others),
        ]
        rows += [
            (one.name, name, said.name)
            for name, said in zip(true, of_things + of_others, strict=True)
            if said.sure_and_wrong
        ]

    if show:
        print(markdown(("frame", "thing", "confident and wrong"), rows), end="\n\n")
    print(f"{len(frames)} frames, each alone; {refused} refused\n")
    columns = ("", "n", "right", "called unknown", "confident and wrong")
    parts = (("taught things", known), ("other objects", others))
    print(markdown(columns, [row(what, told) for what, told in parts if told]))


if __name__ == "__main__":
    subcommand_cli_from_dict({"alone": alone, "taught": taught})
