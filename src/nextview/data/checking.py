"""Whether a store holds what it says."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np

from nextview.arguments import takes_paths
from nextview.cloud import POINTS, visible_points
from nextview.data.correspond import ARRAY, correspondence
from nextview.data.lock import only_one, writing
from nextview.data.pool import each
from nextview.data.store import DEPTH_UNIT, DIGEST, PENDING, POINT_UNIT, ChunkError, ViewStore, digest
from nextview.errors import DatasetError
from nextview.measures.measured_view import MeasuredView
from nextview.measures.registry import MEASURES


@takes_paths("path")
def check(
    path: Path, repair: bool = False, workers: int | None = None, scheduler: str | None = None
) -> Iterator[tuple[str, str | None]]:
    """Read every rendered object and hold its arrays against each other.

    Image and depth must show the same silhouette, points lie where the depth says (if no sensor was in between),
    measures that need no mesh and correspondence, where they are made, must be those of depth and points. Every chunk
    must be there and have its checksum, and the object's arrays and name must have the digest that they were rendered
    with, where the store keeps one. An object whose status is lost is damaged too.

    Args:
        path: the store.
        repair: ``mend`` the arrays, and take damaged objects for not rendered, so that the next nextview render makes
            them anew.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler, to use instead.

    Yields:
        (name, None) for each sound object, (name, what is wrong with it) for a damaged one.

    Raises:
        DatasetError: there is no store, it lacks an array, or, when repairing, another run is writing it or it cannot
            be written.
    """
    if repair:
        mend(path)
    store = ViewStore.open(path)
    for name in store.rendered:
        store.array(name)  # says what is wrong
        if not store.sound(name):
            raise DatasetError(f"{path}: the group of {name} cannot be opened; nextview check {path} --repair makes it")
    with only_one(path) if repair else nullcontext(), writing(path) if repair else nullcontext():
        items = [int(i) for i in np.flatnonzero(store.done)]
        for i, how in store.lost.items():
            if repair:
                store.mark(i, PENDING)
            yield store.names[i], how
        for i, problem in each(partial(_check_object, path.absolute()), items, workers, scheduler):
            if problem is not None and repair:
                store.mark(i, PENDING)
            yield store.names[i], None if problem is None else f"{problem}"


@takes_paths("path")
def mend(path: Path) -> None:
    """Make the arrays that rendering fills and that are missing or cannot be opened; chunks that are there are kept.

    Raises:
        DatasetError: there is no store, another run is writing it, or it cannot be written.
    """
    store = ViewStore.open(path)
    with only_one(path), writing(path):
        for name in (*store.rendered, DIGEST):
            if not store.sound(name) and (name != DIGEST or store.holds(name)):
                store.add(name)


def _check_object(path: Path, i: int) -> str | None:
    store = ViewStore.open(path)
    arrays = {}
    measures = [name for name in MEASURES if name in store.measures]
    added = [*(f"measures/{name}" for name in measures if f"measures/{name}" not in store.rendered), ARRAY, DIGEST]
    for name in (*store.rendered, *added):
        if name in added and not (store.holds(name) and store.has(name, i)):
            continue  # not made yet
        try:
            arrays[name] = store.chunk(name, i)
        except ChunkError as error:
            return f"{name} {error}"
    image, depth = arrays["image"], arrays["depth"]
    if ((image > 0) != (depth > 0)).any():
        return "image and depth do not show the same silhouette"
    if not 0 < arrays["radius"] < np.inf:
        return "radius is not a positive number"
    poses, intrinsics = store.sphere.poses, store.intrinsics
    views = [MeasuredView(d * DEPTH_UNIT, pose, intrinsics) for d, pose in zip(depth, poses, strict=True)]
    for name in measures:
        if MEASURES[name].needs == "mesh":
            continue  # it is there, and has its checksum; the mesh is not at hand
        true = np.array([MEASURES[name](view) for view in views], np.float32)
        if not np.allclose(true, arrays.get(f"measures/{name}", true), rtol=1e-6, atol=1e-9):
            return f"{name} is not that of the depth"
    expected = [
        visible_points(d * np.float32(DEPTH_UNIT), pose, store.intrinsics)
        for d, pose in zip(depth, store.sphere.poses, strict=True)
    ]
    # Half a step of the depth, along a ray that is at most a little longer, and half a step of each coordinate. Errors
    # of a setup take a view from near its pose, which is not kept: there the points have their checksum alone.
    exact, apart = store.group.attrs.get("sensor") is None, DEPTH_UNIT + POINT_UNIT
    if exact and not np.allclose(np.clip(expected, -1, 1), arrays["points"] * POINT_UNIT, rtol=0, atol=apart):
        return "points do not lie where the depth says"
    if ARRAY in arrays:
        true = correspondence(store.points(i), store.depth(i), store.sphere.poses, store.intrinsics)
        # One point seen or not seen: rounding of the last digit may differ between machines.
        if not np.allclose(true, arrays[ARRAY], rtol=0, atol=1.5 / POINTS):
            return "correspondence is not that of points and depth"
    if DIGEST in arrays and (arrays[DIGEST] != digest(store.names[i], arrays)).any():
        return "image, depth, points, radius and name are not together what was rendered"
    return None
