"""A robot's camera in a world: frames in metres, through a sensor, of a target that it was told of as a user would."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import as_line, of_kind
from nextview.cameras.sensors import SensedCamera, Sensor, SensorMix, sensor_named
from nextview.errors import NoViewLeftError, ObservationError, UsageError
from nextview.sensing import Frame, ObservedObject
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.viewsphere import DISTANCE, Viewpoints, ViewSphere, angle_between, direction_of, level_pose
from nextview.worlds.scene import TABLE, Scene

Float = NDArray[np.float64]
Named = Literal["point", "box", "known", "mask"]
SAME = 1e-6
"""Radians between directions that are the same."""


def world_sensor(sensor: Sensor | SensorMix | str, rng: np.random.Generator) -> Sensor:
    """A sensor as it stands in a world: three object radii from a target whose size follows; no boxes of its own.

    Args:
        sensor: or its name, see ``sensor_named``.
        rng: draws one of a mix.
    """
    of_kind(sensor, Sensor | SensorMix | str, "a sensor is one of nextview.cameras.sensors, or its name")
    known = sensor_named(sensor) if isinstance(sensor, str) else sensor
    drawn = known.draw(rng) if isinstance(known, SensorMix) else known
    return replace(drawn, radius=drawn.distance / DISTANCE, boxes=0.0)


def sensed_camera(
    scene: Scene, sensor: Sensor | SensorMix | str, rng: np.random.Generator, denoise: bool = True
) -> SensedCamera:
    """A ``SensedCamera`` before a scene's target: observations in the object frame, with the errors of a sensor.

    What hides the target is told from it exactly; the errors are those of the sensor and of its setup.
    """
    drawn = world_sensor(sensor, rng.spawn(1)[0])
    return SensedCamera(scene.target, drawn, rng, denoise, scene.around, TABLE)


class WorldCamera:
    """Gives frames of a world, metres, to a session that runs in it live.

    The world's frame is the target's object frame, in metres. The target is named to the session as ``named`` says:

    - "point": by a point in its middle; it is found in every frame as the cluster nearest to it, its extent estimated.
    - "box": by the upright box that it just fits into.
    - "known": by its object frame, with the errors of the sensor's setup; what lies in its sphere, and is neither table
      nor another thing, is the target.
    - "mask": by masks that tell it from all else, its extent estimated.

    A pose that cannot be reached, or from which too little of the target is measured, is answered from the nearest of
    the viewpoints that is not so and where it has not stood yet: the same frame again would tell nothing, and be taken
    for more. Ask only for what ``reachable`` allows to be answered from near.

    >>> camera = WorldCamera(build_scene(world, meshes), named="box")           # doctest: +SKIP
    >>> session = nextview.load().session_with(camera)                          # doctest: +SKIP
    >>> session.reachable = camera.reachable                                    # doctest: +SKIP
    >>> session.run(camera)                                                     # doctest: +SKIP

    Args:
        scene: the world.
        sensor: a sensor, or the name of one, see ``sensor_named``.
        rng: for all its errors; seed 0 by default.
        named: how the session is told of the target.
        viewpoints: where it looks from instead of where it cannot.

    Attributes:
        object: what it is to look at.

    Raises:
        UsageError: there is no such sensor, or no such way to name a target.
    """

    def __init__(
        self,
        scene: Scene,
        sensor: Sensor | SensorMix | str = "none",
        rng: np.random.Generator | None = None,
        named: Named = "point",
        viewpoints: Viewpoints | None = None,
    ) -> None:
        of_kind(scene, Scene, "a world's camera looks at a Scene")
        of_kind(rng, np.random.Generator | None, "the errors are drawn by a numpy.random.Generator")
        of_kind(viewpoints, Viewpoints | None, "the viewpoints are a ViewSphere or Directions")
        if not isinstance(named, str) or named not in get_args(Named):
            raise UsageError(f"a target is named by {', '.join(get_args(Named))}, not by {as_line(named)}")
        self.scene, self.named = scene, named
        self._directions = (viewpoints or ViewSphere.named("40")).directions
        self._camera = sensed_camera(scene, sensor, rng or np.random.default_rng(0))
        self._truth = ObjectFrame(np.zeros(3), self._camera.sensor.radius, np.eye(3))
        denoise = self._camera.sensor.name != "none"
        corners = scene.target.vertices * self._truth.radius
        asked = {
            "point": {"point": np.zeros(3)},
            "box": {"box": Box(corners.min(0) - SAME, corners.max(0) + SAME)},
            "known": {"known": self._camera.object_frame, "support": False},
            "mask": {},
        }[named]
        self.object = ObservedObject(denoise=denoise, life_size=False, **asked)  # type: ignore[arg-type]
        self._refused: list[Float] = []
        self._taken: list[Float] = []

    def reachable(self, pose: Float) -> bool:
        """Whether the camera can be brought to a pose of the world, (4, 4), metres: for ``Session.reachable``."""
        return bool(self.scene.reachable(self._truth.pose_in_object(pose)[None, :3, 3])[0])

    def observe(self, pose: Float) -> Frame:
        """Look from a pose, (4, 4), in the object frame as it is believed to be; from near it where that cannot be.

        Raises:
            NoViewLeftError: the target can be seen from nowhere else.
        """
        believed = self.object.object_frame if self.object.sightings or self.object.known else self._truth
        asked = direction_of(self._truth.pose_in_object(believed.pose_in_world(pose)))
        order = np.argsort(angle_between(np.broadcast_to(asked, self._directions.shape), self._directions))
        for direction in (asked, *self._directions[order]):
            there = level_pose(direction)
            tried = self._refused if direction is asked else [*self._refused, *self._taken]
            used = any(angle_between(direction, other) < SAME for other in tried)
            if used or not self.scene.reachable(there[None, :3, 3])[0]:
                continue
            frame = self._camera.frame(there)
            if frame is not None:
                self._taken.append(direction)
                return frame if self.named in ("known", "mask") else replace(frame, mask=None, pixel_centre=0.5)
            self._refused.append(direction)
        raise NoViewLeftError("the target shows from no other place that can be reached")

    def refused(self, error: ObservationError) -> None:
        """The target is not found in the last frame: no other one is taken from there."""
        self._refused.append(self._taken.pop())
