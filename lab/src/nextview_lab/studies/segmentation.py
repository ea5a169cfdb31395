"""Which pixels are one thing: the segmentation against the truth, on real frames.

    python -m nextview_lab.studies.segmentation FOLDER [--network CARD]

FOLDER holds frames with images of labels, as ``nextview_lab.data.real_frames`` reads them. No pose
is known, so neither is gravity.

Printed are, over all things that show in at least ``LEAST_PIXELS`` pixels: the mean intersection
over union (IoU) of each with the segment that fits it best, the shares with more than .5, .75 and
.9, the share of segments that fit some thing by more than .5 (precision), segments that hold most
of two things (merges), and things of which two segments hold a fifth each (splits); the mean IoU by
how many things a frame shows; and the seconds a frame takes. ``--network`` names the card of a
network of ``nextview-lab train segmentation``; without it the bundled one is asked.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

from nextview.cli.exit_status import orderly_end
from nextview.segmentation.instances import LearnedSegmenter
from nextview.sensing.frame import Frame
from nextview_lab.data.real_frames import TrueThing, real_frames
from nextview_lab.studies.shared import progress

LEAST_PIXELS = 200  # of a thing that counts; of a segment half as many
GOOD_IOU = 0.5
MOST_OF_THING = 0.5
PART_OF_THING = 0.2
CROWDS = {"up to 3": (1, 3), "4 to 6": (4, 6), "more": (7, 999)}

Labels = NDArray[np.int64]


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

    def add(self, truth: Labels, found: Labels) -> None:
        """Count a frame."""
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


def labels_of(frame: Frame, things: Sequence[TrueThing]) -> Labels:
    """The number of the thing of each pixel with depth, 0 for none, (H, W)."""
    labels = np.zeros(frame.shape, np.int64)
    for number, thing in enumerate(things, 1):
        if thing.pixels is not None:
            labels[thing.pixels & (frame.depth > 0)] = number
    return labels


def main(folder: tyro.conf.Positional[Path], network: Path | None = None) -> None:
    """Compare segments with the truth.

    Args:
        folder: of the frames.
        network: card of a segmentation network; None for the bundled one.
    """
    learned = LearnedSegmenter(network)
    counts = Counts()
    for real in progress(real_frames(folder), "frames"):
        frame = real.read()
        begun = time.perf_counter()
        found = learned(frame).labels
        counts.seconds += time.perf_counter() - begun
        counts.add(labels_of(frame, real.things()), found)
    counts.print_out()


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
