"""Real frames of things that a memory was not taught: how many get a name, how many confidently.

    python benchmarks/real_tables.py FOLDER [--models ycb] [--show] [--network CARD]

FOLDER holds a folder a frame: depth.png (uint16, millimetres) and K.json (fx, fy, cx, cy, the
middle of the first pixel at 0). No pose of a camera is known: up is the normal of the table. Each
frame is given to a scene of its own. Every name is wrong, so none of them should be confident.
Printed are the objects that were found, those with a name, and those with a confident one; with
``--show`` each confident name, its pixels and how sure its pose is. Nothing is drawn at random.
``--network`` names the card of a network of ``nextview train segmentation`` in place of the bundled
one.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image
from rich.progress import track

import nextview
from nextview.errors import ObservationError, UsageError
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
from nextview.segmentation.instances import LearnedSegmenter
from nextview.sensing.frame import Frame


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


def frame_in(folder: Path) -> Frame:
    """The frame that a folder holds, without a pose."""
    fx, fy, cx, cy = json.loads((folder / "K.json").read_text())
    depth = np.asarray(Image.open(folder / "depth.png"))
    return Frame(depth, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))


def in_words(name: str, thing: SceneObject) -> str:
    """A row of a table on a confident name."""
    pixels = max(int(mask.sum()) for mask in thing.pixels.values())
    return f"| {name} | {thing.name} | {pixels} | {thing.pose_uncertainty} |"


def main(
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
    for path in track(frames, f"frames of {folder.name}"):
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
        print("| frame | name | pixels | uncertainty |", "|---|---|---|---|", sep="\n")
        print("\n".join(rows))
    share = counts.confident / max(counts.objects, 1)
    print(
        f"{counts.frames} frames taken in, {counts.refused} refused: {counts.objects} objects,"
        f" {counts.named} with a name, {counts.confident} with a confident one ({share:.3f})"
    )


if __name__ == "__main__":
    tyro.cli(main)
