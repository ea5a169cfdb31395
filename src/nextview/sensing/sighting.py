"""What one frame shows of an object."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from nextview.sensing.clusters import Footprint
from nextview.sensing.facets import Facets, Noise
from nextview.sensing.frame import Frame
from nextview.sensing.segmentation import Plane
from nextview.types import Float, Mask


@dataclass(frozen=True)
class Sighting:
    """What one frame, with the noise of it all, shows of the object.

    Attributes:
        frame: its pose is shifted so that the object stands where earlier frames show it.
        noise: of the frame.
        facets: the object's surface, camera frame.
        mask: its pixels, (H, W) bool.
        hull: corners of its convex hull, world, (K, 3), metres.
        plane: the support plane, if it is seen.
        footprint: of all that is above the plane, where the object was found so.
        chosen: which cells of the footprint are the object's, (cells,) bool.
        shift: by which the pose was shifted, (3,), metres.
    """

    frame: Frame
    noise: Noise
    facets: Facets
    mask: Mask
    hull: Float
    plane: Plane | None
    footprint: Footprint | None = None
    chosen: Mask | None = None
    shift: Float = field(default_factory=lambda: np.zeros(3))

    @property
    def told(self) -> Frame:
        """The frame with the pose that it was handed in with."""
        return self.frame.shifted(-self.shift) if self.shift.any() else self.frame

    def shifted(self, shift: Float) -> Sighting:
        """The same from a place that is shifted in the world, (3,), metres."""
        plane = self.plane
        return replace(
            self,
            frame=self.frame.shifted(shift),
            hull=self.hull + shift,
            plane=plane
            and replace(plane, offset=plane.offset - float(plane.normal @ shift)),
            shift=self.shift + shift,
        )
