"""Captured objects: folders of depth images with poses, in the layouts of BOP, TUM RGB-D and
7-Scenes.

BOP: Hodan et al., ECCV 2018. TUM RGB-D: Sturm et al., IROS 2012. 7-Scenes: Shotton et al., CVPR
2013.
"""

import os
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from nextview.errors import DAMAGED, DatasetError, ObservationError, UsageError
from nextview.files import read_record, regular_file
from nextview.geometry.mesh import FORMATS
from nextview.sensing.frame import LARGEST_MEDIAN, NEAREST_MEDIAN, Frame, check_pose
from nextview.sensing.object_frame import Box

NOTHING = np.iinfo(np.uint16).max  # what some sensors give for "nothing" besides 0
DEEP = ("I;16", "I;16B", "I")  # Pillow's names of grey images of 16 bits
# the pinhole matrix in a folder of TUM or 7-Scenes, as in 3DMatch
INTRINSICS = "camera-intrinsics.txt"
LARGEST_TEXT = 2**28  # bytes of a list of images or poses
MILLIMETRES = 0.001
TUM_STEP = 1 / 5000  # metres that one step of TUM's depth images stands for
TOGETHER = 0.02  # seconds that an image and its pose, or depth and colour, may be apart
MOST_LOST = 0.1  # share of the lines of a trajectory that may hold no pose
# fx, fy, cx, cy of the depth camera of 7-Scenes, for all of its scenes
KINECT = (585.0, 585.0, 320.0, 240.0)
Float = NDArray[np.float64]
Three = Annotated[list[float], Meta(min_length=3, max_length=3)]
Nine = Annotated[list[float], Meta(min_length=9, max_length=9)]
# as given by hand, see ``read_capture``
Intrinsics = tuple[float, float, float, float] | str | Path | None


@dataclass(frozen=True)
class CapturedFrame:
    """A captured view, as yet unread.

    Attributes:
        name: in the folder.
        depth: 16-bit PNG of distances along the optical axis; 0 and 65535 mean nothing.
        scale: metres that one step of the depth image stands for.
        intrinsics: pinhole matrix, (3, 3) float64, pixels, first pixel's centre at 0 (OpenCV).
        pose: camera-to-world, (4, 4) float64, metres, OpenCV axes.
        mask: picture that is not black where the object is, if there is one.
        image: grey or colour picture registered to the depth, if there is one.
    """

    name: str
    depth: Path
    scale: float
    intrinsics: Float
    pose: Float
    mask: Path | None = None
    image: Path | None = None

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height of the depth image, pixels, from its header alone."""
        return _open(self.depth, ("PNG",), load=False).size

    def read(self, masked: bool = True) -> Frame:
        """Read the images, the mask only if ``masked``; ObservationError if they show nothing of
        use.
        """
        deep = _open(self.depth, ("PNG",))
        if deep.mode not in DEEP:
            raise DatasetError(
                f"{self.depth}: depth is a grey PNG of 16 bits, this one has 8 (mode {deep.mode})"
            )
        raw = np.asarray(deep).astype(np.uint16)
        depth = np.where(raw == NOTHING, 0, raw) * np.float32(self.scale)
        self._check_scale(depth)
        mask = _as_grey(self.mask, raw.shape) > 0 if masked and self.mask is not None else None
        image = None if self.image is None else _as_grey(self.image, raw.shape)
        return Frame(depth, self.intrinsics, self.pose, mask, image)

    def _check_scale(self, depth: NDArray[np.float32]) -> None:
        """Refuse depth that no camera measures: ``Frame`` would speak of other mistakes."""
        measured = depth[depth > 0]
        middle = float(np.median(measured)) if len(measured) else NEAREST_MEDIAN
        if not NEAREST_MEDIAN <= middle <= LARGEST_MEDIAN:
            what = (
                f"the depth has a median of {middle:.3g} m with steps of {1000 * self.scale:.3g} mm"
            )
            raise ObservationError(f"{self.depth}: {what}: the depth scale is wrong")


@dataclass
class _Views:
    """What a layout's reader finds; the fields are those of ``Capture``."""

    frames: list[CapturedFrame]
    notes: list[str]
    unreadable: dict[str, str] = field(default_factory=dict)
    object_is_world: bool = False


@dataclass(frozen=True)
class Capture:
    """A folder of captured views of one scene.

    Attributes:
        layout: "BOP", "TUM RGB-D" or "7-Scenes".
        frames: in the folder's order, at least one.
        up: direction against gravity in its world; None if the layout says nothing.
        notes: what was assumed or left out, a phrase each.
        unreadable: frames without a usable pose: name and reason.
        object_is_world: the poses are relative to the object: what is around it may move.
    """

    folder: Path
    layout: str
    frames: tuple[CapturedFrame, ...]
    up: tuple[float, float, float] | None
    notes: tuple[str, ...]
    unreadable: tuple[tuple[str, str], ...] = ()
    object_is_world: bool = False

    def __repr__(self) -> str:
        return f"{self.folder}: {self.layout} layout, {len(self.frames)} frames; " + "; ".join(
            self.notes
        )


def read_capture(
    folder: str | Path, intrinsics: Intrinsics = None, object_id: int | None = None
) -> Capture:
    """Find out which layout a folder has, and read its poses and intrinsics; the images are read
    when they are used.

    ``intrinsics``: fx, fy, cx, cy, pixels, first pixel's centre at 0, or a file with the pinhole
    matrix; by default those of the folder. ``object_id``: which object of a BOP scene with several.
    DatasetError: what is missing or wrong, and in which file. UsageError: ``object_id`` is given
    for another layout.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f"{folder}: there is no such folder")
    found = [layout for layout, (files, _) in LAYOUTS.items() if next(folder.glob(files), None)]
    if not found:
        raise DatasetError(_no_capture(folder))
    # a capture from elsewhere may not read other files of this machine
    for path in folder.rglob("*"):
        # Not Path.resolve, which raises where links go round in a circle.
        if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(
            os.path.realpath(folder)
        ):
            raise DatasetError(
                f"{path}: is a link out of this folder; put what it points to in its place"
            )
    if len(found) > 1:
        raise DatasetError(
            f"{folder}: has the files of two layouts, {found[0]} and {found[1]}; move one of them"
            " away"
        )
    layout = found[0]
    k = None
    said = list[str]()
    if object_id is not None and layout != "BOP":
        raise UsageError(
            f"objects have numbers in BOP's layout only, and {folder} has the layout of {layout}"
        )
    path = (
        folder / INTRINSICS
        if intrinsics is None or isinstance(intrinsics, tuple)
        else Path(intrinsics)
    )
    if isinstance(intrinsics, tuple):
        k = pinhole_of(*intrinsics)
        said = ["intrinsics as given"]
    elif intrinsics is not None or path.exists():
        k = read_table(path, "the pinhole matrix", 3)
        said = [f"intrinsics of {path.name}"]
    views = LAYOUTS[layout][1](folder, k, object_id)
    if not views.frames:
        raise DatasetError(
            next(iter(views.unreadable.values()), f"{folder}: no image shows the object")
        )
    # the world of 7-Scenes is that of its first camera
    up = None if layout == "7-Scenes" else (0.0, 0.0, 1.0)
    notes = (*said, *views.notes)
    unreadable = tuple(views.unreadable.items())
    return Capture(
        folder, layout, tuple(views.frames), up, notes, unreadable, views.object_is_world
    )


def _no_capture(folder: Path) -> str:
    """Why a folder is no capture: it may be one of meshes."""
    if mesh := next(
        (f for f in islice(folder.rglob("*"), 1000) if f.suffix.lower() in FORMATS), None
    ):
        look = f"recognise one of them ({mesh}), or teach it them: nextview learn {folder} OUT"
        return f"{folder}: is a folder of meshes, not of captured views; {look}"
    known = ", ".join(f"{files} ({layout})" for layout, (files, _) in LAYOUTS.items())
    return f"{folder}: no captured views are found; there is none of {known}"


class _BoxFile(Struct, forbid_unknown_fields=True):
    low: Three
    high: Three
    axes: Annotated[list[Three], Meta(min_length=3, max_length=3)] | None = None


def read_box(path: Path) -> Box:
    """An upright box in a JSON file: "low" and "high", its corners, metres, and "axes", rows, if
    not the world's.
    """
    box = read_record(path, _BoxFile, "a box", DatasetError)
    try:
        return Box(
            np.array(box.low),
            np.array(box.high),
            np.eye(3) if box.axes is None else np.array(box.axes),
        )
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None


def pinhole_of(fx: float, fy: float, cx: float, cy: float) -> Float:
    """Pinhole matrix, (3, 3), of focal lengths and principal point, pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


class _Camera(Struct):
    cam_K: Nine
    depth_scale: Annotated[float, Meta(gt=0)]
    cam_R_w2c: Nine | None = None
    cam_t_w2c: Three | None = None


class _Object(Struct):
    obj_id: int
    cam_R_m2c: Nine | None = None
    cam_t_m2c: Three | None = None


LACKS_POSE = (
    "lacks the camera's pose (cam_R_w2c, cam_t_w2c); an object's pose in scene_gt.json will do,"
    " named with --object-id if there are several"
)


def _bop_mask(folder: Path, name: str, here: list[int]) -> Path | None:
    """The mask of an object by its place in an image; of all objects, without scene_gt.json, if
    there is only one.
    """
    which = f"{here[0]:06d}" if here else "*"
    masks = list(folder.glob(f"mask_visib/{name}_{which}.png"))
    return masks[0] if len(masks) == 1 else None


def _read_bop(folder: Path, intrinsics: Float | None, object_id: int | None) -> _Views:
    """Views of scene_camera.json.

    Without camera poses, the world is the object's model, by scene_gt.json.
    """
    path = folder / "scene_camera.json"
    truth = folder / "scene_gt.json"
    cameras = read_record(path, dict[int, _Camera], "the cameras of a BOP scene", DatasetError)
    all_objects: dict[int, list[_Object]] = {}
    if truth.exists():
        all_objects = read_record(
            truth, dict[int, list[_Object]], "the objects of a BOP scene", DatasetError
        )
    numbers = sorted({one.obj_id for many in all_objects.values() for one in many})
    named = ", ".join(map(str, numbers))
    if object_id is not None and object_id not in numbers:
        known = f"there are {named}" if numbers else "there is no scene_gt.json"
        raise DatasetError(f"{folder}: no object has the number {object_id}; {known}")
    single = numbers[0] if object_id is None and len(numbers) == 1 else object_id

    notes = ["intrinsics of scene_camera.json"] if intrinsics is None else []
    if single is None and numbers:
        notes.append(f"objects {named}: name one with --object-id, and its masks are used")

    views = _Views([], notes)
    from_model = False
    for number, camera in sorted(cameras.items()):
        objects = all_objects.get(number, [])
        name = f"{number:06d}"
        here = [i for i, one in enumerate(objects) if one.obj_id == single]
        if single is not None and numbers and not here:
            continue  # it does not show the object
        rotation = camera.cam_R_w2c
        translation = camera.cam_t_w2c
        where = f"image {number} of {path}"
        if rotation is None and here:
            thing = objects[here[0]]
            from_model = True
            where = f"image {number} of {truth}"
            rotation = thing.cam_R_m2c
            translation = thing.cam_t_m2c
        if rotation is None or translation is None:
            raise DatasetError(f"{where}: {LACKS_POSE}")
        try:
            pose = _from_world_to_camera(rotation, translation, where)
        except DatasetError as error:
            views.unreadable[name] = str(error)
            continue
        k = np.reshape(camera.cam_K, (3, 3)) if intrinsics is None else intrinsics
        mask = _bop_mask(folder, name, here) if len(here) == 1 or not numbers else None
        files = (f"rgb/{name}.png", f"rgb/{name}.jpg", f"gray/{name}.png")
        image = next((folder / file for file in files if (folder / file).exists()), None)
        depth = folder / f"depth/{name}.png"
        step = camera.depth_scale * MILLIMETRES
        views.frames.append(CapturedFrame(name, depth, step, k, pose, mask, image))
    if from_model:
        notes.append("there are no camera poses: the world is the object's model in scene_gt.json")
        views.object_is_world = True
    if any(frame.mask for frame in views.frames):
        notes.append("masks of mask_visib")
    return views


def _from_world_to_camera(rotation: list[float], translation: list[float], where: str) -> Float:
    """The camera-to-world pose of BOP's world-to-camera rotation, row by row, and translation,
    millimetres.
    """
    pose = np.eye(4)
    pose[:3, :3] = np.reshape(rotation, (3, 3)).T
    pose[:3, 3] = -pose[:3, :3] @ (np.array(translation) * MILLIMETRES)
    return _rigid(pose, where)


def _read_tum(folder: Path, intrinsics: Float | None, _: int | None) -> _Views:
    """Views by depth.txt and groundtruth.txt; images of rgb.txt, and masks of the depth images'
    names in mask/.
    """
    if intrinsics is None:
        raise DatasetError(
            f"{folder}: the intrinsics are missing, which this layout does not hold; put the"
            " pinhole matrix into camera-intrinsics.txt or give --intrinsics FX FY CX CY (TUM's"
            " recordings: 525 525 319.5 239.5)"
        )
    times, depths = _images(folder / "depth.txt")
    moments, poses, bad_lines = _trajectory(folder / "groundtruth.txt")
    colour_times, colours = (
        _images(folder / "rgb.txt") if (folder / "rgb.txt").exists() else (np.zeros(0), [])
    )
    frames = []
    for time, depth in zip(times, depths, strict=True):
        at = _nearest(time, moments)
        colour = _nearest(time, colour_times)
        mask = folder / "mask" / depth.name
        if at is not None:
            beside = mask if mask.exists() else None, None if colour is None else colours[colour]
            frames.append(
                CapturedFrame(depth.stem, depth, TUM_STEP, intrinsics, poses[at], *beside)
            )
    if not frames:
        what = f"{folder}: no image of depth.txt has a pose in groundtruth.txt within {TOGETHER} s"
        raise DatasetError(f"{what}; are the times of one clock, in seconds?")
    notes = []
    if bad_lines:
        notes.append(f"{bad_lines} lines of groundtruth.txt hold no pose and are left out")
    if lost := len(times) - len(frames):
        notes.append(f"{lost} depth images have no pose within {TOGETHER} s and are left out")
    return _Views(frames, notes)


def _read_seven_scenes(folder: Path, intrinsics: Float | None, _: int | None) -> _Views:
    """Views by frame-*.depth.png and .pose.txt, and masks in .mask.png.

    The colour images are not registered.
    """
    notes = []
    if intrinsics is None:
        intrinsics = pinhole_of(*KINECT)
        notes.append(
            "there is no camera-intrinsics.txt: the Kinect's fx = fy = 585, cx = 320, cy = 240 are"
            " assumed"
        )
    views = _Views([], notes)
    for depth in sorted(folder.glob("frame-*.depth.png")):
        name = depth.name.removeprefix("frame-").removesuffix(".depth.png")
        path = folder / f"frame-{name}.pose.txt"
        mask = folder / f"frame-{name}.mask.png"
        try:
            pose = _rigid(read_table(path, "the camera's pose", 4), str(path))
        except DatasetError as error:
            views.unreadable[name] = str(error)
            continue
        shown = mask if mask.exists() else None
        views.frames.append(CapturedFrame(name, depth, MILLIMETRES, intrinsics, pose, shown))
    return views


def is_capture(folder: Path) -> bool:
    """Whether a folder holds the files of one of the layouts."""
    return any(next(folder.glob(files), None) for files, _ in LAYOUTS.values())


LAYOUTS = {  # a file that tells each, and what reads its views
    "BOP": ("scene_camera.json", _read_bop),
    "TUM RGB-D": ("depth.txt", _read_tum),
    "7-Scenes": ("frame-*.depth.png", _read_seven_scenes),
}


def _rigid(pose: ArrayLike, where: str) -> Float:
    try:
        return check_pose(pose)
    except ObservationError as error:
        raise DatasetError(f"{where}: {error}") from None


def _nearest(time: float, others: Float) -> int | None:
    """Which of other times, (N,) seconds, is nearest, if it is near enough; a gap of just the
    limit counts.
    """
    gaps = np.abs(others - time)
    return int(gaps.argmin()) if len(gaps) and gaps.min() <= TOGETHER + 1e-6 else None


def _images(path: Path) -> tuple[Float, list[Path]]:
    """Times, (N,) seconds, and the images beside the list."""
    lines = _lines(path, 2, "times and names of images")
    for outside in (
        word for _, word in lines if Path(word).is_absolute() or ".." in Path(word).parts
    ):
        raise DatasetError(f"{path}: {outside} is no file of this folder")
    return _numbers(path, [line[:1] for line in lines])[:, 0], [
        path.parent / word for _, word in lines
    ]


def _trajectory(path: Path) -> tuple[Float, Float, int]:
    """Times, (N,) seconds, camera-to-world poses, (N, 4, 4), and how many lines hold none: the
    camera was lost.
    """
    words = _lines(path, 8, "times, positions and quaternions (x, y, z, w)")
    values = _numbers(path, words, finite=False)
    length = np.linalg.norm(values[:, 4:], axis=1)
    good = np.isfinite(values).all(1) & (np.abs(length - 1) <= 0.01)

    if np.mean(~good) > MOST_LOST:
        values = _numbers(path, words)  # says where NaN is the reason
        worst = max(length, key=lambda n: abs(n - 1))
        raise DatasetError(f"{path}: a quaternion has the length {worst:.3g}, not 1")
    values = values[good]
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(values[:, 4:]).as_matrix()
    poses[:, :3, 3] = values[:, 1:4]
    return values[:, 0], poses, int((~good).sum())


def _lines(path: Path, columns: int, what: str) -> list[list[str]]:
    """The words of each line that is no comment: at least one line, of so many words."""
    regular_file(path, f"a list of {what}", DatasetError, LARGEST_TEXT)
    try:
        lines = [(n, line.split()) for n, line in enumerate(path.read_text().splitlines(), 1)]
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read as text ({error})") from None
    lines = [(n, words) for n, words in lines if words and not words[0].startswith("#")]
    for n, words in ((n, words) for n, words in lines if len(words) != columns):
        raise DatasetError(
            f"{path}: line {n} has {len(words)} words; it lists {what}, {columns} words a line"
        )
    if not lines:
        raise DatasetError(f"{path}: lists nothing; it should list {what}")
    return [words for _, words in lines]


def _numbers(path: Path, words: list[list[str]], finite: bool = True) -> Float:
    try:
        values = np.array(words, np.float64)
    except ValueError as error:
        raise DatasetError(f"{path}: a number is expected ({error})") from None
    if finite and not np.isfinite(values).all():
        raise DatasetError(
            f"{path}: holds NaN or infinity; was the camera lost here? Remove this frame"
        )
    return values


def read_table(path: Path, what: str, side: int) -> Float:
    """A square table of numbers."""
    values = _numbers(path, _lines(path, side, what))
    if len(values) != side:
        raise DatasetError(f"{path}: not {what}, {side} x {side} numbers")
    return values


def _as_grey(path: Path, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """A mask or a picture, (H, W) uint8 (ITU-R BT.601)."""
    image = _open(path, ("PNG", "JPEG"))
    if (image.height, image.width) != shape:
        raise DatasetError(
            f"{path}: is {image.width} x {image.height} pixels, the depth image {shape[1]} x"
            f" {shape[0]}"
        )
    if image.mode in DEEP:
        raise DatasetError(f"{path}: has 16 bits where 8 are expected; is it a depth image?")
    return np.asarray(image.convert("L"))


def _open(path: Path, formats: tuple[str, ...], load: bool = True) -> Image.Image:
    regular_file(path, "an image", DatasetError)
    try:
        with Image.open(path, formats=formats) as image:
            if load:
                image.load()
            return image  # its file is closed, its pixels stay
    except (*DAMAGED, Image.DecompressionBombError) as error:
        raise DatasetError(f"{path}: the image is damaged or cannot be read ({error})") from None
