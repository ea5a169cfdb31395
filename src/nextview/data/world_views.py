"""What a store keeps of worlds beside the views of their targets: so that whoever plans in them needs no meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.data.store import ViewStore
from nextview.errors import DatasetError
from nextview.observation import SceneView
from nextview.viewsphere import ViewSphere
from nextview.worlds.occluded_camera import TARGET, SceneCamera, visible_shares
from nextview.worlds.scene import Scene

SIDE = 80
"""Of the pictures of the whole scene, pixels."""
HALF = 2.0
"""They show so many object radii to each side of the target's centre."""
SCENE_UNIT = 2e-4
"""Their depth is stored as uint16 in steps of this many object radii: up to 13.1."""
SHARE_SIZE = 112
"""Side of the picture in which the share that shows is measured, pixels; as when the world was drawn."""


def scene_intrinsics(distance: float, side: int = SIDE) -> NDArray[np.float64]:
    """Pinhole matrix of the pictures of a scene, (3, 3), pixels; the first pixel's centre is at 0.5."""
    focal = side / 2 * distance / HALF
    return np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1.0]])


def render_scene(scene: Scene, sphere: ViewSphere) -> dict[str, NDArray]:
    """All that is kept of a world beside its target's views, without errors of a sensor, by the names of the arrays."""
    camera = SceneCamera(scene, scene_intrinsics(sphere.distance), (SIDE, SIDE))
    looks = [camera.look(pose) for pose in sphere.poses]
    positions = sphere.poses[:, :3, 3]
    depth = np.rint(np.stack([depth for depth, _ in looks]) / SCENE_UNIT)
    return {
        "scene/depth": depth.clip(max=np.iinfo(np.uint16).max).astype(np.uint16),
        "scene/owner": np.stack([owner for _, owner in looks]),
        "scene/reachable": scene.reachable(positions),
        "measures/visible_share": visible_shares(scene, sphere.poses, SHARE_SIZE, sphere.distance).astype(np.float32),
        "measures/clearance": scene.clearance(positions).astype(np.float32),
    }


@dataclass(frozen=True)
class WorldViews:
    """One world of a store, as it is from all V views.

    Attributes:
        depth: of the whole scene, along the optical axis, (V, S, S) float32, object radii, 0 = nothing.
        owner: NOTHING, TARGET, OTHER or TABLE_TOP of ``nextview.worlds`` for each pixel, (V, S, S) uint8.
        intrinsics: pinhole matrix of these, (3, 3) float64, pixels; the first pixel's centre is at 0.5.
        poses: camera-to-world, (V, 4, 4) float64, OpenCV axes, object frame, object radii.
        reachable: whether a camera can be brought there, (V,) bool.
        visible_share: of the target's picture, (V,) float32, 0 to 1: the truth, for oracles and for learning.
        clearance: distance of the camera from the nearest thing, (V,) float32, object radii.
    """

    depth: NDArray[np.float32]
    owner: NDArray[np.uint8]
    intrinsics: NDArray[np.float64]
    poses: NDArray[np.float64]
    reachable: NDArray[np.bool_]
    visible_share: NDArray[np.float32]
    clearance: NDArray[np.float32]

    def scene_view(self, view: int) -> SceneView:
        """What a camera sees from there: things and table alike are no target."""
        return SceneView(self.depth[view], self.owner[view] == TARGET, self.poses[view], self.intrinsics, True)


def world_views(store: ViewStore, i: int) -> WorldViews:
    """World i of a store that was rendered of worlds.

    Raises:
        DatasetError: it was not, or an array is damaged.
    """
    if "scene" not in store.group.attrs:
        raise DatasetError(f"{store.path}: holds single objects, no worlds; nextview worlds draws some")
    return WorldViews(
        store.read("scene/depth", i) * np.float32(SCENE_UNIT),
        store.read("scene/owner", i),
        scene_intrinsics(store.sphere.distance, store.group.attrs["scene"]),
        store.sphere.poses,
        store.read("scene/reachable", i),
        store.read("measures/visible_share", i),
        store.read("measures/clearance", i),
    )
