"""Which pixels of a frame are one thing: by a trained network, or by a segmentation of your own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nextview.checks import one_line
from nextview.errors import ObservationError
from nextview.geometry.observation import array_of
from nextview.segmentation.features import features, shrink
from nextview.segmentation.network import load_network
from nextview.segmentation.parting import part, sharpen
from nextview.sensing.frame import Frame
from nextview.types import Index, Mask

Segmenter = Callable[[Frame], Any]
"""From a frame to the pixels of each thing, (N, H, W) bool, or to the number of the thing that each
pixel shows, (H, W) int, 0 for none."""


class LearnedSegmenter:
    """A trained network as a segmentation.

    >>> own = LearnedSegmenter("models/segmentation.json")                      # doctest: +SKIP
    >>> scene = nextview.Scene("ycb", segmentation=own)                         # doctest: +SKIP

    Args:
        card: path of the network's card.

    Raises:
        ModelError: card or network are missing or damaged.
    """

    def __init__(self, card: str | Path) -> None:
        self.network = load_network(card)

    def __call__(self, frame: Frame) -> Index:
        """Return the thing of each pixel from 1 on, 0 for none, (H, W) int64.

        Args:
            frame: of a depth camera. With a pose, gravity points along -z of the world.
        """
        picture = shrink(frame.depth, frame.rays)
        up = None if frame.pose is None else frame.camera_to_world[2, :3]
        output = self.network(features(picture, up))
        labels = part(output, picture.depth > 0)
        return sharpen(labels, picture, frame.depth)


def masks_of(segmentation: Segmenter, frame: Frame) -> list[Mask]:
    """Ask a segmentation for the things in a frame.

    Args:
        segmentation: see ``Segmenter``.
        frame: of a depth camera.

    Returns:
        The pixels of each thing, (H, W) bool each.

    Raises:
        ObservationError: what it returned are no masks or labels of the frame.
    """
    given = segmentation(frame)
    if isinstance(given, Sequence) and not isinstance(given, str) and len(given):
        given = np.stack([array_of(mask, "a mask") for mask in given])
    values = array_of(given, "a segmentation")
    if values.size == 0:
        return []
    if values.dtype == bool and values.shape[1:] == frame.shape:
        return list(values)
    if np.issubdtype(values.dtype, np.integer) and values.shape == frame.shape:
        return [values == number for number in np.unique(values[values > 0])]
    raise ObservationError(
        "a segmentation returns masks, (N, H, W) bool, or labels, (H, W) int, of the frame,"
        f" {frame.shape}, not {one_line(f'{values.shape} {values.dtype}')}"
    )
