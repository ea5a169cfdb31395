"""What tests share: tiny furniture, tiny networks, made-up predictions, and small scenes before a
camera.

``conftest.py`` makes fixtures of whole pipelines from it.
"""

import hashlib
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from onnx import TensorProto, helper, numpy_helper
from programs import main
from scipy.spatial.transform import Rotation

from nextview.data.folders import Entry
from nextview.data.samples import SAMPLE_MESHES, boxes_mesh
from nextview.geometry.mesh import Mesh, make_mesh
from nextview.geometry.observation import pinhole
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.recognition.belief import Calibration
from nextview.recognition.inference import BINS_OUTPUT
from nextview.recognition.map_names import measure_of
from nextview_lab.data.measures import MeasuredView
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.store import DONE, ViewStore, describe

SPHERE = ViewSphere.named("40")
CLASSES = ["ball", "box", "pillar"]
"""Of ``some_predictions``."""
FURNITURE = ["chair", "monitor", "table"]
"""Of ``write_furniture``."""
SAMPLE_FILES = Path(__file__).parents[1] / "samples"


# Commands


def refused(capsys, *arguments) -> str:
    """What a command that ends with status 2 says on standard error, in one line."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    assert end.value.code == 2
    return " ".join(capsys.readouterr().err.split())


def run_python(code: str, **options) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        **options,
    )


# Meshes


def meshed(*parts: trimesh.Trimesh) -> Mesh:
    whole = trimesh.util.concatenate(parts)
    return make_mesh(whole.vertices, whole.faces)


def write_off(path: Path, mesh: Mesh) -> Path:
    lines = ["OFF", f"{len(mesh.vertices)} {len(mesh.faces)} 0"]
    lines += [" ".join(map(str, vertex)) for vertex in mesh.vertices]
    lines += [" ".join(map(str, (3, *face))) for face in mesh.faces]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return path


def write_furniture(folder: Path, train: int = 4, test: int = 2, seed: int = 0) -> Path:
    """Chairs, monitors and tables of boxes, each stretched at random, as
    ``folder/CLASS/SPLIT/CLASS_K.off``.
    """
    rng = np.random.default_rng(seed)
    for label in FURNITURE:
        for k in range(train + test):
            scale = rng.uniform(0.8, 1.25, 3)
            boxes = [
                tuple(tuple(np.multiply(corner, scale)) for corner in box)
                for box in SAMPLE_MESHES[label]()
            ]
            split = "train" if k < train else "test"
            write_off(
                folder / label / split / f"{label}_{k}.off",
                boxes_mesh(boxes, label),
            )
    return folder


# Networks of a few weights with the interface of the real ones


def make_recogniser(
    folder: Path,
    classes: list[str],
    size: int = 16,
    seed: int = 0,
    azimuth_bins: int = 0,
) -> Path:
    """A recogniser whose answers are random linear maps of each channel's mean over the image."""
    weights = (
        np.random.default_rng(seed).normal(size=(4, len(classes))).astype(np.float32)
        / 16
    )
    weights -= weights.mean(0)
    nodes = [
        helper.make_node("Cast", ["input"], ["real"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["real", "image"], ["features"], keepdims=0),
        helper.make_node("MatMul", ["features", "weights"], ["logits"]),
    ]
    shape = ["batch", 4, size, size]
    inputs = [helper.make_tensor_value_info("input", TensorProto.UINT8, shape)]
    outputs = [
        helper.make_tensor_value_info(
            "logits",
            TensorProto.FLOAT,
            ["batch", len(classes)],
        )
    ]
    outputs += [
        helper.make_tensor_value_info("features", TensorProto.FLOAT, ["batch", 4])
    ]
    constants = {"weights": weights, "image": np.array([2, 3])}
    card: dict = {
        "kind": "recogniser",
        "classes": classes,
        "input": {"kind": "geometry", "size": size},
    }
    if azimuth_bins:
        nodes += [
            helper.make_node("MatMul", ["features", "side_weights"], ["flat"]),
            helper.make_node("Reshape", ["flat", "side_shape"], ["shaped"]),
            helper.make_node("LogSoftmax", ["shaped"], [BINS_OUTPUT], axis=2),
        ]
        shape = ["batch", len(classes), azimuth_bins]
        outputs += [
            helper.make_tensor_value_info(BINS_OUTPUT, TensorProto.FLOAT, shape)
        ]
        side_weights = (
            np.random.default_rng(seed + 1)
            .normal(size=(4, len(classes) * azimuth_bins))
            .astype(np.float32)
        )
        constants |= {
            "side_weights": side_weights / 16,
            "side_shape": np.array([-1, *shape[1:]]),
        }
        card["azimuth_bins"] = azimuth_bins
    return _save(folder / "tiny.json", nodes, inputs, outputs, constants, card)


def make_map_network(
    folder: Path,
    name: str = "lem",
    rings: int = 5,
    valleys: tuple[str, ...] = (),
) -> Path:
    """A map network whose cells are a random linear map of the cloud's middle."""
    weights = np.random.default_rng(1).normal(size=(3, 3 * rings)).astype(np.float32)
    nodes = [
        helper.make_node("ReduceMean", ["cloud", "points"], ["middle"], keepdims=0),
        helper.make_node("MatMul", ["middle", "weights"], ["flat"]),
        helper.make_node("Reshape", ["flat", "shape"], ["map"]),
    ]
    inputs = [
        helper.make_tensor_value_info(
            "cloud",
            TensorProto.FLOAT,
            ["batch", "points", 3],
        )
    ]
    outputs = [
        helper.make_tensor_value_info("map", TensorProto.FLOAT, ["batch", rings, 3])
    ]
    constants = {
        "weights": weights,
        "points": np.array([1]),
        "shape": np.array([-1, rings, 3]),
    }
    card = {"kind": name, "measure": measure_of(name), "valley_classes": list(valleys)}
    card |= {"input": {"kind": "cloud"}, "output": "window"}
    return _save(folder / f"tiny-{name}.json", nodes, inputs, outputs, constants, card)


def _save(
    path: Path,
    nodes: list,
    inputs: list,
    outputs: list,
    constants: dict,
    card: dict,
) -> Path:
    initial = [
        numpy_helper.from_array(np.asarray(values), name)
        for name, values in constants.items()
    ]
    graph = helper.make_graph(nodes, "tiny", inputs, outputs, initial)
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", 18)],
        ir_version=9,
    )
    weights = path.with_suffix(".onnx")
    onnx.save(model, weights)
    sha256 = hashlib.sha256(weights.read_bytes()).hexdigest()
    path.write_text(
        json.dumps({"schema": 2, "name": path.stem, "sha256": sha256, **card})
    )
    return path


def change_card(path: Path, **values) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


# Predictions


def some_predictions(n: int = 6, seed: int = 0) -> Predictions:
    """Random logits and maps of ``n`` objects of three classes."""
    rng = np.random.default_rng(seed)
    return Predictions(
        rng.normal(size=(n, 40, 3)).astype(np.float32),
        {"lem": rng.random((n, 40, 5, 3)).astype(np.float32)},
        rng.random((n, 40)).astype(np.float32),
        tuple(f"thing_{i}" for i in range(n)),
        np.arange(n) % 3,
        tuple(CLASSES),
        np.array(["test"] * n),
        np.zeros(n, bool),
        SPHERE,
        {"recogniser": ("r", "0" * 64), "lem": ("l", "1" * 64)},
        {"lem": ("box",)},
    )


def train_predictions(
    logits,
    labels,
    sphere,
    classes,
    azimuth_bins=None,
    **fields,
) -> Predictions:
    """Predictions of objects of the training split of which nothing but this is known."""
    n, v, _ = logits.shape
    entropy, splits, conflicting = (
        np.zeros((n, v), np.float32),
        np.array(["train"] * n),
        np.zeros(n, bool),
    )
    given = (
        logits,
        {},
        entropy,
        tuple(map(str, range(n))),
        labels,
        classes,
        splits,
        conflicting,
        sphere,
        {},
        {},
    )
    return replace(Predictions(*given, azimuth_bins=azimuth_bins), **fields)


def scene_predictions(store: Path, classes: Sequence[str]) -> Predictions:
    """Random logits of a store of cluttered scenes.

    A view that hardly shows the target says nothing.
    """
    opened, rng = ViewStore.open(store), np.random.default_rng(0)
    shows = opened.measure("visible_share") > 0.3
    logits = np.where(
        shows[..., None],
        2 * rng.normal(size=(len(opened), 40, len(classes))),
        0,
    ).astype(np.float32)
    return replace(
        some_predictions(len(opened)),
        logits=logits,
        classes=tuple(classes),
        names=tuple(opened.names),
        maps={},
        valley_classes={},
        depth_entropy=opened.measure(),
        store=str(store),
        calibration=Calibration(1.0, 0.3),
    )


def benchmark(predictions: Path, out: Path, **settings):
    from nextview_lab.benchmark.classes import ClassSettings, benchmark_classes

    return benchmark_classes(predictions, out, ClassSettings(**settings))


def store_of(
    path: Path,
    names,
    labels,
    sphere: ViewSphere,
    size: int = 16,
    **arrays,
) -> ViewStore:
    """A store whose objects are rendered, if only these arrays of it hold anything:
    depth_entropy, image.
    """
    both = zip(names, map(str, labels), strict=True)
    entries = [Entry(Path(f"{name}.off"), name, label, "train") for name, label in both]
    store = ViewStore.create(path, describe(entries, sphere, size, {}))
    for name, values in arrays.items():
        store.group[name if name in store.rendered else f"measures/{name}"][:] = values
    store.group["status"][:] = DONE
    return store


def show_taught(scans: Path, models: Path, folder: Path, *options: str) -> None:
    """Taught things through a sensor: views.zarr, and what is said of them, predictions.npz."""
    store = str(folder / "views.zarr")
    render = ["render", str(scans), store, "--sensor", "wrist", "--rotated", *options]
    predict = ["predict", store, str(folder / "predictions.npz")]
    main([*render, "--workers", "0"])
    main([*predict, "--models", str(models), "--workers", "0"])


# Scenes: meshes in metres, and a pinhole camera that casts rays at them

INTRINSICS = np.array([[520.0, 0, 310.5], [0, 530.0, 246.5], [0, 0, 1]])
"""First pixel's centre at 0.5."""
SHAPE = 480, 640


def box(size, middle=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation(middle)


TABLE = box((1.4, 1.4, 0.04), (0, 0, -0.02))
"""Its top is at z = 0."""


def rays(intrinsics, shape) -> np.ndarray:
    """Directions with z = 1 through the centres of the pixels, camera frame, (H, W, 3)."""
    row, column = np.mgrid[: shape[0], : shape[1]] + 0.5
    return np.stack([column, row, np.ones_like(row)], -1) @ np.linalg.inv(intrinsics).T


def cast(
    meshes: Sequence[trimesh.Trimesh],
    pose,
    intrinsics=INTRINSICS,
    shape=SHAPE,
) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) float32, 0 = nothing, and which mesh is seen, -1 for none."""
    scene = EmbreeScene()
    for mesh in meshes:
        TriangleMesh(
            scene,
            mesh.vertices.astype(np.float32),
            np.ascontiguousarray(mesh.faces, np.int32),
        )
    directions = (rays(intrinsics, shape).reshape(-1, 3) @ pose[:3, :3].T).astype(
        np.float32
    )
    origins = np.tile(np.asarray(pose)[:3, 3].astype(np.float32), (len(directions), 1))
    hits = scene.run(origins, directions, output=1)
    hit = hits["primID"] >= 0
    depth, which = np.where(hit, hits["tfar"], 0), np.where(hit, hits["geomID"], -1)
    return depth.reshape(shape).astype(np.float32), which.reshape(shape)


def ball_depth(pose, intrinsics, size, radius=1.0, centre=(0, 0, 0)) -> np.ndarray:
    """Depth image of a ball, (size, size): the smaller root of a quadratic equation, 0 where
    there is none.
    """
    d, o = (
        rays(intrinsics, (size, size)) @ pose[:3, :3].T,
        pose[:3, 3] - np.array(centre),
    )
    a, b, c = (d * d).sum(-1), d @ o, o @ o - radius**2
    inside = b * b - a * c
    return np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, 0)


def pose_at(
    elevation,
    azimuth,
    distance,
    target=(0.0, 0.0, 0.0),
    turn=(0.0, 0.0, 0.0),
) -> np.ndarray:
    """A camera (degrees, metres) that looks at a target and is then turned about its own axes,
    degrees.
    """
    pose = look_at_origin(np.radians(elevation), np.radians(azimuth), distance)
    pose[:3, :3] = (
        pose[:3, :3] @ Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    )
    pose[:3, 3] += target
    return pose


def of_depth(depth, distance=3.0) -> MeasuredView:
    """What a measure is handed where the depth alone is known, from straight ahead."""
    depth = np.asarray(depth)
    return MeasuredView(
        depth,
        look_at_origin(0, 0, distance),
        pinhole(max(depth.shape), distance),
    )
