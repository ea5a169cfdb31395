"""A dataset of the BOP benchmark: its models, and the images in which they are looked for.

Hodan et al., "BOP: Benchmark for 6D Object Pose Estimation", ECCV 2018; "BOP Challenge 2020 on 6D
Object Localization", ECCV workshops 2020. The layout is that of docs/bop_datasets_format.md in
bop_toolkit.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

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
from nextview.errors import DatasetError, UsageError
from nextview.files import read_record

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
