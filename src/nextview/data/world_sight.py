"""What a robot in the worlds of a store would expect to see from each view, whichever views it has taken."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.data.world_views import WorldViews, world_views
from nextview.episode import Visible, unconstrained
from nextview.errors import DatasetError
from nextview.occupancy import Occupancy, SeenScene, expected_visibility
from nextview.occupancy.expected_visibility import GRID, shown_in, sight_lines
from nextview.policies.base import EpisodeState
from nextview.worlds import level_of

Constrain = Callable[[EpisodeState], EpisodeState]


def all_shows(state: EpisodeState) -> NDArray[np.float64]:
    """Nothing stands around any object."""
    return np.ones(state.visited.shape)


def sight_of(worlds: WorldSight | None, objects: NDArray[np.int64]) -> tuple[Constrain, Visible]:
    """What ``run_episodes`` needs of worlds: where cameras can be, and what is expected to show.

    Args:
        worlds: None where the objects stand alone.
        objects: the world of each episode, (E,).
    """
    if worlds is None:
        return unconstrained, all_shows
    return (
        lambda state: replace(state, reachable=worlds.reachable[objects[state.episodes]]),
        lambda state: worlds.visibility(objects[state.episodes], state.visited),
    )


def worlds_of(p: Predictions) -> WorldSight | None:
    """The worlds that predictions are of; None if they are of single objects, whose store need not be there.

    Raises:
        DatasetError: the store is not there and the names are those of worlds: without it nobody knows what hides them
            and where a camera cannot be. Or it lacks one of them, or is damaged.
    """
    try:
        store = ViewStore.open(p.store) if p.store else None
    except DatasetError:
        store = None
    if store is not None:
        return WorldSight.of(store, p.names)
    if any(map(level_of, p.names)):
        lost = f"there is no view store at {p.store} any more; put it back, or" if p.store else "name no view store;"
        raise DatasetError(f"these predictions are of worlds, and {lost} predict again")
    return None


@dataclass(frozen=True)
class WorldSight:
    """Where cameras can be in N worlds, and what is expected to show after some views. What was found once is kept.

    Attributes:
        store: of worlds.
        rows: of the worlds in the store, (N,).
        reachable: whether a camera can be brought to a view, (N, V) bool.
    """

    store: ViewStore
    rows: NDArray[np.int64]
    reachable: NDArray[np.bool_]
    _found: dict[tuple[int, bytes], NDArray[np.float32]] = field(default_factory=dict, repr=False, compare=False)
    _frames: dict[tuple[int, int], tuple[bytes, float]] = field(default_factory=dict, repr=False, compare=False)
    _shown: dict[tuple[int, int], float] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, store: ViewStore, names: Sequence[str]) -> WorldSight | None:
        """Of some of a store's objects; None if it holds no worlds.

        Raises:
            DatasetError: it does not hold one of the objects, or is damaged.
        """
        if "scene" not in store.group.attrs:
            return None
        row = {name: i for i, name in enumerate(store.names)}
        lost = [name for name in names if name not in row]
        if lost:
            raise DatasetError(f"{store.path}: holds no world {lost[0]}")
        rows = np.array([row[name] for name in names])
        return cls(store, rows, np.stack([store.read("scene/reachable", i) for i in rows]))

    def of_worlds(self, kept: NDArray[np.int64]) -> WorldSight:
        """Some of the worlds, by their index; also the same one several times."""
        return replace(self, rows=self.rows[kept], reachable=self.reachable[kept])

    def visibility(self, worlds: NDArray[np.int64], visited: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Share of the target that is expected to show from each view.

        Args:
            worlds: of the episodes, (B,).
            visited: the views whose frames are known, (B, V).

        Returns:
            (B, V) float64, 0 to 1.
        """
        keys = [(int(self.rows[world]), np.packbits(row).tobytes()) for world, row in zip(worlds, visited, strict=True)]
        new = {key: row for key, row in zip(keys, visited, strict=True) if key not in self._found}
        views: tuple[int, WorldViews] | None = None
        for key in sorted(new):  # world by world, each read once
            scene = SeenScene.unseen()
            for view in np.flatnonzero(new[key]):
                if (key[0], int(view)) not in self._frames and (views is None or views[0] != key[0]):
                    views = key[0], world_views(self.store, key[0])
                scene = scene.and_also(self._frame(key[0], int(view), views))
            self._found[key] = expected_visibility(scene, self.store.sphere.poses[:, :3, 3]).expected.astype(np.float32)
        return np.stack([self._found[key] for key in keys]).astype(np.float64)

    def shown(self, worlds: NDArray[np.int64], views: NDArray[np.int64]) -> NDArray[np.float64]:
        """Share of the target that shows in some views of worlds, as far as each frame alone can tell, (B,) each."""
        keys = [(int(self.rows[world]), int(view)) for world, view in zip(worlds, views, strict=True)]
        read: tuple[int, WorldViews] | None = None
        for row, view in sorted({*keys} - {*self._shown}):
            if (row, view) not in self._frames and (read is None or read[0] != row):
                read = row, world_views(self.store, row)
            self._shown[row, view] = shown_in(self._frame(row, view, read), self.store.sphere.poses[view, :3, 3])
        return np.array([self._shown[key] for key in keys])

    def all_shown(self) -> NDArray[np.float64]:
        """The same of all views of all worlds, (N, V)."""
        n, v = self.reachable.shape
        return self.shown(np.repeat(np.arange(n), v), np.tile(np.arange(v), n)).reshape(n, v)

    def _frame(self, row: int, view: int, views: tuple[int, WorldViews] | None) -> SeenScene:
        """What the frame from one view says alone of what lies on a line of sight; kept packed, a hundredth or so."""
        if (row, view) not in self._frames:
            assert views is not None
            asked = sight_lines(GRID, self.store.sphere.poses[:, :3, 3].tobytes()).asked
            seen = SeenScene(Occupancy.unseen(GRID, asked)).seen(views[1].scene_view(view))
            self._frames[row, view] = zlib.compress(seen.occupancy.cells.tobytes(), 1), seen.floor
        packed, floor = self._frames[row, view]
        cells = np.frombuffer(zlib.decompress(packed), np.uint8).reshape((GRID.n,) * 3)
        return SeenScene(Occupancy(GRID, cells), floor)
