"""Depth images in a folder beside the intrinsics of their camera, as RealSense tools write them.

``depth/NAME.png``; the intrinsics in one of ``CAMERA_FILES``; if there, ``color/NAME.png`` or
.jpg of the same size, ``masks/NAME.png``, and the poses, camera-to-world, in metres: a file
``poses/NAME.txt`` for each image, ``poses.json`` (matrices by name, or a list of them in the
order of the images), or ``trajectory.log`` (Open3D).
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nextview.captured.camera_file import CameraFile, check_size, read_camera_file
from nextview.captured.frames import (
    LARGEST_TEXT,
    CapturedFrame,
    DepthFile,
    LayoutViews,
    numbers_of,
    opened_image,
    read_table,
    rigid,
)
from nextview.checks import did_you_mean
from nextview.errors import DatasetError, ObservationError
from nextview.files import read_record, regular_file
from nextview.types import Float

CAMERA_FILES = (
    "camera_info.yaml",
    "camera_info.yml",
    "camera_info.json",
    "intrinsics.json",
    "intrinsics.yaml",
    "intrinsics.yml",
    "intrinsic.json",
    "camera_intrinsics.json",
    "camera_intrinsic.json",
    "camera.json",
)
CAMERA_TABLES = ("cam_K.txt", "intrinsics.txt")  # a pinhole matrix alone
POSES = ("poses", "pose")
MASKS = ("masks", "mask")
COLOUR_FOLDERS = ("color", "colour", "rgb")
IMAGE_ENDINGS = (".png", ".jpg", ".jpeg")
LINES_OF_A_POSE = 5  # in Open3D's log: three numbers, and the rows of the matrix
ASK_FOR_SCALE = (
    "nothing says what one step of the depth images stands for: give --depth-scale, in metres"
    " (0.001 if they are in millimetres)"
)


def is_depth_folder(folder: Path) -> bool:
    """Whether a folder holds depth images in ``depth/``, and is not BOP's without its cameras.

    BOP's has ``mask_visib/`` too; without ``scene_camera.json`` it was not written to its end.
    """
    if (folder / "mask_visib").is_dir():
        return False
    return next(folder.glob("depth/*.png"), None) is not None


def read_depth_folder(
    folder: Path,
    given: CameraFile | None,
    scale: float | None,
) -> LayoutViews:
    """Read the poses and the intrinsics of a folder of depth images.

    Args:
        folder: which ``is_depth_folder``.
        given: its camera, if not that of the folder.
        scale: metres that one step of the images stands for, if not that of the folder.

    Raises:
        DatasetError: intrinsics or depth scale are missing; there are no poses, and more than one
            image; or a file is damaged.
    """
    camera, notes = _camera(folder, given)
    if scale is None and camera.scale is not None:
        notes.append(f"steps of {1000 * camera.scale:g} mm")
    scale = camera.scale if scale is None else scale
    if scale is None:
        raise DatasetError(f"{folder}: {ASK_FOR_SCALE}")

    images = sorted(folder.glob("depth/*.png"))
    poses, unreadable, of_poses = _poses(folder, [path.stem for path in images])

    # Which way is up in its world, no file says.
    views = LayoutViews([], [*notes, of_poses], unreadable, z_is_up=False)
    for path in images:
        depth = DepthFile(path)
        if path.stem not in poses:
            continue
        check_size(camera, depth)
        mask = _beside(folder, MASKS, path.stem)
        colour = _beside(folder, COLOUR_FOLDERS, path.stem)
        if colour is not None and not _same_size(colour, depth):
            colour = None  # not registered to the depth
        pose = poses[path.stem]
        views.frames.append(
            CapturedFrame(
                path.stem,
                depth,
                scale,
                camera.intrinsics,
                pose,
                mask,
                colour,
            )
        )
    return views


def read_depth_image(
    path: Path,
    camera: CameraFile | None,
    scale: float | None,
) -> LayoutViews:
    """A single depth image: its camera is the world.

    Args:
        path: grey PNG of 16 bits.
        camera: that took it.
        scale: metres that one step stands for; None if the camera's file says it.

    Raises:
        DatasetError: intrinsics or depth scale are missing.
    """
    if camera is None:
        raise DatasetError(
            f"{path}: the intrinsics of its camera are missing: give --intrinsics FX FY CX CY, or a"
            " file with them"
        )
    scale = camera.scale if scale is None else scale
    if scale is None:
        raise DatasetError(f"{path}: {ASK_FOR_SCALE}")
    depth = DepthFile(path)
    frame = CapturedFrame(path.stem, depth, scale, camera.intrinsics, np.eye(4))
    return LayoutViews([frame], ["one image: its camera is the world"], z_is_up=False)


def _camera(folder: Path, given: CameraFile | None) -> tuple[CameraFile, list[str]]:
    """The camera of a folder, and a note of where it is described, if it was not given."""
    described = [folder / name for name in CAMERA_FILES if (folder / name).exists()]
    tables = [folder / name for name in CAMERA_TABLES if (folder / name).exists()]
    if described:
        camera = read_camera_file(described[0])
        if given is None:
            return camera, [f"intrinsics of {described[0].name}"]
        return replace(given, scale=given.scale or camera.scale), []
    if given is not None:
        return given, []
    if tables:
        return read_camera_file(tables[0]), [f"intrinsics of {tables[0].name}"]

    others = [
        path.name
        for path in folder.iterdir()
        if path.suffix in (".json", ".yaml", ".yml")
    ]
    near = next((did_you_mean(name, CAMERA_FILES) for name in others), "").replace(
        "?",
        "",
    )
    raise DatasetError(
        f"{folder}: the intrinsics of the depth camera are missing: give --intrinsics FX FY CX CY"
        f" or a file, or put {CAMERA_FILES[0]} or {CAMERA_FILES[3]} into the folder{near}"
    )


def _poses(
    folder: Path,
    names: list[str],
) -> tuple[dict[str, Float], dict[str, str], str]:
    """Poses of images by their names, why others cannot be read, and a note of where they are."""
    for inside in POSES:
        if next(folder.glob(f"{inside}/*.txt"), None):
            poses, unreadable = _pose_files(folder / inside, names)
            return poses, unreadable, f"poses of {inside}/"
    listed = folder / "poses.json"

    if listed.exists():
        return *_pose_list(listed, names), "poses of poses.json"
    log = folder / "trajectory.log"
    if log.exists():
        return *_in_order(log, _log(log), names), "poses of trajectory.log"

    if len(names) == 1:
        return {names[0]: np.eye(4)}, {}, "no pose: the camera is the world"
    raise DatasetError(
        f"{folder}: has {len(names)} depth images and no poses of their camera: put them into"
        " poses/NAME.txt, poses.json or trajectory.log, or give a single image"
    )


def _pose_files(
    folder: Path,
    names: list[str],
) -> tuple[dict[str, Float], dict[str, str]]:
    """Poses of a file for each image."""
    poses = {}
    unreadable = {}
    for name in names:
        path = folder / f"{name}.txt"
        try:
            poses[name] = rigid(read_table(path, "the camera's pose", 4), str(path))
        except DatasetError as error:
            unreadable[name] = str(error)
    return poses, unreadable


def _pose_list(path: Path, names: list[str]) -> tuple[dict[str, Float], dict[str, str]]:
    """Poses of one JSON file, by name or in order."""
    Matrix = list[list[float]]
    found = read_record(path, dict[str, Matrix] | list[Matrix], "poses", DatasetError)  # type: ignore[arg-type]
    if isinstance(found, list):
        return _in_order(path, found, names)
    poses = {}
    unreadable = {}
    for name in names:
        try:
            if name not in found:
                raise DatasetError(f"{path}: has no pose of {name}")
            poses[name] = rigid(_matrix(found[name], path), f"{name} of {path}")
        except DatasetError as error:
            unreadable[name] = str(error)
    return poses, unreadable


def _matrix(rows: list[list[float]], path: Path) -> Float:
    """A pose as it stands in a file, (4, 4)."""
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        raise DatasetError(f"{path}: a pose is 4 rows of 4 numbers")
    return np.array(rows, np.float64)


def _log(path: Path) -> list[Any]:
    """The matrices of an Open3D log, in order."""
    regular_file(path, "a log of poses", DatasetError, LARGEST_TEXT)
    try:
        lines = [line.split() for line in path.read_text().splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read as text ({error})") from None
    if len(lines) % LINES_OF_A_POSE or any(
        len(line) != (3 if n % LINES_OF_A_POSE == 0 else 4)
        for n, line in enumerate(lines)
    ):
        raise DatasetError(f"{path}: not a log of poses, five lines each (Open3D)")
    return [
        numbers_of(path, lines[start + 1 : start + LINES_OF_A_POSE], finite=False)
        for start in range(0, len(lines), LINES_OF_A_POSE)
    ]


def _in_order(
    path: Path,
    matrices: list[Any],
    names: list[str],
) -> tuple[dict[str, Float], dict[str, str]]:
    """Poses that stand in the order of the images."""
    if len(matrices) != len(names):
        raise DatasetError(
            f"{path}: holds {len(matrices)} poses for {len(names)} depth images"
        )
    poses = {}
    unreadable = {}
    for name, matrix in zip(names, matrices, strict=True):
        try:
            poses[name] = rigid(_matrix(list(matrix), path), f"{name} of {path}")
        except DatasetError as error:
            unreadable[name] = str(error)
    return poses, unreadable


def _beside(folder: Path, inside: tuple[str, ...], name: str) -> Path | None:
    """The picture of an image's name in one of some folders, if there is one."""
    paths = (
        folder / each / f"{name}{ending}" for each in inside for ending in IMAGE_ENDINGS
    )
    return next((path for path in paths if path.exists()), None)


def _same_size(picture: Path, depth: DepthFile) -> bool:
    try:
        with opened_image(picture, ("PNG", "JPEG")) as image:
            return image.size == depth.size
    except ObservationError as error:
        raise DatasetError(f"{picture}: {error}") from None
