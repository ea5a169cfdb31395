"""Common style of all figures: narrow, so that they can be read on a phone."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from nextview.figures.fonts import fit_fonts
from nextview.types import Floats

INK = "#1f2933"
GREY = "#8a949e"
FAINT = "#d5dbe1"
# colours of all figures; for policies see ``figures.POLICY_COLOURS``
BLUE = "#0b5fa5"
LIGHT_BLUE = "#38a0d9"
ACCENT = "#d1495b"
# colours of rendered images: page, support surface, objects
PAPER = "#fafaf8"
GROUND = "#f5efe4"
WOOD = "#e0ab6c"
UNKNOWN_COLOUR = 201, 210, 218  # for missing values
FIGURE_STYLE = {
    "font.family": "sans-serif",
    "font.sans-serif": ["Helvetica Neue", "Arial", "Liberation Sans", "DejaVu Sans"],
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.7,
    "svg.fonttype": "none",
    "svg.hashsalt": "nextview",
}


class PlainFigure(Figure):
    """A figure that shows names literally, in fonts that have their characters."""

    def draw(self, renderer: Any) -> None:
        """Choose fonts for all texts, then draw."""
        texts = self.findobj(Text)
        for text in texts:
            text.set_parse_math(False)
        fit_fonts(texts)
        super().draw(renderer)


def new_figure(width: float, height: float) -> tuple[Figure, Axes]:
    """Create a figure with one pair of axes and few ticks at round numbers.

    Args:
        width: of the figure, inches.
        height: of the figure, inches.

    Returns:
        The figure and its axes.
    """
    with matplotlib.rc_context(FIGURE_STYLE):
        figure = PlainFigure((width, height))
        axes = figure.add_subplot()
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        return figure, axes


def legend(axes: Axes, title: str | None = None) -> None:
    """Draw a legend in two columns below the axes.

    Args:
        axes: the axes.
        title: of the legend; None for none.
    """
    with matplotlib.rc_context(FIGURE_STYLE):
        axes.legend(
            loc="upper center",
            bbox_to_anchor=(0.45, -0.17),
            ncols=2,
            title=title,
            title_fontsize=8.5,
        )


def rgb(colour: str) -> tuple[int, int, int]:
    """Convert a colour to three integers from 0 to 255."""
    red, green, blue = (round(255 * part) for part in matplotlib.colors.to_rgb(colour))
    return red, green, blue


def heat(values: Floats) -> NDArray[np.uint8]:
    """Map values to the colours of viridis, lowest to highest, (...) to (..., 3); NaN is grey."""
    known = np.isfinite(values)
    low, high = (
        (values[known].min(), values[known].max()) if known.any() else (0.0, 1.0)
    )
    scaled = np.where(known, values - low, 0.0) / (high - low if high > low else 1.0)
    colours = (255 * matplotlib.colormaps["viridis"](scaled)[..., :3] + 0.5).astype(
        np.uint8
    )
    return np.where(known[..., None], colours, np.array(UNKNOWN_COLOUR, np.uint8))


def to_png(figure: Figure, path: Path) -> None:
    """Write a figure to a PNG file.

    Args:
        figure: the figure.
        path: of the file.
    """
    with matplotlib.rc_context(FIGURE_STYLE):
        figure.savefig(
            path,
            dpi=160,
            facecolor="white",
            bbox_inches="tight",
            pad_inches=0.1,
        )
