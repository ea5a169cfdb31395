"""What tests share: tiny furniture and networks, meshes before a pinhole camera, and simulated
tables with a few things of the bundled memory.

``shared_fixtures.py`` makes fixtures from it.
"""

import hashlib
import json
import subprocess
import sys
from collections.abc import Sequence
from copy import copy, deepcopy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import pytest
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from onnx import TensorProto, helper, numpy_helper
from programs import main
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from nextview.data.samples import SAMPLE_MESHES, boxes_mesh
from nextview.geometry.mesh import Mesh, make_mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.resting import resting_poses
from nextview.geometry.viewsphere import look_at_origin, rotation_z
from nextview.recognition.inference import BINS_OUTPUT
from nextview.recognition.map_names import measure_of
from nextview.sensing.frame import Frame
from nextview.simulation.sensor import SENSORS, Sensor
from nextview.things.memory import taught_meshes

FURNITURE = ["chair", "monitor", "table"]
"""Of ``write_furniture``."""
SAMPLE_FILES = Path(__file__).parents[1] / "samples"


# Commands


def refused(capsys, *arguments, run=main) -> str:
    """What a command that ends with status 2 says on standard error, in one line."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        run([str(argument) for argument in arguments])
    assert end.value.code == 2
    return " ".join(capsys.readouterr().err.split())


def run_python(code: str, **options) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, **options
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


def write_scan(mesh: Mesh, folder: Path) -> Path:
    """Write a mesh of known size as it was scanned, in metres: ``folder/NAME.ply``."""
    path = folder / f"{mesh.name}.ply"
    placed = mesh.vertices * mesh.metres + mesh.centre
    trimesh.Trimesh(placed, mesh.faces, process=False).export(path)
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
                folder / label / split / f"{label}_{k}.off", boxes_mesh(boxes, label)
            )
    return folder


def drawn_thing(name: str) -> dict[str, np.ndarray]:
    """What is taught of a thing, drawn instead of looked at: a tetrahedron."""
    rng = np.random.default_rng([*name.encode()])
    return {
        "rotations": np.eye(3, dtype=np.float32)[None],
        "radii": np.array([0.1], np.float32),
        "upright": np.array([False]),
        "pictures": np.zeros((1, 64, 64), np.uint8),
        "vertices": rng.uniform(-0.1, 0.1, (4, 3)).astype(np.float32),
        "faces": np.array([(0, 1, 2), (0, 2, 3), (0, 3, 1), (1, 3, 2)], np.int32),
        "symmetries": np.zeros((0, 4)),
        "near_symmetries": np.zeros((0, 4)),
    }


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
            "logits", TensorProto.FLOAT, ["batch", len(classes)]
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
    folder: Path, name: str = "lem", rings: int = 5, valleys: tuple[str, ...] = ()
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
            "cloud", TensorProto.FLOAT, ["batch", "points", 3]
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
    path: Path, nodes: list, inputs: list, outputs: list, constants: dict, card: dict
) -> Path:
    initial = [
        numpy_helper.from_array(np.asarray(values), name)
        for name, values in constants.items()
    ]
    graph = helper.make_graph(nodes, "tiny", inputs, outputs, initial)
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9
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
    meshes: Sequence[trimesh.Trimesh], pose, intrinsics=INTRINSICS, shape=SHAPE
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
    elevation, azimuth, distance, target=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0)
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


# Tables with things of the bundled memory, and a camera that knows which of them it sees

CENTRE = np.array([0, 0, 0.03])


def meshes_of(names: Sequence[str]) -> dict[str, Mesh]:
    """Surfaces of the bundled memory, by name."""
    return dict(zip(names, taught_meshes("ycb", names), strict=True))


_RESTING: dict[tuple[bytes, bytes], np.ndarray] = {}


def resting_of(mesh: Mesh) -> np.ndarray:
    """Its resting poses, found once for all tables."""
    key = mesh.vertices.tobytes(), mesh.faces.tobytes()
    if key not in _RESTING:
        _RESTING[key] = resting_poses(mesh)
    return _RESTING[key]


@dataclass(frozen=True, eq=False)
class PlacedThing:
    """An object on a table: vertices (V, 3) in the frame of its file, metres, and its pose."""

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    pose: np.ndarray

    @property
    def placed(self) -> np.ndarray:
        """Vertices in the table frame, (V, 3), metres."""
        return self.vertices @ self.pose[:3, :3].T + self.pose[:3, 3]


@dataclass(frozen=True, eq=False)
class SimulatedTable:
    """Objects on a table whose top is the plane z = 0, centred at the origin."""

    things: tuple[PlacedThing, ...]

    @classmethod
    def draw(cls, meshes, rng, gap=0.10, resting=resting_poses):
        """Each in one of its resting poses with a random azimuth, beside another one: with a gap
        of up to ``gap`` metres.
        """
        things, outlines = [], []
        for mesh in meshes:
            metres = mesh.vertices * mesh.radius + mesh.centre
            poses = resting(mesh)
            turn = (
                rotation_z(rng.uniform(0, 2 * np.pi)) @ poses[rng.integers(len(poses))]
            )
            turned = metres @ turn.T
            middle = (turned.min(0) + turned.max(0)) / 2
            start = np.array([middle[0], middle[1], turned[:, 2].min()])
            flat = (turned - start)[:, :2]
            outline = flat[ConvexHull(flat).vertices]
            place = _free_place(outline, outlines, rng, gap)
            outlines.append(outline + place)
            pose = np.eye(4)
            pose[:3, :3] = turn
            pose[:3, 3] = np.append(place, 0.0) - start
            things.append(PlacedThing(mesh.name, metres, mesh.faces, pose))
        return cls(tuple(things))


def _free_place(outline, others, rng, gap) -> np.ndarray:
    """A place, (2,), where an outline about the origin, (K, 2), is clear of all others."""
    if not others:
        return rng.uniform(-0.05, 0.05, 2)
    for _ in range(100):
        wanted = rng.uniform(0, gap)
        beside = others[int(rng.integers(len(others)))].mean(0)
        angle = rng.uniform(0, 2 * np.pi)
        way = np.array([np.cos(angle), np.sin(angle)])
        for step in range(200):
            place = beside + 0.005 * step * way
            if min(separation(outline + place, other) for other in others) >= wanted:
                break
        if np.linalg.norm(place) < 0.36:
            return place
    raise AssertionError("the things do not fit on the table")


def separation(a: np.ndarray, b: np.ndarray) -> float:
    """Distance of two convex polygons along the best normal of an edge, metres."""

    def gap(a, b) -> float:
        edge = np.roll(a, -1, axis=0) - a
        outward = np.stack([edge[:, 1], -edge[:, 0]], 1)
        outward /= np.maximum(np.linalg.norm(edge, axis=1), 1e-12)[:, None]
        return float(((b @ outward.T).min(0) - (a * outward).sum(1)).max())

    return max(gap(a, b), gap(b, a))


class TableCamera:
    """A depth camera with the errors of a sensor in the world of a robot, over a table and a floor.

    Attributes:
        lean: from the table frame to the robot's world frame, (4, 4).
        shown: number of pixels of each object in the last frame.
        owner: object of each pixel in the last frame, -1 for none, (H, W).
        true_pose: of the camera for the last frame, in the table frame, (4, 4).
    """

    def __init__(self, table: SimulatedTable, sensor: Sensor, rng, room=()) -> None:
        self.sensor, self._rng, self._room = sensor, rng, tuple(room)
        self._drawn: dict[tuple, tuple] = {}
        angles = [*rng.normal(0, sensor.tilt, 2), 0]
        self.lean = np.eye(4)
        self.lean[:3, :3] = Rotation.from_rotvec(angles, degrees=True).as_matrix()
        rays = PinholeCamera.of(sensor.intrinsics, sensor.shape).rays
        self._rays = rays.reshape(-1, 3)
        self.change(table)

    def change(self, table: SimulatedTable) -> None:
        """Replace the table, for example after an object was moved."""
        self.table = table
        things = [(thing.placed, thing.faces) for thing in table.things]
        top, floor = box((1.5, 1.1, 0.03)), box((8, 8, 0.01))
        for slab, height in ((top, -0.015), (floor, -0.745)):
            slab.apply_translation((0, 0, height))
            things.append((slab.vertices, slab.faces.astype(np.int32)))
        self._caster = RayCaster([*things, *self._room])

    def again(self) -> "TableCamera":
        """The same camera as it is now; what either sees later changes nothing in the other, and
        is drawn once for both.
        """
        other = copy(self)
        other._rng = deepcopy(self._rng)
        return other

    @property
    def truth(self) -> dict[str, np.ndarray]:
        """True pose of each object's file in the robot's world, (4, 4), metres, by name."""
        return {thing.name: self.lean @ thing.pose for thing in self.table.things}

    def frame(self, pose: np.ndarray) -> Frame:
        """A frame from the pose, (4, 4), that the robot assumes."""
        number = self._rng.bit_generator.seed_seq.n_children_spawned
        rng = self._rng.spawn(1)[0]
        things = tuple((one.name, one.pose.tobytes()) for one in self.table.things)
        key = number, pose.tobytes(), things, self.sensor
        if key not in self._drawn:
            self._drawn[key] = self._draw(pose, rng)
        measured, self.owner, self.true_pose = self._drawn[key]
        count = len(self.table.things)
        self.shown = np.bincount(self.owner[self.owner >= 0], minlength=count)
        return Frame(measured, self.sensor.intrinsics, pose, pixel_centre=0.5)

    def _draw(self, pose, rng) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth, the object of each pixel, and the true pose."""
        true = np.linalg.inv(self.lean) @ pose
        turn = Rotation.from_rotvec(rng.normal(0, self.sensor.turned, 3), degrees=True)
        true[:3, :3] = true[:3, :3] @ turn.as_matrix()
        true[:3, 3] += rng.normal(0, self.sensor.moved, 3)

        depth, owner = self._caster.cast(true[:3, 3], self._rays @ true[:3, :3].T)
        clean = np.where(np.isfinite(depth), depth, 0).reshape(self.sensor.shape)
        measured, source = self.sensor.measure(clean.astype(np.float32), rng)
        count = len(self.table.things)
        owner = np.where((owner >= 0) & (owner < count), owner, -1)
        shown = np.where(source >= 0, owner[np.maximum(source, 0)], -1)
        shown[measured == 0] = -1
        return measured, shown.astype(np.int16), true


def poses_around(azimuths, elevation, distance, centre) -> np.ndarray:
    """Level camera poses around a point, aimed at it, (V, 4, 4); angles in radians."""
    elevations = np.full(len(azimuths), elevation)
    poses = look_at_origin(elevations, np.asarray(azimuths), distance)
    poses[:, :3, 3] += centre
    return poses


def camera_over(
    meshes: Sequence[Mesh], seed: int = 8, sensor: str = "stereo", gap: float = 0.08
) -> TableCamera:
    """A camera over a table on which some things are put down at random."""
    rng = np.random.default_rng(seed)
    table = SimulatedTable.draw(meshes, rng, gap, resting_of)
    return TableCamera(table, SENSORS[sensor], rng)


def view(degrees: float, elevation: float = 50.0, distance: float = 0.65) -> np.ndarray:
    """The pose of a camera that looks at the table's centre, (4, 4)."""
    return poses_around(np.radians([degrees]), np.radians(elevation), distance, CENTRE)[
        0
    ]


def without(table: SimulatedTable, name: str) -> SimulatedTable:
    """The same table after a thing was taken away."""
    return SimulatedTable(tuple(thing for thing in table.things if thing.name != name))
