"""Things in the images of a BOP dataset: their poses in BOP's file of results."""

import csv
import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct

from nextview.captured.bop_scene import (
    EVERY_SCENE_CAMERAS,
    BopFiles,
    bop_files,
    camera_to_world,
    read_bop_cameras,
)
from nextview.captured.frames import MILLIMETRES, CapturedFrame
from nextview.checks import one_line
from nextview.data.progress import TrackProgress, silently
from nextview.errors import DatasetError, NextviewError, UsageError
from nextview.files import check_new, new_file, only_one, read_record, unfinished
from nextview.recognition.model_card import find_models
from nextview.sensing.frame import Frame
from nextview.session.system import load
from nextview.things.memory import open_memory
from nextview_lab.benchmark.frame_answers import (
    FoundObject,
    FrameAnswer,
    FrameAnswers,
    evenly,
)
from nextview_lab.data.real_frames import bop_frame

MODELS_FOLDER = "models"
TARGETS_FILES = ("test_targets_bop19.json", "test_targets_bop24.json")
_cameras = cache(read_bop_cameras)
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
class BopDataset:
    """A dataset whose images are as yet unread.

    Attributes:
        folder: the whole of it.
        models: mesh file of each model, by its number.
        images: that are looked at, in order, each once.
        scenes: files of the cameras of those that they are of, by their numbers.
    """

    folder: Path
    models: dict[int, Path]
    images: tuple[BopImage, ...]
    scenes: dict[int, BopFiles]

    def frame(self, image: BopImage, in_world: bool = False) -> CapturedFrame:
        """A depth image, as yet unread.

        Args:
            image: one of ``images``.
            in_world: whether its pose is that of the camera in the scene's world; else the camera
                is the world.

        Raises:
            DatasetError: its camera is not known.
        """
        files = self.scenes[image.scene]
        camera = _cameras(files).get(image.image)
        if camera is None:
            raise DatasetError(
                f"{files.camera_file}: has no camera of the image {image.image}"
            )
        pose = None
        if in_world:
            where = f"image {image.image} of {files.camera_file}"
            if camera.cam_R_w2c is None or camera.cam_t_w2c is None:
                raise DatasetError(
                    f"{where}: lacks the camera's pose (cam_R_w2c, cam_t_w2c); leave out"
                    " --camera-poses"
                )
            pose = camera_to_world(camera.cam_R_w2c, camera.cam_t_w2c, where)
        return replace(bop_frame(files, camera, image.image, pose), name=image.name)


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
) -> dict[int, BopFiles]:
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
        scenes[number] = files[0]
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
    left_out: dict[str, NextviewError]
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
    read = read_bop_dataset(dataset, how.split, how.targets, how.camera)
    images = evenly(read.images, how.frames)
    given = _numbers_given(how.ids, read)
    numbers = _numbers_of_things(how.models, given, read)
    system = load(how.models)

    up = np.array(UPWARDS) if how.camera_poses else None
    with only_one(out), unfinished(out, _key(read, how)) as parts:
        answers = FrameAnswers(parts, system, up)
        reads = {image.name: partial(_frame, read, image, how) for image in images}
        track(answers.look_at(reads), len(images), "images")
        found = {
            image: answer
            for image in images
            if (answer := answers[image.name]) is not None
        }
        if not found:
            raise DatasetError(f"{dataset}: no image can be looked at{answers.why()}")
        lines = {
            image: [one for one in answer.objects if one.named and one.name in numbers]
            for image, answer in found.items()
        }
        with new_file(out, overwrite) as new:
            _write(new, found, lines, numbers)

    others = [
        one.name
        for answer in found.values()
        for one in answer.objects
        if one.named and one.name not in numbers
    ]
    return BopRun(
        out,
        len(found),
        answers.left_out,
        sum(map(len, lines.values())),
        float(np.mean([one.seconds for one in found.values()])),
        {name: others.count(name) for name in sorted(set(others))},
        tuple(sorted(set(read.models) - set(numbers.values()))),
    )


def _frame(dataset: BopDataset, image: BopImage, how: BopOptions) -> Frame:
    """Read an image."""
    return dataset.frame(image, how.camera_poses).read(masked=False)


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
    card, _ = open_memory(find_models(memory).recogniser)
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


def _key(dataset: BopDataset, how: BopOptions) -> str:
    """What the part of each image depends on."""
    card, _ = open_memory(find_models(how.models).recogniser)
    depends = [
        str(dataset.folder.resolve()),
        how.split,
        how.camera,
        card.sha256,
        sorted(how.ids),
        how.camera_poses,
    ]
    return hashlib.sha256(msgspec.json.encode(depends)).hexdigest()


def _write(
    path: Path,
    found: Mapping[BopImage, FrameAnswer],
    lines: Mapping[BopImage, Sequence[FoundObject]],
    numbers: Mapping[str, int],
) -> None:
    """Write the file of results: all lines of an image have one time, as bop_toolkit checks."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(BOP_COLUMNS)

        for image, answer in found.items():
            for one in lines[image]:
                rotation = one.matrix[:3, :3].ravel()
                shift = one.matrix[:3, 3] / MILLIMETRES
                writer.writerow(
                    [
                        image.scene,
                        image.image,
                        numbers[one.name],
                        f"{one.belief:.6f}",
                        " ".join(f"{value:.9f}" for value in rotation),
                        " ".join(f"{value:.6f}" for value in shift),
                        f"{answer.seconds:.6f}",
                    ]
                )
