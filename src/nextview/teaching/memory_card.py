"""Combine taught things in a memory, with its card."""

from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace as replace_record

from nextview.files import command
from nextview.recognition.belief import Calibration
from nextview.recognition.model_card import (
    FEATURE_NETWORK,
    ModelCard,
    Symmetry,
    Taught,
    Thing,
    Training,
    find_card,
)
from nextview.teaching.memory_fit import (
    VIEWS_FITTED,
    Fit,
    fit_memory,
    fit_without_features,
    size_evidence,
)
from nextview.teaching.shown_views import ShownThings
from nextview.teaching.thing_sources import ThingSource
from nextview.teaching.thing_views import (
    CONTENT,
    FACES,
    NEAR_SYMMETRIES,
    SYMMETRIES,
    UPRIGHT,
    VERTICES,
)
from nextview.teaching.view_features import Arrays
from nextview.things.memory import AZIMUTHS, Memory
from nextview.things.stored_surfaces import StoredSurfaces
from nextview.things.surface import Surface
from nextview.types import Index

MEMORY_NAME = "memory"  # name of the card in the folder of a memory
Pair = tuple[ThingSource, Arrays]  # a thing and its arrays
PER_THING = ("held_out", "held_out_views", "radii", "pictures")


def fitted(taught: Sequence[Pair], label: Index) -> tuple[Memory, Fit]:
    """Combine things in a memory, and fit to all of them.

    Args:
        taught: the things, sorted by class.
        label: class of each, (T,) int64.

    Returns:
        The memory, and the fit.
    """
    poses = [len(arrays["rotations"]) for _, arrays in taught]
    thing = np.repeat(np.arange(len(taught)), poses)
    stacked = {
        name: np.stack([arrays[name] for _, arrays in taught]) for name in PER_THING
    }
    stacked["radii"] = stacked["radii"][:, 0]
    joint = {
        name: np.concatenate([arrays[name] for _, arrays in taught])
        for name in ("views", "rotations")
    }

    if joint["views"].shape[-1]:
        fit = fit_memory(
            joint["views"],
            thing,
            label,
            *(stacked[name] for name in PER_THING[:3]),
        )
    else:
        fit = fit_without_features(int(label.max()) + 1)

    surfaces = StoredSurfaces.of(
        [_surface_of(source, arrays) for source, arrays in taught]
    )
    memory = Memory(
        thing=thing,
        head=fit.head,
        head_bias=fit.head_bias,
        surfaces=surfaces,
        **joint,
        **stacked,
    )

    return memory, fit


def card_of(
    taught: Sequence[Pair],
    classes: tuple[str, ...],
    label: Index,
    memory: Memory,
    fit: Fit,
    commands: tuple[str, ...],
    sensor: str,
) -> ModelCard:
    """Create the card of a memory, without the hash of its file.

    Args:
        taught: the things.
        classes: names of the classes.
        label: class of each thing, (T,) int64.
        memory: the memory.
        fit: fit to the memory.
        commands: commands that produced the earlier content of the memory.
        sensor: camera that the fits are for.

    Returns:
        The card.
    """
    poses = np.bincount(memory.thing)
    things = tuple(
        Thing(
            source.name,
            str(source.path),
            int(count),
            _symmetries_of(arrays, SYMMETRIES),
            _symmetries_of(arrays, NEAR_SYMMETRIES),
            bool(arrays[UPRIGHT][0]),
            arrays[CONTENT].tobytes().hex() if CONTENT in arrays else None,
        )
        for (source, arrays), count in zip(taught, poses, strict=True)
    )

    features = find_card(FEATURE_NETWORK)
    novelty, usual = (
        tuple(map(tuple, np.round(rows, 4).tolist()))
        for rows in (fit.quantiles, fit.usual)
    )

    return ModelCard(
        MEMORY_NAME,
        "recogniser",
        features.input,
        "0" * 64,
        network=f"memory of {'views' if memory.has_features else 'surfaces'}",
        classes=classes,
        azimuth_bins=AZIMUTHS if memory.has_features else 0,
        calibration=Calibration(
            1.0,
            1.0,
            None,
            fit.correlation,
            tuple(label[memory.thing].tolist()),
        ),
        size=size_evidence(memory.radii, label),
        training=Training(f"{len(taught)} things", commands=commands),
        scores={"held-out views": by_views(fit.accuracy)} if fit.accuracy else {},
        memory=Taught(
            things,
            features.sha256 if memory.has_features else None,
            fit.weight,
            novelty=novelty,
            usual=usual,
            sensor=sensor,
        ),
    ).made_by(command())


def with_scores(card: ModelCard, tested: ShownThings) -> ModelCard:
    """Add the results of tests to a card.

    Args:
        card: card of the memory.
        tested: results of its tests in simulated views.
    """
    scores = dict(card.scores)
    scores["verified by geometry"] = by_views(tested.accuracy)
    return replace_record(card, scores=scores)


def by_views(shares: Sequence[float]) -> dict[str, float]:
    """Shares by the number of views, in the format of cards.

    Args:
        shares: shares after each number of views in VIEWS_FITTED.

    Returns:
        Rounded shares.
    """
    return {
        str(k): round(share, 4) for k, share in zip(VIEWS_FITTED, shares, strict=False)
    }


def _surface_of(source: ThingSource, arrays: Arrays) -> Surface | None:
    """The surface of a thing; None for unknown size."""
    if VERTICES not in arrays:
        return None
    return Surface(source.name, arrays[VERTICES], arrays[FACES])


def _symmetries_of(arrays: Arrays, name: str) -> tuple[Symmetry, ...]:
    """The symmetries of a thing under this name; () for unknown geometry."""
    rows = arrays.get(name, np.zeros((0, 4))).tolist()
    return tuple(Symmetry((x, y, z), int(order)) for x, y, z, order in rows)
