"""Which pixels of a frame are one thing: by a trained network, or by a segmentation of your own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nextview.checks import one_line
from nextview.errors import ObservationError
from nextview.geometry.observation import array_of
from nextview.segmentation.features import features, shrink
from nextview.segmentation.network import load_network
from nextview.segmentation.parting import DOUBTFUL_ODDS, part, sharpen, surface_of
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import upright_axes
from nextview.types import Index, Mask


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What a segmentation says of a frame.

    Attributes:
        labels: number of the thing that each pixel shows, (H, W) int; 0 for none.
        surface: pixels of what carries things, such as floors, tables and the bottoms of bins,
            (H, W) bool; None where the segmentation does not tell them.
        pieces: number of the piece that each pixel belongs to, (H, W) int; 0 for none. A piece
            belongs to one thing without doubt; a thing may be several. None where the segmentation
            has no doubts.
    """

    labels: Index
    surface: Mask | None = None
    pieces: Index | None = None


Segmenter = Callable[[Frame], Any]
"""From a frame to a ``Segmentation``, or only to the pixels of each thing, (N, H, W) bool, or to
the number of the thing that each pixel shows, (H, W) int, 0 for none."""


@dataclass(frozen=True, eq=False)
class Instances:
    """The things in a frame.

    Attributes:
        masks: pixels of each thing, (H, W) bool each.
        surface: pixels of what carries things, (H, W) bool; None where that is not told.
        pieces: see ``Segmentation``.
    """

    masks: tuple[Mask, ...]
    surface: Mask | None = None
    pieces: Index | None = None


class LearnedSegmenter:
    """A trained network as a segmentation.

    >>> scene = nextview.Scene("ycb", segmentation=LearnedSegmenter())          # doctest: +SKIP

    Args:
        card: path of the network's card; None for the bundled network.
        up: direction against gravity in the world of the frames, (3,); None: it is not known, as
            always for frames without a pose.

    Raises:
        ModelError: card or network are missing or damaged.
    """

    def __init__(
        self,
        card: str | Path | None = None,
        up: ArrayLike | None = (0.0, 0.0, 1.0),
    ) -> None:
        self.card = card
        self.up = None if up is None else upright_axes(up)[2]
        self.network = load_network(card)

    def __reduce__(self) -> tuple[type[LearnedSegmenter], tuple[Any, ...]]:
        """It is pickled as the path of its card."""
        return LearnedSegmenter, (self.card, self.up)

    def __call__(self, frame: Frame) -> Segmentation:
        """Return the thing that each pixel shows, and the surfaces.

        Args:
            frame: of a depth camera.
        """
        picture = shrink(frame.depth, frame.rays)
        up = None
        if frame.pose is not None and self.up is not None:
            up = self.up @ frame.camera_to_world[:3, :3]
        output = self.network(features(picture, up))
        valid = picture.depth > 0
        labels = part(output, valid)

        surface_label = int(labels.max(initial=0)) + 1
        labels[surface_of(output, valid) & (labels == 0)] = surface_label
        sharp = sharpen(labels, picture, frame.depth)
        surface = sharp == surface_label
        pieces = sharpen(part(output, valid, DOUBTFUL_ODDS), picture, frame.depth)
        return Segmentation(np.where(surface, 0, sharp), surface, pieces)


def instances_of(segmentation: Segmenter, frame: Frame) -> Instances:
    """Ask a segmentation for the things in a frame.

    Args:
        segmentation: see ``Segmenter``.
        frame: of a depth camera.

    Returns:
        The pixels of each thing, and of the surfaces if they are told.

    Raises:
        ObservationError: what it returned are no masks or labels of the frame.
    """
    given = segmentation(frame)
    if not isinstance(given, Segmentation):
        return Instances(_masks(given, frame))

    masks = _masks(given.labels, frame)
    pieces = None if given.pieces is None else _labels(given.pieces, frame)
    if given.surface is None:
        return Instances(masks, pieces=pieces)
    surface = array_of(given.surface, "the surface of a segmentation")
    if surface.dtype != bool or surface.shape != frame.shape:
        raise ObservationError(
            f"the surface of a segmentation is (H, W) bool, {frame.shape}, not"
            f" {one_line(f'{surface.shape} {surface.dtype}')}"
        )
    for mask in masks:
        surface = surface & ~mask
    return Instances(masks, surface, pieces)


def _labels(given: Any, frame: Frame) -> Index:
    """The pieces of a segmentation.

    Raises:
        ObservationError: they are no labels of the frame.
    """
    values = array_of(given, "the pieces of a segmentation")
    if not np.issubdtype(values.dtype, np.integer) or values.shape != frame.shape:
        raise ObservationError(
            f"the pieces of a segmentation are (H, W) int, {frame.shape}, not"
            f" {one_line(f'{values.shape} {values.dtype}')}"
        )
    return values


def _masks(given: Any, frame: Frame) -> tuple[Mask, ...]:
    """The pixels of each thing, by masks or labels.

    Raises:
        ObservationError: these are neither.
    """
    if isinstance(given, Sequence) and not isinstance(given, str) and len(given):
        given = np.stack([array_of(mask, "a mask") for mask in given])
    values = array_of(given, "a segmentation")
    if values.size == 0:
        return ()
    if values.dtype == bool and values.shape[1:] == frame.shape:
        return tuple(values)
    if np.issubdtype(values.dtype, np.integer) and values.shape == frame.shape:
        return tuple(values == number for number in np.unique(values[values > 0]))
    raise ObservationError(
        "a segmentation returns masks, (N, H, W) bool, or labels, (H, W) int, of the frame,"
        f" {frame.shape}, not {one_line(f'{values.shape} {values.dtype}')}"
    )
