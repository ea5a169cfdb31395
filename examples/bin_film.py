"""A film of a cell that empties a bin: the cell, the last depth image, and what is known."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from panda_film import ACCENT, BACKGROUND, GREY, SIDE, SIZE, scene, text
from PIL import Image, ImageDraw
from scipy import ndimage

from nextview.geometry.viewsphere import look_at_origin
from nextview.scene.scene import Scene

if TYPE_CHECKING:
    from bin_cell import Cell

EVERY = 4  # tenths of a second of simulated time between two frames
RATE = 10  # frames a second of the film
STILL_FRAMES = 8  # of what is known after a look
ROWS = 14  # objects that are listed


class BinFilm:
    """Frames of a cell; nothing is drawn without a file to write them to.

    Args:
        cell: that is filmed, from now on.
        path: GIF; None for no film.
    """

    def __init__(self, cell: Cell, path: Path | None) -> None:
        self.cell = cell
        self.path = path
        self.frames: list[Image.Image] = []
        self.beside = Image.new("RGB", (SIDE, SIZE[1]), BACKGROUND)
        self._count = 0
        self._begin = cell.seconds
        self._pose = look_at_origin(np.radians(33), np.radians(-38), 1.35)
        self._pose[:3, 3] += [0.38, -0.16, 0.2]
        if path is not None:
            cell.watch = self.passed

    def passed(self) -> None:
        """A tenth of a second of simulated time has passed."""
        self._count += 1
        if self._count % EVERY == 0:
            self.show()

    def show(self) -> None:
        """Draw a frame."""
        frame = Image.new("RGB", (SIZE[0] + SIDE, SIZE[1]), BACKGROUND)
        frame.paste(scene(self.cell.things(), self._pose), (0, 0))
        frame.paste(self.beside, (SIZE[0], 0))
        text(frame, (14, 12), f"{self.cell.seconds - self._begin:5.1f} s", 15)
        self.frames.append(frame)

    def looked(self, known: Scene) -> None:
        """Show what is known after a look for a while."""
        if self.path is None:
            return
        self.beside = panel(known)
        self.show()
        self.frames += [self.frames[-1]] * STILL_FRAMES

    def save(self) -> None:
        """Write the film."""
        if self.path is None or not self.frames:
            return
        palette = self.frames[-1].quantize(128)
        frames = [
            frame.quantize(palette=palette, dither=Image.Dither.NONE)
            for frame in [*self.frames, *[self.frames[-1]] * (2 * RATE)]
        ]
        frames[0].save(
            self.path,
            save_all=True,
            append_images=frames[1:],
            duration=1000 // RATE,
            loop=0,
            optimize=True,
        )


def panel(known: Scene) -> Image.Image:
    """The last depth image with the outlines of the objects, and their names."""
    picture = Image.new("RGB", (SIDE, SIZE[1]), BACKGROUND)
    frame = known.frames[-1]
    number = len(known.frames) - 1
    text(picture, (8, 12), f"view {number + 1}: depth", 13)
    near, far = np.quantile(frame.depth[frame.depth > 0], [0.02, 0.98])
    shade = np.where(frame.depth > 0, (far - frame.depth) / (far - near), 0).clip(0, 1)
    colours = (255 * matplotlib.colormaps["viridis"](shade)[..., :3]).astype(np.uint8)
    for one in known.objects:
        if number in one.pixels:
            mask = one.pixels[number]
            rim = ndimage.binary_dilation(mask, iterations=3) & ~mask
            colours[rim] = (255, 255, 255) if one.confident else (120, 120, 120)
    width = SIDE - 16
    height = width * frame.shape[0] // frame.shape[1]
    picture.paste(Image.fromarray(colours).resize((width, height)), (8, 34))

    draw = ImageDraw.Draw(picture)
    for row, one in enumerate(known.objects[:ROWS]):
        y = 46 + height + 20 * row
        draw.rectangle((8, y + 2, 18, y + 12), ACCENT if one.confident else GREY)
        doubt = "" if one.confident else " ?"
        text(picture, (24, y), one.name.replace("_", " ") + doubt, 12)
    return picture
