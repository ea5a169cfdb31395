"""The view of one object that is chosen by its pixels."""

from __future__ import annotations

import numpy as np

from nextview.segmentation.instances import Instances
from nextview.sensing.frame import Frame
from nextview.sensing.observation import Observation
from nextview.sensing.view import View
from nextview.types import Float

NOT_LEVEL = np.inf  # height of pixels of which no plane is known


def view_of(observation: Observation) -> View:
    """Return the view of an object that an observation was made of, in metres.

    Args:
        observation: a view of the object, with a scale; its pixels are the only segment, and all
            others show what is known otherwise. Without a frame, the world is the object frame.
    """
    sighting = observation.sighting
    scale = _scale(observation)
    if sighting is None:
        depth = observation.depth * np.float32(scale)
        pose = _in_metres(observation.pose, scale)
        frame = Frame(depth, observation.intrinsics, pose, pixel_centre=0.5)
        target = depth > 0
        plane = None
    else:
        depth = sighting.frame.depth * np.float32(scale)
        pose = _in_metres(sighting.frame.camera_to_world, scale)
        frame = sighting.frame.with_pose(pose).with_depth(depth)
        target = sighting.mask
        plane = sighting.plane

    height = np.full(frame.shape, NOT_LEVEL, np.float32)
    up = np.array([0.0, 0.0, 1.0])
    if plane is not None:
        height = frame.along(plane.normal, plane.offset * scale)
        up = plane.normal
    none = np.zeros(frame.shape, bool)
    measured = frame.depth > 0
    instances = Instances((target & measured,), none, none)
    rest = measured & ~target
    return View.of(frame, instances, measured, height, up, np.inf, rest)


def into_object(observation: Observation) -> Float:
    """Return the motion from the world of ``view_of`` to the object frame, (4, 4), metres."""
    found = np.eye(4)
    if observation.object_frame is not None:
        axes = observation.object_frame.axes
        centre = observation.object_frame.centre * _scale(observation)
        found[:3] = np.column_stack([axes, -axes @ centre])
    return found


def _in_metres(pose: Float, scale: float) -> Float:
    """Return a pose, (4, 4), whose places are multiplied by a factor."""
    found = pose.copy()
    found[:3, 3] *= scale
    return found


def _scale(observation: Observation) -> float:
    """Return the metres of a unit of the frame of an observation, or of an object radius."""
    radius = observation.radius or 1.0
    known = observation.object_frame
    return radius if known is None else radius / known.radius
