"""Cameras in front of the target of a scene, of a whole scene, and in a room."""

from dataclasses import replace
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from nextview.geometry.observation import (
    Observation,
    checked_intrinsics,
    checked_pose,
    pinhole,
)
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.viewsphere import CAMERA_DISTANCE
from nextview.sensing import Frame
from nextview.simulation.sensor import Sensor
from nextview.simulation.simulated import SimulatedCamera
from nextview.types import Float, Float32, Mask
from nextview_lab.worlds.scene import TargetScene

# labels of pixels
SHOWS_NOTHING, SHOWS_TARGET, SHOWS_OTHER, SHOWS_TABLE = np.arange(4, dtype=np.uint8)
# least distance of an occluder in front of the target, object radii, as the table touches it
OCCLUDER_GAP = 1e-4


class OccludedCamera:
    """A camera in front of the target of a scene, without the occluded pixels."""

    def __init__(
        self,
        scene: TargetScene,
        size: int = 224,
        distance: float = CAMERA_DISTANCE,
    ) -> None:
        self.scene = scene
        self._target = SimulatedCamera(scene.target, size, distance)
        self._others = RayCaster(
            [
                (mesh.vertices, mesh.faces)
                for mesh in (scene.table, scene.around)
                if mesh
            ]
        )
        self._rays = PinholeCamera.of(pinhole(size, distance), (size, size)).rays

    def observe(self, pose: Float) -> Observation:
        """Render an observation from a camera-to-world pose, (4, 4), OpenCV axes, object radii."""
        seen = self._target.observe(pose)
        hidden = self._hidden(seen)
        assert seen.image is not None
        return replace(
            seen,
            depth=np.where(hidden, 0, seen.depth),
            image=np.where(hidden, np.uint8(0), seen.image),
        )

    def visible_share(self, pose: Float) -> float:
        """Return the visible share of the target's pixels from a pose, (4, 4)."""
        seen = self._target.observe(pose)
        return (
            1 - np.count_nonzero(self._hidden(seen)) / seen.visible
            if seen.visible
            else 0.0
        )

    def _hidden(self, seen: Observation) -> Mask:
        """Return the occluded pixels of the target, (H, W)."""
        there = seen.depth > 0
        rays = self._rays[there] @ seen.pose[:3, :3].T.astype(np.float32)
        depth, _ = self._others.cast(seen.pose[:3, 3], rays)
        hidden = np.zeros(there.shape, bool)
        hidden[there] = depth < seen.depth[there] - OCCLUDER_GAP
        return hidden


class SceneCamera:
    """Renders a whole scene through a pinhole, (3, 3), pixels, first pixel's centre at 0.5."""

    def __init__(
        self,
        scene: TargetScene,
        intrinsics: Float,
        shape: tuple[int, int],
    ) -> None:
        meshes = (scene.target, scene.table, scene.around)
        self._caster = RayCaster(
            [(mesh.vertices, mesh.faces) for mesh in meshes if mesh]
        )
        self._rays = PinholeCamera.of(checked_intrinsics(intrinsics, shape), shape).rays
        self._owners = np.array([SHOWS_TARGET, SHOWS_TABLE, SHOWS_OTHER, SHOWS_NOTHING])

    def look(self, pose: Float) -> tuple[Float32, NDArray[np.uint8]]:
        """Render the scene from a camera-to-world pose, (4, 4), object frame and radii.

        Returns:
            Depth, (H, W) float32, object radii, 0 = nothing; and SHOWS_NOTHING, SHOWS_TARGET,
            SHOWS_OTHER or SHOWS_TABLE, (H, W) uint8.
        """
        pose = checked_pose(pose)
        rays = self._rays.reshape(-1, 3) @ pose[:3, :3].T.astype(np.float32)
        depth, which = self._caster.cast(pose[:3, 3].astype(np.float32), rays)
        shape = self._rays.shape[:2]
        return np.where(which < 0, np.float32(0), depth).reshape(shape), self._owners[
            which
        ].reshape(shape)


class RoomCamera:
    """Delivers the frames of a sensor in a room: 16-bit millimetres, in the frame of its target.

    A pose always gives the same frame: its noise depends on the seed and the pose.

    Args:
        scene: the room, whose target has a known size.
        sensor: simulated depth errors. Those of a setup, such as pose errors, are not simulated.
        seed: of the noise.
    """

    def __init__(self, scene: TargetScene, sensor: Sensor, seed: int = 0) -> None:
        assert scene.metres is not None
        self.scene = scene
        self.metres = scene.metres
        self.sensor = sensor
        self.seed = seed
        self._camera = SceneCamera(scene, sensor.intrinsics, sensor.shape)

    def reachable(self, pose: Float) -> bool:
        """Return True if the camera can be at a pose, (4, 4), metres."""
        place = np.asarray(pose)[None, :3, 3] / self.metres
        return bool(self.scene.reachable(place)[0])

    def look(self, pose: Float) -> tuple[Frame, Mask]:
        """Capture a frame from a camera-to-world pose, (4, 4), OpenCV axes, metres.

        Returns:
            The frame, and the pixels of the target, (H, W) bool.
        """
        pose = np.asarray(pose, np.float64)
        near = pose.copy()
        near[:3, 3] /= self.metres
        depth, owner = self._camera.look(near)
        rng = np.random.default_rng([self.seed, crc32(np.round(pose, 4).tobytes())])
        metres = (self.metres * depth).astype(np.float32)
        measured, source = self.sensor.measure(metres, rng)
        shown = (owner.ravel() == SHOWS_TARGET)[np.maximum(source, 0)]
        millimetres = np.rint(1000 * measured.clip(max=65)).astype(np.uint16)
        frame = Frame(millimetres, self.sensor.intrinsics, pose, pixel_centre=0.5)
        return frame, shown & (source >= 0) & (measured > 0)


def visible_shares(
    scene: TargetScene,
    poses: Float,
    size: int,
    distance: float,
) -> Float:
    """Return the visible share of the target's pixels from each pose.

    Args:
        scene: the scene.
        poses: camera-to-world, (V, 4, 4).
        size: side of the images, pixels.
        distance: of the cameras, object radii.

    Returns:
        Shares, (V,) float64.
    """
    camera = OccludedCamera(scene, size, distance)
    return np.array([camera.visible_share(pose) for pose in poses])
