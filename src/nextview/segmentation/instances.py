"""Which pixels of a frame are one thing, and which are of the surfaces that things stand on.

A trained network tells both. A segmentation of your own may tell the things in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from nextview.checks import one_line, plugin_errors
from nextview.errors import ObservationError, UsageError
from nextview.geometry.axes import upright_axes
from nextview.geometry.camera import array_of
from nextview.segmentation.features import features, quarter_turns, shrink, turned
from nextview.segmentation.network import SegmentationNetwork, load_network
from nextview.segmentation.parting import (
    DOUBTFUL_ODDS,
    background_of,
    part,
    sharpen,
    surface_of,
)
from nextview.types import Float, Float32, Index, Mask

NO_LABEL = 255  # of no thing, in many images of labels
WHOLE_IMAGE = 0.99  # share of an image of which nothing is left around a thing


class MeasuredFrame(Protocol):
    """What is used of a ``nextview.sensing.Frame``; see there."""

    @property
    def depth(self) -> Float32:
        """(H, W), metres; 0 where nothing was measured."""

    @property
    def rays(self) -> tuple[Float32, Float32]:
        """Slopes x/z of its columns, (W,), and y/z of its rows, (H,)."""

    @property
    def pose(self) -> Float | None:
        """Camera-to-world, (4, 4), as it was given."""

    @property
    def camera_to_world(self) -> Float:
        """The same; the camera's own axes where none was given."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""


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
        background: pixels that are clearly neither a thing nor a surface, such as walls and the
            sides of bins, (H, W) bool; None where the segmentation does not tell them.
    """

    labels: Index
    surface: Mask | None = None
    pieces: Index | None = None
    background: Mask | None = None


Segmenter = Callable[[Any], Any]
"""From a ``nextview.sensing.Frame`` to a ``Segmentation``, or only to the pixels of each thing,
(N, H, W) bool, or to the number of the thing that each pixel shows, (H, W) int, 0 for none."""


@dataclass(frozen=True, eq=False)
class Instances:
    """The things in a frame.

    Attributes:
        masks: pixels of each thing, (H, W) bool each.
        surface: pixels of what carries things, (H, W) bool.
        background: pixels that are clearly neither, (H, W) bool.
        pieces: see ``Segmentation``.
    """

    masks: tuple[Mask, ...]
    surface: Mask
    background: Mask
    pieces: Index | None = None


class LearnedSegmenter:
    """A trained network as a segmentation.

    >>> LearnedSegmenter()(frame).labels                                        # doctest: +SKIP

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
        self.network = _loaded(card)

    def __reduce__(self) -> tuple[type[LearnedSegmenter], tuple[Any, ...]]:
        """It is pickled as the path of its card."""
        return LearnedSegmenter, (self.card, self.up)

    def __call__(self, frame: MeasuredFrame) -> Segmentation:
        """Return the thing that each pixel shows, and the surfaces.

        Args:
            frame: of a depth camera.
        """
        picture = shrink(frame.depth, frame.rays)
        up = None
        if frame.pose is not None and self.up is not None:
            up = self.up @ frame.camera_to_world[:3, :3]
        quarters = quarter_turns(up)
        upright, up = turned(picture, up, quarters)
        output = self.network(features(upright, up))
        valid = upright.depth > 0
        labels = part(output, valid)
        surface_label = int(labels.max(initial=0)) + 1
        labels[surface_of(output, valid) & (labels == 0)] = surface_label
        labels[background_of(output, valid) & (labels == 0)] = surface_label + 1
        fine = part(output, valid, DOUBTFUL_ODDS)

        labels, fine = (np.rot90(found, -quarters) for found in (labels, fine))
        sharp = sharpen(labels, picture, frame.depth)
        surface = sharp == surface_label
        background = sharp == surface_label + 1
        pieces = sharpen(fine, picture, frame.depth)
        labels = np.where(surface | background, 0, sharp)
        return Segmentation(labels, surface, pieces, background)


@lru_cache(maxsize=8)
def _loaded(card: str | Path | None) -> SegmentationNetwork:
    """A network, opened once."""
    return load_network(card)


def instances_of(
    segmentation: Segmenter | None,
    frame: MeasuredFrame,
    up: ArrayLike | None = None,
) -> Instances:
    """Ask a segmentation for the things in a frame, and for the surfaces.

    Args:
        segmentation: see ``Segmenter``; None for the bundled network, which also tells the surfaces
            where another segmentation does not.
        frame: of a depth camera.
        up: direction against gravity in the world of the frame, (3,); None: it is not known.

    Raises:
        ObservationError: what it returned are no masks or labels of the frame.
        UsageError: it raises.
    """
    learned = LearnedSegmenter(up=up)
    if segmentation is None:
        given = learned(frame)
    else:
        with plugin_errors(lambda said: UsageError(f"the segmentation raised {said}")):
            given = segmentation(frame)
    if not isinstance(given, Segmentation):
        given = Segmentation(given)
    masks = _masks(given.labels, frame)
    if segmentation is not None:
        _check_covered(masks)
    pieces = None if given.pieces is None else _labels(given.pieces, frame)

    if given.surface is None or given.background is None:
        told = learned(frame)
        given = replace(
            given,
            surface=told.surface if given.surface is None else given.surface,
            background=told.background
            if given.background is None
            else given.background,
        )
    surface = _pixels(given.surface, "surface", frame)
    background = _pixels(given.background, "background", frame)
    for mask in masks:
        surface = surface & ~mask
        background = background & ~mask
    return Instances(masks, surface, background, pieces)


def _check_none(labels: Index) -> None:
    """Refuse labels with a usual number other than 0 for no thing.

    Raises:
        ObservationError: there are numbers below 0 beside 0, or 255 on most of the image.
    """
    others = None
    if labels.min() < 0 and (labels == 0).any():
        others = int(labels.min())
    elif 2 * np.count_nonzero(labels == NO_LABEL) > labels.size:
        others = NO_LABEL
    if others is not None:
        raise ObservationError(
            f"the labels of a segmentation are 0 where there is no thing, and these seem to be"
            f" {others} there"
        )


def _check_covered(masks: Sequence[Mask]) -> None:
    """Refuse a thing that is all there is to see: what stands on something leaves it in sight.

    Raises:
        ObservationError: a mask covers the whole image.
    """
    if any(np.mean(mask) > WHOLE_IMAGE for mask in masks):
        raise ObservationError(
            "a mask of the segmentation covers the whole image, as that of the background does:"
            " a thing leaves what is around it in sight"
        )


def _pixels(given: Any, what: str, frame: MeasuredFrame) -> Mask:
    """The surface or the background of a segmentation.

    Raises:
        ObservationError: these are no pixels of the frame.
    """
    values = array_of(given, f"the {what} of a segmentation")
    if values.dtype != bool or values.shape != frame.shape:
        raise ObservationError(
            f"the {what} of a segmentation is (H, W) bool, {frame.shape}, not"
            f" {one_line(f'{values.shape} {values.dtype}')}"
        )
    return values


def _labels(given: Any, frame: MeasuredFrame) -> Index:
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


def _masks(given: Any, frame: MeasuredFrame) -> tuple[Mask, ...]:
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
        _check_none(values)
        return tuple(values == number for number in np.unique(values[values > 0]))
    raise ObservationError(
        "a segmentation returns masks, (N, H, W) bool, or labels, (H, W) int, of the frame,"
        f" {frame.shape}, not {one_line(f'{values.shape} {values.dtype}')}"
    )
