"""True measures and true maps, from predictions and their view store."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nextview.errors import DatasetError
from nextview.recognition.map_names import CONFIDENCE, map_name, measure_of
from nextview.types import Float32
from nextview_lab.data.measures import confidence_maps, normalise_per_object
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.store import ViewStore
from nextview_lab.errors import EntryError

TRUE = "true-"  # prefix of the names of true maps
IN_PREDICTIONS: dict[
    str,
    Callable[[Predictions], NDArray],
] = {  # (N, V); others: in the store
    "depth_entropy": lambda p: normalise_per_object(p.depth_entropy),
    # 0 where the recogniser is wrong (section 4.1.3)
    CONFIDENCE: lambda p: confidence_maps(p.logits, p.labels),
}


def true_map(p: Predictions, name: str) -> Float32:
    """Return the local windows of a true map.

    Args:
        p: the predictions.
        name: of the map.

    Returns:
        Windows of all views, (N, V, rings, 3) float32, 0 to 1.
    """
    measure = measure_of(name)
    known = IN_PREDICTIONS.get(measure)
    values = (
        normalise_per_object(stored_rows(p, f"measures/{measure}"))
        if known is None
        else known(p)
    )
    return values[:, p.sphere.windows]


def known_maps(p: Predictions) -> tuple[str, ...]:
    """Return the names of the maps whose true values are known."""
    try:
        stored = tuple(ViewStore.open(p.store).measures) if p.store else ()
    except DatasetError:
        stored = ()
    return tuple(map(map_name, dict.fromkeys((*IN_PREDICTIONS, *stored))))


def true_measure(p: Predictions, measure: str) -> Float32:
    """Return a measure of the views of predictions.

    Args:
        p: the predictions.
        measure: name of the measure.

    Returns:
        Values, (N, V) float32.

    Raises:
        EntryError: the view store is missing or does not match.
    """
    return (
        p.depth_entropy
        if measure == "depth_entropy"
        else stored_rows(p, f"measures/{measure}")
    )


def stored_rows(p: Predictions, name: str) -> NDArray:
    """Read an array of the view store for the objects of predictions.

    Args:
        p: the predictions.
        name: of the array.

    Returns:
        Its rows, (N, ...).

    Raises:
        EntryError: the view store is missing or does not match.
    """
    if not p.store:
        raise EntryError(
            "these predictions do not say which view store they were made from, so they lack "
            + name
        )

    try:
        store = ViewStore.open(p.store)
        store.array(name)
        objects = store.rows_of(p.names)
        if (objects < 0).any():
            raise EntryError(
                f"{p.store}: holds no object {p.names[objects.argmin()]}, for which {name} is"
                " needed"
            )
        if not np.array_equal(
            np.array([store.read("measures/depth_entropy", i) for i in objects]),
            p.depth_entropy,
        ):
            raise EntryError(
                f"{p.store}: holds other views than those that these predictions were made from"
            )
        return np.array([store.read(name, i) for i in objects])
    except DatasetError as error:
        raise EntryError(str(error)) from error
