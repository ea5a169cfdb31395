"""Combine taught things in a memory, with its card."""

from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace as replace_record

from nextview.files import command
from nextview.recognition.belief import Calibration
from nextview.recognition.model_card import (
    ModelCard,
    Symmetry,
    Taught,
    Thing,
    Training,
)
from nextview.recognition.network_input import InputSpec
from nextview.teaching.shown_views import VIEWS_SHOWN, ShownThings
from nextview.teaching.sizes import size_evidence
from nextview.teaching.thing_sources import ThingSource
from nextview.teaching.thing_views import (
    CONTENT,
    FACES,
    NEAR_SYMMETRIES,
    SYMMETRIES,
    UPRIGHT,
    VERTICES,
    Arrays,
)
from nextview.things.memory import Memory
from nextview.things.stored_surfaces import StoredSurfaces
from nextview.things.surface import Surface
from nextview.types import Index

MEMORY_NAME = "memory"  # name of the card in the folder of a memory
Pair = tuple[ThingSource, Arrays]  # a thing and its arrays
PER_THING = ("rotations", "radii", "pictures")
INPUT = InputSpec("geometry", 112)  # cards have one; a memory takes the depth itself


def memory_of(taught: Sequence[Pair]) -> Memory:
    """Combine things in a memory.

    Args:
        taught: the things, sorted by class.

    Returns:
        The memory.
    """
    joint = {
        name: np.concatenate([arrays[name] for _, arrays in taught])
        for name in PER_THING
    }
    surfaces = StoredSurfaces.of(
        [
            Surface(source.name, arrays[VERTICES], arrays[FACES])
            for source, arrays in taught
        ]
    )
    return Memory(surfaces=surfaces, **joint)


def card_of(
    taught: Sequence[Pair],
    classes: tuple[str, ...],
    label: Index,
    memory: Memory,
    commands: tuple[str, ...],
    sensor: str,
) -> ModelCard:
    """Create the card of a memory, without the hash of its file.

    Args:
        taught: the things.
        classes: names of the classes.
        label: class of each thing, (T,) int64.
        memory: the memory.
        commands: commands that produced the earlier content of the memory.
        sensor: camera of the test.

    Returns:
        The card.
    """
    things = tuple(
        Thing(
            source.name,
            str(source.path),
            _symmetries_of(arrays, SYMMETRIES),
            _symmetries_of(arrays, NEAR_SYMMETRIES),
            bool(arrays[UPRIGHT][0]),
            arrays[CONTENT].tobytes().hex() if CONTENT in arrays else None,
        )
        for source, arrays in taught
    )

    return ModelCard(
        MEMORY_NAME,
        "recogniser",
        INPUT,
        "0" * 64,
        network="memory of surfaces",
        classes=classes,
        calibration=Calibration(1.0, 1.0, hypotheses=tuple(label.tolist())),
        size=size_evidence(memory.radii, label),
        training=Training(f"{len(taught)} things", commands=commands),
        memory=Taught(things, sensor=sensor),
    ).made_by(command())


def with_scores(card: ModelCard, tested: ShownThings) -> ModelCard:
    """Add the results of tests to a card.

    Args:
        card: card of the memory.
        tested: results of its tests in simulated views.
    """
    right = {
        str(views): round(share, 4)
        for views, share in zip(VIEWS_SHOWN, tested.accuracy, strict=False)
    }
    return replace_record(card, scores={"verified by geometry": right})


def _symmetries_of(arrays: Arrays, name: str) -> tuple[Symmetry, ...]:
    """The symmetries of a thing under this name."""
    return tuple(
        Symmetry((x, y, z), int(order)) for x, y, z, order in arrays[name].tolist()
    )
