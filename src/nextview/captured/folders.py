"""Read captures: depth images with poses, in folders of several layouts and in ROS 2 bags.

BOP: Hodan et al., ECCV 2018. TUM RGB-D: Sturm et al., IROS 2012. 7-Scenes: Shotton et al., CVPR
2013. OCID: Suchi et al., ICRA 2019.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct
from scipy.spatial.transform import Rotation

from nextview.captured.bag import At, is_bag, read_bag
from nextview.captured.bop_scene import (
    EVERY_SCENE_CAMERAS,
    ThreeNumbers,
    read_bop_scene,
)
from nextview.captured.camera_file import CameraFile, check_size, read_camera_file
from nextview.captured.depth_folder import (
    camera_folders,
    is_depth_folder,
    read_camera_folders,
    read_depth_folder,
    read_depth_image,
)
from nextview.captured.frames import (
    MILLIMETRES,
    Capture,
    CapturedFrame,
    DepthFile,
    LayoutViews,
    lines_of,
    numbers_of,
    read_table,
    rigid,
)
from nextview.captured.mat_scenes import META_ENDING, read_graspnet, read_ycb_video
from nextview.captured.pcd import is_organised, read_clouds
from nextview.captured.unread import why_unread
from nextview.checks import number
from nextview.errors import DatasetError, UsageError, option
from nextview.files import read_record
from nextview.geometry.pinhole import pinhole_matrix
from nextview.sensing.object_frame import Box
from nextview.types import Float

# pinhole matrix in a folder of TUM or 7-Scenes, as in 3DMatch
INTRINSICS = "camera-intrinsics.txt"
TUM_STEP = 1 / 5000  # metres per unit of TUM's depth images
# seconds, largest time difference of an image and its pose, or of depth and colour
STAMP_DIFFERENCE = 0.02
MOST_LOST = 0.1  # largest share of the lines of a trajectory without a valid pose
# fx, fy, cx, cy of the depth camera in all scenes of 7-Scenes
KINECT = (585.0, 585.0, 320.0, 240.0)
# metres, largest unit of an integer depth image; a float image has 1
LARGEST_SCALE = 0.05
# as given by hand, see ``read_capture``
Intrinsics = tuple[float, float, float, float] | str | Path | None


@dataclass(frozen=True)
class Reading:
    """Options for reading captured frames; None for the values in their files.

    Attributes:
        intrinsics: fx, fy, cx, cy, pixels, first pixel's centre at 0, or a file with them, see
            ``camera_file``.
        object_id: number of the object in a BOP scene with several.
        depth_scale: metres per unit of the depth images; 0.001 for millimetres.
        depth_topic: of a ROS 2 bag with several depth topics.
        world_frame: of a ROS 2 bag: tf frame of the world, z up; by default the root of the tree.
        at: of a ROS 2 bag of a static camera: image to use; by default all, see ``read_bag``.
    """

    intrinsics: Intrinsics = None
    object_id: int | None = None
    depth_scale: float | None = None
    depth_topic: str | None = None
    world_frame: str | None = None
    at: At = None


def read_capture(
    path: str | Path,
    intrinsics: Intrinsics = None,
    object_id: int | None = None,
    depth_scale: float | None = None,
    depth_topic: str | None = None,
    world_frame: str | None = None,
    at: At = None,
) -> Capture:
    """Read the poses and intrinsics of captured frames in any supported layout.

    The images are read when they are used.

    Args:
        path: a folder of one of ``FOLDER_LAYOUTS``, a ROS 2 bag (a folder, or its .mcap or .db3
            file), a single depth image (.png), or a single organised cloud (.pcd).
        intrinsics: see ``Reading``, like all others.
        object_id: of a BOP scene.
        depth_scale: metres.
        depth_topic: of a bag.
        world_frame: of a bag.
        at: of a bag.

    Raises:
        DatasetError: something is missing or wrong; the message names the file.
        UsageError: an option is for another layout, or invalid.
        MissingExtraError: bags need the extra "bags".
    """
    path = Path(path)
    if depth_scale is not None:
        _check_scale(depth_scale)
    layout = _layout_of(path)
    how = Reading(intrinsics, object_id, depth_scale, depth_topic, world_frame, at)
    _check_options(path, layout, how)
    if path.is_dir():
        _check_links(path)

    camera, said = _given_camera(path, how.intrinsics)
    views = FOLDER_LAYOUTS[layout](path, camera, how)
    if camera is not None and camera.size is not None:
        _check_sizes(camera, views)
    if not views.frames:
        raise DatasetError(
            next(iter(views.unreadable.values()), f"{path}: no image shows the object")
        )
    if depth_scale is not None:
        views.frames = [replace(frame, scale=depth_scale) for frame in views.frames]
        said.append(f"steps of {1000 * depth_scale:g} mm as given")
    return Capture(
        path,
        layout,
        tuple(views.frames),
        (0.0, 0.0, 1.0) if views.z_is_up else None,
        (*said, *views.notes),
        tuple(views.unreadable.items()),
        views.object_is_world,
        depth_scale is not None,
    )


def _check_sizes(camera: CameraFile, views: LayoutViews) -> None:
    """Check that images have the size of their camera; damaged ones become unreadable."""
    for frame in list(views.frames):
        try:
            frame.size  # noqa: B018  # reads the header of a file
        except DatasetError as error:
            views.unreadable[frame.name] = str(error)
            views.frames.remove(frame)
        else:
            check_size(camera, frame.depth)


def is_capture(path: Path) -> bool:
    """Return True if a folder or a bag file contains captured frames in one of the layouts."""
    if path.is_dir():
        marked = bool(_layouts_in(path)) or is_bag(path) or is_depth_folder(path)
        return marked or bool(_cloud_files(path))
    return is_bag(path)


def _layout_of(path: Path) -> str:
    """Return the layout of a folder or file; DatasetError if there is none, or if there are two."""
    if is_bag(path):
        return BAG
    if path.is_file() and path.suffix.lower() == ".png":
        return ONE_IMAGE
    if path.is_file() and path.suffix.lower() == ".pcd":
        return CLOUDS
    if not path.is_dir():
        raise DatasetError(
            f"{path}: is neither a ROS 2 bag (.mcap, .db3) nor a depth image (.png) nor a cloud"
            " (.pcd)"
            if path.exists()
            else f"{path}: there is no such file or folder"
        )

    found = _layouts_in(path)
    if len(found) > 1:
        raise DatasetError(
            f"{path}: has the files of two layouts, {found[0]} and {found[1]}; move one of them"
            " away"
        )
    if found:
        return found[0]

    # a sequence of OCID has depth images, too, but no intrinsics
    if (path / "pcd").is_dir() and _cloud_files(path):
        return CLOUDS
    if is_depth_folder(path):
        return DEPTH_FOLDER
    if _cloud_files(path):
        return CLOUDS
    if camera_folders(path):
        return SEVERAL_CAMERAS
    raise DatasetError(why_unread(path, is_capture))


def _layouts_in(folder: Path) -> list[str]:
    """Return the layouts whose marker files a folder has."""
    return [
        layout
        for layout, files in LAYOUT_MARKS.items()
        if next(folder.glob(files), None)
    ]


def _cloud_files(folder: Path) -> list[Path]:
    """Return the PCD files of a folder, or of a sequence of OCID; empty if none is organised."""
    inside = "pcd/*.pcd" if (folder / "label").is_dir() else "*.pcd"
    files = sorted(folder.glob(inside))
    return files if any(map(is_organised, files[:1])) else []


def _check_scale(scale: float) -> None:
    """Check that a depth scale is a plausible unit.

    Raises:
        UsageError: it may be units per metre.
    """
    number(scale, "the depth scale, in metres,", above=0)
    if scale > LARGEST_SCALE and scale != 1:
        steps = (
            f"{scale:g} steps a metre are {1 / scale:g}"
            if scale > 50
            else "0.001: millimetres"
        )
        raise UsageError(
            f"the depth scale is what one step of the image stands for in metres ({steps}), not"
            f" {scale:g}"
        )


def _check_options(path: Path, layout: str, how: Reading) -> None:
    """Reject options that are for another layout."""
    if how.object_id is not None and layout != "BOP":
        raise UsageError(
            f"objects have numbers in BOP's layout only, and {path} has the layout of {layout}"
        )
    of_bags = (how.depth_topic, how.world_frame, how.at)
    if layout != BAG and any(each is not None for each in of_bags):
        raise UsageError(
            f"topics, tf frames and moments are of ROS 2 bags, and {path} is none"
        )


def _check_links(folder: Path) -> None:
    """Check that links in a downloaded capture do not lead to other files of this machine."""
    inside = os.path.realpath(folder)
    for path in folder.rglob("*"):
        # Path.resolve raises an error for circular links.
        if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(
            inside
        ):
            raise DatasetError(
                f"{path}: is a link out of this folder; put what it points to in its place"
            )


def _given_camera(path: Path, given: Intrinsics) -> tuple[CameraFile | None, list[str]]:
    """Return the camera from the options or the folder, if any, and a note of its source."""
    if isinstance(given, tuple):
        camera = CameraFile(pinhole_matrix(*given), None, None)
        return camera, ["intrinsics as given"]
    file = path / INTRINSICS if given is None else Path(given)
    if given is None and not (path.is_dir() and file.exists()):
        return None, []
    return read_camera_file(file), [f"intrinsics of {file.name}"]


def _matrix(camera: CameraFile | None) -> Float | None:
    """Return the pinhole matrix of a camera, (3, 3), if there is one."""
    return None if camera is None else camera.intrinsics


class _BoxFile(Struct, forbid_unknown_fields=True):
    low: ThreeNumbers
    high: ThreeNumbers
    axes: Annotated[list[ThreeNumbers], Meta(min_length=3, max_length=3)] | None = None


def read_box(path: Path) -> Box:
    """Read an upright box from a JSON file with "low", "high" and, if needed, "axes"."""
    box = read_record(path, _BoxFile, "a box", DatasetError)
    try:
        return Box(
            np.array(box.low),
            np.array(box.high),
            np.eye(3) if box.axes is None else np.array(box.axes),
        )
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None


def _read_tum(folder: Path, camera: CameraFile | None, _: Reading) -> LayoutViews:
    """Read views from depth.txt and groundtruth.txt, with images and masks if there are any."""
    intrinsics = _matrix(camera)
    if intrinsics is None:
        raise DatasetError(
            f"{folder}: the intrinsics are missing, which this layout does not hold; put the"
            f" pinhole matrix into camera-intrinsics.txt or give {option('intrinsics')} FX FY CX CY"
            " (TUM's recordings: 525 525 319.5 239.5)"
        )

    times, depths = _images(folder / "depth.txt")
    moments, poses, bad_lines = _trajectory(folder / "groundtruth.txt")
    colour_times, colours = (
        _images(folder / "rgb.txt")
        if (folder / "rgb.txt").exists()
        else (np.zeros(0), [])
    )

    frames = []
    for time, depth in zip(times, depths, strict=True):
        at = _nearest(time, moments)
        colour = _nearest(time, colour_times)
        mask = folder / "mask" / depth.name
        if at is not None:
            beside = (
                mask if mask.exists() else None,
                None if colour is None else colours[colour],
            )
            frames.append(
                CapturedFrame(
                    depth.stem,
                    DepthFile(depth),
                    TUM_STEP,
                    intrinsics,
                    poses[at],
                    *beside,
                )
            )

    if not frames:
        what = (
            f"{folder}: no image of depth.txt has a pose in groundtruth.txt within"
            f" {STAMP_DIFFERENCE} s"
        )
        raise DatasetError(f"{what}; are the times of one clock, in seconds?")

    notes = []
    if bad_lines:
        notes.append(
            f"{bad_lines} lines of groundtruth.txt hold no pose and are left out"
        )
    if lost := len(times) - len(frames):
        notes.append(
            f"{lost} depth images have no pose within {STAMP_DIFFERENCE} s and are left out"
        )
    return LayoutViews(frames, notes)


def _read_seven_scenes(
    folder: Path,
    camera: CameraFile | None,
    _: Reading,
) -> LayoutViews:
    """Read views from frame-*.depth.png and .pose.txt, with masks from .mask.png.

    The colour images are not registered to the depth.
    """
    notes = []
    intrinsics = _matrix(camera)
    if intrinsics is None:
        intrinsics = pinhole_matrix(*KINECT)
        notes.append(
            "there is no camera-intrinsics.txt: the Kinect's fx = fy = 585, cx = 320, cy = 240 are"
            " assumed"
        )
    # the world frame is the first camera frame
    views = LayoutViews([], notes, z_is_up=False)
    for depth in sorted(folder.glob("frame-*.depth.png")):
        name = depth.name.removeprefix("frame-").removesuffix(".depth.png")
        path = folder / f"frame-{name}.pose.txt"
        mask = folder / f"frame-{name}.mask.png"
        try:
            pose = rigid(read_table(path, "the camera's pose", 4), str(path))
        except DatasetError as error:
            views.unreadable[name] = str(error)
            continue
        shown = mask if mask.exists() else None
        views.frames.append(
            CapturedFrame(name, DepthFile(depth), MILLIMETRES, intrinsics, pose, shown)
        )
    return views


LAYOUT_MARKS = {  # a file that identifies each layout
    "BOP": EVERY_SCENE_CAMERAS,
    "TUM RGB-D": "depth.txt",
    "7-Scenes": "frame-*.depth.png",
    "YCB-Video": f"*{META_ENDING}",
    "GraspNet": "meta/*.mat",
}
DEPTH_FOLDER = "depth folder"
SEVERAL_CAMERAS = "several cameras"
ONE_IMAGE = "depth image"
CLOUDS = "PCD"
BAG = "ROS 2 bag"


def _nearest(time: float, others: Float) -> int | None:
    """Return the index of the nearest of other times, (N,) seconds, if it is close enough."""
    gaps = np.abs(others - time)
    return (
        int(gaps.argmin())
        if len(gaps) and gaps.min() <= STAMP_DIFFERENCE + 1e-6
        else None
    )


def _images(path: Path) -> tuple[Float, list[Path]]:
    """Return times, (N,) seconds, and image paths from a list."""
    lines = lines_of(path, 2, "times and names of images")
    for outside in (
        word
        for _, word in lines
        if Path(word).is_absolute() or ".." in Path(word).parts
    ):
        raise DatasetError(f"{path}: {outside} is no file of this folder")
    return numbers_of(path, [line[:1] for line in lines])[:, 0], [
        path.parent / word for _, word in lines
    ]


def _trajectory(path: Path) -> tuple[Float, Float, int]:
    """Read times, (N,) seconds, poses, (N, 4, 4), and the number of lines without one."""
    words = lines_of(path, 8, "times, positions and quaternions (x, y, z, w)")
    values = numbers_of(path, words, finite=False)
    length = np.linalg.norm(values[:, 4:], axis=1)
    good = np.isfinite(values).all(1) & (np.abs(length - 1) <= 0.01)

    if np.mean(~good) > MOST_LOST:
        values = numbers_of(path, words)  # raises an error that names NaN
        worst = max(length, key=lambda n: abs(n - 1))
        raise DatasetError(f"{path}: a quaternion has the length {worst:.3g}, not 1")
    values = values[good]
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(values[:, 4:]).as_matrix()
    poses[:, :3, 3] = values[:, 1:4]
    return values[:, 0], poses, int((~good).sum())


FOLDER_LAYOUTS: dict[
    str,
    Callable[[Path, CameraFile | None, Reading], LayoutViews],
] = {
    "BOP": lambda path, camera, how: read_bop_scene(
        path, _matrix(camera), how.object_id
    ),
    "TUM RGB-D": _read_tum,
    "7-Scenes": _read_seven_scenes,
    "YCB-Video": lambda path, camera, how: read_ycb_video(path, camera),
    "GraspNet": lambda path, camera, how: read_graspnet(path, camera),
    CLOUDS: lambda path, camera, how: read_clouds(
        _cloud_files(path) if path.is_dir() else [path], camera
    ),
    DEPTH_FOLDER: lambda path, camera, how: read_depth_folder(
        path,
        camera,
        how.depth_scale,
    ),
    SEVERAL_CAMERAS: lambda path, camera, how: read_camera_folders(
        path,
        camera,
        how.depth_scale,
    ),
    ONE_IMAGE: lambda path, camera, how: read_depth_image(
        path, camera, how.depth_scale
    ),
    BAG: lambda path, camera, how: read_bag(
        path,
        _matrix(camera),
        how.depth_topic,
        how.world_frame,
        how.at,
    ),
}
"""Reader of each layout."""
