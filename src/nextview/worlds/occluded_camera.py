"""A camera without errors in a world: the target as far as it shows, and everything with its owner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import as_line, of_kind, whole
from nextview.cameras.ray_caster import RayCaster, pixel_rays
from nextview.cameras.simulated import LARGEST, SimulatedCamera
from nextview.errors import UsageError
from nextview.observation import Observation, checked_intrinsics, checked_pose, pinhole
from nextview.viewsphere import DISTANCE
from nextview.worlds.scene import Scene

NOTHING, TARGET, OTHER, TABLE_TOP = np.arange(4, dtype=np.uint8)
"""What a pixel shows."""
NEARER = 1e-4
"""How much nearer than the target something has to be to hide it, object radii: the table touches it."""


class OccludedCamera:
    """Looks at the target of a scene; what hides it is cut out, as if it had been told from the target exactly.

    Where nothing hides it, the observations are those of a ``SimulatedCamera`` before the target alone, to the bit.

    Args:
        scene: the world.
        size: side of the square image, pixels.
        distance: at which the unit sphere just fills the image, object radii.

    Raises:
        UsageError: no scene, or no size of an image.
        ObservationError: the camera stands in the object.
    """

    def __init__(self, scene: Scene, size: int = 224, distance: float = DISTANCE) -> None:
        of_kind(scene, Scene, "what is looked at is a Scene")
        self.scene = scene
        self._target = SimulatedCamera(scene.target, size, distance)
        others = [scene.table] if scene.around is None else [scene.table, scene.around]
        self._others = RayCaster([(mesh.vertices, mesh.faces) for mesh in others])
        self._rays = pixel_rays(pinhole(size, distance), (size, size))

    def observe(self, pose: NDArray[np.float64]) -> Observation:
        """Look from a camera-to-world pose, (4, 4), OpenCV axes, object frame, object radii."""
        seen = self._target.observe(pose)
        hidden = self._hidden(seen)
        assert seen.image is not None
        return replace(seen, depth=np.where(hidden, 0, seen.depth), image=np.where(hidden, np.uint8(0), seen.image))

    def visible_share(self, pose: NDArray[np.float64]) -> float:
        """Share of the target's picture from a pose, (4, 4), that nothing hides; 0 if it has none."""
        seen = self._target.observe(pose)
        return 1 - np.count_nonzero(self._hidden(seen)) / seen.visible if seen.visible else 0.0

    def _hidden(self, seen: Observation) -> NDArray[np.bool_]:
        """Pixels of the target alone before which something stands, (H, W)."""
        there = seen.depth > 0
        depth, _ = self._others.cast(
            seen.pose[:3, 3].astype(np.float32), self._rays[there] @ seen.pose[:3, :3].T.astype(np.float32)
        )
        hidden = np.zeros(there.shape, bool)
        hidden[there] = depth < seen.depth[there] - NEARER
        return hidden


class SceneCamera:
    """Shows a whole scene, through any pinhole: depth, and the owner of each pixel.

    Args:
        scene: the world.
        intrinsics: pinhole matrix, (3, 3), pixels, the first pixel's centre at 0.5.
        shape: height and width of the image.

    Raises:
        UsageError: no scene, or no shape of an image.
        ObservationError: a matrix that no pinhole has.
    """

    def __init__(self, scene: Scene, intrinsics: NDArray[np.float64], shape: tuple[int, int]) -> None:
        of_kind(scene, Scene, "what is looked at is a Scene")
        if not (isinstance(shape, tuple | list) and len(shape) == 2):
            raise UsageError(f"the shape of an image is its height and its width, not {as_line(shape)}")
        height, width = (whole(side, "a side of the image", 1, LARGEST) for side in shape)
        intrinsics = checked_intrinsics(intrinsics, (height, width))
        meshes = [scene.target, scene.table] if scene.around is None else [scene.target, scene.table, scene.around]
        self._caster = RayCaster([(mesh.vertices, mesh.faces) for mesh in meshes])
        self._rays = pixel_rays(intrinsics, (height, width))
        self._owners = np.array([TARGET, TABLE_TOP, OTHER, NOTHING])

    def look(self, pose: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """What is there from a camera-to-world pose, (4, 4), OpenCV axes, object frame, object radii.

        Raises:
            ObservationError: it is no pose.

        Returns:
            Depth along the optical axis, (H, W) float32, object radii, 0 = nothing; and NOTHING, TARGET, OTHER or
            TABLE_TOP for each pixel, (H, W) uint8.
        """
        pose = checked_pose(pose)
        rays = self._rays.reshape(-1, 3) @ pose[:3, :3].T.astype(np.float32)
        depth, which = self._caster.cast(pose[:3, 3].astype(np.float32), rays)
        shape = self._rays.shape[:2]
        return np.where(which < 0, np.float32(0), depth).reshape(shape), self._owners[which].reshape(shape)


def visible_shares(scene: Scene, poses: NDArray[np.float64], size: int, distance: float) -> NDArray[np.float64]:
    """Share of the target's picture that nothing hides, from each of some poses, (V, 4, 4); (V,) float64."""
    camera = OccludedCamera(scene, size, distance)
    return np.array([camera.visible_share(pose) for pose in poses])
