"""Real frames of things on a table, one view each: things that were taught, or none of which was.

    python -m benchmarks.real_frames taught FOLDER SCANS [--models ycb] [--network CARD]
    python -m benchmarks.real_frames untaught FOLDER [--models ycb] [--show] [--network CARD]

No camera pose is known: up is the normal of the table. Nothing is drawn at random. ``--network``
is the card of a network of ``nextview train segmentation`` in place of the bundled one.

``taught``: FOLDER holds frames: NAME.depth.png (uint16, millimetres), NAME.labels.png (uint8, the
label of each pixel) and names.txt, a line for each label, the first for the background. SCANS holds
the scans of the things that the memory knows, in metres, by their names. Each thing is selected
once by a point, the median of the positions under its label, and once by its label as a mask.
Printed are the answer by outline and size alone and with the geometry, whether the thing is among
the first three, the belief in the answer, its residual, and the intersection over union of the
label with the outline of the posed scan (of the true thing, if it is among the hypotheses; what
stands before it is not taken off). Labels of few pixels are left out. Then a scene looks at each
frame; printed are its right and wrong names.

``untaught``: FOLDER holds a folder for each frame: depth.png (uint16, millimetres) and K.json (fx,
fy, cx, cy, with the middle of the first pixel at 0). Each frame is given to a scene of its own.
Every name is wrong, so none of them should be confident. Printed are the objects that were found,
those with a name, and those with a confident one; with ``--show`` each confident name, its pixels
and how uncertain its pose is.
"""

import time
from collections.abc import Iterator
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
)
from nextview.errors import ObservationError, UsageError
from nextview.geometry.observation import Observation
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
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


@dataclass
class Counts:
    """What was found in some frames.

    Attributes:
        frames: that were taken in.
        refused: frames in which no table was seen.
        objects: that were found.
        named: of these, those with a name.
        confident: of these, those whose name is confident.
    """

    frames: int = 0
    refused: int = 0
    objects: int = 0
    named: int = 0
    confident: int = 0


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


def print_scenes(
    system: nextview.System,
    paths: list[Path],
    names: list[str],
    intrinsics: NDArray[np.float64],
    segmentation: Segmenter | None,
) -> None:
    """Print how many things are named right and wrong by a scene of each frame.

    Args:
        system: that knows the things.
        paths: of the depth images.
        names: of the labels, the first of what is none.
        intrinsics: of the camera, (3, 3).
        segmentation: that tells the things; None for the bundled network.
    """
    things = right = sure_right = wrong = sure_wrong = 0
    for path in paths:
        labels = labels_of(path)
        frame = Frame(np.asarray(Image.open(path)), intrinsics)
        shown = np.bincount(labels[frame.depth > 0], minlength=len(names))[1:]
        things += int(np.count_nonzero(shown >= LEAST_PIXELS))

        scene = nextview.Scene(system, up=None, segmentation=segmentation)
        scene.update(frame)
        taken = set()
        for found in scene.objects:
            (mask,) = found.pixels.values()
            true = names[int(np.bincount(labels[mask]).argmax())]
            if found.name == UNKNOWN_NAME:
                continue
            good = found.name == true and true not in taken
            taken.add(found.name)
            right += good
            wrong += not good
            sure_right += good and found.confident
            sure_wrong += not good and found.confident
    print(
        f"scenes: of {things} things {right} named right, {sure_right} of them confidently; {wrong}"
        f" wrong names, {sure_wrong} of them confident"
    )


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
    print_scenes(nextview.load(models), paths, names, matrix, learned)


def in_words(name: str, thing: SceneObject) -> tuple[object, ...]:
    """A row of a table on a confident name."""
    pixels = max(int(mask.sum()) for mask in thing.pixels.values())
    return name, thing.name, pixels, thing.pose_uncertainty


def untaught(
    folder: tyro.conf.Positional[Path],
    models: str = "ycb",
    show: bool = False,
    network: Path | None = None,
) -> None:
    """Count what is found in the frames of a folder, and what gets a name.

    Args:
        folder: of the frames.
        models: memory of things, none of which is in the frames.
        show: whether each confident name is printed.
        network: card of a segmentation network; None for the bundled one.
    """
    frames = sorted(path.parent for path in folder.glob("*/depth.png"))
    if not frames:
        raise UsageError(f"{folder}: holds no folder with a depth.png")
    system = nextview.load(models=models)
    learned = None if network is None else LearnedSegmenter(network)
    counts = Counts()
    rows = []
    for path in progress(frames, f"frames of {folder.name}"):
        scene = nextview.Scene(system, up=None, segmentation=learned)
        try:
            scene.update(frame_in(path))
        except ObservationError as error:
            counts.refused += 1
            print(f"{path.name}: {error}")
            continue
        sure = [thing for thing in scene.objects if thing.confident]
        counts.frames += 1
        counts.objects += len(scene.objects)
        counts.named += sum(thing.name != UNKNOWN_NAME for thing in scene.objects)
        counts.confident += len(sure)
        rows += [in_words(path.name, thing) for thing in sure]

    if show:
        print(markdown(("frame", "name", "pixels", "uncertainty"), rows))
    share = counts.confident / max(counts.objects, 1)
    print(
        f"{counts.frames} frames taken in, {counts.refused} refused: {counts.objects} objects,"
        f" {counts.named} with a name, {counts.confident} with a confident one ({share:.3f})"
    )


if __name__ == "__main__":
    subcommand_cli_from_dict({"taught": taught, "untaught": untaught})
