"""From a trained network to an ONNX file that gives the same answers, with half-precision weights."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from nextview.models.inference import BINS_OUTPUT, FEATURES_OUTPUT
from nextview.outputs import written_whole

OPSET = 18
SMALL = 2**17


class ShippedRecogniser(nn.Module):
    """The recogniser as it ships: raw input bytes in, logits out, and the features of all networks side by side.

    Where all networks know the azimuth bins of objects, a third output is what they say of them, see
    ``networks.ResNet``.

    Args:
        networks: their logits are averaged, and what they say of the azimuth bins.
    """

    def __init__(self, networks: Sequence[nn.Module]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)
        bins = {getattr(network, "azimuths", 0) for network in networks}
        self.azimuth_bins = bins.pop() if len(bins) == 1 else 0

    @property
    def outputs(self) -> list[str]:
        """Names of what it gives."""
        return ["logits", FEATURES_OUTPUT] + [BINS_OUTPUT] * bool(self.azimuth_bins)

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        x = x.float() / 255
        features = [network.features(x) for network in self.networks]
        outputs = [network.answers(seen) for network, seen in zip(self.networks, features, strict=True)]
        logits, joined = torch.stack([each[0] for each in outputs]).mean(0), torch.cat(features, 1)
        if not self.azimuth_bins:
            return logits, joined
        return logits, joined, torch.stack([each[1] for each in outputs]).mean(0).log_softmax(2)


class ShippedMap(nn.Module):
    """A map network as it ships, a ``PointNet`` or a ``ViewMap``.

    It gives the map of the window and, if it knows it, that of the sphere, (B, rings, azimuths).
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network, self.whole = network, network.shape[1] > 3

    def forward(self, seen: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        if seen.dtype == torch.uint8:
            seen = seen.float() / 255
        outputs = self.network(seen)[0]
        return (outputs[..., [-1, 0, 1]], outputs) if self.whole else outputs


def answer(network: nn.Module, inputs: NDArray) -> NDArray[np.float32]:
    """What a network, in torch, says of inputs (B, ...): its first output where it has several."""
    with torch.no_grad():
        outputs = network.eval()(torch.from_numpy(inputs))
    return (outputs[0] if isinstance(outputs, tuple) else outputs).numpy()


def export_onnx(
    network: nn.Module, example: NDArray, inputs: str, outputs: list[str], path: Path, bits: int = 16
) -> None:
    """Write a network as ONNX, batch size free, weights in fewer bits and arithmetic in single precision.

    Args:
        network: in evaluation mode.
        example: an input, (B, ...), B at least 2.
        inputs: name of the input.
        outputs: names of the outputs.
        path: the file, written aside and renamed.
        bits: that a weight takes, 16 or 8; see ``shrink_weights``.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            network.eval(),
            (torch.from_numpy(example),),
            dynamo=True,
            input_names=[inputs],
            output_names=outputs,
            dynamic_shapes=({0: torch.export.Dim("batch")},),
            opset_version=OPSET,
            verbose=False,
        )
    model = strip_traces(shrink_weights(program.model_proto, bits))
    onnx.checker.check_model(model, full_check=True)
    with written_whole(path) as part:
        onnx.save(model, part)


def strip_traces(model: onnx.ModelProto) -> onnx.ModelProto:
    """Take out what the exporter notes down of the machine: source lines and stack traces."""
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.value_info, *graph.input, *graph.output, *graph.initializer):
        del part.metadata_props[:]
        part.doc_string = ""
    return model


def shrink_weights(model: onnx.ModelProto, bits: int) -> onnx.ModelProto:
    """Store large float32 weights in fewer bits and turn them back where they are used: the arithmetic stays single.

    Args:
        model: changed in place.
        bits: 16 for half precision; 8 for integers, with a scale of its own for every output (row of the weight), save
            for weights of fewer than ``SMALL`` numbers: the first convolutions, where rounding does the most harm.
    """
    nodes, scales = [], []
    for weight in model.graph.initializer:
        if weight.data_type != TensorProto.FLOAT or np.prod(weight.dims) < 1024:
            continue
        name, values = weight.name, numpy_helper.to_array(weight)
        small = f"{name}_small"
        if bits == 16 or values.size < SMALL:
            weight.CopyFrom(numpy_helper.from_array(values.astype(np.float16), small))
            nodes.append(helper.make_node("Cast", [small], [name], to=TensorProto.FLOAT))
            continue
        scale = np.abs(values).max(tuple(range(1, values.ndim)), keepdims=True) / 127
        scale[scale == 0] = 1
        weight.CopyFrom(numpy_helper.from_array(np.rint(values / scale).astype(np.int8), small))
        scales.append(numpy_helper.from_array(scale.astype(np.float32), f"{name}_scale"))
        nodes.append(helper.make_node("Cast", [small], [f"{name}_steps"], to=TensorProto.FLOAT))
        nodes.append(helper.make_node("Mul", [f"{name}_steps", f"{name}_scale"], [name]))
    nodes += list(model.graph.node)
    model.graph.initializer.extend(scales)
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    return model
