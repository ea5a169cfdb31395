"""What a measure is handed: one view of an object."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nextview.geometry.depth import object_depth
from nextview.geometry.observation import depth_image


@dataclass(frozen=True)
class MeasuredView:
    """One view of an object. What several measures ask for is computed once, when the first one asks.

    Attributes:
        depth: distance along the optical axis, (H, W) float, object radii, 0 where there is no object. What a sensor
            gives for nothing else becomes 0 here.
        pose: camera-to-world, (4, 4) float64, OpenCV axes; the world is the object frame, z up.
        intrinsics: pinhole matrix, (3, 3) float64, pixels, the first pixel's centre at 0.5.
    """

    depth: NDArray[np.floating]
    pose: NDArray[np.float64]
    intrinsics: NDArray[np.float64]

    def __post_init__(self) -> None:
        object.__setattr__(self, "depth", object_depth(depth_image(self.depth)))

    @cached_property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns that hold the object, (H', W'); none of them where nothing is seen."""
        seen = self.depth > 0
        rows, columns = (np.flatnonzero(seen.any(axis)) for axis in (1, 0))
        if len(rows) == 0:
            return slice(0, 0), slice(0, 0)
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)

    @cached_property
    def near(self) -> NDArray[np.floating]:
        """The depth in the box, (H', W'): most of an image is background, and so most of the work is saved."""
        return self.depth[self.box]

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """Where the box shows the object, (H', W')."""
        return self.near > 0

    @cached_property
    def depths(self) -> NDArray[np.floating]:
        """Depth of the pixels that show the object, (n,), row by row."""
        return self.near[self.seen]

    @cached_property
    def rays(self) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Slopes x/z of the box's columns, (W',), and y/z of its rows, (H',), in the camera's axes."""
        rows, columns = self.box
        (fx, _, cx), (_, fy, cy) = self.intrinsics[:2]
        x = (np.arange(columns.start, columns.stop) + 0.5 - cx) / fx
        y = (np.arange(rows.start, rows.stop) + 0.5 - cy) / fy
        return x, y
