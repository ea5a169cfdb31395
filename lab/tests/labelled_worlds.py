"""Worlds of boxes and household things, and a camera that knows what each pixel truly shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from factories import resting_of

from nextview.geometry.mesh import Mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.segmentation.instances import Segmentation
from nextview.sensing.frame import Frame
from nextview.simulation.sensor import SENSORS
from nextview_lab.worlds.tables import SimulatedTable
from nextview_lab.worlds.worlds import BACKGROUND, SURFACE, slab

FLOOR = (slab((8, 8, 0.05), (0, 0), 0.0), SURFACE)


def drawn(
    meshes: Sequence[Mesh],
    seed: int,
    gap: float = 0.06,
    base: tuple[float, float, float] = (0, 0, 0),
    first: int = 0,
) -> list:
    """Things in resting poses at random, around a place, with their numbers.

    Args:
        meshes: of the things.
        seed: of the draw.
        gap: metres between neighbours, at most.
        base: middle of the surface that they stand on, metres.
        first: number of the first thing.
    """
    table = SimulatedTable.draw(meshes, np.random.default_rng(seed), gap, resting_of)
    return [
        ((thing.placed + np.array(base), thing.faces), first + number)
        for number, thing in enumerate(table.things)
    ]


class LabelledCamera:
    """A camera that looks at solids through a sensor, and knows what it sees.

    Attributes:
        owner: number of the thing that each pixel of the last frame shows, SURFACE or BACKGROUND,
            (H, W) int64.
    """

    def __init__(self, solids: Sequence, sensor: str = "stereo", seed: int = 0) -> None:
        self.sensor = SENSORS[sensor]
        self._rng = np.random.default_rng(seed)
        self._labels = np.array([label for _, label in solids] + [BACKGROUND])
        self._caster = RayCaster([solid for solid, _ in solids])
        rays = PinholeCamera.of(self.sensor.intrinsics, self.sensor.shape).rays
        self._rays = rays.reshape(-1, 3)

    def frame(self, pose: np.ndarray, posed: bool = True) -> Frame:
        """Look from a pose, camera-to-world, (4, 4), that the frame tells or not."""
        depth, owner = self._caster.cast(pose[:3, 3], self._rays @ pose[:3, :3].T)
        clean = np.where(np.isfinite(depth), depth, 0).reshape(self.sensor.shape)
        measured, source = self.sensor.measure(clean.astype(np.float32), self._rng)
        labels = self._labels[np.where(np.isfinite(depth), owner, -1)]
        labels = np.where(source >= 0, labels[np.maximum(source, 0)], BACKGROUND)
        self.owner = np.where(measured > 0, labels, BACKGROUND).reshape(measured.shape)
        given = pose if posed else None
        return Frame(measured, self.sensor.intrinsics, given, pixel_centre=0.5)

    def truth(self, frame: Frame) -> Segmentation:
        """What the last frame truly shows, as a segmentation."""
        return Segmentation(np.maximum(self.owner + 1, 0), self.owner == SURFACE)
