"""Make the features that taught things are remembered by: three frozen networks and a projection of
what they say.

    python -m research.thing_features data/ModelNet10 efficientnet-lite0-57934424.pth features
        [--things 600]

The networks are the two of the bundled recogniser and an EfficientNet-Lite0 with the weights of
ImageNet. The projection to 256 numbers begins as a linear discriminant of the same view without and
with a sensor's errors. It is then trained so that a view through a sensor finds the mean of a clean
view and one through another sensor among those of all things in the batch (InfoNCE). Half of the
meshes are laid down first, a quarter stretched. Of three projections (the discriminant alone, this
one, one trained against the views of all things at once) this one named most right of 60 objects of
twelve Princeton classes and 26 chairs that no network was trained on. Writes features.onnx.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path

from nextview_lab.extras import require

require("train")

import numpy as np
import onnx
import torch
import tyro
from numpy.typing import NDArray
from onnx import TensorProto, compose, helper, numpy_helper, utils
from torch import nn
from torch.nn import functional as F

from nextview.cli.exit_status import orderly_end
from nextview.data.folders import list_dataset
from nextview.files import sha256_of
from nextview.geometry.mesh import load_mesh, make_mesh
from nextview.geometry.viewsphere import look_at_origin
from nextview.recognition.inference import FEATURES_OUTPUT
from nextview.recognition.model_card import (
    BUNDLED_MODELS,
    RECOGNISER,
    find_card,
    read_card,
)
from nextview.recognition.network_input import from_observations
from nextview.runtime import OnnxFile, open_onnx
from nextview.simulation.sensed_camera import SensedCamera
from nextview.simulation.simulated import SimulatedCamera
from nextview_lab.training.architectures import LiteNet
from nextview_lab.training.export import export_onnx
from nextview_lab.training.runs import start_from

VIEWS = 16
SETUP = 8
DIM = 256
# of ImageNet's pixels
MIDDLE = 0.449
SPREAD = 0.226
LYING = ([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], [[1, 0, 0], [0, 0, -1], [0, 1, 0]])
HIGHEST = np.sin(np.radians(75))
NEAR = 0.35  # views are told from those of about the same elevation, radians


class LiteFeatures(nn.Module):
    """EfficientNet-Lite0 before its last layer, on the geometry channels, by ImageNet's weights."""

    def __init__(self, checkpoint: Path) -> None:
        super().__init__()
        self.net = LiteNet(1000, 4)
        start_from(self.net, checkpoint, head=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Features, (B, 1280), of images (B, 4, H, W) uint8."""
        return self.net.features((x.float() / 255 - MIDDLE) / SPREAD)


@lru_cache(maxsize=1)
def networks(lite: Path) -> tuple[OnnxFile, OnnxFile]:
    card = find_card(RECOGNISER)
    return open_onnx(card.path, card.sha256, 1), open_onnx(lite, sha256_of(lite), 1)


def look(
    lite: Path,
    mesh: Path,
    seed: int,
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Clean features (V, D), those through two sensors (2, V, D), where all is seen (V,), and
    elevations (V,).
    """
    rng = np.random.default_rng(seed)
    thing = load_mesh(mesh)
    if rng.random() < 0.5:
        vertices = (
            thing.vertices * np.exp(rng.uniform(-0.5, 0.5, 3))
            if rng.random() < 0.5
            else thing.vertices
        )
        thing = make_mesh(
            vertices @ np.array(LYING[rng.integers(2)]).T * rng.choice([-1, 1]),
            thing.faces,
        )
    elevation = np.arcsin(rng.uniform(-0.05, HIGHEST, VIEWS))
    azimuth = rng.uniform(0, 2 * np.pi, VIEWS)
    poses = look_at_origin(elevation, azimuth)
    clean = SimulatedCamera(thing)
    seen = [[clean.observe(pose) for pose in poses]]
    for sensor in ("wrist", rng.choice(["wrist", "mix"])):
        cameras = [
            SensedCamera(thing, str(sensor), child)
            for child in rng.spawn(VIEWS // SETUP)
        ]
        seen.append([cameras[k // SETUP].observe(pose) for k, pose in enumerate(poses)])
    recogniser, session = networks(lite)
    takes = find_card(RECOGNISER).input
    found = []
    for views in seen:
        inputs = {"input": from_observations(takes, views)}
        own = [
            recogniser.run([FEATURES_OUTPUT], inputs)[0],
            session.run(None, inputs)[0],
        ]
        found.append(np.concatenate(own, 1))
    shown = np.array([[view.seen for view in views] for views in seen[1:]]).all(0)
    return found[0], np.stack(found[1:]), shown, elevation


def discriminant(clean: NDArray, sensed: NDArray, middle: NDArray) -> NDArray:
    """Directions, (D, DIM), of much variance among all views and little between a view and
    itself through a sensor.
    """
    d = clean.shape[-1]
    every = np.concatenate([clean.reshape(-1, d), sensed.reshape(-1, d)]) - middle
    pairs = (clean - sensed[:, 0], clean - sensed[:, 1], sensed[:, 0] - sensed[:, 1])
    same = np.concatenate([pair.reshape(-1, d) for pair in pairs])
    total = every.T @ every / len(every)
    within = same.T @ same / len(same) / 2
    values, axes = np.linalg.eigh(within + 0.1 * np.trace(total) / d * np.eye(d))
    white = axes / np.sqrt(values)
    return (
        white @ np.linalg.eigh(white.T @ total @ white)[1][:, ::-1][:, :DIM]
    ).astype(np.float32)


def train(
    clean: NDArray,
    sensed: NDArray,
    seen: NDArray,
    elevation: NDArray,
    steps: int,
    seed: int,
) -> tuple[NDArray, NDArray]:
    """The middle of the features, (D,), and the projection, (D, DIM)."""
    rng = np.random.default_rng(seed)
    middle = np.concatenate([clean[:, None], sensed], 1).mean((0, 1, 2))
    first = torch.tensor(discriminant(clean, sensed, middle))
    projection = nn.Parameter(first.clone())
    scale = nn.Parameter(torch.tensor(np.log(20.0)))
    rate = 0.02 * float(first.abs().mean())
    optimiser = torch.optim.Adam([{"params": [projection]}, {"params": [scale]}])
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser,
        max_lr=[rate, 1e-2],
        total_steps=steps,
    )
    own = torch.tensor(clean - middle)
    through = torch.tensor(sensed - middle)

    def project(x: torch.Tensor) -> torch.Tensor:
        return F.normalize(x @ projection, dim=1)

    for _ in range(steps):
        objects = np.repeat(
            rng.choice(len(clean), min(96, len(clean)), replace=False),
            6,
        )
        views = np.concatenate(
            [rng.permutation(VIEWS)[:6] for _ in range(len(objects) // 6)]
        )
        memory = F.normalize(
            project(own[objects, views]) + project(through[objects, 1, views]),
            dim=1,
        )
        logits = project(through[objects, 0, views]) @ memory.T * scale.exp()
        e = torch.tensor(elevation[objects, views])
        logits = logits.masked_fill((e[:, None] - e).abs() > NEAR, -1e4)
        kept = torch.tensor(seen[objects, views])
        loss = F.cross_entropy(logits[kept], torch.arange(len(logits))[kept])
        loss = loss + 0.01 * ((projection - first) ** 2).sum() / (first**2).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return middle, projection.detach().numpy()


def joined(lite: Path, middle: NDArray, projection: NDArray, out: Path) -> None:
    """Write one network: both files side by side, then the projection to unit vectors."""
    part = out.with_suffix(".part.onnx")
    utils.extract_model(
        str(read_card(BUNDLED_MODELS / f"{RECOGNISER}.json").path),
        str(part),
        ["input"],
        ["features"],
    )
    graphs = [
        compose.add_prefix(onnx.load(path), name)
        for path, name in ((part, "pair_"), (lite, "lite_"))
    ]
    part.unlink()
    nodes = [node for graph in graphs for node in graph.graph.node]
    for node in nodes:
        node.input[:] = [
            "input" if name in ("pair_input", "lite_input") else name
            for name in node.input
        ]
    constants = [numpy_helper.from_array(middle.astype(np.float32), "middle")]
    constants += [numpy_helper.from_array(projection.astype(np.float16), "small")]
    constants += [
        numpy_helper.from_array(np.array([1]), "axis"),
        numpy_helper.from_array(np.float32(1e-9), "least"),
    ]
    made = [
        ("Concat", ["pair_features", "lite_features"], "joined", {"axis": 1}),
        ("Sub", ["joined", "middle"], "centred", {}),
        ("Cast", ["small"], "projection", {"to": TensorProto.FLOAT}),
        ("MatMul", ["centred", "projection"], "projected", {}),
        ("ReduceL2", ["projected", "axis"], "length", {"keepdims": 1}),
        ("Max", ["length", "least"], "longer", {}),
        ("Div", ["projected", "longer"], "embedding", {}),
    ]
    nodes += [
        helper.make_node(kind, inputs, [output], **more)
        for kind, inputs, output, more in made
    ]
    ends = (
        ("input", TensorProto.UINT8, ["batch", 4, 112, 112]),
        ("embedding", TensorProto.FLOAT, ["batch", DIM]),
    )
    given, gives = ([helper.make_tensor_value_info(*end)] for end in ends)
    weights = [w for graph in graphs for w in graph.graph.initializer] + constants
    graph = helper.make_graph(nodes, "features", given, gives, weights)
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", 18)],
        ir_version=graphs[0].ir_version,
    )
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, out)


def main(
    dataset: Path,
    checkpoint: Path,
    out: Path,
    things: int = 600,
    steps: int = 1200,
    seed: int = 0,
) -> None:
    """Make features.onnx in a folder from the training meshes that the bundled recogniser was
    trained on.
    """
    out.mkdir(parents=True, exist_ok=True)
    lite = out / "lite.onnx"
    export_onnx(
        LiteFeatures(checkpoint),
        np.zeros((2, 4, 112, 112), np.uint8),
        "input",
        ["features"],
        lite,
        8,
    )
    held_out = set(read_card(BUNDLED_MODELS / f"{RECOGNISER}.json").held_out)
    meshes = [
        e.path
        for e in list_dataset(dataset)
        if e.split == "train" and e.name not in held_out
    ]
    chosen = [
        meshes[i] for i in np.random.default_rng(seed).permutation(len(meshes))[:things]
    ]
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        found = list(pool.map(look, [lite] * len(chosen), chosen, range(len(chosen))))
    arrays = [
        np.stack([np.asarray(each[k], np.float32) for each in found]) for k in (0, 1, 3)
    ]
    seen = np.stack([each[2] for each in found])
    joined(
        lite,
        *train(arrays[0], arrays[1], seen, arrays[2], steps, seed),
        out / "features.onnx",
    )
    lite.unlink()


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main, config=(tyro.conf.PositionalRequiredArgs,))
