"""The gain policy: what inference needs of it. How it is trained is in ``nextview.training``."""

from nextview.policies.gain.decision_features import (
    INPUTS,
    VISIBILITY,
    Frame,
    features,
    maps_of,
    mirrored,
    mirrored_features,
    ordered,
    origin,
)
from nextview.policies.gain.gain_policy import Gain

__all__ = [
    "INPUTS", "VISIBILITY", "Frame", "Gain", "features", "maps_of", "mirrored", "mirrored_features", "ordered",
    "origin",
]  # fmt: skip
