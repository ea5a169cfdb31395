"""The coordinate frame of the poses of a result."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from nextview.sensing.observed_object import ObservedObject
from nextview.types import Float

PoseFrameName = Literal["world", "camera", "object"]
IN_WORDS: dict[PoseFrameName, str] = {
    "world": "the world",
    "camera": "the camera's frame",
    "object": "the object frame",
}


@dataclass(frozen=True, eq=False)
class PoseFrame:
    """The coordinate frame of poses.

    Attributes:
        name: "world": the frame of the camera poses, usually that of the robot. "camera": the
            camera frame, OpenCV axes, of a single frame without a pose. "object": the object frame,
            for cameras that return observations, such as simulated ones.
        from_object: transform from the object frame, in metres, to this frame, (4, 4) float64.
    """

    name: PoseFrameName = "object"
    from_object: Float = field(default_factory=lambda: np.eye(4))

    def __str__(self) -> str:
        return IN_WORDS[self.name]

    @classmethod
    def of(cls, thing: ObservedObject | None) -> PoseFrame:
        """Return the frame of an observed object.

        Args:
            thing: the object observed in frames; None if observations were passed in.
        """
        if thing is None or not thing.sightings:
            return cls()

        frame = thing.object_frame
        from_object = np.eye(4)
        from_object[:3, :3] = frame.axes.T
        # With pose errors each frame shows the object displaced; the mean displacement is used.
        shifts = [sighting.shift for sighting in thing.sightings]
        from_object[:3, 3] = frame.centre - np.mean(shifts, axis=0)
        posed = thing.sightings[-1].frame.pose is not None
        return cls("world" if posed else "camera", from_object)
