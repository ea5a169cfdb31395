"""From the trained networks of the gain policy, or of an agent, to one ONNX file that gives the same answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from nextview.errors import ModelError
from nextview.models.model_card import file_hash
from nextview.models.onnx_file import open_onnx
from nextview.outputs import written_whole
from nextview.policies.gain import Gain
from nextview.policies.gain.gain_file import FEATURES_INPUT
from nextview.policies.policy_card import PolicyCard, write_policy_card
from nextview.training.gain.perceptrons import Perceptrons

OPSET = 18
IR_VERSION = 8
"""That of the ONNX releases with this opset: older ONNX Runtimes read it too."""

BOUND = 1e-5
"""How far the file's answers may be from those of the networks in double precision; of answers larger than 1, so large
a part of the largest. For gains a fiftieth of the lowest travel weight that is tried."""


def gain_graph(perceptrons: Perceptrons) -> onnx.ModelProto:
    """One graph: "told" (B, D) float32 in, "cells" (B, V) float32 out, B free, weights in single precision.

    Every row is a product of its own: (B, 2, E, 1, in) by (2, E, in, out), the 2 being the object and its mirror image.
    Which kernel ONNX Runtime takes for a product depends on its shape and on the machine, and kernels may differ in the
    last bit; so it is the same product whether a row is asked alone, live, or with many others, in replay.

    Added to every answer is zero times the sum of all weights, which is not a number if one of them is not finite: so
    such a file shows without its weights being read, even where a ReLU hides the fault. It is worked out once, on
    loading.
    """
    p, e = perceptrons, len(perceptrons.networks)
    depths = {len(layers) for layers in p.networks}
    if len(depths) > 1:
        raise ModelError("the networks are not equally deep")
    d, v = len(p.features_flip), len(p.cells_flip)
    faces = np.stack([np.arange(d), p.features_flip])[:, None, None, :]
    straight = np.arange(e * v).reshape(e, v)
    constants: dict[str, NDArray[Any]] = {
        "faces": faces,
        "flat": np.array([-1, 2 * e * v]),
        "straight": straight,
        "turned": e * v + straight[:, p.cells_flip],
        "networks": np.array([1]),
        "half": np.array(0.5, np.float32),
        "nothing": np.array(0, np.float32),
    }
    nodes = [helper.make_node("Gather", [FEATURES_INPUT, "faces"], ["values0"], axis=1)]
    for i, layer in enumerate(zip(*p.networks, strict=True)):
        constants[f"weights{i}"] = np.stack([weights for weights, _ in layer])[None].astype(np.float32)
        constants[f"bias{i}"] = np.stack([bias for _, bias in layer])[:, None].astype(np.float32)
        nodes += [
            helper.make_node("Concat", [f"weights{i}", f"weights{i}"], [f"twice{i}"], axis=0),
            helper.make_node("MatMul", [f"values{i}", f"twice{i}"], [f"product{i}"]),
            helper.make_node("Add", [f"product{i}", f"bias{i}"], [f"sum{i}"]),
            helper.make_node("ReduceSum", [f"weights{i}"], [f"weights{i}_sum"], keepdims=0),
            helper.make_node("ReduceSum", [f"bias{i}"], [f"bias{i}_sum"], keepdims=0),
            helper.make_node("Relu", [f"sum{i}"], [f"values{i + 1}"]),
        ]
    last = nodes.pop().input[0]
    nodes += [
        helper.make_node("Reshape", [last, "flat"], ["all"]),
        helper.make_node("Gather", ["all", "straight"], ["object"], axis=1),
        helper.make_node("Gather", ["all", "turned"], ["mirror"], axis=1),
        helper.make_node("Add", ["object", "mirror"], ["both"]),
        helper.make_node("ReduceMean", ["both", "networks"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "half"], ["worth"]),
        helper.make_node("Sum", [name for node in nodes for name in node.output if name.endswith("_sum")], ["total"]),
        helper.make_node("Mul", ["total", "nothing"], ["fault"]),
        helper.make_node("Add", ["worth", "fault"], ["cells"]),
    ]
    inputs = [helper.make_tensor_value_info(FEATURES_INPUT, TensorProto.FLOAT, ["batch", d])]
    outputs = [helper.make_tensor_value_info("cells", TensorProto.FLOAT, ["batch", v])]
    initial = [numpy_helper.from_array(np.ascontiguousarray(values), name) for name, values in constants.items()]
    graph = helper.make_graph(nodes, "gain", inputs, outputs, initial)
    model = helper.make_model(
        graph, producer_name="nextview", opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def write_gain(card: Path, policy: Gain, about: PolicyCard, features: NDArray[np.float32]) -> float:
    """Write a policy that was trained: the ONNX file, then the card, each aside and then renamed.

    Args:
        card: NAME.json; the ONNX file is NAME.onnx.
        policy: whose score is of ``Perceptrons``.
        about: the card, to which the hash and what the policy itself says are added.
        features: states on which the file is compared with the networks, (S, D).

    Returns:
        By how much their answers differ at most.

    Raises:
        ModelError: by more than BOUND, or the policy is of other networks; then nothing is written.
    """
    if not isinstance(policy.score, Perceptrons):
        raise ModelError("only a policy that was just trained can be written")
    weights = card.with_suffix(".onnx")
    with written_whole(weights) as part:
        onnx.save(gain_graph(policy.score), part)
        sha256 = file_hash(part)
        answers = open_onnx(part, sha256, threads=1).run(["cells"], {FEATURES_INPUT: features.astype(np.float32)})[0]
        expected = policy.score(features.astype(np.float64))
        difference = float(np.abs(answers - expected).max())
        if not difference <= BOUND * max(1.0, float(np.abs(expected).max())):
            raise ModelError(
                f"{weights}: ONNX Runtime's answers differ by {difference:.2g} from the networks'; not written"
            )
    write_policy_card(card, replace(about, sha256=sha256, table=policy.to_dict(), scope=policy.scope))
    return difference
