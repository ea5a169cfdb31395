"""Scenes in a view store, with the expected visibility and reachability of each view."""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial, reduce

import numpy as np
from numpy.typing import NDArray

from nextview.errors import DatasetError
from nextview.geometry.observation import SceneView
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.viewsphere import ViewSphere
from nextview.sensing.expected_visibility import (
    VISIBILITY_GRID,
    Occupancy,
    SeenScene,
    expected_visibility,
    sight_lines,
)
from nextview.session.episode import Constrain, Visible, unconstrained
from nextview.types import Float, Float32, Index, Mask
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.store import ViewStore
from nextview_lab.worlds.scene import TargetScene
from nextview_lab.worlds.scene_cameras import SHOWS_TARGET, SceneCamera, visible_shares
from nextview_lab.worlds.scene_layout import clutter_level

SCENE_SIDE = 80  # side of the images of the whole scene, pixels
HALF = 2.0  # half their width at the target's centre, object radii
SCENE_UNIT = 2e-4  # unit of their uint16 depth, object radii; the range is 13.1
# side of the image that measures the visible share, pixels, as in the generation of scenes
SHARE_SIZE = 112


def scene_intrinsics(distance: float, side: int = SCENE_SIDE) -> Float:
    """Return the pinhole matrix of the images of a scene.

    Args:
        distance: of the cameras from the target, object radii.
        side: of the images, pixels.

    Returns:
        Matrix, (3, 3) float64, pixels; the centre of the first pixel is at 0.5.
    """
    focal = side / 2 * distance / HALF
    return PinholeCamera.centred(focal, (side, side)).matrix


def render_scene(scene: TargetScene, sphere: ViewSphere) -> dict[str, NDArray]:
    """Render the stored arrays of a scene, except for the views of its target.

    The images contain no sensor errors.

    Args:
        scene: the scene.
        sphere: the viewpoints.

    Returns:
        The arrays by their names in the store.
    """
    camera = SceneCamera(
        scene,
        scene_intrinsics(sphere.distance),
        (SCENE_SIDE, SCENE_SIDE),
    )

    looks = [camera.look(pose) for pose in sphere.poses]
    positions = sphere.poses[:, :3, 3]
    depth = np.rint(np.stack([depth for depth, _ in looks]) / SCENE_UNIT)
    return {
        "scene/depth": depth.clip(max=np.iinfo(np.uint16).max).astype(np.uint16),
        "scene/owner": np.stack([owner for _, owner in looks]),
        "scene/reachable": scene.reachable(positions),
        "measures/visible_share": visible_shares(
            scene,
            sphere.poses,
            SHARE_SIZE,
            sphere.distance,
        ).astype(np.float32),
        "measures/clearance": scene.clearance(positions).astype(np.float32),
    }


@dataclass(frozen=True)
class SceneViews:
    """One scene of a store from all V views.

    Attributes:
        depth: (V, S, S), object radii, 0 = nothing.
        owner: of each pixel: SHOWS_NOTHING, SHOWS_TARGET, SHOWS_OTHER or SHOWS_TABLE, (V, S, S).
        intrinsics: of the camera, pixels, (3, 3).
        poses: camera-to-world, (V, 4, 4).
        reachable: whether a camera can be at each view, (V,).
        visible_share: true visible share of the target, (V,).
        clearance: (V,), object radii.
    """

    depth: Float32
    owner: NDArray[np.uint8]
    intrinsics: Float
    poses: Float
    reachable: Mask
    visible_share: Float32
    clearance: Float32

    def scene_view(self, view: int) -> SceneView:
        """Return one view, in which other objects and the table are not distinguished."""
        return SceneView(
            self.depth[view],
            self.owner[view] == SHOWS_TARGET,
            self.poses[view],
            self.intrinsics,
            True,
        )


def scene_views(store: ViewStore, i: int) -> SceneViews:
    """Read a scene from a store.

    Args:
        store: the view store.
        i: row of the scene.

    Returns:
        The views of the scene.

    Raises:
        DatasetError: the store contains single objects.
    """
    if store.attributes.scene is None:
        raise DatasetError(
            f"{store.path}: holds single objects, no scenes; nextview-lab scenes draws some"
        )
    return SceneViews(
        store.read("scene/depth", i) * np.float32(SCENE_UNIT),
        store.read("scene/owner", i),
        scene_intrinsics(store.sphere.distance, store.attributes.scene),
        store.sphere.poses,
        store.read("scene/reachable", i),
        store.read("measures/visible_share", i),
        store.read("measures/clearance", i),
    )


def sight_of(scenes: "SceneSight | None", objects: Index) -> tuple[Constrain, Visible]:
    """Return the arguments of ``run_episodes`` for scenes.

    Args:
        scenes: the scenes; None for single objects.
        objects: scene of each episode, (E,) int64.

    Returns:
        A function that marks the reachable views of a state, and one that returns the expected
        visible shares.
    """
    if scenes is None:
        return unconstrained, lambda state: np.ones(state.visited.shape)
    return (
        lambda state: replace(
            state,
            reachable=scenes.reachable[objects[state.episodes]],
        ),
        lambda state: scenes.visibility(objects[state.episodes], state.visited),
    )


def scenes_of(p: Predictions) -> "SceneSight | None":
    """Return the scenes of predictions; None if they are of single objects."""
    try:
        store = ViewStore.open(p.store) if p.store else None
    except DatasetError:
        store = None
    if store is not None:
        return SceneSight.of(store, p.names)
    if any(map(clutter_level, p.names)):
        lost = (
            f"there is no view store at {p.store} any more; put it back, or"
            if p.store
            else "name no view store;"
        )
        raise DatasetError(f"these predictions are of scenes, and {lost} predict again")
    return None


@dataclass(frozen=True)
class SceneSight:
    """Reachable views and expected visibility in N scenes of a view store.

    Attributes:
        store: view store of the scenes.
        rows: row of each scene in the store, (N,).
        reachable: whether a camera can be at each view, (N, V).
    """

    store: ViewStore
    rows: Index
    reachable: Mask
    _found: dict[tuple[int, bytes], Float32] = field(default_factory=dict, repr=False)
    _frames: dict[tuple[int, int], tuple[bytes, float]] = field(
        default_factory=dict,
        repr=False,
    )

    @classmethod
    def of(cls, store: ViewStore, names: Sequence[str]) -> "SceneSight | None":
        """Prepare some scenes of a store.

        Args:
            store: the view store.
            names: of the scenes.

        Returns:
            The scenes; None if the store contains single objects.

        Raises:
            DatasetError: a scene is missing in the store.
        """
        if store.attributes.scene is None:
            return None
        rows = store.rows_of(names)
        if (rows < 0).any():
            raise DatasetError(
                f"{store.path}: holds no scene {names[int(rows.argmin())]}"
            )
        return cls(
            store,
            rows,
            np.stack([store.read("scene/reachable", i) for i in rows]),
        )

    def of_scenes(self, kept: Index) -> "SceneSight":
        """Return some of the scenes, by index, possibly repeated."""
        return replace(self, rows=self.rows[kept], reachable=self.reachable[kept])

    def visibility(self, scenes: Index, visited: Mask) -> Float:
        """Return the expected visible share of the target from each view.

        Args:
            scenes: index of each scene, (B,) int64.
            visited: views taken so far, (B, V) bool.

        Returns:
            Shares, (B, V) float64.
        """
        keys = [
            (int(self.rows[scene]), np.packbits(row).tobytes())
            for scene, row in zip(scenes, visited, strict=True)
        ]
        new = {
            key: row
            for key, row in zip(keys, visited, strict=True)
            if key not in self._found
        }

        read = lru_cache(maxsize=1)(partial(scene_views, self.store))
        for key in sorted(new):  # scene by scene, each read once
            frames = (
                self._frame(key[0], int(view), read)
                for view in np.flatnonzero(new[key])
            )
            scene = reduce(SeenScene.and_also, frames, SeenScene.unseen())
            self._found[key] = expected_visibility(
                scene,
                self.store.sphere.poses[:, :3, 3],
            ).astype(np.float32)

        return np.stack([self._found[key] for key in keys]).astype(np.float64)

    def _frame(
        self,
        row: int,
        view: int,
        read: Callable[[int], SceneViews],
    ) -> SeenScene:
        """Return the occupancy after one view; cached in packed form."""
        if (row, view) not in self._frames:
            asked = sight_lines(
                VISIBILITY_GRID,
                self.store.sphere.poses[:, :3, 3].tobytes(),
            ).asked
            seen = SeenScene(Occupancy.unseen(VISIBILITY_GRID, asked)).seen(
                read(row).scene_view(view)
            )
            self._frames[row, view] = (
                zlib.compress(seen.occupancy.cells.tobytes(), 1),
                seen.floor,
            )

        packed, floor = self._frames[row, view]
        cells = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(
            (VISIBILITY_GRID.n,) * 3
        )
        return SeenScene(Occupancy(VISIBILITY_GRID, cells), floor)
