"""Follow the poses of recognised things at the rate of the camera, from depth alone.

In each frame a thing is registered from its expected pose, with the expectation as the prior (an
iterated extended Kalman filter). Whether it is still there follows from the likelihood of the
pixels on it, against that without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from nextview.checks import number
from nextview.errors import SessionError, UsageError
from nextview.scene.body import Body, Tracked
from nextview.scene.followed import (
    SURPRISE,
    followed,
    name_probability,
    view_to_follow,
)
from nextview.scene.motion import MotionModel
from nextview.scene.scene import Scene
from nextview.sensing.frame import Frame
from nextview.sensing.noise import Noise
from nextview.sensing.planes import Plane
from nextview.sensing.view import View

FRAME_SECONDS = 1 / 30  # between frames without a time
NAME_SECONDS = 1.0  # after which a name is compared again
LATEST_TIME = 1e11  # seconds: since 1970, the year 5138
LONGEST_PAUSE = 1e5  # seconds, a day: nothing is followed so long without a frame


class Tracker:
    """Follows the things that a scene has named, frame by frame.

    >>> tracker = nextview.Tracker(scene)                                       # doctest: +SKIP
    >>> for frame in frames:                                                    # doctest: +SKIP
    ...     for thing in tracker.update(frame):
    ...         print(thing.name, thing.lost, thing.pose)

    A thing that stands is expected to stay while something hides it. One that moves is expected
    where its velocity would bring it, until that is too uncertain; then it is lost, unless it
    comes back to where it was seen last. One whose ``name_probability`` falls may have been
    exchanged, or named wrongly. Update the scene with a frame and ``follow`` it again.

    Args:
        scene: with at least one frame; its things with confident names are followed.
        model: how things move.

    Raises:
        SessionError: the scene has no frame yet.
    """

    def __init__(
        self,
        scene: Scene,
        model: MotionModel = MotionModel(),
    ) -> None:
        self.model = model
        self._bodies: Mapping[int, Body] = {}
        self._time: float | None = None
        self._noise: Noise
        self._ground: Plane | None = None
        self.follow(scene)

    def follow(self, scene: Scene, since: Sequence[Tracked] = ()) -> None:
        """Take over what a scene has found: new things and names, and things that are lost here.

        A thing that is followed keeps its pose, unless it is lost. One that the scene no longer
        has, or whose name is no longer confident, is no longer followed.

        Args:
            scene: with at least one frame.
            since: ``things`` when the last frame of the scene was taken. What was followed then,
                and rests now, takes the pose of the scene, which is of all its frames, moved as it
                was followed since then.

        Raises:
            SessionError: the scene has no frame yet.
        """
        if not scene.tops:
            raise SessionError(
                "there is nothing to follow before the first frame of the scene"
            )
        self._library = scene.library
        top = scene.tops[-1]
        self._noise = top.noise
        self._ground = top.plane if top.shows_ground else None

        starts = {thing.number: thing.pose for thing in since if not thing.lost}
        bodies = {}
        for one in scene.objects:
            fresh = Body.of(one, self._library, self.model)
            if fresh is None:
                continue
            body = self._bodies.get(one.number)
            if body is None or body.lost or body.name != fresh.name:
                body = fresh
            elif one.number in starts and body.rests:
                motion = body.pose @ np.linalg.inv(starts[one.number])
                body = Body.of(one, self._library, self.model, motion)
            assert body is not None
            bodies[one.number] = body
        self._bodies = bodies

    @property
    def things(self) -> tuple[Tracked, ...]:
        """The things that are followed, by their numbers."""
        return tuple(body.tracked for _, body in sorted(self._bodies.items()))

    def update(self, frame: Frame, time: float | None = None) -> tuple[Tracked, ...]:
        """Follow all things into the next frame.

        Args:
            frame: of the same camera or another one, with a pose.
            time: of the frame, seconds on any clock; 1/30 s after the last frame by default.

        Returns:
            The things that are followed, by their numbers.

        Raises:
            UsageError: the time is before that of the last frame, or not in seconds.
        """
        before = self._time
        if time is None:
            time = 0.0 if before is None else before + FRAME_SECONDS
        time = number(time, "the time", least=-np.inf if before is None else before)
        gap = 0.0 if before is None else time - before
        if abs(time) > LATEST_TIME or gap > LONGEST_PAUSE:
            told = (
                f"{time:.4g}"
                if gap <= LONGEST_PAUSE
                else f"{gap:.4g} after the last one"
            )
            raise UsageError(
                f"the time of a frame is in seconds, and {told} is none: nanoseconds, or"
                " microseconds?"
            )
        seconds = FRAME_SECONDS if before is None else time - before
        self._time = time

        bodies = {
            key: body.after(seconds, self.model) for key, body in self._bodies.items()
        }
        view = view_to_follow(frame, self._noise, self._ground)
        for key, body in bodies.items():
            bodies[key] = self._followed(body, seconds, view)

        # one name a frame is compared with others, as this takes longer than to follow a thing
        due = [
            key
            for key, body in bodies.items()
            if body.uncompared >= NAME_SECONDS and body.visible > 0 and not body.lost
        ]
        if due:
            key = max(due, key=lambda key: bodies[key].uncompared)
            chance = name_probability(self._library, view, bodies[key])
            bodies[key] = replace(bodies[key], name_probability=chance, uncompared=0.0)
        self._bodies = bodies
        return self.things

    def _followed(self, body: Body, seconds: float, view: View) -> Body:
        """Register a thing in a frame."""
        found = followed(self._library, view, body)
        body = body.judged(seconds, found.evidence, found.visible)
        # few things that stand are moved in a frame: a few pixels do not tell it
        enough = SURPRISE if body.rests else 0.0
        if found.errors is None or found.evidence <= enough:
            return body
        return body.measured(found.state, found.errors)
