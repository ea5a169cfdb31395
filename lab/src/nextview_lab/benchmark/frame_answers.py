"""What is found in a frame, in a scene of its own."""

import time

import numpy as np
from msgspec import Struct

from nextview.scene.scene import Scene
from nextview.session.system import System
from nextview.types import Float
from nextview_lab.data.real_frames import RealFrame


class FoundObject(Struct, frozen=True):
    """An object that was found in a frame, and the likeliest thing that it is.

    Attributes:
        name: of the thing.
        belief: in this name, 0 to 1.
        named: whether the object is called so.
        confident: whether this is confident.
        pose: scan-to-camera, row by row, metres.
    """

    name: str
    belief: float
    named: bool
    confident: bool
    pose: tuple[float, ...]

    @property
    def matrix(self) -> Float:
        """The pose, (4, 4)."""
        return np.reshape(self.pose, (4, 4))


class FrameAnswer(Struct, frozen=True):
    """What was found in a frame.

    Attributes:
        objects: those that resemble a thing.
        cpu: seconds of CPU that it took to read the frame and to look at it.
    """

    objects: tuple[FoundObject, ...]
    cpu: float


def answer_to(real: RealFrame, system: System) -> FrameAnswer:
    """Look at a frame.

    Args:
        real: the frame, as yet unread.
        system: that knows the things.

    Raises:
        DatasetError: a file is missing or damaged.
        ObservationError: it shows no plane, or nothing.
    """
    begun = time.process_time()
    scene = Scene(system, None)
    frame = real.read()
    scene.update(frame)
    to_camera = np.linalg.inv(frame.camera_to_world)
    objects = []
    for one in scene.objects:
        if one.candidates:
            first = one.candidates[0]
            pose = tuple((to_camera @ first.pose).ravel().tolist())
            belief, named = one.beliefs[first.thing], one.pose is not None
            objects.append(FoundObject(first.thing, belief, named, one.confident, pose))
    return FrameAnswer(tuple(objects), time.process_time() - begun)
