"""Things in the images of a BOP dataset: their poses in BOP's file of results."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec import Struct

from nextview.captured.bop_scene import EVERY_SCENE_CAMERAS, BopFiles, bop_files
from nextview.captured.frames import MILLIMETRES
from nextview.checks import one_line
from nextview.data.progress import TrackProgress, silently
from nextview.errors import DatasetError, NextviewError, UsageError
from nextview.files import read_record
from nextview.session.system import load
from nextview_lab.benchmark.frame_answers import (
    FrameAnswers,
    check_table,
    evenly,
    looked_at,
    write_table,
)
from nextview_lab.data.real_frames import RealFrame, bop_frames

TARGETS_FILES = ("test_targets_bop19.json", "test_targets_bop24.json")
BOP_COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
MODEL_NAME = re.compile(r"obj_0*(\d+)")

Image = tuple[int, int]  # numbers of its scene and of itself


class _Target(Struct):
    scene_id: int
    im_id: int


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
    """

    models: str = "ycb"
    ids: tuple[str, ...] = ()
    split: str = "test"
    targets: Path | None = None
    camera: str | None = None
    frames: int | None = None


@dataclass(frozen=True)
class BopRun:
    """What was found in a dataset.

    Attributes:
        images: how many were looked at.
        left_out: why images could not be, by their names.
        poses: how many lines were written.
        seconds: a looked-at image, mean.
        others: how often things were found that are no models of the dataset, by name.
        not_known: models that the memory does not know, by their numbers.
    """

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
    check_table(out, overwrite)
    models = _models(dataset)
    images = _images(dataset, how)
    system = load(how.models)
    numbers = _numbers(how, dataset, models, system.classes)

    frames = images.values()
    with looked_at(out, how.models, system, frames, how.camera, track) as answers:
        lines, others = _lines(images, answers, numbers)
        found = [one for one in map(answers.of, frames) if one is not None]
        if not found:
            raise DatasetError(f"{dataset}: no image can be looked at{answers.why()}")
        write_table(out, overwrite, BOP_COLUMNS, lines)
    return BopRun(
        len(found),
        answers.left_out,
        len(lines),
        float(np.mean([one.seconds for one in found])),
        {name: others.count(name) for name in sorted(set(others))},
        tuple(sorted(models - set(numbers.values()))),
    )


def _models(dataset: Path) -> set[int]:
    """The numbers of the models of a dataset."""
    files = dataset.glob("models/*.ply")
    names = (MODEL_NAME.fullmatch(file.stem) for file in files)
    models = {int(name[1]) for name in names if name is not None}
    if not models:
        raise DatasetError(
            f"{dataset}: has no models (models/obj_000001.ply); is it the folder of a whole BOP"
            " dataset, with its models unpacked?"
        )
    return models


def _images(dataset: Path, how: BopOptions) -> dict[Image, RealFrame]:
    """The images that are looked at, as yet unread."""
    files = [dataset / name for name in TARGETS_FILES]
    path = how.targets or next((file for file in files if file.exists()), files[0])
    what = "the targets of a BOP dataset"
    listed = read_record(path, list[_Target], what, DatasetError)
    asked = dict.fromkeys((one.scene_id, one.im_id) for one in listed)
    if not asked:
        raise DatasetError(f"{path}: lists no image")

    some = evenly(list(asked), how.frames)
    there: dict[Image, RealFrame] = {}
    for number in dict.fromkeys(scene for scene, _ in some):
        frames = bop_frames(_camera_of(dataset, number, how))
        there |= {(number, int(frame.name)): frame for frame in frames}
    for scene, image in some:
        if (scene, image) not in there:
            raise DatasetError(f"{path}: scene {scene} has no camera of image {image}")
    return {image: there[image] for image in some}


def _camera_of(dataset: Path, number: int, how: BopOptions) -> BopFiles:
    """The files of a scene, or of one of its cameras."""
    scene = dataset / how.split / f"{number:06d}"
    if not scene.is_dir():
        every = dataset.glob(f"*/*/{EVERY_SCENE_CAMERAS}")
        there = sorted({path.parents[1].name for path in every})
        hint = (
            f"--split names one of {', '.join(there)}" if there else "unpack its images"
        )
        raise DatasetError(f"{scene}: there is no such folder; {hint}")
    files = bop_files(scene, how.camera)
    if len(files) > 1:
        named = ", ".join(one.camera for one in files)
        raise DatasetError(
            f"{scene}: has depth images of several cameras: --camera names one of {named}"
        )
    return files[0]


def _numbers(
    how: BopOptions,
    dataset: Path,
    models: set[int],
    things: Sequence[str],
) -> dict[str, int]:
    """The number of each thing that is a model of the dataset, by its name."""
    named = {name: MODEL_NAME.fullmatch(name) for name in things}
    numbers = {name: int(found[1]) for name, found in named.items() if found}
    numbers = {name: number for name, number in numbers.items() if number in models}
    for text in how.ids:
        name, _, number = text.rpartition("=")
        if name not in things:
            raise UsageError(
                f"--ids: {how.models} knows nothing called {one_line(name)}"
            )
        if not number.isdecimal() or int(number) not in models:
            there = ", ".join(map(str, sorted(models)))
            raise UsageError(
                f"--ids {one_line(text)}: {dataset} has no model {one_line(number)}; it has {there}"
            )
        numbers[name] = int(number)
    if not numbers:
        raise UsageError(
            f"{how.models}: none of its things is called as a model of {dataset}, such as"
            " obj_000001; say which things they are with --ids NAME=NUMBER"
        )
    return numbers


def _lines(
    images: dict[Image, RealFrame],
    answers: FrameAnswers,
    numbers: dict[str, int],
) -> tuple[list[list[object]], list[str]]:
    """The lines of the file of results, and the names that are of no model.

    All lines of an image have one time, as bop_toolkit checks.
    """
    lines: list[list[object]] = []
    others = []
    for (scene, image), frame in images.items():
        answer = answers.of(frame)
        for one in () if answer is None else answer.objects:
            if one.named and one.name not in numbers:
                others.append(one.name)
            elif one.named and answer is not None:
                turn = one.matrix[:3, :3].ravel()
                shift = one.matrix[:3, 3] / MILLIMETRES
                pose = (
                    " ".join(f"{value:.9f}" for value in turn),
                    " ".join(f"{value:.6f}" for value in shift),
                )
                known = [scene, image, numbers[one.name], f"{one.belief:.6f}"]
                lines.append([*known, *pose, f"{answer.seconds:.6f}"])
    return lines, others
