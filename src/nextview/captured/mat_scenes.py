"""Folders of depth images with MATLAB files of their cameras: YCB-Video and GraspNet.

YCB-Video (PoseCNN, Xiang et al., RSS 2018) has ``000001-depth.png`` beside ``000001-meta.mat``.
GraspNet-1Billion (Fang et al., CVPR 2020) has ``depth/0000.png`` and ``meta/0000.mat``, and for all
images ``camera_poses.npy`` and ``cam0_wrt_table.npy``.
"""

import struct
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from nextview.captured.camera_file import CameraFile
from nextview.captured.frames import (
    CapturedFrame,
    DepthFile,
    LayoutViews,
    rigid,
)
from nextview.checks import one_line
from nextview.errors import DAMAGED, DatasetError
from nextview.files import regular_file
from nextview.types import Float

META_ENDING = "-meta.mat"  # of YCB-Video
LARGEST_MAT = 2**26  # bytes of a file
MAT_HEADER = 128  # bytes
# bytes of a variable; larger ones, such as images of labels, are not read
LARGEST_VARIABLE = 2**16
COMPRESSED_VARIABLE = 15  # in the tag of a variable
MOST_POSES = 100_000
FACTORS = (100.0, 1e6)  # plausible steps of a depth image per metre


def read_ycb_video(folder: Path, given: CameraFile | None) -> LayoutViews:
    """Read a sequence of YCB-Video, or of another dataset in the layout of PoseCNN.

    Args:
        folder: of the sequence.
        given: camera whose intrinsics replace those of the files.

    Raises:
        DatasetError: there are several images, and nothing tells the poses of their camera.
    """
    views = LayoutViews([], [], z_is_up=False)
    if given is None:
        views.notes.append(f"intrinsics of the *{META_ENDING} files")

    metas = sorted(folder.glob(f"*{META_ENDING}"))
    for path in metas:
        name = path.name.removesuffix(META_ENDING)
        try:
            meta = read_mat(path)
            pose = _world_pose(meta, path, len(metas) == 1)
            k, scale = _camera_of(meta, path)
        except DatasetError as error:
            views.unreadable[name] = str(error)
            continue

        pictures = (folder / f"{name}-color{ending}" for ending in (".png", ".jpg"))
        views.frames.append(
            CapturedFrame(
                name,
                DepthFile(folder / f"{name}-depth.png"),
                scale,
                k if given is None else given.intrinsics,
                pose,
                image=next((path for path in pictures if path.exists()), None),
            )
        )
    return views


def read_graspnet(folder: Path, given: CameraFile | None) -> LayoutViews:
    """Read the images of one camera in a scene of GraspNet.

    Args:
        folder: of a camera in a scene, such as ``scene_0000/kinect``.
        given: camera whose intrinsics replace those of the files.

    Raises:
        DatasetError: the poses of the camera are missing or damaged.
    """
    images = sorted(folder.glob("depth/*.png"))
    poses = _poses_of(folder, len(images))
    table = folder / "cam0_wrt_table.npy"
    to_table = np.eye(4)
    if table.exists():
        to_table = rigid(_matrices(table, (4, 4)), str(table))

    views = LayoutViews([], [], z_is_up=table.exists())
    views.notes.append(
        "poses of camera_poses.npy on the table of cam0_wrt_table.npy"
        if table.exists()
        else "poses of camera_poses.npy: the first camera is the world"
    )

    for path in images:
        meta_file = folder / f"meta/{path.stem}.mat"
        try:
            k, scale = _camera_of(read_mat(meta_file), meta_file)
            if not path.stem.isdecimal() or int(path.stem) >= len(poses):
                raise DatasetError(
                    f"{folder / 'camera_poses.npy'}: has no pose of image {path.stem}"
                )
            pose = rigid(
                to_table @ poses[int(path.stem)], f"pose {path.stem} of {folder}"
            )
        except DatasetError as error:
            views.unreadable[path.stem] = str(error)
            continue

        picture = folder / f"rgb/{path.name}"
        views.frames.append(
            CapturedFrame(
                path.stem,
                DepthFile(path),
                scale,
                k if given is None else given.intrinsics,
                pose,
                image=picture if picture.exists() else None,
            )
        )
    return views


def read_mat(path: Path) -> dict[str, Float]:
    """Read the small numeric variables of a MATLAB file (version 5 to 7).

    Large variables are skipped before memory is spent on them.

    Args:
        path: of the file.

    Returns:
        The variables as float64, by name.

    Raises:
        DatasetError: the file is missing or damaged, or is of another version.
    """
    regular_file(path, "a MATLAB file", DatasetError, LARGEST_MAT)
    try:
        small = BytesIO(_small_variables(path.read_bytes()))
        found = loadmat(small)  # type: ignore[arg-type]  # its stubs know no open file
        return {
            name: value.astype(np.float64)
            for name, value in found.items()
            if isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
        }
    except (*DAMAGED, MatReadError) as error:
        raise DatasetError(
            f"{path}: is no MATLAB file of version 5 to 7, or is damaged"
            f" ({one_line(str(error), 100)})"
        ) from None


def _small_variables(content: bytes) -> bytes:
    """Return a MATLAB file with only the small variables of another one, unpacked."""
    kept = [content[:MAT_HEADER]]
    order = {b"IM": "<", b"MI": ">"}[content[MAT_HEADER - 2 : MAT_HEADER]]
    at = MAT_HEADER

    while at < len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        element = content[at : at + 8 + size]
        if len(element) < 8 + size:
            raise ValueError("it ends in the middle of a variable")
        if kind == COMPRESSED_VARIABLE:
            unpack = zlib.decompressobj()
            element = unpack.decompress(element[8:], LARGEST_VARIABLE + 1)
        if len(element) <= LARGEST_VARIABLE:
            kept.append(element)
        at += 8 + size
    return b"".join(kept)


def _variable(
    meta: dict[str, Float],
    name: str,
    shape: tuple[int, ...],
    path: Path,
) -> Float:
    """Return a variable of a file, checked."""
    if name not in meta:
        raise DatasetError(f"{path}: has no {name}")
    value = meta[name]
    if value.shape != shape or not np.isfinite(value).all():
        raise DatasetError(
            f"{path}: {name} is {' x '.join(map(str, shape))} finite numbers, not"
            f" {' x '.join(map(str, value.shape))}"
        )
    return value


def _camera_of(meta: dict[str, Float], path: Path) -> tuple[Float, float]:
    """Return the pinhole matrix, (3, 3), and the metres per step of a depth image."""
    k = _variable(meta, "intrinsic_matrix", (3, 3), path)
    factor = float(_variable(meta, "factor_depth", (1, 1), path)[0, 0])
    if not FACTORS[0] <= factor <= FACTORS[1]:
        raise DatasetError(
            f"{path}: factor_depth is the number of steps per metre, such as 1000 or 10000, not"
            f" {factor:g}"
        )
    return k, 1 / factor


def _world_pose(meta: dict[str, Float], path: Path, single: bool) -> Float:
    """Return a camera-to-world pose, (4, 4); a single image may have none."""
    name = "rotation_translation_matrix"
    if single and name not in meta:
        return np.eye(4)
    to_camera = np.vstack([_variable(meta, name, (3, 4), path), [0, 0, 0, 1]])
    to_world = np.linalg.inv(rigid(to_camera, f"{name} of {path}"))
    return np.asarray(to_world, np.float64)


def _poses_of(folder: Path, images: int) -> Float:
    """Return the camera poses of a scene of GraspNet, relative to its first camera, (N, 4, 4)."""
    path = folder / "camera_poses.npy"
    if images == 1 and not path.exists():
        return np.eye(4)[None]
    if not path.exists():
        raise DatasetError(
            f"{folder}: has {images} depth images and no camera_poses.npy: nothing tells where the"
            " camera was"
        )
    return _matrices(path, (None, 4, 4))


def _matrices(path: Path, shape: tuple[int | None, ...]) -> Float:
    """Return the array of a .npy file, checked; None in the shape for any number."""
    regular_file(path, "an array of poses", DatasetError)
    try:
        # a mapped file is compared with the size that its header claims
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except DAMAGED as error:
        raise DatasetError(
            f"{path}: is no array of numpy, or is damaged ({one_line(str(error), 100)})"
        ) from None
    fits = values.ndim == len(shape) and values.dtype.kind in "fiu"
    fits = fits and all(
        wanted in (None, there)
        for wanted, there in zip(shape, values.shape, strict=True)
    )
    if not fits or len(values) > MOST_POSES:
        raise DatasetError(
            f"{path}: poses are 4 x 4 numbers, not an array of {values.shape}"
        )
    return np.array(values, np.float64)
