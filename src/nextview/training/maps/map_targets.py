"""What the map networks learn: one value for every view of every object that has any."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.errors import PredictionsError, UsageError
from nextview.measures.confidence_map import confidence_maps
from nextview.measures.depth_entropy import normalise_per_object
from nextview.measures.map_names import CONFIDENCE


@dataclass(frozen=True)
class Target:
    """Values of all views of a store's objects.

    Attributes:
        values: (N, V) float32, 0 .. 1.
        there: which objects have values, (N,) bool.
    """

    values: NDArray[np.float32]
    there: NDArray[np.bool_]

    def known(self, objects: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of some objects that have values."""
        return objects[self.there[objects]]


def target_of(measure: str, store: ViewStore, predictions: Predictions | None = None) -> Target:
    """A measure of a store's views, scaled to 0 .. 1 over each object's; the confidence is that already.

    Args:
        measure: one that the store holds, or "confidence".
        store: the views.
        predictions: for the confidence, of the recogniser that is confident.

    Raises:
        DatasetError: the store lacks the measure.
        PredictionsError: see ``confidence_target``.
        UsageError: predictions for another measure, or none for the confidence.
    """
    if (measure == CONFIDENCE) != (predictions is not None):
        raise UsageError(
            "a map of the confidence is learned from predictions: give those of the recogniser"
            if predictions is None
            else f"a map of {measure} is learned from the store alone: predictions are for a map of the {CONFIDENCE}"
        )
    if predictions is not None:
        return confidence_target(store, predictions)
    return Target(normalise_per_object(store.measure(measure)), store.done)


def confidence_target(store: ViewStore, predictions: Predictions) -> Target:
    """The recogniser's confidence where it is right.

    A recogniser is too sure of what it was trained on, and another one prefers other views: validate on objects that
    the recogniser of use has not seen. Objects without predictions, and those right from no view, have no values.

    Raises:
        PredictionsError: the predictions are of none of the store's objects, or of other views.
    """
    row = {name: i for i, name in enumerate(store.names)}
    here = np.array([row.get(name, -1) for name in predictions.names])
    if (here < 0).all() or predictions.sphere != store.sphere:
        raise PredictionsError(f"these predictions are not of the views of {store.path}")
    values = np.zeros((len(store), len(store.sphere)), np.float32)
    values[here[here >= 0]] = confidence_maps(predictions.logits, predictions.labels)[here >= 0]
    return Target(values, values.any(1) & store.done)
