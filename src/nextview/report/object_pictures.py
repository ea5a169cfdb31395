"""What the objects of an episode look like, from the view store they were rendered into: pictures, and points."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.data.world_sight import WorldSight
from nextview.data.world_views import WorldViews, world_views
from nextview.errors import DatasetError, ResultsError
from nextview.shading import headlight
from nextview.worlds import OTHER, TARGET

CLOUD = 1500
"""Points of an object in the viewer."""
AROUND = 4500
"""Points of the things around it."""
THINNED = 0.04, 0.09
"""Side of the cubes, object radii, in each of which one point is kept: of a target, and of the things around it."""
PICTURE = 112
"""Side of a view's picture, pixels."""


@dataclass(frozen=True)
class Pictures:
    """What the objects look like, from the store they were rendered into.

    Attributes:
        store: None if there are no pictures.
        why_not: a sentence that says why there are none; empty if there are.
    """

    store: ViewStore | None
    why_not: str = ""

    @classmethod
    def of(cls, predictions: Predictions, store: Path | None = None) -> Pictures:
        """Pictures of the objects of some predictions.

        Args:
            predictions: they name the store that they were made from, and hold the depth-entropy of each of its views,
                by which it is known again.
            store: take this one instead, as it is.

        Raises:
            DatasetError: the store that was given cannot be read.
            ResultsError: it holds none of the objects, or other views of them.
        """
        if store is not None:
            given = ViewStore.open(store)
            if given.sphere != predictions.sphere or not set(given.names) & set(predictions.names):
                raise ResultsError(f"{store}: holds no views of these objects from these viewpoints")
            return cls(given)
        remedy = "give it with --store"
        if not predictions.store:
            return cls(None, f"No pictures: the predictions do not name the view store they were made from; {remedy}.")
        try:
            named = ViewStore.open(predictions.store)
            row = {name: i for i, name in enumerate(named.names)}
            rows = [row.get(name, -1) for name in predictions.names]
            same = named.sphere == predictions.sphere and -1 not in rows
            same = same and np.array_equal(named.measure()[rows], predictions.depth_entropy)
        except DatasetError:
            return cls(None, f"No pictures: there is no view store at {predictions.store} any more; {remedy}.")
        if not same:
            return cls(None, f"No pictures: the view store {predictions.store} has changed since; {remedy}.")
        return cls(named)

    def row(self, name: str) -> int | None:
        """Where an object is in the store."""
        if self.store is None or name not in self.store.names:
            return None
        return self.store.names.index(name)

    def cloud(self, name: str) -> str | None:
        """Points of all views together, (CLOUD, 3) int8 in 1/127 radii, base64."""
        row = self.row(name)
        if row is None or self.store is None:
            return None
        world = _world(self.store, row)
        if world is not None:
            return _bytes(_thinned(world, TARGET))
        points = self.store.points(row).reshape(-1, 3)
        return _bytes(points[np.random.default_rng(0).choice(len(points), CLOUD, replace=False)])

    def world(self, name: str) -> dict[str, Any] | None:
        """What stands around an object; None if it stands alone, or there are no pictures.

        Returns:
            things: points of all that may hide it, (n, 3) int8 in 1/127 of the distance of the views, base64; shows:
            share of the object that shows from each view; unreachable: views to which no camera can be brought; scale:
            an object radius, in that distance.
        """
        row = self.row(name)
        world = _world(self.store, row) if row is not None and self.store is not None else None
        if world is None or self.store is None:
            return None
        scale = 1 / self.store.sphere.distance
        return {
            "things": _bytes(scale * _thinned(world, OTHER)),
            "shows": world.visible_share.round(3).tolist(),
            "unreachable": np.flatnonzero(~world.reachable).tolist(),
            "scale": round(scale, 4),
        }

    def shown(self, name: str, views: list[int]) -> NDArray[np.float64] | None:
        """Share of an object that shows in some views, as far as each frame alone can tell; None as for ``world``."""
        worlds = WorldSight.of(self.store, [name]) if self.store is not None and self.row(name) is not None else None
        return None if worlds is None else worlds.shown(np.zeros(len(views), np.int64), np.array(views))

    def views(self, name: str, views: list[int]) -> dict[int, str]:
        """Shaded images of some views, as data URIs."""
        row = self.row(name)
        if row is None or self.store is None:
            return {}
        world = _world(self.store, row)
        images = self.store.image(row) if world is None else _scenes(world)
        return {view: _data_uri(images[view]) for view in views}


OWNERS = np.array([[255, 255, 255], [11, 95, 165], [209, 73, 91], [225, 225, 225]])
"""Colours of nothing, the target, other things and the table."""


def _world(store: ViewStore, row: int) -> WorldViews | None:
    """That of a row; None in a store of single objects."""
    return world_views(store, row) if "scene" in store.group.attrs else None


def _scenes(world: WorldViews) -> NDArray[np.uint8]:
    """A world as it looks from all views, the target told from all else by its colour, (V, S, S, 3) uint8."""
    shade = np.stack([headlight(depth, world.intrinsics) for depth in world.depth])[..., None] / 255
    return np.where(world.owner[..., None] > 0, OWNERS[world.owner] * (0.35 + 0.65 * shade), 255).astype(np.uint8)


def _data_uri(image: NDArray[np.uint8]) -> str:
    file = BytesIO()
    Image.fromarray(image).resize((PICTURE, PICTURE), Image.Resampling.LANCZOS).save(file, "WEBP", quality=70)
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()


def _thinned(world: WorldViews, owner: np.uint8) -> NDArray[np.float64]:
    """Points of what is seen of the target, or of the things around it, evenly spread, (n, 3) in object radii."""
    view, row, column = np.nonzero(world.owner == owner)
    z = world.depth[view, row, column].astype(np.float64)
    k = world.intrinsics
    seen = np.stack([(column + 0.5 - k[0, 2]) * z / k[0, 0], (row + 0.5 - k[1, 2]) * z / k[1, 1], z], 1)
    points = np.einsum("nij,nj->ni", world.poses[view, :3, :3], seen) + world.poses[view, :3, 3]
    most, side = (CLOUD, THINNED[0]) if owner == TARGET else (AROUND, THINNED[1])
    kept = np.unique(np.floor(points / side).astype(np.int64), axis=0, return_index=True)[1]
    if len(kept) > most:
        kept = np.random.default_rng(0).choice(kept, most, replace=False)
    return points[kept]


def _bytes(points: NDArray[np.floating]) -> str:
    return base64.b64encode(np.rint(127 * points.clip(-1, 1)).astype(np.int8).tobytes()).decode()
