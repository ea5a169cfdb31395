"""In which frame the poses of a result are given."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from nextview.types import Float

if TYPE_CHECKING:
    from nextview.sensing.observed_object import ObservedObject

PoseFrameName = Literal["world", "camera", "object"]
IN_WORDS: dict[PoseFrameName, str] = {
    "world": "the world",
    "camera": "the camera's frame",
    "object": "the object frame",
}


@dataclass(frozen=True, eq=False)
class PoseFrame:
    """The frame in which poses are given.

    Attributes:
        name: "world": the robot's, in which the poses of the frames' cameras are given. "camera":
            that of the camera, OpenCV axes, of a single frame without a pose. "object": the object
            frame, for cameras that give observations, as simulated ones do.
        from_object: from the object frame, in metres, into this one, (4, 4) float64.
    """

    name: PoseFrameName = "object"
    from_object: Float = field(default_factory=lambda: np.eye(4))

    def __str__(self) -> str:
        return IN_WORDS[self.name]

    @classmethod
    def of(cls, thing: ObservedObject | None) -> PoseFrame:
        """The frame of what is seen of an object.

        Args:
            thing: the object as it was seen in frames; None where observations were handed in.
        """
        if thing is None or not thing.sightings:
            return cls()

        frame = thing.object_frame
        from_object = np.eye(4)
        from_object[:3, :3] = frame.axes.T
        # Each frame shows the object in another place, if their poses err: it is where they show
        # it in the mean.
        shifts = [sighting.shift for sighting in thing.sightings]
        from_object[:3, 3] = frame.centre - np.mean(shifts, axis=0)
        posed = thing.sightings[-1].frame.pose is not None
        return cls("world" if posed else "camera", from_object)
