"""Whether a store holds what it says."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np

from nextview.cloud import POINTS, visible_points
from nextview.data.correspond import ARRAY, correspondence
from nextview.data.lock import only_one
from nextview.data.pool import each
from nextview.data.rendering import writing
from nextview.data.store import DEPTH_UNIT, PENDING, POINT_UNIT, RENDERED, ViewStore
from nextview.measures.registry import MEASURES


def check(
    path: Path, repair: bool = False, workers: int | None = None, scheduler: str | None = None
) -> Iterator[tuple[str, str | None]]:
    """Read every rendered object and hold its arrays against each other.

    Image and depth must show the same silhouette, points must lie where the depth says, measures and correspondence,
    where they are made, must be those of depth and points. Chunks written with a checksum must have it.

    Args:
        path: the store.
        repair: take damaged objects for not rendered, so that the next nextview render makes them anew.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler, to use instead.

    Yields:
        (name, None) for each sound object, (name, what is wrong with it) for a damaged one.

    Raises:
        DatasetError: there is no store, it lacks an array, or, when repairing, another run is writing it or it cannot
            be written.
    """
    store = ViewStore.open(path)
    for name in RENDERED:
        store.array(name)
    items = [int(i) for i in np.flatnonzero(store.done)]
    with only_one(path) if repair else nullcontext(), writing(path) if repair else nullcontext():
        for i, problem in each(partial(_check_object, path.absolute()), items, workers, scheduler):
            if problem is not None and repair:
                store.group["status"][i] = PENDING
            yield store.names[i], None if problem is None else f"{problem}"


def _check_object(path: Path, i: int) -> str | None:
    store = ViewStore.open(path)
    arrays = {}
    measures = [name for name in MEASURES if name in store.measures]
    computed = [ARRAY] if ARRAY in store.group else []
    for name in ("image", "depth", "points", "radius", *(f"measures/{name}" for name in measures), *computed):
        try:
            arrays[name] = store.array(name)[i]
        except Exception as error:  # a damaged chunk raises whatever its codec makes of it
            return f"{name} cannot be read ({error})"
    image, depth = arrays["image"], arrays["depth"]
    if ((image > 0) != (depth > 0)).any():
        return "image and depth do not show the same silhouette"
    if not 0 < arrays["radius"] < np.inf:
        return "radius is not a positive number"
    for name in measures:
        stored = arrays[f"measures/{name}"]
        true = np.array([MEASURES[name](d * DEPTH_UNIT) for d in depth], np.float32)
        if not (np.isnan(stored).all() or np.allclose(true, stored, rtol=1e-6, atol=0)):
            return f"{name} is not that of the depth"
    expected = [
        visible_points(d * np.float32(DEPTH_UNIT), pose, store.intrinsics)
        for d, pose in zip(depth, store.sphere.poses, strict=True)
    ]
    # Half a step of the depth, along a ray that is at most a little longer, and half a step of each coordinate.
    if not np.allclose(expected, arrays["points"] * POINT_UNIT, rtol=0, atol=DEPTH_UNIT + POINT_UNIT):
        return "points do not lie where the depth says"
    if computed and np.isfinite(arrays[ARRAY]).any():
        true = correspondence(store.points(i), store.depth(i), store.sphere.poses, store.intrinsics)
        # One point seen or not seen: rounding of the last digit may differ between machines.
        if not np.allclose(true, arrays[ARRAY], rtol=0, atol=1.5 / POINTS):
            return "correspondence is not that of points and depth"
    return None
