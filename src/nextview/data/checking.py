"""Whether a store holds what it says."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np

from nextview.data.pool import each
from nextview.data.store import DEPTH_UNIT, POINT_UNIT, ViewStore, opened, writing
from nextview.errors import DatasetError
from nextview.geometry.depth import visible_points


def check(
    path: Path, repair: bool = False, workers: int | None = None, scheduler: str | None = None
) -> Iterator[tuple[str, str | None]]:
    """Read every rendered object, and hold its arrays against each other.

    Every chunk is there and has its checksum, image and depth show the same silhouette, and points lie where the depth
    puts them (if no sensor was in between).

    ``repair`` counts damaged objects as not rendered, so that the next nextview render makes them anew.

    Yields:
        (name, None) for each sound object, (name, what is wrong with it) for a damaged one.
    """
    store = ViewStore.open(path)
    for name in store.rendered:
        store.array(name)  # says what is wrong
    with writing(path) if repair else nullcontext():
        items = np.flatnonzero(store.done).tolist()
        for i, problem in each(partial(_check_object, Path(path).absolute()), items, workers, scheduler):
            if problem is not None and repair:
                store.forget(i)
            yield store.names[i], None if problem is None else f"{problem}"


def incomplete(path: Path) -> dict[str, int]:
    """The arrays that were added to a store and lack some of the rendered objects, and how many objects they hold."""
    store = ViewStore.open(path)
    done = store.done
    held = {name: int((store.held(name) & done).sum()) for name in store.added}
    return {name: n for name, n in held.items() if n < done.sum()}


def _check_object(path: Path, i: int) -> str | None:
    store = opened(path)
    names = [*store.rendered, *(name for name in store.added if store.has(name, i))]
    try:
        arrays = {name: store.read(name, i) for name in names}
    except DatasetError as error:
        return str(error)
    image, depth = arrays["image"], arrays["depth"]
    if ((image > 0) != (depth > 0)).any():
        return "image and depth do not show the same silhouette"
    if not 0 < arrays["radius"] < np.inf:
        return "radius is not a positive number"
    if store.attributes.sensor is not None:  # its pose is not the one that is kept
        return None
    views = zip(depth, store.sphere.poses, strict=True)
    points = [visible_points(d * np.float32(DEPTH_UNIT), pose, store.intrinsics) for d, pose in views]
    # Half a step of the depth, along a ray that is at most a little longer, and half a step of each coordinate.
    if not np.allclose(np.clip(points, -1, 1), arrays["points"] * POINT_UNIT, rtol=0, atol=DEPTH_UNIT + POINT_UNIT):
        return "points do not lie where the depth says"
    return None
