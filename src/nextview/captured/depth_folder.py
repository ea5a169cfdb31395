"""Read a folder of depth images with camera intrinsics, as written by RealSense tools.

Depth images are ``depth/NAME.png``; the intrinsics are in one of ``CAMERA_FILES``. Optional are
``color/NAME.png`` or .jpg of the same size, ``masks/NAME.png``, and camera-to-world poses in
metres: a file ``poses/NAME.txt`` for each image, ``poses.json`` (matrices by name, or a list in the
order of the images), ``trajectory.log`` (Open3D), or ``pose.txt`` with the only pose of a camera
that stands still. The folders of several cameras are in one folder, by the names of the cameras.
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
from nextview.errors import DatasetError, ObservationError, option
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
CAMERA_TABLES = ("cam_K.txt", "intrinsics.txt")  # contain only a pinhole matrix
POSES = ("poses", "pose")
ONE_POSE = "pose.txt"  # of a camera that stands still
CAMERA_IS_WORLD = "no pose: the camera is the world"
MASKS = ("masks", "mask")
COLOUR_FOLDERS = ("color", "colour", "rgb")
IMAGE_ENDINGS = (".png", ".jpg", ".jpeg")
LINES_OF_A_POSE = (
    5  # in Open3D's log: a line of three numbers, and the rows of the matrix
)


def is_depth_folder(folder: Path) -> bool:
    """Return True if a folder has depth images in ``depth/`` and is not an incomplete BOP folder.

    A BOP folder also has ``mask_visib/``; without ``scene_camera.json`` it is incomplete.
    """
    if (folder / "mask_visib").is_dir():
        return False
    return next(folder.glob("depth/*.png"), None) is not None


def camera_folders(folder: Path) -> list[Path]:
    """Return the folders of depth images of several cameras in a folder, by name."""
    found = [
        path for path in folder.iterdir() if path.is_dir() and is_depth_folder(path)
    ]
    scenes = [path for path in found if (path / "scene_camera.json").exists()]
    return sorted(found) if len(found) > 1 and not scenes else []


def read_camera_folders(
    folder: Path,
    given: CameraFile | None,
    scale: float | None,
) -> LayoutViews:
    """Read the folders of depth images of several cameras, whose poses are in one world.

    Args:
        folder: see ``camera_folders``.
        given: camera that replaces those of the folders.
        scale: metres per unit of the images, which replaces those of the folders.

    Raises:
        DatasetError: as of ``read_depth_folder``; or the poses of a camera are missing.
    """
    views = LayoutViews([], [], z_is_up=False)
    for path in camera_folders(folder):
        own = read_depth_folder(path, given, scale)
        if any(note == CAMERA_IS_WORLD for note in own.notes):
            raise DatasetError(
                f"{path}: the pose of camera {path.name} is missing, in the world of the other"
                " cameras: put it into pose.txt, or poses of its images into poses/NAME.txt"
            )
        views.frames += [
            replace(frame, name=f"{path.name}/{frame.name}", camera=path.name)
            for frame in own.frames
        ]
        for name, reason in own.unreadable.items():
            views.unreadable[f"{path.name}/{name}"] = reason
        views.notes.append(f"camera {path.name}: {', '.join(own.notes)}")
    return views


def read_depth_folder(
    folder: Path,
    given: CameraFile | None,
    scale: float | None,
) -> LayoutViews:
    """Read the poses and the intrinsics of a folder of depth images.

    Args:
        folder: see ``is_depth_folder``.
        given: camera that replaces that of the folder.
        scale: metres per unit of the images, which replaces that of the folder.

    Raises:
        DatasetError: intrinsics or depth scale are missing; there are several images without poses;
            or a file is damaged.
    """
    camera, notes = _camera(folder, given)
    if scale is None and camera.scale is not None:
        notes.append(f"steps of {1000 * camera.scale:g} mm")
    scale = camera.scale if scale is None else scale
    if scale is None:
        raise DatasetError(_asked_for_scale(folder))

    images = sorted(folder.glob("depth/*.png"))
    poses, unreadable, of_poses = _poses(folder, [path.stem for path in images])

    # No file defines the up direction of the world.
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
        views.frames.append(
            CapturedFrame(
                path.stem,
                depth,
                scale,
                camera.intrinsics,
                poses[path.stem],
                mask,
                colour,
                folder.name if (folder / ONE_POSE).exists() else "",
            )
        )
    return views


def read_depth_image(
    path: Path,
    camera: CameraFile | None,
    scale: float | None,
) -> LayoutViews:
    """Read a single depth image, whose camera frame is the world frame.

    Args:
        path: 16-bit grey PNG.
        camera: of the image.
        scale: metres per unit; None if the camera file has it.

    Raises:
        DatasetError: intrinsics or depth scale are missing.
    """
    if camera is None:
        raise DatasetError(
            f"{path}: the intrinsics of its camera are missing: give {option('intrinsics')} FX FY"
            " CX CY, or a file with them"
        )
    scale = camera.scale if scale is None else scale
    if scale is None:
        raise DatasetError(_asked_for_scale(path))
    depth = DepthFile(path)
    frame = CapturedFrame(path.stem, depth, scale, camera.intrinsics, np.eye(4))
    return LayoutViews([frame], ["one image: its camera is the world"], z_is_up=False)


def _asked_for_scale(path: Path) -> str:
    """Ask for the depth scale of a file or folder that does not contain it."""
    return (
        f"{path}: nothing says what one step of the depth images stands for: give"
        f" {option('depth_scale')}, in metres (0.001 if they are in millimetres)"
    )


def _camera(folder: Path, given: CameraFile | None) -> tuple[CameraFile, list[str]]:
    """Return the camera of a folder, and a note of its source if it was not given."""
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
        f"{folder}: the intrinsics of the depth camera are missing: give"
        f" {option('intrinsics')} FX FY CX CY or a file, or put {CAMERA_FILES[0]} or"
        f" {CAMERA_FILES[3]} into the folder{near}"
    )


def _poses(
    folder: Path,
    names: list[str],
) -> tuple[dict[str, Float], dict[str, str], str]:
    """Return poses by image name, reasons for unreadable ones, and a note of their source."""
    for inside in POSES:
        if next(folder.glob(f"{inside}/*.txt"), None):
            poses, unreadable = _pose_files(folder / inside, names)
            return poses, unreadable, f"poses of {inside}/"
    if (folder / ONE_POSE).exists():
        path = folder / ONE_POSE
        pose = rigid(read_table(path, "the camera's pose", 4), str(path))
        return dict.fromkeys(names, pose), {}, f"the pose of {ONE_POSE}"
    listed = folder / "poses.json"

    if listed.exists():
        return *_pose_list(listed, names), "poses of poses.json"
    log = folder / "trajectory.log"
    if log.exists():
        return *_in_order(log, _log(log), names), "poses of trajectory.log"

    if len(names) == 1:
        return {names[0]: np.eye(4)}, {}, CAMERA_IS_WORLD
    raise DatasetError(
        f"{folder}: has {len(names)} depth images and no poses of their camera: put them into"
        " poses/NAME.txt, poses.json or trajectory.log, or that of a camera that stands still into"
        f" {ONE_POSE}, or give a single image"
    )


def _pose_files(
    folder: Path,
    names: list[str],
) -> tuple[dict[str, Float], dict[str, str]]:
    """Read poses from one file per image."""
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
    """Read poses from one JSON file, by name or in order."""
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
    """Return a pose from the rows of a file, (4, 4)."""
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        raise DatasetError(f"{path}: a pose is 4 rows of 4 numbers")
    return np.array(rows, np.float64)


def _log(path: Path) -> list[Any]:
    """Return the matrices of an Open3D log, in order."""
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
    """Assign poses in the order of the images."""
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
    """Return the image of the same name in one of some folders, if there is one."""
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
