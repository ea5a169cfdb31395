"""Frames of depth cameras, and what is known of the things in them.

Frames are read in every layout of ``nextview.captured``; depth/NAME.png and clouds need no poses
here. Further layouts are files NAME.depth.png, and for each frame a folder with depth.png and
K.json ([fx, fy, cx, cy], the middle of the first pixel at 0; scale.json has metres a step, if it is
not a millimetre). The truth is in whichever of these is there:

| file | what is known |
|---|---|
| truth.json | by the name of each frame its things: "name", left out for a thing without one, and \
"column" and "row" of a pixel on it, or "label", its number in the image of labels, or "pose", \
scan-to-camera, four rows of four numbers, metres |
| labels/NAME.png, label/NAME.png, NAME.labels.png, NAME-label.png | the number of the thing in \
each pixel, 0 for none |
| NAME/labels.png | the same; without names.txt the tens digit is the thing, and below 10 is none |
| names.txt | the names of the numbers 0, 1, 2, ..., a word each |
| scene_gt.json, mask_visib/ | BOP: poses and pixels; a model without a name is called obj_000012 |
| NAME-meta.mat, meta/NAME.mat | YCB-Video, GraspNet: poses of the things in the image of labels |
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray
from PIL import Image

from nextview.captured.bop_scene import (
    EVERY_SCENE_CAMERAS,
    BopFiles,
    BopObject,
    bop_files,
    camera_to_world,
    read_bop_cameras,
    read_bop_objects,
)
from nextview.captured.depth_folder import CAMERA_FILES, CAMERA_TABLES
from nextview.captured.folders import (
    INTRINSICS,
    LAYOUT_MARKS,
    Intrinsics,
    read_capture,
)
from nextview.captured.frames import (
    MILLIMETRES,
    CapturedFrame,
    DepthFile,
    opened_image,
)
from nextview.captured.mat_scenes import read_mat
from nextview.errors import DatasetError, ObservationError
from nextview.files import read_record, regular_file, write_record
from nextview.sensing.frame import Frame
from nextview.types import Float, Mask

PIXELS_NEAR = 8  # of a given pixel, which are taken for those of the thing
LEAST_LABEL = 200  # pixels of a thing that counts, where all of them are known
LABELS = (
    "labels/{}.png",
    "label/{}.png",
    "{}.labels.png",
    "frame-{}.labels.png",
    "{}-label.png",
    "{}/labels.png",
)
FRAMES = ("*/depth.png", "*.depth.png", "depth/*.png", "pcd/*.pcd", "*.pcd")
METAS = ("{}-meta.mat", "meta/{}.mat")
CAMERA, SCALE, TRUTH, NAMES = "K.json", "scale.json", "truth.json", "names.txt"

FourNumbers = Annotated[list[float], Meta(min_length=4, max_length=4)]
Matrix = Annotated[list[FourNumbers], Meta(min_length=4, max_length=4)]


class Told(Struct, forbid_unknown_fields=True):
    """A thing in truth.json."""

    name: str = ""
    column: float | None = None
    row: float | None = None
    label: int | None = None
    pose: Matrix | None = None


Shot = tuple[NDArray[np.uint16], NDArray[np.uint8], Sequence[Told]]


@dataclass(frozen=True, eq=False)
class TrueThing:
    """A thing in a frame.

    Attributes:
        name: of it; "" if it has none.
        pixels: all that show it, or some of them, (H, W) bool; None if none is known.
        pose: scan-to-camera, (4, 4), metres; None if it is not known.
    """

    name: str
    pixels: Mask | None = None
    pose: Float | None = None


@dataclass(frozen=True, eq=False)
class RealFrame:
    """A frame, as yet unread.

    Attributes:
        folder: that it is of.
        captured: its images.
        things: reads what is known of the things in it.
    """

    folder: Path
    captured: CapturedFrame
    things: Callable[[], list[TrueThing]]

    @property
    def name(self) -> str:
        """Of the frame in its folder."""
        return self.captured.name

    def read(self) -> Frame:
        """Read the depth, without a pose."""
        return replace(self.captured.read(masked=False), pose=None)


def real_frames(
    folder: Path,
    intrinsics: Intrinsics = None,
    depth_scale: float | None = None,
    first_label: int = 1,
) -> list[RealFrame]:
    """Find the frames of a folder, and what is known of the things in them.

    Args:
        folder: or a bag, or a file of one frame.
        intrinsics: fx, fy, cx, cy, pixels, or a camera file, if the folder has none.
        depth_scale: metres a step of the depth images, if the folder tells none.
        first_label: smallest number of a thing in images of labels.

    Raises:
        DatasetError: a file is missing or damaged.
    """
    beside = folder if folder.is_dir() else folder.parent
    named = beside / NAMES
    names = named.read_text().split() if named.exists() else []
    if next(folder.glob(EVERY_SCENE_CAMERAS), None):
        return [
            frame for files in bop_files(folder) for frame in bop_frames(files, names)
        ]

    told: dict[str, list[Told]] = {}
    if (beside / TRUTH).exists():
        what = "what is known of frames"
        told = read_record(beside / TRUTH, dict[str, list[Told]], what, DatasetError)
    found = []
    for captured in _captured(folder, intrinsics, depth_scale):
        things = partial(
            _things, beside, captured, names, first_label, told.get(captured.name, [])
        )
        found.append(RealFrame(folder, captured, things))
    return found


def _captured(
    folder: Path,
    intrinsics: Intrinsics,
    scale: float | None,
) -> Sequence[CapturedFrame]:
    """The frames of a folder that is no scene of BOP; their poses are not needed."""
    marked = any(next(folder.glob(mark), None) for mark in LAYOUT_MARKS.values())
    several = () if marked else map(sorted, map(folder.glob, FRAMES))
    paths = next(filter(None, several), [])
    if not paths:
        return read_capture(folder, intrinsics, depth_scale=scale).frames

    names = (*CAMERA_FILES, *CAMERA_TABLES, INTRINSICS)
    described = [folder / name for name in names if (folder / name).exists()]
    found = []
    for path in paths:
        camera, steps = path.with_name(CAMERA), path.with_name(SCALE)
        given: Intrinsics = described[0] if described else intrinsics
        if camera.exists():
            what = "fx, fy, cx, cy"
            fx, fy, cx, cy = read_record(camera, FourNumbers, what, DatasetError)
            given = fx, fy, cx, cy
        step = scale
        if steps.exists():
            step = read_record(steps, float, "metres a step", DatasetError)
        elif scale is None and isinstance(given, tuple) and path.suffix == ".png":
            step = MILLIMETRES
        (frame,) = read_capture(path, given, depth_scale=step).frames
        name = path.stem.removesuffix(".depth")
        found.append(replace(frame, name=path.parent.name if name == "depth" else name))
    return found


def write_frames(folder: Path, intrinsics: Float, shots: Mapping[str, Shot]) -> None:
    """Write frames, and what is known of the things in them.

    Args:
        folder: to write into; none of the frames may be there.
        intrinsics: pinhole matrix, (3, 3), pixels, the middle of the first pixel at 0.
        shots: depth, (H, W) uint16, millimetres, the number of the thing in each pixel, (H, W)
            uint8, and the things, by the names of the frames.
    """
    (folder / "labels").mkdir(parents=True, exist_ok=True)
    for name, (depth, labels, _) in shots.items():
        (folder / name).mkdir()
        Image.fromarray(depth).save(folder / name / "depth.png")
        Image.fromarray(labels).save(folder / LABELS[0].format(name))
        write_record(
            folder / name / CAMERA, intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        )
    write_record(folder / TRUTH, {name: told for name, (_, _, told) in shots.items()})


def bop_frames(files: BopFiles, names: Sequence[str] = ()) -> list[RealFrame]:
    """Find the images of a scene of BOP, or of one of its cameras, in order.

    Args:
        files: of the scene.
        names: of the models, by their numbers.

    Raises:
        DatasetError: a file is missing or damaged.
    """
    objects = read_bop_objects(files)
    found = []
    for image, camera in sorted(read_bop_cameras(files).items()):
        name = f"{image:06d}"
        captured = CapturedFrame(
            name,
            DepthFile(files.depth(name)),
            camera.depth_scale * MILLIMETRES,
            camera.intrinsics,
            np.eye(4),
            image=files.picture(name),
        )
        here = objects.get(image, [])
        things = partial(_bop_things, files, captured, here, names)
        found.append(RealFrame(files.folder, captured, things))
    return found


def _bop_things(
    files: BopFiles,
    captured: CapturedFrame,
    objects: Sequence[BopObject],
    names: Sequence[str],
) -> list[TrueThing]:
    """The things in an image of BOP."""
    things = []
    for row, one in enumerate(objects):
        pose: Float | None = None
        if one.cam_R_m2c is not None and one.cam_t_m2c is not None:
            where = f"{files.object_file}: image {captured.name}"
            to_model = camera_to_world(one.cam_R_m2c, one.cam_t_m2c, where)
            pose = np.asarray(np.linalg.inv(to_model), np.float64)
        mask = files.mask(captured.name, [row])
        pixels = None if mask is None else _numbers(mask, captured) > 0
        name = _named(one.obj_id, names) or f"obj_{one.obj_id:06d}"
        if pixels is None or pixels.sum() >= LEAST_LABEL:
            things.append(TrueThing(name, pixels, pose))
    return things


def _things(
    folder: Path,
    captured: CapturedFrame,
    names: Sequence[str],
    first_label: int,
    told: Sequence[Told],
) -> list[TrueThing]:
    """The things in a frame that is not of BOP."""
    file = _there(folder, LABELS, captured.name)
    labels = None if file is None else _numbers(file, captured)
    if labels is not None and file == folder / LABELS[-1].format(captured.name):
        labels = labels if names else labels // 10

    of_label: dict[int, TrueThing] = {}
    poses = _poses_of_labels(_there(folder, METAS, captured.name))
    if labels is not None:
        for number in np.unique(labels[labels >= first_label]).tolist():
            pixels = labels == number
            if pixels.sum() >= LEAST_LABEL:
                name = _named(number, names)
                of_label[number] = TrueThing(name, pixels, poses.get(number))

    found = []
    for one in told:
        pose = None if one.pose is None else np.array(one.pose)
        if one.label is None:
            found.append(TrueThing(one.name, _pixels_near(one, captured), pose))
        elif one.label in of_label:
            known = of_label.pop(one.label)
            found.append(TrueThing(one.name, known.pixels, pose))
    return [*found, *of_label.values()]


def _poses_of_labels(meta: Path | None) -> dict[int, Float]:
    """The poses of the things of an image of labels, by their numbers."""
    known = {} if meta is None else read_mat(meta)
    if not {"cls_indexes", "poses"} <= known.keys():
        return {}
    numbers = known["cls_indexes"].astype(int).ravel().tolist()
    each = np.moveaxis(known["poses"].reshape(3, 4, -1), 2, 0)
    whole = [np.vstack([pose, [0, 0, 0, 1]]) for pose in each]
    return dict(zip(numbers, whole, strict=True))


def _pixels_near(one: Told, captured: CapturedFrame) -> Mask | None:
    """The pixels near the one that is given for a thing."""
    if one.column is None or one.row is None:
        return None
    width, height = captured.size
    rows, columns = np.indices((height, width))
    return np.asarray(np.hypot(rows - one.row, columns - one.column) <= PIXELS_NEAR)


def _there(folder: Path, patterns: Sequence[str], name: str) -> Path | None:
    """The first of the files of a frame that is there."""
    files = (folder / pattern.format(name) for pattern in patterns)
    return next((file for file in files if file.exists()), None)


def _named(number: int, names: Sequence[str]) -> str:
    """The name of a number; "" if there is none."""
    return names[number] if number < len(names) else ""


def _numbers(file: Path, captured: CapturedFrame) -> NDArray[np.int64]:
    """The numbers in an image of labels or a mask, (H, W)."""
    regular_file(file, "an image of labels", DatasetError)
    try:
        with opened_image(file, ("PNG",)) as image:
            numbers = np.asarray(image).astype(np.int64)
    except ObservationError as error:
        raise DatasetError(f"{file}: {error}") from None
    width, height = captured.size
    if numbers.shape != (height, width):
        raise DatasetError(
            f"{file}: holds no number for each of the {width} x {height} pixels of {captured.depth}"
        )
    return numbers
