"""Things in the images of a BOP dataset: their poses in BOP's file of results."""

import csv
import hashlib
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct

from nextview.captured.bop_scene import (
    EVERY_SCENE_CAMERAS,
    BopCamera,
    BopFiles,
    bop_files,
    camera_to_world,
    read_bop_cameras,
)
from nextview.captured.frames import MILLIMETRES, CapturedFrame, DepthFile
from nextview.checks import one_line
from nextview.data.progress import TrackProgress, silently
from nextview.errors import DatasetError, ObservationError, UsageError
from nextview.files import (
    check_new,
    new_file,
    only_one,
    read_record,
    unfinished,
    write_record,
)
from nextview.scene.scene import Scene
from nextview.session.system import System, load
from nextview.teaching.learn import CARD
from nextview.things.memory import open_memory
from nextview.types import Float

MODELS_FOLDER = "models"
TARGETS_FILES = ("test_targets_bop19.json", "test_targets_bop24.json")
MODEL_NAME = re.compile(r"obj_0*(\d+)")


class _Target(Struct):
    scene_id: int
    im_id: int


@dataclass(frozen=True, order=True)
class BopImage:
    """An image that is looked at.

    Attributes:
        scene: number of its scene.
        image: its number there.
    """

    scene: int
    image: int

    @property
    def name(self) -> str:
        """As its files are: ``000001/000000``."""
        return f"{self.scene:06d}/{self.image:06d}"


@dataclass(frozen=True)
class BopScene:
    """A scene, as yet unread.

    Attributes:
        files: of the camera that is used.
    """

    files: BopFiles

    @cached_property
    def cameras(self) -> dict[int, BopCamera]:
        """By the numbers of the images; a DatasetError if they cannot be read."""
        return read_bop_cameras(self.files)


@dataclass(frozen=True)
class BopDataset:
    """A dataset whose images are as yet unread.

    Attributes:
        folder: the whole of it.
        models: mesh file of each model, by its number.
        images: that are looked at, in order, each once.
        scenes: that they are of, by their numbers.
    """

    folder: Path
    models: dict[int, Path]
    images: tuple[BopImage, ...]
    scenes: dict[int, BopScene]

    def camera(self, image: BopImage) -> BopCamera:
        """The camera of an image.

        Args:
            image: one of ``images``.

        Raises:
            DatasetError: it is not known.
        """
        scene = self.scenes[image.scene]
        if image.image not in scene.cameras:
            raise DatasetError(
                f"{scene.files.camera_file}: has no camera of the image {image.image}"
            )
        return scene.cameras[image.image]

    def frame(self, image: BopImage, in_world: bool = False) -> CapturedFrame:
        """A depth image, as yet unread.

        Args:
            image: one of ``images``.
            in_world: whether its pose is that of the camera in the scene's world; else the camera
                is the world.

        Raises:
            DatasetError: its camera is not known.
        """
        files = self.scenes[image.scene].files
        camera = self.camera(image)
        pose = np.eye(4)
        if in_world:
            where = f"image {image.image} of {files.camera_file}"
            if camera.cam_R_w2c is None or camera.cam_t_w2c is None:
                raise DatasetError(
                    f"{where}: lacks the camera's pose (cam_R_w2c, cam_t_w2c); leave out"
                    " --camera-poses"
                )
            pose = camera_to_world(camera.cam_R_w2c, camera.cam_t_w2c, where)

        name = f"{image.image:06d}"
        return CapturedFrame(
            image.name,
            DepthFile(files.depth(name)),
            camera.depth_scale * MILLIMETRES,
            camera.intrinsics,
            pose,
            image=files.picture(name),
        )


def read_bop_dataset(
    folder: Path,
    split: str = "test",
    targets: Path | None = None,
    camera: str | None = None,
) -> BopDataset:
    """Read what a dataset has, without its images.

    Args:
        folder: the whole dataset.
        split: folder of the scenes in it.
        targets: file that lists the images; by default one of ``TARGETS_FILES``.
        camera: the one whose files are read, where each has its own; by default the only one with
            depth images.

    Raises:
        DatasetError: a file is missing or damaged, or lists nothing.
        UsageError: the split is no name of a folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f"{folder}: there is no such folder")
    models = _models(folder)
    images = _images(folder, targets)
    scenes = _scenes(folder, split, {image.scene for image in images}, camera)
    return BopDataset(folder, models, images, scenes)


def model_number(name: str) -> int | None:
    """The number of a model by its name, as 12 of ``obj_000012``; None if it is no such name.

    Args:
        name: of a thing, or of a mesh file without its suffix.
    """
    found = MODEL_NAME.fullmatch(name)
    return None if found is None else int(found[1])


def _models(folder: Path) -> dict[int, Path]:
    """The mesh files of a dataset by their numbers."""
    found = {
        number: path
        for path in sorted((folder / MODELS_FOLDER).glob("*.ply"))
        if (number := model_number(path.stem)) is not None
    }
    if not found:
        raise DatasetError(
            f"{folder}: has no models (models/obj_000001.ply); is it the folder of a whole BOP"
            " dataset, with its models unpacked?"
        )
    return found


def _images(folder: Path, targets: Path | None) -> tuple[BopImage, ...]:
    """The images that are looked at, each once."""
    files = [folder / name for name in TARGETS_FILES] if targets is None else [targets]
    path = next((file for file in files if file.exists()), files[0])
    listed = read_record(
        path, list[_Target], "the targets of a BOP dataset", DatasetError
    )
    if not listed:
        raise DatasetError(f"{path}: lists no image")
    return tuple(dict.fromkeys(BopImage(one.scene_id, one.im_id) for one in listed))


def _scenes(
    folder: Path,
    split: str,
    numbers: set[int],
    camera: str | None,
) -> dict[int, BopScene]:
    """The scenes of some numbers in a split."""
    if Path(split).name != split:
        raise UsageError(f"--split is the name of a folder of {folder}, not {split!r}")
    if not (folder / split).is_dir():
        there = sorted(
            path.parents[1].name for path in folder.glob(f"*/*/{EVERY_SCENE_CAMERAS}")
        )
        named = ", ".join(dict.fromkeys(there))
        hint = f"--split names one of {named}" if there else "are its images unpacked?"
        raise DatasetError(f"{folder / split}: there is no such folder; {hint}")
    scenes = {}
    for number in sorted(numbers):
        scene = folder / split / f"{number:06d}"
        if not scene.is_dir():
            raise DatasetError(
                f"{scene}: the targets name this scene, and there is no such folder"
            )
        files = bop_files(scene, camera)
        if len(files) > 1:
            named = ", ".join(one.camera for one in files)
            raise DatasetError(
                f"{scene}: has depth images of several cameras: --camera names one of {named}"
            )
        scenes[number] = BopScene(files[0])
    return scenes


BOP_COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
UPWARDS = (0.0, 0.0, 1.0)  # in the world of camera poses
MOST_NAMED = 5  # of many in a sentence


@dataclass(frozen=True)
class BopOptions:
    """What is looked for, and in which images.

    Attributes:
        models: memory that was taught with the models of the dataset (nextview learn
            DATASET/models MEMORY --unit mm), or with things in the same frames.
        ids: numbers of the models that things of the memory are, NAME=NUMBER; things called
            obj_000012 need none.
        split: folder of the scenes, such as test_primesense.
        targets: file that lists the images; by default DATASET/test_targets_bop19.json, or
            test_targets_bop24.json.
        camera: the one whose images are looked at, where each has files of its own:
            photoneo of scene_camera_photoneo.json; by default the only one with depth images.
        frames: number of images to look at, evenly spread over those of the targets, for a first
            try; by default all.
        camera_poses: use the poses of the cameras in scene_camera.json, in whose world z points
            up; by default the normal of the support plane does.
    """

    models: str = "ycb"
    ids: tuple[str, ...] = ()
    split: str = "test"
    targets: Path | None = None
    camera: str | None = None
    frames: int | None = None
    camera_poses: bool = False


class FoundPose(msgspec.Struct, frozen=True):
    """A model that was found in an image.

    Attributes:
        model: its number.
        score: belief that it is this one, 0 to 1.
        pose: of the model in the camera, (3, 4) row by row, millimetres.
    """

    model: int
    score: float
    pose: tuple[float, ...]

    @property
    def matrix(self) -> Float:
        """The pose, (4, 4) float64, millimetres."""
        return np.vstack([np.reshape(self.pose, (3, 4)), [0.0, 0.0, 0.0, 1.0]])


class FoundInImage(msgspec.Struct, frozen=True):
    """What was found in an image.

    Attributes:
        poses: of all things that were named.
        seconds: that it took to read the image and to look at it.
        others: names of things that were found and are no models of the dataset.
    """

    poses: tuple[FoundPose, ...]
    seconds: float
    others: tuple[str, ...] = ()


@dataclass(frozen=True)
class BopRun:
    """What was found in a dataset.

    Attributes:
        out: the file of results.
        images: how many were looked at.
        left_out: why images could not be, by their names.
        poses: how many lines were written.
        seconds: a looked-at image, mean.
        others: how often things were found that are no models of the dataset, by name.
        not_known: models that the memory does not know, by their numbers.
    """

    out: Path
    images: int
    left_out: dict[str, str]
    poses: int
    seconds: float
    others: dict[str, int]
    not_known: tuple[int, ...] = ()


def look_for_models(
    dataset: Path,
    out: Path,
    how: BopOptions = BopOptions(),
    overwrite: bool = False,
    track: TrackProgress = silently,
) -> BopRun:
    """Name and locate the models of a BOP dataset in its depth images.

    Each image of the targets is looked at by itself; its things and the pose of its camera are
    not known. Every thing that is named becomes a line of OUT with the belief as its score, as
    BOP's 6D detection wants it and bop_toolkit, which evaluates it, reads it. An interrupted run
    resumes.

    Args:
        dataset: folder of a whole BOP dataset: models/, test/ and the file of its targets.
        out: file to write, .csv; BOP wants METHOD_DATASET-SPLIT.csv, such as
            nextview_lmo-test.csv.
        how: models and images.
        overwrite: replace OUT.
        track: follows the images.

    Returns:
        What was found.

    Raises:
        DatasetError: a file of the dataset is missing or damaged, or no image can be looked at.
        ResultsError: ``out`` exists, or cannot be written.
        UsageError: an option makes no sense, or the memory knows none of the models.
    """
    out = Path(out)
    check_new(out, overwrite)
    if out.suffix.lower() != ".csv":
        raise UsageError(f"{out}: the name ends in .csv")
    if how.frames is not None and how.frames < 1:
        raise UsageError(f"at least one frame is looked at, not {how.frames}")
    read = read_bop_dataset(dataset, how.split, how.targets, how.camera)
    images = _evenly(read.images, how.frames)
    given = _numbers_given(how.ids, read)
    numbers = _numbers_of_things(how.models, given, read)
    system = load(how.models)

    left_out: dict[str, str] = {}
    with only_one(out), unfinished(out, _key(read, how)) as parts:
        looks = _looks(read, images, system, numbers, how.camera_poses, parts, left_out)
        track(looks, len(images), "images")
        found = {
            image: _part(parts, image)
            for image in images
            if _part_file(parts, image).exists()
        }
        if not found:
            raise DatasetError(
                f"{dataset}: no image can be looked at: {next(iter(left_out.values()))}"
            )
        with new_file(out, overwrite) as new:
            _write(new, found)

    names = [name for one in found.values() for name in one.others]
    return BopRun(
        out,
        len(found),
        left_out,
        sum(len(one.poses) for one in found.values()),
        float(np.mean([one.seconds for one in found.values()])),
        {name: names.count(name) for name in sorted(set(names))},
        tuple(sorted(set(read.models) - set(numbers.values()))),
    )


def _evenly(images: Sequence[BopImage], most: int | None) -> tuple[BopImage, ...]:
    """At most so many images, evenly spread."""
    if most is None or most >= len(images):
        return tuple(images)
    few = np.unique(np.linspace(0, len(images) - 1, most).round().astype(int))
    return tuple(images[row] for row in few)


def _numbers_given(ids: Sequence[str], dataset: BopDataset) -> dict[str, int]:
    """The numbers of models that a person gave, by the names of things."""
    numbers = {}
    for text in ids:
        name, equals, digits = text.rpartition("=")
        if not (name and equals and digits.isdecimal()):
            raise UsageError(
                f"--ids takes NAME=NUMBER, such as mug=14, not {one_line(repr(text))}"
            )

        number = int(digits)
        if number not in dataset.models:
            there = ", ".join(map(str, sorted(dataset.models)))
            raise UsageError(
                f"--ids {one_line(text)}: {dataset.folder} has no model {number}; it has {there}"
            )
        numbers[name] = number
    return numbers


def _numbers_of_things(
    memory: str,
    given: dict[str, int],
    dataset: BopDataset,
) -> dict[str, int]:
    """The number of each thing that is a model of the dataset, by its name."""
    card, _ = open_memory(_card_of(memory))
    assert card.memory is not None
    things = [thing.name for thing in card.memory.things]
    for name in given:
        if name not in things:
            raise UsageError(f"--ids: {memory} knows nothing called {one_line(name)}")

    named = {
        name: number for name in things if (number := model_number(name)) is not None
    }
    numbers = {
        name: number
        for name, number in (named | given).items()
        if number in dataset.models
    }

    if not numbers:
        raise UsageError(
            f"{memory}: none of its things ({_few(things)}) is called as a model of"
            f" {dataset.folder} ({next(iter(dataset.models.values())).stem}); say which"
            " things they are with --ids NAME=NUMBER"
        )
    return numbers


def _few(names: Sequence[str]) -> str:
    more = ", ..." if len(names) > MOST_NAMED else ""
    return ", ".join(one_line(name) for name in names[:MOST_NAMED]) + more


def _card_of(memory: str) -> Path | str:
    """The card of a memory that is named, or given as a folder."""
    return Path(memory) / CARD if Path(memory).is_dir() else memory


def _key(dataset: BopDataset, how: BopOptions) -> str:
    """What the part of each image depends on."""
    card, _ = open_memory(_card_of(how.models))
    depends = [
        str(dataset.folder.resolve()),
        how.split,
        how.camera,
        card.sha256,
        sorted(how.ids),
        how.camera_poses,
    ]
    return hashlib.sha256(msgspec.json.encode(depends)).hexdigest()


def _part_file(parts: Path, image: BopImage) -> Path:
    return parts / f"{image.scene:06d}-{image.image:06d}.json"


def _part(parts: Path, image: BopImage) -> FoundInImage:
    what = "what was found in an image"
    return read_record(_part_file(parts, image), FoundInImage, what, DatasetError)


def _looks(
    dataset: BopDataset,
    images: Sequence[BopImage],
    system: System,
    numbers: dict[str, int],
    in_world: bool,
    parts: Path,
    left_out: dict[str, str],
) -> Iterator[int]:
    """Look at each image that is not done, and write what is found; yields how many are done."""
    for done, image in enumerate(images, 1):
        if not _part_file(parts, image).exists():
            try:
                found = _look(dataset, image, system, numbers, in_world)
            except (DatasetError, ObservationError) as error:
                left_out[image.name] = str(error)
            else:
                write_record(_part_file(parts, image), found)
        yield done


def _look(
    dataset: BopDataset,
    image: BopImage,
    system: System,
    numbers: dict[str, int],
    in_world: bool,
) -> FoundInImage:
    """Look at one image.

    Raises:
        DatasetError: a file is missing or damaged.
        ObservationError: it shows no plane, or nothing.
    """
    begun = time.perf_counter()
    captured = dataset.frame(image, in_world)
    scene = Scene(system, UPWARDS if in_world else None)
    scene.update(captured.read())
    to_camera = np.linalg.inv(captured.pose)

    poses = []
    others = []
    for thing in scene.objects:
        name = thing.name
        pose = thing.pose
        if pose is None:
            continue
        if name not in numbers:
            others.append(name)
            continue
        in_camera = (to_camera @ pose)[:3]
        in_camera[:, 3] /= MILLIMETRES
        flat = tuple(in_camera.ravel().tolist())
        poses.append(FoundPose(numbers[name], thing.confidence, flat))
    seconds = time.perf_counter() - begun
    return FoundInImage(tuple(poses), seconds, tuple(others))


def _write(path: Path, found: dict[BopImage, FoundInImage]) -> None:
    """Write the file of results: all lines of an image have one time, as bop_toolkit checks."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(BOP_COLUMNS)

        for image, one in found.items():
            for pose in one.poses:
                matrix = pose.matrix
                writer.writerow(
                    [
                        image.scene,
                        image.image,
                        pose.model,
                        f"{pose.score:.6f}",
                        " ".join(f"{value:.9f}" for value in matrix[:3, :3].ravel()),
                        " ".join(f"{value:.6f}" for value in matrix[:3, 3]),
                        f"{one.seconds:.6f}",
                    ]
                )
