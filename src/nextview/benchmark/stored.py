"""What the view store behind predictions holds of their objects: true measures of views, and plans of policies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.errors import DatasetError, EntryError


def stored_rows(p: Predictions, name: str) -> NDArray:
    """Rows of one of the store's arrays for the objects of predictions, (N, ...).

    Raises:
        EntryError: it is not known which store they were made from, or it is not there, lacks the array, or holds other
            views now.
    """
    if not p.store:
        raise EntryError("these predictions do not say which view store they were made from, so they lack " + name)
    try:
        store = ViewStore.open(p.store)
        store.array(name)
        row = {stored: i for i, stored in enumerate(store.names)}
        objects = [row.get(wanted, -1) for wanted in p.names]
        if -1 in objects:
            raise EntryError(f"{p.store}: holds no object {p.names[objects.index(-1)]}, for which {name} is needed")
        entropy = np.array([store.read("measures/depth_entropy", i) for i in objects])
        if not np.array_equal(entropy, p.depth_entropy):
            raise EntryError(f"{p.store}: holds other views than those that these predictions were made from")
        return np.array([store.read(name, i) for i in objects])
    except DatasetError as error:
        raise EntryError(str(error)) from error
