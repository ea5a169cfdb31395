"""How long the bundled networks take for one view, and how near that is to what the cores can
multiply.

    python -m benchmarks.latency [--threads 2] [--models NAME-or-card ...]

For each network: milliseconds a view (median and the 95th percentile over single views, ONNX
Runtime), multiplications and additions of its convolutions and matrix products, and their rate as a
share of the rate of a large matrix product in single precision, measured in the same run by ONNX
Runtime on as many threads. Needs the train extra, for onnx.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from nextview.cli.exit_status import require

require("train")

import numpy as np
import onnx
import tyro
from numpy.typing import NDArray
from onnx import TensorProto, helper, shape_inference

from nextview.cli.exit_status import orderly_end
from nextview.recognition.inference import open_weights
from nextview.recognition.model_card import ModelCard, bundled_cards, find_card
from nextview.runtime import ort

SIDE = 2048
"""Of the matrices of the baselines."""


def flops(card: ModelCard, shape: tuple[int, ...]) -> float:
    """Multiplications and additions of one forward pass, an input of (1, ...), in convolutions
    and matrix products.
    """
    model = onnx.load(card.path)
    for size, dimension in zip(
        shape,
        model.graph.input[0].type.tensor_type.shape.dim,
        strict=True,
    ):
        dimension.Clear()
        dimension.dim_value = size
    graph = shape_inference.infer_shapes(model, data_prop=True).graph
    known = {
        v.name: [d.dim_value for d in v.type.tensor_type.shape.dim]
        for v in (*graph.input, *graph.value_info, *graph.output)
    }
    known |= {w.name: list(w.dims) for w in graph.initializer}
    total = 0
    for node in graph.node:
        if node.op_type == "Conv":
            total += (
                2
                * int(np.prod(known[node.output[0]]))
                * int(np.prod(known[node.input[1]][1:]))
            )
        elif node.op_type in ("Gemm", "MatMul"):
            deep = known[node.input[0]][-1]
            total += 2 * int(np.prod(known[node.output[0]])) * deep
    return float(total)


def matrix_product(threads: int) -> Callable[[], object]:
    """One product of two square matrices in single precision by ONNX Runtime."""
    pair = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [SIDE, SIDE])
        for name in "ab"
    ]
    out = helper.make_tensor_value_info("c", TensorProto.FLOAT, [SIDE, SIDE])
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["a", "b"], ["c"])],
        "product",
        pair,
        [out],
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", 18)],
        ir_version=8,
    )
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    session = ort.InferenceSession(
        model.SerializeToString(),
        options,
        providers=["CPUExecutionProvider"],
    )
    rng = np.random.default_rng(0)
    values = {name: rng.random((SIDE, SIDE), np.float32) for name in "ab"}
    return lambda: session.run(None, values)


def seconds(run: Callable[[], object], rounds: int) -> NDArray[np.float64]:
    """How long each of some runs takes, after one that does not count."""
    run()
    found = []
    for _ in range(rounds):
        began = time.perf_counter()
        run()
        found.append(time.perf_counter() - began)
    return np.array(found)


def main(
    models: tuple[str, ...] = (),
    threads: int = 2,
    rounds: int = 200,
    seed: int = 0,
) -> None:
    """Print the table.

    Args:
        models: names of bundled models or cards; all that are bundled by default.
        threads: of ONNX Runtime.
        rounds: views that are timed.
        seed: of the noise that stands for a view.
    """
    product = matrix_product(threads)
    rng = np.random.default_rng(seed)
    print(
        f"{'':22}{'ms a view':>10}{'95 %':>8}{'MFLOP':>9}{'GFLOP/s':>9}{'of a matrix product':>21}"
    )
    for card in map(find_card, models or bundled_cards()):
        session = open_weights(card, threads)
        sees = card.input.kind
        size = card.input.size
        channels = session.get_inputs()[0].shape[1]
        seen: NDArray = rng.random((1, 1024, 3), np.float32)
        if sees != "cloud":
            seen = rng.integers(0, 256, (1, channels, size, size), np.uint8)
        values = {session.get_inputs()[0].name: seen}
        work = flops(card, seen.shape)
        # beside each network: clocks change
        limit = 2 * SIDE**3 / np.median(seconds(product, 5))
        took = seconds(lambda s=session, v=values: s.run(None, v), rounds)  # type: ignore[misc]
        rate = work / np.median(took)
        share = f"{rate / limit:.2f} of {limit / 1e9:.0f}"
        milli = [1e3 * np.median(took), 1e3 * np.percentile(took, 95)]
        print(
            f"{card.name:22}{milli[0]:10.2f}{milli[1]:8.2f}{work / 1e6:9.0f}{rate / 1e9:9.0f}"
            f"{share:>21}"
        )


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.cli(main)
