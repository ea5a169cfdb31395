"""How long things take: the bundled networks, and updates of a session.

    python -m benchmarks.latency networks [--threads 2] [--models NAME-or-card ...]
    python -m benchmarks.latency session [--updates 200] [--threads 2] [--cpu] [--threshold 1]

``networks``: how long the bundled networks take for one view, and how near that is to what the
cores can multiply. For each network: milliseconds a view (median and the 95th percentile over
single views, ONNX Runtime), multiplications and additions of its convolutions and matrix products,
and their rate as a share of the rate of a large matrix product in single precision, measured in the
same run by ONNX Runtime on as many threads. Needs the train extra, for onnx.

``session``: how long one update takes, from a 640 x 480 frame on, and whether memory stays flat
over many. A chair on a table, noise 1 mm, 3 % holes, from random places around it; sessions of up
to five frames, one after the other, that never reach the threshold by default. The time of an
update is until it is said where to look next, or, in the last one, what the object is. Prints the
mean, the median and the 99th percentile of the milliseconds, in parts: finding the object in the
frame (noise, support plane, cluster), its geometry (surface, object frame, images, of earlier
frames too where the object frame got better), the networks, the policy, and the rest (checks). Then
the same by the number of the frame in its session, and the resident memory after each tenth of the
updates.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.data.samples import sample_mesh
from nextview.geometry.viewsphere import look_at_origin
from nextview.recognition.inference import open_weights
from nextview.recognition.model_card import ModelCard, find_card
from nextview.runtime import ort
from nextview.sensing import Frame, ObservedObject, plausibility, resampling, sighting
from nextview_lab.extras import require

NETWORKS = ("lcm-modelnet10", "lem-modelnet10", "recogniser-modelnet10")
SIDE = 2048  # of the matrices of the baseline

INTRINSICS = np.array([[520.0, 0, 319.5], [0, 520.0, 239.5], [0, 0, 1]])
SHAPE = 480, 640
FRAMES = 40  # different ones; they come again
PARTS = ("finding", "geometry", "networks", "policy", "rest")


def flops(card: ModelCard, shape: tuple[int, ...]) -> float:
    """Multiplications and additions of one forward pass, an input of (1, ...), in convolutions
    and matrix products.
    """
    import onnx
    from onnx import shape_inference

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
    from onnx import TensorProto, helper

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


def networks(
    models: tuple[str, ...] = NETWORKS,
    threads: int = 2,
    rounds: int = 200,
    seed: int = 0,
) -> None:
    """Print how long the networks take for one view.

    Args:
        models: names of bundled models or cards.
        threads: of ONNX Runtime.
        rounds: views that are timed.
        seed: of the noise that stands for a view.
    """
    require("train")
    product = matrix_product(threads)
    rng = np.random.default_rng(seed)
    print(
        f"{'':22}{'ms a view':>10}{'95 %':>8}{'MFLOP':>9}{'GFLOP/s':>9}{'of a matrix product':>21}"
    )
    for card in map(find_card, models):
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


class Clock:
    """Adds up the time that passes within functions, by the part that they belong to."""

    def __init__(self, now: Callable[[], float]) -> None:
        self.now = now
        self.spent: dict[str, float] = defaultdict(float)

    def timed(
        self,
        part: str,
        run: Callable[..., Any],
        within: str = "",
    ) -> Callable[..., Any]:
        """A function that does the same and is timed; its time is taken from that of the part
        within which it runs.
        """

        def timed(*given: Any, **more: Any) -> Any:
            begun = self.now()
            try:
                return run(*given, **more)
            finally:
                took = self.now() - begun
                self.spent[part] += took
                if within:
                    self.spent[within] -= took

        return timed


def frames(rng: np.random.Generator) -> list[Frame]:
    """Frames of a chair on a table."""
    mesh = sample_mesh("chair")
    scene = EmbreeScene()
    vertices = 0.12 * mesh.vertices
    vertices[:, 2] -= vertices[:, 2].min()
    corners = np.array(
        [[-0.7, -0.7, 0], [0.7, -0.7, 0], [0.7, 0.7, 0], [-0.7, 0.7, 0]],
        np.float32,
    )
    TriangleMesh(
        scene,
        vertices.astype(np.float32),
        np.ascontiguousarray(mesh.faces, np.int32),
    )
    TriangleMesh(scene, corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    row, column = np.indices(SHAPE)
    rays = (
        np.stack([column, row, np.ones(SHAPE)], -1).reshape(-1, 3)
        @ np.linalg.inv(INTRINSICS).T
    )
    found = []
    for _ in range(FRAMES):
        pose = look_at_origin(
            np.radians(rng.uniform(15, 70)),
            rng.uniform(0, 2 * np.pi),
            0.6,
        )
        pose[2, 3] += 0.1
        origins = np.tile(pose[:3, 3].astype(np.float32), (len(rays), 1))
        hits = scene.run(origins, (rays @ pose[:3, :3].T).astype(np.float32), output=1)
        depth = np.where(hits["primID"] >= 0, hits["tfar"], np.nan).reshape(
            SHAPE
        ) + rng.normal(0, 0.001, SHAPE)
        depth[rng.random(SHAPE) < 0.03] = np.nan
        found.append(Frame(depth, INTRINSICS, pose))
    return found


def resident() -> float:
    """MiB of memory that this process holds (Linux)."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def session(
    updates: int = 200,
    threads: int = 2,
    cpu: bool = False,
    seed: int = 0,
    threshold: float = 1.0,
) -> None:
    """Print how long the updates of a session take.

    Args:
        updates: how many are timed, after one session that is not.
        threads: of ONNX Runtime.
        cpu: count the time of the processor, not that of the clock on the wall; with one thread.
        seed: of the places and the noise.
        threshold: of the sessions; 0.97 is that of use.
    """
    system = nextview.load(threshold=threshold, threads=threads)
    views = frames(np.random.default_rng(seed))
    clock = Clock(time.process_time if cpu else time.perf_counter)
    taken = []
    memory = []
    # What is timed is wrapped here, so that the product itself knows nothing of it.
    for module, name, part in (
        (sighting, "fit_facets", "geometry"),
        (sighting, "enclose", "geometry"),
        (resampling, "look_again", "geometry"),
        (plausibility, "check_observation", "rest"),
        (plausibility, "check_last_view", "rest"),
    ):
        timed = clock.timed(part, getattr(module, name), within="finding")
        setattr(module, name, timed)
    policy_type = type(system.policy)
    models_type = type(system.models)
    policy_type.scores = clock.timed("policy", policy_type.scores)  # type: ignore[attr-defined]
    ObservedObject.add = clock.timed("finding", ObservedObject.add)  # type: ignore[method-assign]
    models_type.evidence = clock.timed("networks", models_type.evidence)  # type: ignore[method-assign]
    recogniser = type(system.models.recogniser)
    recogniser.novelty_scores = clock.timed("networks", recogniser.novelty_scores)  # type: ignore[method-assign]
    k = -5
    while k < updates:
        thing = ObservedObject(life_size=False)
        looking = system.session(object=thing, distance=0.6)
        while not looking.done and k < updates:
            clock.spent.clear()
            begun = clock.now()
            looking.update(views[k % FRAMES])
            if looking.done:
                # whether it is of a known class is asked for here, where not before
                str(looking.result)
            took = clock.now() - begun
            clock.spent["rest"] += took - sum(clock.spent.values())
            if k >= 0:
                taken.append(
                    (len(looking.views), took, *(clock.spent[part] for part in PARTS))
                )
                if k % max(1, updates // 10) == 0 or k == updates - 1:
                    memory.append((k, resident()))
            k += 1
    table = np.array(taken)
    numbers = table[:, 0]
    times = 1e3 * table[:, 1:]
    print(
        "mean: "
        + ", ".join(
            f"{name} {m:.1f}"
            for name, m in zip(("all", *PARTS), times.mean(0), strict=True)
        )
    )
    print(
        f"{'ms':16}{'updates':>8}" + "".join(f"{name:>18}" for name in ("all", *PARTS))
    )
    for label, rows in [
        ("all", numbers > 0),
        *((f"frame {n}", numbers == n) for n in range(1, 6)),
    ]:
        if rows.any():
            middle = np.median(times[rows], 0)
            high = np.percentile(times[rows], 99, axis=0)
            cells = "".join(
                f"{f'{m:.1f} ({h:.1f})':>18}" for m, h in zip(middle, high, strict=True)
            )
            print(f"{label:16}{int(rows.sum()):8}{cells}")
    print("median (99th percentile)")
    print("MiB after updates: " + ", ".join(f"{k}: {size:.0f}" for k, size in memory))


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.extras.subcommand_cli_from_dict({"networks": networks, "session": session})
