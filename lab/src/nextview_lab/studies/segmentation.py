"""Which pixels are one thing: the segmentation against the truth, on real frames.

    python -m nextview_lab.studies.segmentation FOLDER [--network CARD] [--picture PNG]

FOLDER holds frames with images of labels, as ``nextview_lab.data.real_frames`` reads them. No pose
is known, so neither is gravity.

Printed are, over all things that show in at least ``LEAST_PIXELS`` pixels: the mean intersection
over union (IoU) of each with the segment that fits it best, the shares with more than .5, .75 and
.9; the segments, the share of them that fit some thing by more than .5 (precision), those that hold
most of two things (merges), and things of which two segments hold a fifth each (splits); and the
seconds a frame takes. A table has the IoU, how many things are joined with another and how many are
cut, by what is around a thing, by how many things its frame shows, and by its distance.
``--picture`` draws the things that fit worst, at most one of a frame. ``--network`` names the card
of a network of ``nextview-lab train segmentation``; without it the bundled one is asked.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image
from rich.progress import track
from scipy import ndimage

from nextview.cli.exit_status import orderly_end
from nextview.cli.progress import console
from nextview.figures.style import ACCENT, BLUE, PlainFigure
from nextview.files import new_file
from nextview.scene.figure import grey_picture
from nextview.segmentation.instances import LearnedSegmenter
from nextview.sensing.frame import Frame
from nextview_lab.data.real_frames import TrueThing, real_frames

LEAST_PIXELS = 200  # of a thing that counts; of a segment half as many
GOOD_IOU = 0.5
MOST_OF_THING = 0.5
PART_OF_THING = 0.2
BESIDE = 4  # pixels between things that touch in the image
GROUPS = {  # of things: an attribute of ``Parted``, its least and its largest value
    "alone in the image": ("touching", 0, 0),
    "touches one other": ("touching", 1, 1),
    "touches more": ("touching", 2, np.inf),
    "in pieces, behind another": ("pieces", 2, np.inf),
    "up to 3 in the frame": ("crowd", 1, 3),
    "4 to 6": ("crowd", 4, 6),
    "more": ("crowd", 7, np.inf),
    "nearer than 0.8 m": ("distance", 0, 0.8),
    "0.8 to 1 m": ("distance", 0.8, 1.0),
    "farther": ("distance", 1.0, np.inf),
}
PICTURES = 5, 4  # of the things that fit worst: rows and columns
FEWEST_ROWS = 130  # of the image in a picture

Labels = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Parted:
    """How well a thing is parted from what is around it.

    Attributes:
        frame: that shows it.
        mask: its pixels, (H, W).
        found: the segment of each pixel, 0 for none, (H, W).
        overlap: IoU with the segment that fits it best.
        joined: of how many others the segment that holds most of it holds most, too.
        cut: how many segments hold a fifth of it each.
        crowd: how many things its frame shows.
        distance: its median depth, metres.
        touching: how many others are beside it in the image.
        pieces: into how many, a fifth of it each, what is before it parts it.
    """

    frame: Frame
    mask: NDArray[np.bool_]
    found: Labels
    overlap: float
    joined: int
    cut: int
    crowd: int
    distance: float
    touching: int
    pieces: int


@dataclass
class Counts:
    """What was counted.

    Attributes:
        things: how well each is parted.
        segments: how many there were.
        good: of these, those that fit a thing.
        merges: of these, those that hold most of two things.
        seconds: of all frames.
        frames: how many.
    """

    things: list[Parted] = field(default_factory=list)
    segments: int = 0
    good: int = 0
    merges: int = 0
    seconds: float = 0.0
    frames: int = 0

    def add(self, frame: Frame, truth: Labels, found: Labels) -> None:
        """Count a frame.

        Args:
            frame: what the camera measured.
            truth: number of the thing of each pixel, 0 for none, (H, W).
            found: number of the segment of each pixel, 0 for none, (H, W).
        """
        both = np.zeros((int(truth.max()) + 1, int(found.max()) + 1), np.int64)
        np.add.at(both, (truth.ravel(), found.ravel()), 1)
        numbers = np.flatnonzero(both[1:].sum(1) >= LEAST_PIXELS) + 1
        segments = np.flatnonzero(both[:, 1:].sum(0) >= LEAST_PIXELS / 2) + 1

        shared = both[np.ix_(numbers, segments)]
        size = both[numbers].sum(1)
        overlap = shared / (size[:, None] + both[:, segments].sum(0) - shared)
        share = shared / size[:, None]
        most = share > MOST_OF_THING

        self.segments += len(segments)
        self.good += int((overlap.max(0, initial=0) > GOOD_IOU).sum())
        self.merges += int((most.sum(0) > 1).sum())
        self.frames += 1

        for row, number in enumerate(numbers):
            mask = truth == number
            near = truth[ndimage.binary_dilation(mask, iterations=BESIDE)]
            pieces = np.bincount(ndimage.label(mask, np.ones((3, 3)))[0][mask])

            self.things.append(
                Parted(
                    frame,
                    mask,
                    found,
                    overlap=float(overlap[row].max(initial=0)),
                    joined=int((most.sum(0) - 1)[most[row]].max(initial=0)),
                    cut=int((share[row] > PART_OF_THING).sum()),
                    crowd=len(numbers),
                    distance=float(np.median(frame.depth[mask])),
                    touching=len(np.setdiff1d(near, [0, number])),
                    pieces=int((pieces > PART_OF_THING * mask.sum()).sum()),
                )
            )

    def print_out(self) -> None:
        """Print the counts as lines of a table."""
        overlap = np.array([thing.overlap for thing in self.things])
        shares = " ".join(f">{t}: {np.mean(overlap > t):.3f}" for t in (0.5, 0.75, 0.9))
        print(f"things {len(overlap)}, mean IoU {overlap.mean():.3f}, {shares}")
        print(
            f"segments {self.segments},"
            f" precision {self.good / max(self.segments, 1):.3f}, merges {self.merges},"
            f" splits {sum(thing.cut > 1 for thing in self.things)},"
            f" {self.seconds / self.frames:.3f} s a frame"
        )

        print(f"{'':28}things    IoU  joined    cut")
        for name, (value, low, high) in GROUPS.items():
            those = [one for one in self.things if low <= getattr(one, value) <= high]
            if those:
                print(
                    f"{name:28}{len(those):6}"
                    f"{np.mean([one.overlap for one in those]):7.3f}"
                    f"{sum(one.joined > 0 for one in those):8}"
                    f"{sum(one.cut > 1 for one in those):7}"
                )


def draw_worst(things: Sequence[Parted], out: Path) -> None:
    """Draw of each frame the thing that fits worst, and the outlines of the segments there.

    Args:
        things: of all frames.
        out: PNG file.
    """
    of_frames = {
        id(thing.frame): thing for thing in sorted(things, key=lambda one: -one.overlap)
    }
    worst = sorted(of_frames.values(), key=lambda one: one.overlap)
    figure = PlainFigure((9.0, 10.0), layout="constrained")
    for place, thing in enumerate(worst[: PICTURES[0] * PICTURES[1]], 1):
        axis = figure.add_subplot(*PICTURES, place)
        axis.imshow(grey_picture(thing.frame), cmap="gray", vmin=0, vmax=1)
        axis.contourf(thing.mask, [0.5, 2], colors=[BLUE], alpha=0.35)

        for number in np.setdiff1d(thing.found, [0]):
            axis.contour(thing.found == number, [0.5], colors=[ACCENT], linewidths=1.3)

        high, wide = (np.array([at.min(), at.max()]) for at in np.nonzero(thing.mask))
        half = 0.75 * max(np.ptp(high), np.ptp(wide) * 0.75, FEWEST_ROWS)
        middle = np.clip(high.mean(), half, len(thing.mask) - half)
        axis.set(
            xlim=wide.mean() + np.array([-1, 1]) * half / 0.75,
            ylim=middle + np.array([1, -1]) * half,
        )

        axis.set_axis_off()
        axis.set_title(
            f"IoU {thing.overlap:.2f}"
            + f", joined with {thing.joined}" * (thing.joined > 0)
            + f", cut in {thing.cut}" * (thing.cut > 1),
            fontsize=8.5,
            pad=3,
        )

    figure.suptitle("blue: the thing; red: outlines of the segments", fontsize=9.5)
    with new_file(out, overwrite=True) as part:
        figure.savefig(part, format="png", dpi=110, facecolor="white")
        # fewer colours make a smaller file
        Image.open(part).convert("RGB").quantize(256).save(part, "png", optimize=True)


def labels_of(frame: Frame, things: Sequence[TrueThing]) -> Labels:
    """Number the things of a frame.

    Args:
        frame: (H, W).
        things: with their pixels, (H, W), where these are known.

    Returns:
        The number of the thing of each pixel with depth, 0 for none, (H, W).
    """
    labels = np.zeros(frame.shape, np.int64)
    for number, thing in enumerate(things, 1):
        if thing.pixels is not None:
            labels[thing.pixels & (frame.depth > 0)] = number
    return labels


def main(
    folder: tyro.conf.Positional[Path],
    network: Path | None = None,
    picture: Path | None = None,
) -> None:
    """Compare segments with the truth.

    Args:
        folder: of the frames.
        network: card of a segmentation network; None for the bundled one.
        picture: PNG file of the things that fit worst; None for none.
    """
    learned = LearnedSegmenter(network)
    counts = Counts()
    for real in track(real_frames(folder), "frames", console=console):
        frame = real.read()
        begun = time.perf_counter()
        found = learned(frame).labels
        counts.seconds += time.perf_counter() - begun
        counts.add(frame, labels_of(frame, real.things()), found)
    counts.print_out()
    if picture is not None:
        draw_worst(counts.things, picture)


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
