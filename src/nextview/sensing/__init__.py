"""Turn sensor frames into observations: support plane, segmentation, object frame, denoising."""

from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.sensing.observed_object import ObservedObject
from nextview.sensing.plausibility import ViewWarning, check_observation, check_views

__all__ = [
    "Box",
    "Frame",
    "ObjectFrame",
    "ObservedObject",
    "ViewWarning",
    "check_observation",
    "check_views",
]
