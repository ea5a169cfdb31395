"""Which pixels are one thing: the segmentation against the truth, on real and simulated frames.

    python -m benchmarks.segmentation real FOLDER [--network CARD] [--figure OUT.png]
    python -m benchmarks.segmentation {table,bin,shelf,floor,belt} SCANS [--frames 40] [--seed 0]

``real``: FOLDER holds a folder a frame: depth.png (uint16, millimetres), K.json (fx, fy, cx, cy,
the middle of the first pixel at 0) and labels.png (0: none, 1: table, else the tens digit is the
thing). No pose is known, so neither is gravity.

The others draw worlds of that kind from SCANS, a folder of scans in metres that trained nothing,
and look at each once through a sensor of 640 x 480 pixels.

Printed are, over all things that show in at least ``LEAST_PIXELS`` pixels: the mean intersection
over union (IoU) of each with the segment that fits it best, the shares with more than .5, .75 and
.9, the share of segments that fit some thing by more than .5 (precision), segments that hold most
of two things (merges), and things of which two segments hold a fifth each (splits); the mean IoU by
how many things a frame shows; and the seconds a frame takes. ``--network``
names the card of a network of ``nextview-lab train segmentation``; without it the bundled one is
asked. ``--figure`` draws the worst frames and the best.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image

from benchmarks.shared import frame_in, progress, scans_in
from nextview.errors import UsageError
from nextview.geometry.mesh import load_mesh
from nextview.segmentation.instances import LearnedSegmenter
from nextview.sensing.frame import Frame
from nextview_lab.worlds.worlds import Shape, draw_world, photograph

LEAST_PIXELS = 200  # of a thing that counts; of a segment half as many
SHAPE = (480, 640)
GOOD_IOU = 0.5
MOST_OF_THING = 0.5
PART_OF_THING = 0.2
CROWDS = {"up to 3": (1, 3), "4 to 6": (4, 6), "more": (7, 999)}

Labels = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Truth:
    """A frame and what its pixels show.

    Attributes:
        name: of the frame.
        frame: as a camera gives it.
        labels: number of the thing of each pixel from 1 on, 0 for none, (H, W).
    """

    name: str
    frame: Frame
    labels: Labels


@dataclass
class Counts:
    """What was counted.

    Attributes:
        overlaps: IoU of each thing with the segment that fits it best.
        crowds: how many things its frame shows.
        segments: how many there were.
        good: of these, those that fit a thing.
        merges: of these, those that hold most of two things.
        splits: things that are cut.
        seconds: of all frames.
        frames: how many.
    """

    overlaps: list[float] = field(default_factory=list)
    crowds: list[int] = field(default_factory=list)
    segments: int = 0
    good: int = 0
    merges: int = 0
    splits: int = 0
    seconds: float = 0.0
    frames: int = 0

    def add(self, truth: Labels, found: Labels) -> float:
        """Count a frame; return its mean IoU."""
        both = np.zeros((int(truth.max()) + 1, int(found.max()) + 1), np.int64)
        np.add.at(both, (truth.ravel(), found.ravel()), 1)
        things = np.flatnonzero(both[1:].sum(1) >= LEAST_PIXELS) + 1
        segments = np.flatnonzero(both[:, 1:].sum(0) >= LEAST_PIXELS / 2) + 1
        shared = both[np.ix_(things, segments)]
        size = both[things].sum(1)
        union = size[:, None] + both[:, segments].sum(0) - shared
        overlap = shared / union if shared.size else np.zeros((len(things), 1))

        best = overlap.max(1, initial=0)
        self.overlaps += best.tolist()
        self.crowds += [len(things)] * len(things)
        self.segments += len(segments)
        self.good += int((overlap.max(0, initial=0)[: len(segments)] > GOOD_IOU).sum())
        if shared.size:
            share = shared / size[:, None]
            self.merges += int(((share > MOST_OF_THING).sum(0) > 1).sum())
            self.splits += int(((share > PART_OF_THING).sum(1) > 1).sum())
        self.frames += 1
        return float(best.mean()) if len(best) else 1.0

    def print_out(self) -> None:
        """Print the counts as lines of a table."""
        overlap = np.array(self.overlaps)
        crowd = np.array(self.crowds)
        shares = " ".join(f">{t}: {np.mean(overlap > t):.3f}" for t in (0.5, 0.75, 0.9))
        print(f"things {len(overlap)}, mean IoU {overlap.mean():.3f}, {shares}")
        for name, (low, high) in CROWDS.items():
            those = overlap[(crowd >= low) & (crowd <= high)]
            if len(those):
                print(f"  {name} in a frame: {those.mean():.3f} of {len(those)}")
        precision = self.good / max(self.segments, 1)
        print(
            f"segments {self.segments}, precision {precision:.3f}, merges {self.merges},"
            f" splits {self.splits}, {self.seconds / self.frames:.3f} s a frame"
        )


def real_frames(folder: Path) -> Iterator[Truth]:
    """The labelled frames of a folder."""
    for path in sorted(folder.glob("*/labels.png")):
        frame = frame_in(path.parent)
        given = np.asarray(Image.open(path)).astype(np.int64)
        labels = np.where((given >= 10) & (frame.depth > 0), given // 10, 0)
        yield Truth(path.parent.name, frame, labels)


def simulated_frames(kind: str, scans: Path, frames: int, seed: int) -> Iterator[Truth]:
    """Frames of worlds of a kind, made of scans."""
    shapes = []
    for path in scans_in(scans).values():
        mesh = load_mesh(path)
        vertices = mesh.vertices / np.ptp(mesh.vertices, axis=0).max()
        shapes.append(Shape.of((vertices, mesh.faces)))
    number = 0
    for world_number in range(20 * frames):
        rng = np.random.default_rng([seed, world_number])
        world = draw_world(shapes, [], rng, kind)
        for view in photograph(world, rng, SHAPE, 1):
            if number == frames or not (view.labels >= 0).any():
                continue
            number += 1
            frame = Frame(view.depth, view.intrinsics, view.pose, pixel_centre=0.5)
            yield Truth(f"{kind} {number}", frame, np.maximum(view.labels + 1, 0))
        if number == frames:
            return


def draw(rows: list[tuple[float, Truth, Labels]], path: Path) -> None:
    """Draw the worst frames and the best: depth, truth and segments side by side."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    rows = sorted(rows, key=lambda row: row[0])
    chosen = [*rows[:6], *rows[-2:]]
    figure, axes = plt.subplots(len(chosen) // 2, 6, figsize=(15, 8))
    colours = np.random.default_rng(4).uniform(0.25, 1, (256, 3))
    colours[0] = 0.08
    for place, (overlap, truth, found) in enumerate(chosen):
        own = axes.flat[3 * place : 3 * place + 3]
        depth = truth.frame.depth
        low, high = np.quantile(depth[depth > 0], [0.02, 0.98])
        own[0].imshow(
            np.where(depth > 0, depth, np.nan), cmap="bone_r", vmin=low, vmax=high
        )
        own[1].imshow(colours[truth.labels % 256])
        own[2].imshow(colours[found % 256])
        for axis, title in zip(
            own, (truth.name, "truth", f"IoU {overlap:.2f}"), strict=True
        ):
            axis.set_title(title, fontsize=9)
            axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def main(
    kind: tyro.conf.Positional[
        Literal["real", "table", "bin", "shelf", "floor", "belt"]
    ],
    folder: tyro.conf.Positional[Path],
    frames: int = 40,
    seed: int = 0,
    network: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Compare segments with the truth.

    Args:
        kind: of frames.
        folder: of real frames, or of scans.
        frames: that are simulated.
        seed: of the worlds.
        network: card of a segmentation network; None for the bundled one.
        figure: file for a picture of the worst frames and the best.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder")
    every = list(
        real_frames(folder)
        if kind == "real"
        else simulated_frames(kind, folder, frames, seed)
    )
    learned = LearnedSegmenter(network)
    counts = Counts()
    rows = []
    for truth in progress(every, f"frames of {kind}"):
        begun = time.perf_counter()
        found = learned(truth.frame).labels
        counts.seconds += time.perf_counter() - begun
        rows.append((counts.add(truth.labels, found), truth, found))
    counts.print_out()
    if figure is not None:
        draw(rows, figure)
        print(f"wrote {figure}")


if __name__ == "__main__":
    tyro.cli(main)
