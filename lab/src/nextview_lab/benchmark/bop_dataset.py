"""A dataset of the BOP benchmark: its models, and the images in which they are looked for.

Hodan et al., "BOP: Benchmark for 6D Object Pose Estimation", ECCV 2018; "BOP Challenge 2020 on 6D
Object Localization", ECCV workshops 2020. The layout is that of docs/bop_datasets_format.md in
bop_toolkit.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct, field

from nextview.captured.bop_scene import (
    EVERY_SCENE_CAMERAS,
    BopCamera,
    BopFiles,
    BopObject,
    ThreeNumbers,
    bop_files,
    camera_to_world,
    read_bop_cameras,
    read_bop_objects,
)
from nextview.captured.frames import MILLIMETRES, CapturedFrame, DepthFile
from nextview.errors import DatasetError, UsageError
from nextview.files import read_record
from nextview.types import Float

MODELS_FOLDER = "models"
EVALUATED_MODELS = "models_eval"  # with fewer faces, for errors of poses
MODELS_INFO = "models_info.json"
TARGETS_FILES = ("test_targets_bop19.json", "test_targets_bop24.json")
MODEL_NAME = re.compile(r"obj_0*(\d+)")
LEAST_VISIBLE = 0.1  # share of an object that counts in BOP
SixteenNumbers = Annotated[list[float], Meta(min_length=16, max_length=16)]


class ContinuousSymmetry(Struct):
    """An axis about which a model can be turned by any angle.

    Attributes:
        axis: its direction, in the model's frame.
        offset: a point on it, millimetres.
    """

    axis: ThreeNumbers
    offset: ThreeNumbers = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def __post_init__(self) -> None:
        if not any(self.axis):
            raise ValueError("the axis of a symmetry is a direction, not 0, 0, 0")


class BopModelInfo(Struct):
    """What ``models_info.json`` says of a model.

    Attributes:
        diameter: largest distance of two vertices, millimetres.
        symmetries_discrete: transforms after which it looks the same, row by row, millimetres.
        symmetries_continuous: axes about which it can be turned.
    """

    diameter: Annotated[float, Meta(gt=0)]
    symmetries_discrete: list[SixteenNumbers] = []
    symmetries_continuous: list[ContinuousSymmetry] = []


class _Target(Struct):
    scene_id: int
    im_id: int


class _Visible(Struct):
    visib_fract: float = 1.0


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
class TrueObject:
    """An object in an image, as ``scene_gt.json`` has it.

    Attributes:
        model: number of its model.
        pose: of the model in the camera, (4, 4) float64, millimetres.
        counts: whether enough of it is visible, see ``LEAST_VISIBLE``.
    """

    model: int
    pose: Float
    counts: bool


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

    @cached_property
    def objects(self) -> dict[int, list[BopObject]]:
        """By the numbers of the images, empty if they are not known."""
        return read_bop_objects(self.files)

    @cached_property
    def visible(self) -> dict[int, list[float]]:
        """Visible share of each object by the numbers of the images, if it is known."""
        path = self.files.visible_file
        if not path.exists():
            return {}
        what = "what is visible of the objects of a BOP scene"
        found = read_record(path, dict[int, list[_Visible]], what, DatasetError)
        return {
            image: [one.visib_fract for one in many] for image, many in found.items()
        }


@dataclass(frozen=True)
class BopDataset:
    """A dataset whose images are as yet unread.

    Attributes:
        folder: the whole of it.
        models: mesh file of each model, by its number.
        info: what is known of each model, by its number.
        images: that are looked at, in order, each once.
        scenes: that they are of, by their numbers.
    """

    folder: Path
    models: dict[int, Path]
    info: dict[int, BopModelInfo]
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

    def true_objects(self, image: BopImage) -> tuple[TrueObject, ...] | None:
        """The objects of an image with a model; None where ``scene_gt.json`` says nothing of it.

        Args:
            image: one of ``images``.

        Raises:
            DatasetError: a pose is missing or not rigid.
        """
        scene = self.scenes[image.scene]
        objects = scene.objects.get(image.image)
        if objects is None:
            return None
        visible = scene.visible.get(image.image, [1.0] * len(objects))
        where = f"image {image.image} of {scene.files.object_file}"
        if len(visible) != len(objects):
            raise DatasetError(
                f"{where}: has {len(objects)} objects, and {scene.files.visible_file.name}"
                f" {len(visible)}"
            )

        return tuple(
            TrueObject(one.obj_id, self._true_pose(one, where), shown >= LEAST_VISIBLE)
            for one, shown in zip(objects, visible, strict=True)
            if one.obj_id in self.models
        )

    def without_model(self, image: BopImage) -> tuple[int, ...]:
        """Numbers of the objects of an image that have no model, in order.

        Args:
            image: one of ``images``.
        """
        objects = self.scenes[image.scene].objects.get(image.image, [])
        return tuple(one.obj_id for one in objects if one.obj_id not in self.models)

    def _true_pose(self, one: BopObject, where: str) -> Float:
        """The pose of an object in the camera, (4, 4), millimetres."""
        if one.cam_R_m2c is None or one.cam_t_m2c is None:
            raise DatasetError(
                f"{where}: the object {one.obj_id} has no pose (cam_R_m2c, cam_t_m2c)"
            )
        # it is checked as the inverse, in metres
        to_model = camera_to_world(one.cam_R_m2c, one.cam_t_m2c, where)
        pose = np.eye(4)
        pose[:3, :3] = to_model[:3, :3].T
        pose[:3, 3] = one.cam_t_m2c
        return pose

    def evaluated_model(self, model: int) -> Path:
        """The mesh file that errors of poses are measured with.

        Args:
            model: its number.
        """
        path = self.folder / EVALUATED_MODELS / self.models[model].name
        return path if path.exists() else self.models[model]


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
    info = _info(folder, models)
    images = _images(folder, targets)
    scenes = _scenes(folder, split, {image.scene for image in images}, camera)
    return BopDataset(folder, models, info, images, scenes)


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


def _info(folder: Path, models: dict[int, Path]) -> dict[int, BopModelInfo]:
    """What is known of the models by their numbers."""
    places = (EVALUATED_MODELS, MODELS_FOLDER)
    files = [folder / place / MODELS_INFO for place in places]
    path = next((file for file in files if file.exists()), files[-1])
    what = "the models of a BOP dataset"
    info = read_record(path, dict[int, BopModelInfo], what, DatasetError)
    for number in models:
        if number not in info:
            raise DatasetError(f"{path}: says nothing of {models[number].name}")
    return {number: info[number] for number in models}


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
