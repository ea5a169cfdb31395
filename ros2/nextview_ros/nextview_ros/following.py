"""Follow what a scene has named in the images that come between its looks."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import nextview
from nextview.captured.messages import seconds
from nextview.captured.transforms import NoTransformError
from nextview.errors import NextviewError
from nextview.scene.body import Tracked
from nextview.sensing.frame import Frame
from nextview_ros.inputs import DepthCamera

LONGEST_WAIT = 0.2  # seconds that an image waits for its transform


class Follower:
    """Follows the things of a scene; what it finds changes nothing in the scene.

    Looks and images may come in different threads.

    Args:
        cameras: whose images are used, each once.
        frame_of: makes the frame of an image with its camera_info, without waiting for its
            transform; NoTransformError if it has not come yet.
    """

    def __init__(
        self,
        cameras: Sequence[DepthCamera],
        frame_of: Callable[[DepthCamera, Any, Any], Frame],
    ) -> None:
        self.cameras = cameras
        self.frame_of = frame_of
        self.scene: nextview.Scene | None = None
        self.tracker: nextview.Tracker | None = None
        self.lock = threading.Lock()
        self.taken: dict[str, float] = {}  # stamp of the last image of each camera
        self.waiting: dict[
            str, Any
        ] = {}  # image and camera_info without a transform yet

    @property
    def things(self) -> tuple[Tracked, ...]:
        """The things that are followed."""
        tracker = self.tracker
        return () if tracker is None else tracker.things

    @property
    def found(self) -> list[Tracked]:
        """Those that are not lost, and whose name is likely."""
        return [
            thing
            for thing in self.things
            if not thing.lost and thing.name_probability >= 0.5
        ]

    def begin(self, scene: nextview.Scene) -> None:
        """Forget what was followed, and follow the things of a scene."""
        with self.lock:
            self.scene = scene
            self.taken.clear()
            self.tracker = nextview.Tracker(scene) if scene.tops else None

    def look_taken(self, since: Sequence[Tracked]) -> None:
        """Take over what a look of the scene has found.

        Args:
            since: ``things`` when its images were taken.
        """
        with self.lock:
            if self.tracker is None:
                self.tracker = nextview.Tracker(self.scene)
            else:
                self.tracker.follow(self.scene, since)

    def steps(self, now: float) -> Iterator[Any | NextviewError]:
        """Follow the things into the images that have come since, one after the other.

        Args:
            now: seconds, in the clock of the stamps.

        Yields:
            The stamp of each image that was used, or why one cannot be.
        """
        if self.tracker is None:
            return
        new = []
        for camera in self.cameras:
            pair = self.waiting.pop(camera.namespace, camera.latest)
            if pair is not None:
                stamp = seconds(pair[0].header.stamp)
                if stamp != self.taken.get(camera.namespace):
                    new.append((stamp, camera, *pair))
        for stamp, camera, image, info in sorted(new, key=lambda one: one[0]):
            try:
                frame = self.frame_of(camera, image, info)
            except NextviewError as error:
                if isinstance(error, NoTransformError) and now < stamp + LONGEST_WAIT:
                    self.waiting[camera.namespace] = image, info
                    return
                self.taken[camera.namespace] = stamp
                yield error
                continue
            if self.step(camera.namespace, stamp, frame):
                yield image.header.stamp

    def step(self, camera: str, stamp: float, frame: Frame) -> bool:
        """Follow the things into a frame, unless one of another camera was later."""
        if stamp < self.taken.get(camera, stamp):  # a bag begins again
            self.begin(self.scene)
        with self.lock:
            last = max(self.taken.values(), default=stamp)
            self.taken[camera] = stamp
            if self.tracker is None or stamp < last:
                return False
            self.tracker.update(frame, stamp)
            return True
