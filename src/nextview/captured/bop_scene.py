"""A scene of a BOP dataset: its cameras, its objects and its images (Hodan et al., ECCV 2018).

A folder with ``scene_camera.json``, ``depth/000000.png`` and, if there, ``scene_gt.json``,
``rgb/`` or ``gray/``, and ``mask_visib/``. Where several cameras have files of their own, all these
names end in that of the camera: ``scene_camera_photoneo.json``, ``depth_photoneo/000000.png``.
Poses go from the world, or from a model, to the camera; lengths are in millimetres.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from nextview.captured.frames import (
    MILLIMETRES,
    CapturedFrame,
    DepthFile,
    LayoutViews,
    rigid,
)
from nextview.errors import DatasetError
from nextview.files import read_record
from nextview.types import Float

ThreeNumbers = Annotated[list[float], Meta(min_length=3, max_length=3)]
Nine = Annotated[list[float], Meta(min_length=9, max_length=9)]
SCENE_CAMERAS = "scene_camera.json"
EVERY_SCENE_CAMERAS = "scene_camera*.json"  # those of each camera, too


@dataclass(frozen=True)
class BopFiles:
    """Files of a scene, or of one of its cameras.

    Attributes:
        folder: of the scene.
        camera: name at the end of its files, such as photoneo; "" where there is one set of files.
    """

    folder: Path
    camera: str = ""

    def named(self, kind: str, ending: str = "") -> Path:
        """Path of a file or folder.

        Args:
            kind: beginning of its name, such as ``scene_gt``.
            ending: end of its name, such as ``.json``.
        """
        of_camera = f"_{self.camera}" if self.camera else ""
        return self.folder / f"{kind}{of_camera}{ending}"

    @property
    def camera_file(self) -> Path:
        """File of the cameras of all images."""
        return self.named("scene_camera", ".json")

    @property
    def object_file(self) -> Path:
        """File of the objects in all images."""
        return self.named("scene_gt", ".json")

    def depth(self, name: str) -> Path:
        """Path of a depth image.

        Args:
            name: of the image, six digits.
        """
        return self.named("depth") / f"{name}.png"

    def picture(self, name: str) -> Path | None:
        """The colour or grey image of a depth image, if there is one.

        Args:
            name: of the depth image, six digits.
        """
        rgb, gray = self.named("rgb"), self.named("gray")
        files = (rgb / f"{name}.png", rgb / f"{name}.jpg", gray / f"{name}.png")
        return next((file for file in files if file.exists()), None)

    def mask(self, name: str, here: list[int]) -> Path | None:
        """The mask of an object by its number in an image, if there is exactly one.

        Args:
            name: of the image, six digits.
            here: number of the object; empty if the objects are not known.
        """
        which = f"{here[0]:06d}" if here else "*"
        masks = list(self.named("mask_visib").glob(f"{name}_{which}.png"))
        return masks[0] if len(masks) == 1 else None


def bop_files(folder: Path, camera: str | None = None) -> list[BopFiles]:
    """Find the files of a scene, of each camera with depth images where each has its own.

    Args:
        folder: of the scene.
        camera: name of the only one to be found; by default all.

    Raises:
        DatasetError: there is no such camera, or none has depth images.
    """
    if camera is None and (folder / SCENE_CAMERAS).exists():
        return [BopFiles(folder)]

    every = [path.stem for path in sorted(folder.glob("scene_camera_*.json"))]
    there = [name.removeprefix("scene_camera_") for name in every]
    if camera is not None:
        if camera not in there:
            known = f"; there are {', '.join(there)}" if there else ""
            raise DatasetError(f"{folder}: has no scene_camera_{camera}.json{known}")
        return [BopFiles(folder, camera)]
    if not there:
        return [BopFiles(folder)]

    found = [BopFiles(folder, name) for name in there]
    with_depth = [files for files in found if files.named("depth").is_dir()]
    if not with_depth:
        raise DatasetError(
            f"{folder}: none of its cameras ({', '.join(there)}) has depth images"
            f" ({found[0].named('depth').name}/000000.png)"
        )
    return with_depth


class BopCamera(Struct):
    """The camera of one image.

    Attributes:
        cam_K: pinhole matrix, row by row, pixels.
        depth_scale: millimetres that one step of the depth image stands for.
        cam_R_w2c: rotation from the world to the camera, row by row, if known.
        cam_t_w2c: its translation, millimetres.
    """

    cam_K: Nine
    depth_scale: Annotated[float, Meta(gt=0)]
    cam_R_w2c: Nine | None = None
    cam_t_w2c: ThreeNumbers | None = None

    @property
    def intrinsics(self) -> Float:
        """Pinhole matrix, (3, 3) float64, pixels."""
        return np.reshape(np.array(self.cam_K, np.float64), (3, 3))


class BopObject(Struct):
    """An object in one image.

    Attributes:
        obj_id: number of its model.
        cam_R_m2c: rotation from the model to the camera, row by row.
        cam_t_m2c: its translation, millimetres.
    """

    obj_id: int
    cam_R_m2c: Nine | None = None
    cam_t_m2c: ThreeNumbers | None = None


LACKS_POSE = (
    "lacks the camera's pose (cam_R_w2c, cam_t_w2c); an object's pose in scene_gt.json will do,"
    " named with --object-id if there are several"
)


def read_bop_cameras(files: BopFiles) -> dict[int, BopCamera]:
    """The cameras of a scene, by the numbers of the images.

    Args:
        files: of the scene.

    Raises:
        DatasetError: ``scene_camera.json`` is missing or damaged.
    """
    what = "the cameras of a BOP scene"
    return read_record(files.camera_file, dict[int, BopCamera], what, DatasetError)


def read_bop_objects(files: BopFiles) -> dict[int, list[BopObject]]:
    """The objects of a scene, by the numbers of the images; empty without ``scene_gt.json``.

    Args:
        files: of the scene.

    Raises:
        DatasetError: the file is damaged.
    """
    if not files.object_file.exists():
        return {}
    what = "the objects of a BOP scene"
    return read_record(
        files.object_file, dict[int, list[BopObject]], what, DatasetError
    )


def read_bop_scene(
    folder: Path,
    intrinsics: Float | None = None,
    object_id: int | None = None,
) -> LayoutViews:
    """Views of scene_camera.json, or of the files of each camera, whose poses are in one world.

    Without camera poses, the world is the object's model, by scene_gt.json.

    Args:
        folder: of the scene.
        intrinsics: pinhole matrix, (3, 3), if not those of the folder.
        object_id: which object, of several.

    Raises:
        DatasetError: a file is damaged, there is no such object, or nothing tells the poses.
    """
    cameras_there = bop_files(folder)
    if len(cameras_there) == 1:
        return _views_of(cameras_there[0], intrinsics, object_id)

    views = LayoutViews([], [])
    for files in cameras_there:
        own = _views_of(files, intrinsics, object_id)
        views.frames += [
            replace(frame, name=f"{files.camera}/{frame.name}", camera=files.camera)
            for frame in own.frames
        ]
        for name, reason in own.unreadable.items():
            views.unreadable[f"{files.camera}/{name}"] = reason
        views.notes.append(f"camera {files.camera}: {', '.join(own.notes)}")
        views.object_is_world |= own.object_is_world
    return views


def _views_of(
    files: BopFiles,
    intrinsics: Float | None,
    object_id: int | None,
) -> LayoutViews:
    """Views of one set of files, see ``read_bop_scene``."""
    path = files.camera_file
    truth = files.object_file
    cameras = read_bop_cameras(files)
    all_objects = read_bop_objects(files)
    numbers = sorted({one.obj_id for many in all_objects.values() for one in many})
    named = ", ".join(map(str, numbers))
    if object_id is not None and object_id not in numbers:
        known = f"there are {named}" if numbers else f"there is no {truth.name}"
        raise DatasetError(
            f"{files.folder}: no object has the number {object_id}; {known}"
        )
    single = numbers[0] if object_id is None and len(numbers) == 1 else object_id

    notes = [f"intrinsics of {path.name}"] if intrinsics is None else []
    if single is None and numbers:
        notes.append(
            f"objects {named}: name one with --object-id, and its masks are used"
        )

    views = LayoutViews([], notes)
    from_model = False
    for index, taken in sorted(cameras.items()):
        objects = all_objects.get(index, [])
        name = f"{index:06d}"
        here = [i for i, one in enumerate(objects) if one.obj_id == single]
        if single is not None and numbers and not here:
            continue  # it does not show the object
        rotation = taken.cam_R_w2c
        translation = taken.cam_t_w2c
        where = f"image {index} of {path}"
        if rotation is None and here:
            thing = objects[here[0]]
            from_model = True
            where = f"image {index} of {truth}"
            rotation = thing.cam_R_m2c
            translation = thing.cam_t_m2c
        if rotation is None or translation is None:
            raise DatasetError(f"{where}: {LACKS_POSE}")
        try:
            pose = camera_to_world(rotation, translation, where)
        except DatasetError as error:
            views.unreadable[name] = str(error)
            continue
        k = taken.intrinsics if intrinsics is None else intrinsics
        mask = files.mask(name, here) if len(here) == 1 or not numbers else None
        image = files.picture(name)
        depth = DepthFile(files.depth(name))
        step = taken.depth_scale * MILLIMETRES
        views.frames.append(CapturedFrame(name, depth, step, k, pose, mask, image))
    if from_model:
        notes.append(
            f"there are no camera poses: the world is the object's model in {truth.name}"
        )
        views.object_is_world = True
    if any(frame.mask for frame in views.frames):
        notes.append(f"masks of {files.named('mask_visib').name}")
    return views


def camera_to_world(
    rotation: list[float],
    translation: list[float],
    where: str,
) -> Float:
    """Convert BOP's world-to-camera transform to a camera-to-world pose, (4, 4), metres.

    Args:
        rotation: row by row.
        translation: millimetres.
        where: beginning of the error message.

    Raises:
        DatasetError: it is not rigid.
    """
    pose = np.eye(4)
    pose[:3, :3] = np.reshape(rotation, (3, 3)).T
    pose[:3, 3] = -pose[:3, :3] @ (np.array(translation) * MILLIMETRES)
    return rigid(pose, where)
