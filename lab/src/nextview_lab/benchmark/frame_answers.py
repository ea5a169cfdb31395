"""What is found in frames, each in a scene of its own; an interrupted run goes on."""

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from msgspec import Struct

from nextview.captured.check import evenly_spread
from nextview.errors import DatasetError, NextviewError, ObservationError, UsageError
from nextview.files import read_record, write_record
from nextview.scene.scene import Scene
from nextview.sensing.frame import Frame
from nextview.session.system import System
from nextview.types import Float

Item = TypeVar("Item")


def evenly(items: Sequence[Item], most: int | None) -> Sequence[Item]:
    """At most so many items, evenly spread.

    Args:
        items: in order.
        most: number of those that are kept; None for all.

    Raises:
        UsageError: it is no number of frames.
    """
    if most is not None and most < 1:
        raise UsageError(f"at least one frame is looked at, not {most}")
    few = evenly_spread(len(items), len(items) if most is None else most)
    return [items[row] for row in few]


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
        seconds: that it took to read the frame and to look at it.
        cpu: seconds of CPU of the same.
    """

    objects: tuple[FoundObject, ...]
    seconds: float
    cpu: float


class FrameAnswers:
    """What is found in frames, each in a scene of its own; kept in a folder.

    Attributes:
        left_out: why frames could not be looked at, by their names.
    """

    def __init__(self, folder: Path, system: System, up: Float | None) -> None:
        """Nothing is looked at yet.

        Args:
            folder: that keeps what is found.
            system: that knows the things.
            up: direction against gravity in the world, (3,); None for the normal of the support
                plane.
        """
        self.left_out: dict[str, NextviewError] = {}
        self._folder = folder
        self._system = system
        self._up = up

    def look_at(self, frames: Mapping[str, Callable[[], Frame]]) -> Iterator[int]:
        """Look at each frame that is not done; yields how many are.

        Args:
            frames: functions that read them, by their names.
        """
        for done, (name, read) in enumerate(frames.items(), 1):
            if not self._file(name).exists():
                try:
                    write_record(self._file(name), self._looked(read))
                except (DatasetError, ObservationError) as error:
                    self.left_out[name] = error
            yield done

    def refused(self, name: str) -> bool:
        """Whether a frame was read, and showed no plane, or nothing."""
        return isinstance(self.left_out.get(name), ObservationError)

    def why(self) -> str:
        """Why the first frame that is left out is, as the end of a sentence."""
        return next((f": {error}" for error in self.left_out.values()), "")

    def __getitem__(self, name: str) -> FrameAnswer | None:
        """What was found in a frame; None if it could not be looked at."""
        if not self._file(name).exists():
            return None
        return read_record(
            self._file(name), FrameAnswer, "what was found", DatasetError
        )

    def _file(self, name: str) -> Path:
        return self._folder / f"{hashlib.sha256(name.encode()).hexdigest()}.json"

    def _looked(self, read: Callable[[], Frame]) -> FrameAnswer:
        """Look at a frame; an ObservationError if it shows no plane, or nothing."""
        begun = time.perf_counter(), time.process_time()
        scene = Scene(self._system, self._up)
        frame = read()
        scene.update(frame)
        to_camera = np.linalg.inv(frame.camera_to_world)
        objects = []
        for one in scene.objects:
            if one.candidates:
                first = one.candidates[0]
                pose = tuple((to_camera @ first.pose).ravel().tolist())
                belief = one.beliefs[first.thing]
                named = one.pose is not None
                objects.append(
                    FoundObject(first.thing, belief, named, one.confident, pose)
                )
        ended = time.perf_counter(), time.process_time()
        return FrameAnswer(tuple(objects), ended[0] - begun[0], ended[1] - begun[1])
