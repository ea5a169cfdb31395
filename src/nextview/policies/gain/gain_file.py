"""The gain policy from its card and the ONNX file beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.errors import ModelError
from nextview.json_file import Fields
from nextview.models.onnx_file import check_end, open_onnx, run_onnx
from nextview.policies.base import Scope
from nextview.policies.gain.decision_features import mirrored_features
from nextview.policies.gain.gain_policy import Gain
from nextview.viewsphere import ViewSphere

FEATURES_INPUT = "told"
"""The name that the features have in the ONNX file."""


@takes_paths("weights")
def read_gain(
    sphere: ViewSphere, table: Any, scope: Scope, weights: Path, sha256: str, kind: type[Gain] = Gain
) -> Gain:
    """The policy that a card describes.

    Args:
        sphere: the viewpoints.
        table: what the card says of it under "table", see ``Gain.to_dict``.
        scope: where it may go.
        weights: the ONNX file, from "told" (B, D) to "cells" (B, V), both float32; see ``Gain.score``.
        sha256: of that file.
        kind: the policy that its scores are for.

    Raises:
        ModelError: the card makes no sense, or the file cannot be used or is one for other inputs or viewpoints.
        PolicyError: unknown inputs, frame or a negative travel weight.
    """
    fields = Fields(table, "the table")
    classes, inputs = fields.whole("classes", least=1), fields.texts("inputs", unique=True)
    travel_weight, frame = fields.number("travel_weight"), fields.text("frame")
    fields.end()
    session = open_onnx(weights, sha256, threads=1)

    def score(features: NDArray[np.float32]) -> NDArray[np.float32]:
        return run_onnx(weights, session, ["cells"], features)[0]

    policy = kind(sphere, classes, score, inputs, travel_weight, scope, frame)  # type: ignore[arg-type]  # it checks them
    width = len(mirrored_features(sphere, policy.classes, policy.inputs, policy.frame))
    ends = [*session.get_inputs(), *session.get_outputs()]
    if [end.name for end in ends] != [FEATURES_INPUT, "cells"]:
        names = ", ".join(end.name for end in ends)
        raise ModelError(f"{weights}: has {names}, not {FEATURES_INPUT} and cells")
    for end, size in zip(ends, (width, len(sphere)), strict=True):
        check_end(weights, end, "tensor(float)", (size,))
    # The graph answers with what is not a number if any weight is not finite, whatever it is given.
    score(np.zeros((1, width), np.float32))
    return policy
