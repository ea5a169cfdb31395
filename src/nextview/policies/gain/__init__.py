"""The gain policy: what inference needs of it. How it is trained is in ``nextview.training``."""

from nextview.policies.gain.decision_features import (
    INPUTS,
    MAPS,
    Frame,
    features,
    mirrored,
    mirrored_features,
    origin,
)
from nextview.policies.gain.gain_policy import Gain

__all__ = ["INPUTS", "MAPS", "Frame", "Gain", "features", "mirrored", "mirrored_features", "origin"]
