"""Turn sensor frames into observations: support plane, segmentation, object frame, denoising."""

from typing import TYPE_CHECKING, Any

from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.sensing.plausibility import ViewWarning, check_observation, check_views

if TYPE_CHECKING:
    from nextview.sensing.observed_object import ObservedObject

__all__ = [
    "Box",
    "Frame",
    "ObjectFrame",
    "ObservedObject",
    "ViewWarning",
    "check_observation",
    "check_views",
]


def __getattr__(name: str) -> Any:
    """Import ``ObservedObject`` lazily, because it needs SciPy."""
    if name == "ObservedObject":
        from nextview.sensing.observed_object import ObservedObject

        return ObservedObject
    raise AttributeError(f"module 'nextview.sensing' has no attribute {name!r}")
