"""What is found in frames, each in a scene of its own; an interrupted run goes on."""

import csv
import hashlib
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np
from msgspec import Struct

from nextview.captured.check import evenly_spread
from nextview.data.progress import TrackProgress
from nextview.errors import DatasetError, NextviewError, ObservationError, UsageError
from nextview.files import (
    check_new,
    new_file,
    only_one,
    read_record,
    unfinished,
    write_record,
)
from nextview.recognition.model_card import find_models
from nextview.scene.scene import Scene
from nextview.session.system import System
from nextview.things.memory import open_memory
from nextview.types import Float
from nextview_lab.data.real_frames import RealFrame

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

    def __init__(self, folder: Path, system: System) -> None:
        """Nothing is looked at yet.

        Args:
            folder: that keeps what is found.
            system: that knows the things.
        """
        self.left_out: dict[str, NextviewError] = {}
        self._folder = folder
        self._system = system

    def look_at(self, frames: Iterable[RealFrame]) -> Iterator[int]:
        """Look at each frame that is not done; yields how many are.

        Args:
            frames: as yet unread.
        """
        for done, frame in enumerate(frames, 1):
            if not self._file(frame).exists():
                try:
                    write_record(self._file(frame), self._looked(frame))
                except (DatasetError, ObservationError) as error:
                    self.left_out[_named(frame)] = error
            yield done

    def refused(self, frame: RealFrame) -> bool:
        """Whether a frame was read, and showed no plane, or nothing."""
        return isinstance(self.left_out.get(_named(frame)), ObservationError)

    def why(self) -> str:
        """Why the first frame that is left out is, as the end of a sentence."""
        return next((f": {error}" for error in self.left_out.values()), "")

    def of(self, frame: RealFrame) -> FrameAnswer | None:
        """What was found in a frame; None if it could not be looked at."""
        file = self._file(frame)
        if not file.exists():
            return None
        return read_record(file, FrameAnswer, "what was found", DatasetError)

    def _file(self, frame: RealFrame) -> Path:
        digest = hashlib.sha256(_named(frame).encode()).hexdigest()
        return self._folder / f"{digest}.json"

    def _looked(self, real: RealFrame) -> FrameAnswer:
        """Look at a frame; an ObservationError if it shows no plane, or nothing."""
        begun = time.perf_counter(), time.process_time()
        scene = Scene(self._system, None)
        frame = real.read()
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


def _named(frame: RealFrame) -> str:
    """A frame as it is named where it is left out."""
    return f"{frame.folder}: {frame.name}"


@contextmanager
def looked_at(
    out: Path,
    models: str,
    system: System,
    frames: Collection[RealFrame],
    how: object,
    track: TrackProgress,
) -> Iterator[FrameAnswers]:
    """Look at frames, for a table that is written in this context; a stopped run goes on.

    Args:
        out: the table.
        models: name or folder of the memory.
        system: that it is opened as.
        frames: as yet unread.
        how: else the answers depend on.
        track: follows the frames.
    """
    card, _ = open_memory(find_models(models).recogniser)
    depends = str((card.sha256, how, Path.cwd()))
    key = hashlib.sha256(depends.encode()).hexdigest()
    with only_one(out), unfinished(out, key) as parts:
        answers = FrameAnswers(parts, system)
        track(answers.look_at(frames), len(frames), "frames")
        yield answers


def check_table(out: Path, overwrite: bool) -> None:
    """Check, before any work is done, that a table can be written.

    Args:
        out: the table.
        overwrite: whether it may replace another.

    Raises:
        ResultsError: it exists, or cannot be written.
        UsageError: its name does not end in .csv.
    """
    check_new(out, overwrite)
    if out.suffix.lower() != ".csv":
        raise UsageError(f"{out}: the name ends in .csv")


def write_table(
    out: Path,
    overwrite: bool,
    head: Iterable[str],
    rows: Iterable[Iterable[object]],
) -> None:
    """Write a table of comma-separated values, completely or not at all.

    Args:
        out: the table.
        overwrite: whether it may replace another.
        head: names of the columns.
        rows: of values.
    """
    with (
        new_file(out, overwrite) as new,
        new.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(head)
        writer.writerows(rows)
