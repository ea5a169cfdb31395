"""The gain policy from its card and the ONNX file beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ModelError
from nextview.models.onnx_file import open_onnx
from nextview.policies.gain import Gain, mirrored_features
from nextview.viewsphere import ViewSphere

FEATURES_INPUT = "told"
"""The name that the features have in the ONNX file."""


def read_gain(sphere: ViewSphere, facts: dict[str, Any], weights: Path) -> Gain:
    """The policy that a card describes.

    Args:
        sphere: the viewpoints.
        facts: what the card says.
        weights: the ONNX file, from "told" (B, D) to "cells" (B, V), both float32; see ``Gain.score``.

    Raises:
        ModelError: the file cannot be used, or is one for other inputs or viewpoints.
        PolicyError, KeyError or TypeError: the card is damaged.
    """
    table = facts["table"]
    session = open_onnx(weights, facts["sha256"], threads=1)

    def score(features: NDArray[np.float32]) -> NDArray[np.float32]:
        return session.run(["cells"], {FEATURES_INPUT: features})[0]

    policy = Gain(
        sphere,
        table["classes"],
        score,
        tuple(table["inputs"]),
        table["travel_weight"],
        facts["anywhere"],
        table.get("frame", "camera"),
    )
    width = len(mirrored_features(sphere, policy.classes, policy.inputs, policy.frame))
    wanted = [(FEATURES_INPUT, "tensor(float)", [width]), ("cells", "tensor(float)", [len(sphere)])]
    ends = [*session.get_inputs(), *session.get_outputs()]
    found = [(end.name, end.type, list(end.shape[1:])) for end in ends]
    if found != wanted or any(isinstance(end.shape[0], int) for end in ends):
        shapes = ", ".join(f"{end.name} {tuple(end.shape)}" for end in ends)
        raise ModelError(
            f"{weights}: has {shapes}, not {FEATURES_INPUT} (batch, {width}) and cells (batch, {len(sphere)})"
        )
    # The graph answers with what is not a number if any weight is not finite, whatever it is told.
    if not np.isfinite(score(np.zeros((1, width), np.float32))).all():
        raise ModelError(f"{weights}: a weight is not a finite number")
    return policy
