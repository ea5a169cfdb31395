"""The gain policy: what inference needs of it. How it is trained is in ``nextview.training``."""

from nextview.policies.gain.decision_features import (
    INPUTS,
    MAPS,
    VISIBILITY,
    Frame,
    features,
    mirrored,
    mirrored_features,
    origin,
)
from nextview.policies.gain.gain_policy import Gain

__all__ = ["INPUTS", "MAPS", "VISIBILITY", "Frame", "Gain", "features", "mirrored", "mirrored_features", "origin"]
