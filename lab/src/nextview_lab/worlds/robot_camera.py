"""A robot's camera in a scene, which delivers frames in metres and specifies the target."""

from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from nextview.checks import one_line
from nextview.errors import NoViewLeftError, ObservationError, UsageError
from nextview.geometry.viewsphere import (
    CAMERA_DISTANCE,
    ViewSphere,
    angle_between,
    direction_of,
    level_pose,
)
from nextview.sensing import Frame, ObservedObject
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.sensor import Sensor, SensorMix, sensor_named
from nextview.types import Float
from nextview_lab.worlds.scene import SCENE_TABLE, TargetScene

Named = Literal["point", "box", "known", "mask"]
SAME_DIRECTION = 1e-6  # radians, tolerance of equal directions


def sensed_camera(
    scene: TargetScene,
    sensor: Sensor | SensorMix | str,
    rng: np.random.Generator,
) -> SensedCamera:
    """Create a camera three radii from the target of a scene, with exact segmentation.

    Args:
        scene: the scene.
        sensor: simulated sensor errors.
        rng: source of all random numbers.

    Returns:
        The camera.
    """
    drawn = sensor_named(sensor).draw(rng.spawn(1)[0])
    drawn = replace(drawn, radius=drawn.distance / CAMERA_DISTANCE, boxes=0.0)
    return SensedCamera(
        scene.target,
        drawn,
        rng,
        around=scene.around,
        table=SCENE_TABLE,
        true_size=False,
    )


class RobotCamera:
    """Delivers frames of a scene, in metres, to a live session.

    The scene's frame is the target's object frame, in metres. The target is specified by a "point"
    in its centre, by its upright bounding "box", by its "known" object frame with the errors of the
    sensor's setup, or by a "mask".

    If a pose cannot be reached, or too little of the target is visible from it, the nearest other
    unused viewpoint is taken. Request only poses that ``reachable`` allows, to get frames close to
    them. The sensor errors are drawn with seed 0.
    """

    # the scene defines reachable poses; see ``session.FrameCamera``
    knows_reach = True

    def __init__(
        self,
        scene: TargetScene,
        sensor: Sensor | SensorMix | str = "none",
        named: Named = "point",
    ) -> None:
        if named not in get_args(Named):
            raise UsageError(
                f"a target is named by {', '.join(get_args(Named))}, not by {one_line(repr(named))}"
            )

        self.scene = scene
        self.named = named
        self._directions = ViewSphere.named("40").directions
        self._camera = sensed_camera(scene, sensor, np.random.default_rng(0))
        self._truth = ObjectFrame(np.zeros(3), self._camera.sensor.radius, np.eye(3))
        denoise = self._camera.sensor.name != "none"
        corners = scene.target.vertices * self._truth.radius
        asked = {
            "point": {"point": np.zeros(3)},
            "box": {
                "box": Box(
                    corners.min(0) - SAME_DIRECTION,
                    corners.max(0) + SAME_DIRECTION,
                )
            },
            "known": {"known": self._camera.object_frame, "support": False},
            "mask": {},
        }[named]
        self.object = ObservedObject(denoise=denoise, life_size=False, **asked)  # type: ignore[arg-type]
        self._refused = list[Float]()
        self._taken = list[Float]()

    def reachable(self, pose: Float) -> bool:
        """Return True if the camera can reach a pose of the scene, (4, 4), metres."""
        return bool(
            self.scene.reachable(self._truth.pose_in_object(pose)[None, :3, 3])[0]
        )

    def observe(self, pose: Float) -> Frame:
        """Capture a frame from a pose, (4, 4), in the estimated object frame, or from near it."""
        believed = (
            self.object.object_frame
            if self.object.sightings or self.object.known
            else self._truth
        )
        asked = direction_of(self._truth.pose_in_object(believed.pose_in_world(pose)))
        order = np.argsort(
            angle_between(
                np.broadcast_to(asked, self._directions.shape),
                self._directions,
            )
        )

        for direction in (asked, *self._directions[order]):
            there = level_pose(direction)
            tried = (
                self._refused if direction is asked else [*self._refused, *self._taken]
            )
            used = any(
                angle_between(direction, other) < SAME_DIRECTION for other in tried
            )
            if used or not self.scene.reachable(there[None, :3, 3])[0]:
                continue

            if (frame := self._camera.frame(there)) is not None:
                self._taken.append(direction)
                return (
                    frame
                    if self.named in ("known", "mask")
                    else replace(frame, mask=None)
                )
            self._refused.append(direction)
        raise NoViewLeftError(
            "the target shows from no other place that can be reached"
        )

    def refused(self, error: ObservationError) -> None:
        """Report that the target was not found; the viewpoint is not used again."""
        self._refused.append(self._taken.pop())
