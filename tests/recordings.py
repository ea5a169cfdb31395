"""Captures of every layout, as their tools write them: a camera around a box on the ground."""

import json
import struct

import numpy as np
import trimesh
from factories import box, cast, pose_at
from PIL import Image
from ros_messages import (
    CAMERA_INFO,
    DEPTH,
    header,
    image_message,
    info_message,
    tf_message,
    transform_message,
    write_bag,
)
from scipy.io import savemat
from scipy.spatial.transform import Rotation

SHAPE = 120, 160
K = np.array([[150.0, 0, 81.5], [0, 152, 58.2], [0, 0, 1]])
"""First pixel's centre at 0."""
HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""From there to a first pixel's centre at 0.5."""
START = 1_700_000_000.0
"""Seconds, as of a real clock."""
NAMES = ("000000", "000001", "000002")
CAMERA = {"fx": 150, "fy": 152, "cx": 81.5, "cy": 58.2, "width": 160, "height": 120}


def views_around(azimuths=(10, 40, 75)):
    """Depth, whole millimetres as uint16, and poses."""
    ground = box((3, 3, 0.02), (0, 0, -0.01))
    thing = box((0.2, 0.3, 0.25), (0, 0, 0.125))
    found = []
    for azimuth in azimuths:
        pose = pose_at(40, azimuth, 1.0, (0.02, 0, 0.1))
        depth, _ = cast((ground, thing), pose, K + HALF, SHAPE)
        depth[50:53, 20:40] = 0  # holes
        found.append((np.rint(1000 * depth).astype(np.uint16), pose))
    return found


def write_png(path, values, dtype=np.uint16):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(values, dtype)).save(path)


def points_of(depth, k=K):
    """Points of a depth image, (H, W, 3) float32, metres, NaN for holes."""
    rows, columns = np.indices(depth.shape)
    z = np.where(depth > 0, depth / 1000, np.nan)
    x = (columns - k[0, 2]) / k[0, 0] * z
    y = (rows - k[1, 2]) / k[1, 1] * z
    return np.stack([x, y, z], -1).astype(np.float32)


def packed_by_lzf(content):
    """Literal runs, and a reference to the eight bytes before wherever they are repeated."""
    out = bytearray()
    at = 0
    while at < len(content):
        begin = content[at - 8 : at] if at >= 8 else b""
        run = 0
        while begin and run < 200 and content[at + run : at + run + 8] == begin:
            run += 8
        if run >= 16:
            out += bytes([7 << 5, run - 2 - 7, 7])
            at += run
            continue
        literal = content[at : at + 8]
        out += bytes([len(literal) - 1]) + literal
        at += len(literal)
    return bytes(out)


def write_pcd(path, points, kind="binary", pose=None, **changed):
    """A cloud of PointXYZRGB, as PCL's writers lay it out: with padding only if binary."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = points.shape[:2]
    said = np.array([0, 0, 0, 1, 0, 0, 0.0])
    if pose is not None:
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        said = np.array([*pose[:3, 3], w, x, y, z])
    padded = kind == "binary"
    lines = {
        "VERSION": "0.7",
        "FIELDS": "x y z _ rgb _" if padded else "x y z rgb",
        "SIZE": "4 4 4 1 4 1" if padded else "4 4 4 4",
        "TYPE": "F F F U F U" if padded else "F F F F",
        "COUNT": "1 1 1 4 1 12" if padded else "1 1 1 1",
        "WIDTH": width,
        "HEIGHT": height,
        "VIEWPOINT": " ".join(f"{value:.9g}" for value in said),
        "POINTS": width * height,
        "DATA": kind,
    } | changed
    text = "# .PCD v0.7 - Point Cloud Data file format\n" + "".join(
        f"{name} {value}\n" for name, value in lines.items() if value is not None
    )
    flat = points.reshape(-1, 3)
    colour = np.full((len(flat), 1), 4.2108e06, np.float32)
    every = np.hstack([flat, colour]).astype(np.float32)
    if kind == "ascii":
        rows = (" ".join(f"{v:.9g}" for v in row) for row in every)
        content = "\n".join(rows).encode()
    elif padded:
        padding = np.zeros((len(flat), 1), np.float32)
        content = np.hstack([flat, padding, colour, *[padding] * 3]).tobytes()
    else:
        plain = every.T.tobytes()
        packed = packed_by_lzf(plain)
        content = struct.pack("<II", len(packed), len(plain)) + packed
    path.write_bytes(text.encode() + content)
    return path


def write_clouds(folder, views, kind="binary"):
    for name, (depth, pose) in zip(NAMES, views, strict=True):
        write_pcd(folder / f"{name}.pcd", points_of(depth), kind, pose)
    return folder


def write_bop(folder, views):
    """With depth in steps of 0.5 mm, and poses from the world to the camera."""
    cameras = {}
    for number, (depth, pose) in enumerate(views):
        write_png(folder / f"depth/{number:06d}.png", 2 * depth)
        there = np.linalg.inv(pose)
        cameras[str(number)] = {
            "cam_K": K.ravel().tolist(),
            "depth_scale": 0.5,
            "cam_R_w2c": there[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1000 * there[:3, 3]).tolist(),
        }
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return folder


def write_tum(folder, views):
    """With depth in steps of 0.2 mm, and a trajectory of other moments than the images'."""
    listed, lines = ["# time name"], ["# t x y z quaternion"]
    for number, (depth, pose) in enumerate(views):
        write_png(folder / f"depth/{number}.png", 5 * depth)
        listed.append(f"{number + 10}.00 depth/{number}.png")
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
        row = " ".join(f"{value:.9f}" for value in (*pose[:3, 3], *turn))
        lines += [f"{number + 9}.97 9 9 9 0 0 0 1", f"{number + 10}.004 {row}"]
    (folder / "depth.txt").write_text("\n".join(listed))
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")
    np.savetxt(folder / "camera-intrinsics.txt", K)
    return folder


def write_seven(folder, views):
    for number, (depth, pose) in enumerate(views):
        write_png(folder / f"frame-{number:06d}.depth.png", depth)
        np.savetxt(folder / f"frame-{number:06d}.pose.txt", pose)
    np.savetxt(folder / "camera-intrinsics.txt", K)
    return folder


def write_ycb_video(folder, views, **changed):
    """With depth in tenths of millimetres, and poses from the world to the camera."""
    for number, (depth, pose) in enumerate(views, 1):
        write_png(folder / f"{number:06d}-depth.png", 10 * depth)
        Image.new("RGB", SHAPE[::-1]).save(folder / f"{number:06d}-color.jpg")
        meta = {
            "cls_indexes": np.array([[2], [5]], np.uint8),
            "factor_depth": np.array([[10000]], np.uint16),
            "intrinsic_matrix": K,
            "rotation_translation_matrix": np.linalg.inv(pose)[:3],
            "vertmap": np.zeros((*SHAPE, 3), np.float32),
        } | changed
        meta = {name: value for name, value in meta.items() if value is not None}
        path = folder / f"{number:06d}-meta.mat"
        savemat(path, meta, do_compression=bool(number % 2))
    return folder


def write_graspnet(folder, views, table=True):
    """One camera of a scene: poses relative to the first image, which is seen from the table."""
    (folder / "meta").mkdir()
    first = views[0][1]
    for number, (depth, _) in enumerate(views):
        write_png(folder / f"depth/{number:04d}.png", depth)
        write_png(folder / f"rgb/{number:04d}.png", np.zeros((*SHAPE, 3)), np.uint8)
        meta = {"intrinsic_matrix": K, "factor_depth": np.array([[1000]], np.uint16)}
        savemat(folder / f"meta/{number:04d}.mat", meta)
    poses = np.stack([np.linalg.inv(first) @ pose for _, pose in views])
    np.save(folder / "camera_poses.npy", poses)
    if table:
        np.save(folder / "cam0_wrt_table.npy", first)
    return folder


def write_folder(folder, views, camera=CAMERA, poses="files", scale=0.001):
    """Depth images and a file of intrinsics, with poses in one of four forms."""
    for number, (depth, pose) in enumerate(views):
        write_png(folder / f"depth/{number:04d}.png", depth)
        if poses == "files":
            (folder / "poses").mkdir(exist_ok=True)
            np.savetxt(folder / f"poses/{number:04d}.txt", pose)
    matrices = [pose.tolist() for _, pose in views]
    if poses == "json":
        (folder / "poses.json").write_text(json.dumps(matrices))
    if poses == "names":
        named = {f"{number:04d}": matrix for number, matrix in enumerate(matrices)}
        (folder / "poses.json").write_text(json.dumps(named))
    if poses == "log":
        lines = [
            "\n".join(
                [f"{n} {n} {n + 1}", *(" ".join(map(str, row)) for row in matrix)]
            )
            for n, matrix in enumerate(matrices)
        ]
        (folder / "trajectory.log").write_text("\n".join(lines) + "\n")
    fields = camera | ({} if scale is None else {"depth_scale": scale})
    (folder / "intrinsics.json").write_text(json.dumps(fields))
    return folder


def said_at(views, k=K):
    """What a camera on an arm that stops at each view says: topic, seconds, message of each."""
    said = []
    for number, (depth, pose) in enumerate(views):
        time = START + number
        for moment in (time - 0.05, time + 0.05):
            link = transform_message(pose, "optical", moment, "base_link")
            said.append(("/tf", moment, tf_message(link)))
        stamped = header("optical", time)
        said.append((DEPTH, time, image_message(depth, "16UC1", header=stamped)))
        info = info_message(k, depth.shape, header=stamped)
        said.append((CAMERA_INFO, time, info))
    return said


def write_recording(folder, views, **options):
    return write_bag(folder / "bag", said_at(views), **options)


LAYOUTS = {
    "BOP": write_bop,
    "TUM RGB-D": write_tum,
    "7-Scenes": write_seven,
    "YCB-Video": write_ycb_video,
    "GraspNet": write_graspnet,
    "PCD": write_clouds,
    "depth folder": write_folder,
    "ROS 2 bag": write_recording,
}
"""How each is written into a folder that is there; what is to be read comes back."""


def write_captured(mesh, folder, sphere, radius, table=False):
    """A mesh of a radius in metres, upon z = 0, from the viewpoints of a sphere, and its masks."""
    k = np.array([[525.0, 0, 319.5], [0, 525, 239.5], [0, 0, 1]])
    below = radius * mesh.vertices[:, 2].min()
    thing = trimesh.Trimesh(radius * mesh.vertices - (0, 0, below), mesh.faces)
    shown = [thing, box((4 * radius, 4 * radius, 0.02), (0, 0, -0.01))][: 1 + table]
    cameras = {}
    for number, pose in enumerate(sphere.poses):
        there = pose.copy()
        there[:3, 3] = radius * pose[:3, 3] - (0, 0, below)
        depth, which = cast(shown, there, k + HALF, (480, 640))
        name = f"{number:06d}"
        write_png(folder / f"depth/{name}.png", np.rint(10_000 * depth))
        mask = 255 * ((which == 0) & (depth > 0))
        write_png(folder / f"mask_visib/{name}_000000.png", mask, np.uint8)
        back = np.linalg.inv(there)
        cameras[str(number)] = {
            "cam_K": k.ravel().tolist(),
            "depth_scale": 0.1,
            "cam_R_w2c": back[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1000 * back[:3, 3]).tolist(),
        }
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
