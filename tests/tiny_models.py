"""Networks of a few weights with the interface of the real ones, for tests that run whole pipelines."""

import json
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from nextview.models.inference import BINS_OUTPUT
from nextview.models.model_card import file_hash


def make_recogniser(folder: Path, classes: list[str], size: int = 16, seed: int = 0, azimuth_bins: int = 0) -> Path:
    """A recogniser whose answers are random linear maps of each channel's mean over the image."""
    weights = np.random.default_rng(seed).normal(size=(4, len(classes))).astype(np.float32) / 16
    weights -= weights.mean(0)
    nodes = [
        helper.make_node("Cast", ["input"], ["real"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["real", "image"], ["features"], keepdims=0),
        helper.make_node("MatMul", ["features", "weights"], ["logits"]),
    ]
    shape = ["batch", 4, size, size]
    inputs = [helper.make_tensor_value_info("input", TensorProto.UINT8, shape)]
    outputs = [helper.make_tensor_value_info("logits", TensorProto.FLOAT, ["batch", len(classes)])]
    outputs += [helper.make_tensor_value_info("features", TensorProto.FLOAT, ["batch", 4])]
    constants = {"weights": weights, "image": np.array([2, 3])}
    card: dict = {"kind": "recogniser", "classes": classes, "input": {"kind": "geometry", "size": size}}
    if azimuth_bins:
        nodes += [
            helper.make_node("MatMul", ["features", "side_weights"], ["flat"]),
            helper.make_node("Reshape", ["flat", "side_shape"], ["shaped"]),
            helper.make_node("LogSoftmax", ["shaped"], [BINS_OUTPUT], axis=2),
        ]
        shape = ["batch", len(classes), azimuth_bins]
        outputs += [helper.make_tensor_value_info(BINS_OUTPUT, TensorProto.FLOAT, shape)]
        side_weights = np.random.default_rng(seed + 1).normal(size=(4, len(classes) * azimuth_bins)).astype(np.float32)
        constants |= {"side_weights": side_weights / 16, "side_shape": np.array([-1, *shape[1:]])}
        card["azimuth_bins"] = azimuth_bins
    return _save(folder / "tiny.json", nodes, inputs, outputs, constants, card)


def make_map_network(folder: Path, name: str = "lem", rings: int = 5, valleys: tuple[str, ...] = ()) -> Path:
    """A map network whose cells are a random linear map of the cloud's middle."""
    weights = np.random.default_rng(1).normal(size=(3, 3 * rings)).astype(np.float32)
    nodes = [
        helper.make_node("ReduceMean", ["cloud", "points"], ["middle"], keepdims=0),
        helper.make_node("MatMul", ["middle", "weights"], ["flat"]),
        helper.make_node("Reshape", ["flat", "shape"], ["map"]),
    ]
    inputs = [helper.make_tensor_value_info("cloud", TensorProto.FLOAT, ["batch", "points", 3])]
    outputs = [helper.make_tensor_value_info("map", TensorProto.FLOAT, ["batch", rings, 3])]
    constants = {"weights": weights, "points": np.array([1]), "shape": np.array([-1, rings, 3])}
    card = {"kind": name, "input": {"kind": "cloud"}, "output": "window", "valley_classes": list(valleys)}
    return _save(folder / f"tiny-{name}.json", nodes, inputs, outputs, constants, card)


def _save(path: Path, nodes: list, inputs: list, outputs: list, constants: dict, card: dict) -> Path:
    initial = [numpy_helper.from_array(np.asarray(values), name) for name, values in constants.items()]
    graph = helper.make_graph(nodes, "tiny", inputs, outputs, initial)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    weights = path.with_suffix(".onnx")
    onnx.save(model, weights)
    path.write_text(json.dumps({"schema": 1, "name": path.stem, "sha256": file_hash(weights), **card}))
    return path
