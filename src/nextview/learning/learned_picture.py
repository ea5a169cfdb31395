"""One picture of what was learned: how sure it will be, and which things it will confuse."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from nextview.learning.memory_fit import VIEWS, Fit

PAIRS, THINGS = 4, 12
INK, QUIET, BAR = "#1d1d1f", "#8a8a8e", "#2f6fde"


def draw_learned(path: Path, pictures: Mapping[str, NDArray[np.uint8]], fit: Fit) -> None:
    """Write it: the things, the share named right by the number of views, and the pairs that are confused most."""
    names = list(pictures)
    figure = Figure(figsize=(11, 6), dpi=120, facecolor="white")
    page = figure.add_axes((0, 0, 1, 1))  # one for all pictures: axes take longer than what is in them
    page.set_axis_off()
    figure.text(0.03, 0.94, f"{len(names)} things learned", size=17, color=INK, weight="bold")
    shown = names[:: max(1, -(-len(names) // THINGS))][:THINGS]
    for k, name in enumerate(shown):
        _picture(page, (0.03 + (k % 6) * 0.105, 0.66 - k // 6 * 0.26, 0.095, 0.19), pictures[name], name)
    axes = figure.add_axes((0.73, 0.47, 0.24, 0.38))
    bars = axes.bar([str(k) for k in VIEWS], [100 * a for a in fit.accuracy], color=BAR, width=0.6)
    axes.bar_label(bars, fmt="%.0f", color=INK, size=11)
    axes.set_ylim(0, 110)
    axes.set_yticks([])
    for side in ("top", "left", "right"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set_color(QUIET)
    axes.tick_params(axis="x", length=0, colors=INK)
    axes.set_title("named right, % of cases", size=10, color=INK, loc="left")
    axes.set_xlabel("views", size=10, color=INK)
    pairs = [(names[a], names[b], share) for a, b, share in fit.confused[:PAIRS]]
    heading = "confused most, share of the cases after two views" if pairs else "no two things are confused"
    figure.text(0.03, 0.32, heading, size=11, color=INK, weight="bold")
    for k, (a, b, share) in enumerate(pairs):
        left = 0.03 + k * 0.245
        _picture(page, (left, 0.08, 0.095, 0.19), pictures[a], a)
        _picture(page, (left + 0.1, 0.08, 0.095, 0.19), pictures[b], b)
        figure.text(left + 0.0975, 0.275, f"{share:.0%}", size=10, color=QUIET, ha="center")
    page.set(xlim=(0, 1), ylim=(0, 1), aspect="auto")
    figure.savefig(path)


def _picture(page: Axes, place: tuple[float, float, float, float], picture: NDArray[np.uint8], name: str) -> None:
    left, bottom, width, _ = place
    height = width * 11 / 6
    shade = np.where(picture > 0, 60 + 0.7 * picture.astype(float), 255)
    extent = (left, left + width, bottom, bottom + height)
    page.imshow(shade, cmap="gray", vmin=0, vmax=255, interpolation="bilinear", extent=extent)
    below = left + width / 2, bottom - 0.025
    page.text(*below, name.replace("_", " ")[:18], size=7.5, color=INK, ha="center", va="center")
