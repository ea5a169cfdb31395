"""Maps that no model predicts: the true measures around every view, for oracles and for judging what is predicted."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nextview.benchmark.stored import stored_rows
from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.errors import DatasetError
from nextview.measures.confidence_map import confidence_maps
from nextview.measures.depth_entropy import normalise_per_object
from nextview.measures.map_names import CONFIDENCE, map_name, measure_of

TRUE = "true-"
"""How the names of true maps begin."""


def true_lem(p: Predictions) -> NDArray[np.float32]:
    """Local windows of the true entropy map, (N, V, R, 3)."""
    return normalise_per_object(p.depth_entropy)[:, p.sphere.windows]


def true_lcm(p: Predictions) -> NDArray[np.float32]:
    """Local windows of the recogniser's confidence, 0 where it is wrong (section 4.1.3), (N, V, R, 3)."""
    return confidence_maps(p.logits, p.labels)[:, p.sphere.windows]


IN_PREDICTIONS: dict[str, Callable[[Predictions], NDArray]] = {"depth_entropy": true_lem, CONFIDENCE: true_lcm}
"""Measures whose true maps the predictions themselves tell; those of others stand in the store that they were made
from."""


def true_map(p: Predictions, name: str) -> NDArray[np.float32]:
    """Local windows of the true map of that name, (N, V, R, 3), 0 .. 1.

    Raises:
        EntryError: neither the predictions nor their store tell it.
    """
    measure = measure_of(name)
    if measure in IN_PREDICTIONS:
        return IN_PREDICTIONS[measure](p)
    return normalise_per_object(true_measure(p, measure))[:, p.sphere.windows]


def known_maps(p: Predictions) -> tuple[str, ...]:
    """Names of the maps whose truth can be told."""
    return tuple(map(map_name, dict.fromkeys((*IN_PREDICTIONS, *stored_measures(p.store)))))


def stored_measures(store: str) -> tuple[str, ...]:
    """Names of the measures in a store; none where there is no store."""
    try:
        return tuple(ViewStore.open(store).measures) if store else ()
    except DatasetError:
        return ()


def true_measure(p: Predictions, measure: str) -> NDArray[np.float32]:
    """A measure of the views of some predictions, from the store that they were made from, (N, V) float32.

    Raises:
        EntryError: the store is not there, not the same any more, or lacks the measure.
    """
    return p.depth_entropy if measure == "depth_entropy" else stored_rows(p, f"measures/{measure}")
