"""Summary picture of the learned things: their accuracy and the confused pairs."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from nextview.teaching.shown_views import VIEWS_SHOWN

PAGE_WIDTH = 11.0  # inches
PICTURE_WIDTH = 1.05  # width and height, inches
PICTURE_GAP = 0.11  # between pictures, inches
LINE = 0.22  # height of a name below a picture, inches
PICTURE_MARGIN = 0.33
# grid of things beside the bars
THING_COLUMNS = 6
THING_ROWS = 2
ALL_COLUMNS = 9  # columns of things below the bars
ROW = PICTURE_WIDTH + LINE + PICTURE_GAP
TITLE_HEIGHT = 0.75
MOST_THINGS_SHOWN = 120  # largest number of things; more are thinned evenly
MOST_PAIRS = 4
LONGEST_LABEL = 18  # letters
PIXELS_PER_INCH = 120
PICTURE_INK = "#1d1d1f"
QUIET = "#8a8a8e"
BAR = "#2f6fde"

ThingPictures = Mapping[str, NDArray[np.uint8]]
Pairs = Sequence[tuple[str, str, float]]  # two things, and the share of the cases


def draw_learned(
    path: Path,
    pictures: ThingPictures,
    accuracy: Sequence[float],
    confused: Pairs,
) -> None:
    """Draw the things, the accuracy by the number of views, and the confused pairs.

    The height of the picture follows its content.

    Args:
        path: path of the PNG file.
        pictures: picture of each thing, by its name, (64, 64) uint8; 0 for background.
        accuracy: share of correct names after each number of views; empty if none was tested.
        confused: pairs that are confused, the most frequent first.
    """
    shown = _even_choice(list(pictures))
    pairs = confused[:MOST_PAIRS]
    rows = max(THING_ROWS, 1 + _place(len(shown) - 1)[0])
    pairs_height = LINE + (LINE + ROW if pairs else 0)
    height = TITLE_HEIGHT + rows * ROW + pairs_height + PICTURE_MARGIN

    figure = Figure(
        figsize=(PAGE_WIDTH, height),
        dpi=PIXELS_PER_INCH,
        facecolor="white",
    )
    # one for all pictures: creating axes takes longer than drawing them
    page = figure.add_axes((0, 0, 1, 1))
    page.set_axis_off()
    page.set(xlim=(0, PAGE_WIDTH), ylim=(height, 0))  # inches from the top left corner
    _draw_things(page, pictures, shown)
    if accuracy:
        _draw_bars(figure, accuracy, height)
    if accuracy and len(pictures) > 1:
        _draw_pairs(page, pictures, pairs, TITLE_HEIGHT + rows * ROW + LINE)
    # imshow changes the limits
    page.set(xlim=(0, PAGE_WIDTH), ylim=(height, 0), aspect="auto")
    figure.savefig(path)


def _even_choice(names: list[str]) -> list[str]:
    """All names, or MOST_THINGS_SHOWN evenly spaced ones."""
    if len(names) <= MOST_THINGS_SHOWN:
        return names
    return [
        names[k * len(names) // MOST_THINGS_SHOWN] for k in range(MOST_THINGS_SHOWN)
    ]


def _draw_things(page: Axes, pictures: ThingPictures, shown: list[str]) -> None:
    title = (
        "1 thing learned" if len(pictures) == 1 else f"{len(pictures)} things learned"
    )
    page.text(PICTURE_MARGIN, 0.45, title, size=17, color=PICTURE_INK, weight="bold")

    if len(shown) < len(pictures):
        page.text(
            PICTURE_MARGIN,
            0.66,
            f"{len(shown)} of them, evenly chosen:",
            size=9,
            color=QUIET,
        )

    for k, name in enumerate(shown):
        row, column = _place(k)
        left = PICTURE_MARGIN + column * (PICTURE_WIDTH + PICTURE_GAP)
        _draw_picture(page, left, TITLE_HEIGHT + row * ROW, pictures[name], name)


def _place(k: int) -> tuple[int, int]:
    """Row and column of a thing, by its number: the rows below the bars are longer."""
    beside = THING_COLUMNS * THING_ROWS
    if k < beside:
        return divmod(k, THING_COLUMNS)
    row, column = divmod(k - beside, ALL_COLUMNS)
    return THING_ROWS + row, column


def _draw_bars(figure: Figure, accuracy: Sequence[float], height: float) -> None:
    left = PICTURE_MARGIN + THING_COLUMNS * (PICTURE_WIDTH + PICTURE_GAP) + 0.4
    size = THING_ROWS * ROW - 2 * LINE - 0.5
    bottom = height - TITLE_HEIGHT - 0.3 - size
    width = PAGE_WIDTH - PICTURE_MARGIN - left
    axes = figure.add_axes(
        (left / PAGE_WIDTH, bottom / height, width / PAGE_WIDTH, size / height)
    )

    views = [str(k) for k in VIEWS_SHOWN[: len(accuracy)]]
    bars = axes.bar(views, [100 * a for a in accuracy], color=BAR, width=0.6)
    axes.bar_label(bars, fmt="%.0f", color=PICTURE_INK, size=11)
    axes.set_ylim(0, 110)
    axes.set_yticks([])
    for side in ("top", "left", "right"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set_color(QUIET)
    axes.tick_params(axis="x", length=0, colors=PICTURE_INK)
    axes.set_title("named right, % of cases", size=10, color=PICTURE_INK, loc="left")
    axes.set_xlabel("views", size=10, color=PICTURE_INK)


def _draw_pairs(
    page: Axes,
    pictures: ThingPictures,
    pairs: Pairs,
    top: float,
) -> None:
    heading = (
        "confused most, share of the cases after two views"
        if pairs
        else "no two things are confused"
    )
    page.text(PICTURE_MARGIN, top, heading, size=11, color=PICTURE_INK, weight="bold")

    each = (PAGE_WIDTH - 2 * PICTURE_MARGIN + PICTURE_GAP) / MOST_PAIRS
    for k, (first, second, share) in enumerate(pairs):
        left = PICTURE_MARGIN + k * each
        _draw_picture(page, left, top + 1.6 * LINE, pictures[first], first)
        _draw_picture(
            page,
            left + PICTURE_WIDTH + PICTURE_GAP,
            top + 1.6 * LINE,
            pictures[second],
            second,
        )
        page.text(
            left + PICTURE_WIDTH + PICTURE_GAP / 2,
            top + 1.3 * LINE,
            f"{share:.0%}",
            size=10,
            color=QUIET,
            ha="center",
        )


def _draw_picture(
    page: Axes,
    left: float,
    top: float,
    picture: NDArray[np.uint8],
    name: str,
) -> None:
    """A small picture with its name below, at a position in inches."""
    shade = np.where(picture > 0, 60 + 0.7 * picture.astype(float), 255)
    extent = (left, left + PICTURE_WIDTH, top + PICTURE_WIDTH, top)
    page.imshow(
        shade,
        cmap="gray",
        vmin=0,
        vmax=255,
        interpolation="bilinear",
        extent=extent,
    )

    words = name.replace("_", " ")
    short = words if len(words) <= LONGEST_LABEL else f"{words[: LONGEST_LABEL - 3]}..."
    middle = left + PICTURE_WIDTH / 2
    page.text(
        middle,
        top + PICTURE_WIDTH + LINE / 2,
        short,
        size=7.5,
        color=PICTURE_INK,
        ha="center",
        va="center",
    )
