"""Real frames of things on a table, one view each: what scenes say of them.

    python -m nextview_lab.studies.real_frames FOLDER [--models ycb] [--show] [--network CARD]

No camera pose is known: up is the normal of the table. Nothing is drawn at random. ``--network``
is the card of a network of ``nextview-lab train segmentation`` in place of the bundled one.

Each frame is given to a scene of its own. FOLDER holds one of

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
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image

import nextview
from nextview.errors import ObservationError, UsageError
from nextview.scene.objects import UNKNOWN_NAME
from nextview.segmentation.instances import LearnedSegmenter
from nextview.sensing import Frame
from nextview.types import Mask
from nextview_lab.studies.shared import (
    camera_matrix,
    frame_in,
    markdown,
    progress,
    share,
)

# of the camera of the PoseCNN demo: fx, fy, cx, cy
INTRINSICS = (618.017, 618.003, 312.377, 232.375)
NEAR_PIXELS = 8  # of a given pixel, that are still on the thing


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


def labels_of(path: Path) -> NDArray[np.uint8]:
    """What each pixel of a depth image shows, (H, W), by the image of labels beside it."""
    labels = path.with_name(path.name.replace("depth", "labels"))
    return np.asarray(Image.open(labels))


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
    tyro.cli(alone)
