"""A page of mistaken episodes: what was taken for the object, and what it was, sorted by cause."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from textwrap import shorten

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import binary_closing

from nextview.files import new_folder
from nextview.sensing import Frame
from nextview.session.style import ACCENT, BLUE, FIGURE_STYLE, INK, PAPER
from nextview.types import Mask

ACROSS = 3  # pictures in a row
WIDTH = 4.2  # inches of one
HEIGHT = 3.6
SHAPE = 0.7  # height of a picture, as a part of its width
DOTS = 110  # an inch
AROUND = 1.6  # the picture shows so many times the extent of the object and of what was taken
LEAST_SIDE = 90  # pixels that it shows at least
CLOSED = 4  # pixels up to which gaps in a mask are no part of its outline
LONGEST = 62  # letters of a line
HEAD = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>Mistakes in rooms</title>
<style>
body {{ font: 16px/1.5 Helvetica, Arial, sans-serif; margin: 2rem auto; max-width: 1400px;
  padding: 0 1rem; color: {ink}; background: {paper} }}
img {{ max-width: 100% }}
</style>
</head>
<body>
<h1>Mistakes in rooms</h1>
<p>Each picture is the worst frame of an episode that was not named right: depth in grey,
<b style="color: {truth}">what the object was</b> and <b style="color: {taken}">what was taken for
it</b>. Nothing was measured where it is white.</p>
"""


@dataclass(frozen=True)
class Picture:
    """A frame of a mistaken episode.

    Attributes:
        cause: of the mistake.
        title: what was looked at, and how.
        called: what it was called.
        frame: what the camera gave.
        shown: pixels of the object, (H, W).
        found: pixels that were taken for it, (H, W).
    """

    cause: str
    title: str
    called: str
    frame: Frame
    shown: Mask
    found: Mask


def write_page(
    folder: Path,
    pictures: Iterable[Picture],
    causes: Sequence[str],
) -> None:
    """Write a folder with index.html and a picture for each cause; whole or not at all."""
    every = list(pictures)
    text = HEAD.format(ink=INK, paper=PAPER, truth=ACCENT, taken=BLUE)
    with new_folder(folder, last="index.html") as new:
        for number, cause in enumerate(causes):
            some = [picture for picture in every if picture.cause == cause]
            if not some:
                continue
            file = f"{number}_{cause.replace(' ', '_')}.png"
            _draw(some, new / file)
            text += f"<h2>{escape(cause)}: {len(some)}</h2>\n"
            text += f'<img src="{file}" alt="{len(some)} episodes: {escape(cause)}">\n'
        if not every:
            text += "<p>There is none.</p>\n"
        (new / "index.html").write_text(f"{text}</body></html>\n", "utf-8")


def _draw(pictures: Sequence[Picture], path: Path) -> None:
    rows = -(-len(pictures) // ACROSS)
    with matplotlib.rc_context(FIGURE_STYLE | {"axes.grid": False}):
        figure = Figure((ACROSS * WIDTH, rows * HEIGHT), facecolor=PAPER)
        axes = figure.subplots(rows, ACROSS, squeeze=False).ravel()
        for axis in axes:
            axis.axis("off")
        for axis, picture in zip(axes, pictures, strict=False):
            _panel(axis, picture)
        figure.tight_layout(pad=0.8)
        figure.savefig(
            path,
            dpi=DOTS,
            facecolor=PAPER,
            bbox_inches="tight",
            pad_inches=0.15,
        )


def _panel(axis: Axes, picture: Picture) -> None:
    """Depth in grey, brighter where it is nearer and where the surface faces the camera."""
    part = _part(picture.shown | picture.found)
    depth = picture.frame.depth[part].astype(np.float64)
    known = depth > 0
    grey = np.full(depth.shape, 1.0)
    if known.any():
        near, far = np.quantile(depth[known], [0.02, 0.98])
        share = np.clip((depth - near) / max(far - near, 1e-6), 0, 1)
        grey[known] = (0.85 - 0.65 * share)[known]
    axis.imshow(grey, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    for mask, colour, wide in (
        (picture.shown, ACCENT, 1.8),
        (picture.found, BLUE, 1.2),
    ):
        outline = binary_closing(np.pad(mask[part], CLOSED), iterations=CLOSED)
        if outline.any():
            axis.contour(
                np.arange(outline.shape[1]) - CLOSED,
                np.arange(outline.shape[0]) - CLOSED,
                outline,
                [0.5],
                colors=colour,
                linewidths=wide,
            )
    title = shorten(picture.title, LONGEST, placeholder="...")
    called = shorten(picture.called, LONGEST, placeholder="...")
    axis.set_title(f"{title}\n{called}", fontsize=8, loc="left", color=INK)


def _part(mask: Mask) -> tuple[slice, slice]:
    """Rows and columns around some pixels; all of them where there are none."""
    if not mask.any():
        return slice(0, mask.shape[0]), slice(0, mask.shape[1])
    spans = [np.flatnonzero(mask.any(axis))[[0, -1]] for axis in (1, 0)]
    extent = max(np.ptp(spans[0]), SHAPE * np.ptp(spans[1]), LEAST_SIDE)
    found = []
    for span, side, wide in zip(
        spans,
        mask.shape,
        (extent, extent / SHAPE),
        strict=True,
    ):
        half = min(AROUND * wide, side) / 2
        middle = np.clip(span.mean(), half, side - half)
        found.append(slice(int(middle - half), int(middle + half) + 1))
    return found[0], found[1]
