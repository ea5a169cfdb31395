"""A small dataset in the layout of BOP: two images of a simulated table."""

import json
from pathlib import Path

import numpy as np
import trimesh
from factories import camera_over, meshes_of, view
from PIL import Image
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

NUMBERS = {"cracker_box": 2, "mug": 14}  # of the models
IDS = tuple(f"{name}={number}" for name, number in NUMBERS.items())
STRANGER = "banana"  # stands there, too, and is no model
VIEWS = ((3, 20.0), (7, 110.0))  # numbers of the images, and where they are taken from
STEP = 0.1  # mm, of the depth images


def in_millimetres(mesh) -> np.ndarray:
    return 1000 * (mesh.vertices * mesh.radius + mesh.centre)


def half_turns(vertices) -> list[list[float]]:
    """The three half turns of a box along the axes, about its centre."""
    centre = (vertices.min(0) + vertices.max(0)) / 2
    found = []
    for axis in np.eye(3):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(np.pi * axis).as_matrix()
        turn[:3, 3] = centre - turn[:3, :3] @ centre
        found.append(turn.ravel().tolist())
    return found


def write_models(folder: Path, meshes) -> None:
    folder.mkdir(parents=True)
    info = {}
    for name in NUMBERS.keys() & meshes.keys():
        number = NUMBERS[name]
        vertices = in_millimetres(meshes[name])
        model = trimesh.Trimesh(vertices, meshes[name].faces, process=False)
        model.export(folder / f"obj_{number:06d}.ply")
        diameter = pdist(trimesh.convex.convex_hull(vertices).vertices).max()
        info[number] = {"diameter": diameter}
        if name == "cracker_box":
            info[number]["symmetries_discrete"] = half_turns(vertices)
    (folder / "models_info.json").write_text(json.dumps(info))


def pose_as(pose, source, goal) -> dict:
    """A transform in metres as BOP writes it: cam_R_w2c and cam_t_w2c, or of a model."""
    return {
        f"cam_R_{source}2{goal}": pose[:3, :3].ravel().tolist(),
        f"cam_t_{source}2{goal}": (1000 * pose[:3, 3]).tolist(),
    }


def write_scene(folder: Path, meshes) -> None:
    (folder / "depth").mkdir(parents=True)
    camera = camera_over(list(meshes.values()))
    cameras, objects = {}, {}
    for number, degrees in VIEWS:
        frame = camera.frame(view(degrees))
        steps = np.rint(1000 * frame.depth / STEP).astype(np.uint16)
        Image.fromarray(steps).save(folder / f"depth/{number:06d}.png")
        matrix = np.array(frame.intrinsics)
        matrix[:2, 2] -= 0.5  # from a frame's own to the centre of the first pixel at 0
        to_camera = np.linalg.inv(camera.true_pose)
        cameras[number] = {
            "cam_K": matrix.ravel().tolist(),
            "depth_scale": STEP,
            **pose_as(to_camera, "w", "c"),
        }
        objects[number] = [
            {"obj_id": NUMBERS[thing.name], **pose_as(to_camera @ thing.pose, "m", "c")}
            for thing in camera.table.things
            if thing.name in NUMBERS
        ]
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    (folder / "scene_gt.json").write_text(json.dumps(objects))


def write_dataset(folder: Path) -> None:
    """Two images of a table with two models and a stranger."""
    meshes = meshes_of((*NUMBERS, STRANGER))
    write_models(folder / "models", meshes)
    write_scene(folder / "test/000001", meshes)
    targets = [
        {"scene_id": 1, "im_id": image, "obj_id": number, "inst_count": 1}
        for image, _ in VIEWS
        for number in NUMBERS.values()
    ]
    (folder / "test_targets_bop19.json").write_text(json.dumps(targets))
