"""The network that parts a frame into things: its file, its card, and what its outputs mean."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from nextview.errors import ModelError
from nextview.files import HashText, read_record
from nextview.runtime import check_end, open_onnx, run_onnx
from nextview.segmentation.features import PICTURE_CHANNELS, SIDE_MULTIPLE
from nextview.types import Float32

BUNDLED_NETWORK = Path(__file__).parent / "bundled" / "segmentation.json"
PICTURE_INPUT = "features"
PICTURE_OUTPUT = "output"
OUTPUT_CLASSES = (
    "background",
    "surface",
    "thing",
)  # log-odds of each, the first outputs
# rows and columns from a pixel to those of which the last outputs say whether they are of its thing
AFFINITY_STEPS = (
    (0, 1),
    (1, 0),
    (0, 4),
    (4, 0),
    (4, 4),
    (4, -4),
    (0, 10),
    (10, 0),
    (10, 10),
    (10, -10),
    (0, 26),
    (26, 0),
)
OUTPUTS = len(OUTPUT_CLASSES) + len(AFFINITY_STEPS)
AFFINITY_OUTPUTS = slice(len(OUTPUT_CLASSES), OUTPUTS)


class SegmentationCard(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    tag_field="kind",
    tag="segmentation",
):
    """The card of a segmentation network: a JSON file beside its ONNX file.

    The outputs are, in this order: the log-odds of each class; and for each step the log-odds that
    the pixel so many rows and columns on is of the same thing, if both are of things.

    Attributes:
        name: of the network.
        sha256: of the ONNX file.
        channels: of its input, see ``features.features``.
        classes: in the order of the first outputs.
        affinity_steps: rows and columns to the other pixel of each pair.
        network: in words.
        data: what it was trained on, in words.
        recipe: settings of its training.
        commands: that led to it.
        scores: on frames that it was not trained on, by what these are.
        largest_difference_to_torch: of its outputs on such frames.
        held_out: meshes that it was not trained on.
        note: further text.
    """

    name: str
    sha256: HashText
    channels: int
    classes: tuple[str, ...]
    affinity_steps: tuple[tuple[int, int], ...]
    network: str = ""
    data: str = ""
    recipe: dict[str, Any] = {}
    commands: tuple[str, ...] = ()
    scores: dict[str, dict[str, float]] = {}
    largest_difference_to_torch: float | None = None
    held_out: tuple[str, ...] = ()
    note: str = ""

    @property
    def meaning(self) -> tuple[Any, ...]:
        """What a network has to have in common with this version of the package."""
        return self.channels, self.classes, self.affinity_steps


def new_card(name: str, sha256: str) -> SegmentationCard:
    """Return the card of a network of this version, as yet without its origin.

    Args:
        name: of the network.
        sha256: of its file.
    """
    return SegmentationCard(
        name,
        sha256,
        PICTURE_CHANNELS,
        OUTPUT_CLASSES,
        AFFINITY_STEPS,
    )


def read_segmentation_card(path: Path) -> SegmentationCard:
    """Read a card.

    Args:
        path: of the card.

    Raises:
        ModelError: it is missing, damaged, or of a network with other inputs or outputs.
    """
    card = read_record(path, SegmentationCard, "the card of a segmentation network")
    if card.meaning != new_card("", card.sha256).meaning:
        raise ModelError(
            f"{path}: its network has other inputs or outputs than this version takes; train and"
            " export it anew"
        )
    return card


class SegmentationNetwork:
    """Says of each pixel what it is, and which others are of the same thing.

    Attributes:
        card: what its card says.
    """

    def __init__(self, card: Path) -> None:
        """Open a network.

        Args:
            card: path of its card; its file has the same name and ends in .onnx.

        Raises:
            ModelError: card or file are missing or damaged, or do not belong together.
        """
        self.card = read_segmentation_card(card)
        self.path = card.with_suffix(".onnx")
        self._session = open_onnx(self.path, self.card.sha256)
        for ends, name, size in (
            (self._session.get_inputs(), PICTURE_INPUT, PICTURE_CHANNELS),
            (self._session.get_outputs(), PICTURE_OUTPUT, OUTPUTS),
        ):
            if [end.name for end in ends] != [name]:
                there = ", ".join(end.name for end in ends) or "nothing"
                raise ModelError(
                    f"{self.path}: has {there} where it should have {name}"
                )
            check_end(self.path, ends[0], "tensor(float)", (size, None, None))

    def __call__(self, features: Float32) -> Float32:
        """Return the outputs for one picture.

        Args:
            features: see ``features.features``, (C, h, w).

        Returns:
            The outputs, (15, h, w) float32, see ``SegmentationCard``.

        Raises:
            ModelError: the network fails.
        """
        _, height, width = features.shape
        sides = ((0, 0), (0, -height % SIDE_MULTIPLE), (0, -width % SIDE_MULTIPLE))
        padded = np.pad(features, sides)[None].astype(np.float32, copy=False)
        found = run_onnx(self.path, self._session, [PICTURE_OUTPUT], padded)
        return found[0][0, :, :height, :width]


def load_network(path: str | Path | None = None) -> SegmentationNetwork:
    """Open a segmentation network.

    Args:
        path: of its card; None for the bundled one.

    Raises:
        ModelError: see ``SegmentationNetwork``.
    """
    return SegmentationNetwork(BUNDLED_NETWORK if path is None else Path(path))
