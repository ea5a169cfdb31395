"""The view of one object that is chosen by its pixels."""

from __future__ import annotations

import numpy as np

from nextview.geometry.observation import Observation
from nextview.segmentation.instances import Instances
from nextview.sensing.frame import Frame
from nextview.sensing.view import View

NOT_LEVEL = np.inf  # height of pixels of which no plane is known


def view_of(observation: Observation) -> View:
    """Return the view of an object that an observation shows, in metres.

    Args:
        observation: a view of the object, with a scale; its pixels are the only segment, and all
            others show what is known otherwise.
    """
    radius = float(observation.radius or 1.0)
    scene = observation.scene
    if scene is None:
        depth = observation.depth
        target = depth > 0
        pose = observation.pose
        intrinsics = observation.intrinsics
        support = None
    else:
        depth = scene.depth
        target = scene.target
        pose = scene.pose
        intrinsics = scene.intrinsics
        support = scene.support

    # in metres
    pose = pose.copy()
    pose[:3, 3] *= radius
    metres = np.where(np.isfinite(depth), depth, 0).astype(np.float32) * np.float32(
        radius
    )
    frame = Frame(metres, intrinsics, pose, pixel_centre=0.5)
    height = np.full(depth.shape, NOT_LEVEL, np.float32)
    if support is not None:
        height = frame.along(support[:3], float(support[3]) * radius)

    none = np.zeros(depth.shape, bool)
    measured = frame.depth > 0
    instances = Instances((target & measured,), none, none)
    return View.of(frame, instances, measured, height, np.inf, measured & ~target)
