"""From a sensor frame to an observation: units and frames, support plane, segmentation, object frame, denoising."""

from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.sensing.observed_object import ObservedObject
from nextview.sensing.plausibility import Doubt, check_observation, check_views

__all__ = ["Box", "Doubt", "Frame", "ObjectFrame", "ObservedObject", "check_observation", "check_views"]
