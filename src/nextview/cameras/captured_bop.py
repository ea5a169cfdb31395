"""Captured views in the layout of the BOP challenge (Hodan et al., ECCV 2018): the folder of one scene."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.cameras.captured_frame import CapturedFrame, inverse, rigid
from nextview.errors import DatasetError, ModelError
from nextview.json_file import Fields, read_object

Float = NDArray[np.float64]

MILLIMETRES = 0.001


@takes_paths("folder")
def read_bop(folder: Path, object_id: int | None, intrinsics: Float | None) -> tuple[list[CapturedFrame], list[str]]:
    """The views of one scene.

    Where scene_camera.json has no camera poses (cam_R_w2c), those of the object in scene_gt.json are used: the world is
    then the object's model. Masks of mask_visib/ are used where it is clear whose they are.

    Args:
        folder: with scene_camera.json and depth/.
        object_id: which object is meant, its obj_id; not needed if there is but one.
        intrinsics: (3, 3); those of scene_camera.json if not given.

    Returns:
        The views that show the object, and what was assumed.

    Raises:
        DatasetError: what is missing or wrong.
    """
    cameras = _read(folder / "scene_camera.json", "the cameras of a BOP scene")
    truth = _read(folder / "scene_gt.json", "the objects of a BOP scene") if (folder / "scene_gt.json").exists() else {}
    numbers = _of_images(cameras, folder / "scene_camera.json")
    objects = sorted({_id(one, folder) for many in truth.values() for one in _list(many, folder)})
    if object_id is not None and object_id not in objects:
        known = f"there are {', '.join(map(str, objects))}" if objects else "there is no scene_gt.json"
        raise DatasetError(f"{folder}: no object has the number {object_id}; {known}")
    single = object_id if object_id is not None else (objects[0] if len(objects) == 1 else None)
    notes = ["intrinsics of scene_camera.json"] if intrinsics is None else []
    if single is None and len(objects) > 1:
        notes.append(f"objects {', '.join(map(str, objects))}: name one with --object-id, and its masks are used")
    masks = (folder / "mask_visib").is_dir() and (single is not None or not objects)
    frames, from_model = [], False
    for number in numbers:
        where = f"image {number} of {folder / 'scene_camera.json'}"
        camera = _fields(cameras[str(number)], where)
        instances = _list(truth.get(str(number), []), folder)
        here = [i for i, one in enumerate(instances) if _id(one, folder) == single]
        if objects and single is not None and not here:
            continue  # it does not show the object
        k = _matrix(camera, "cam_K", (3, 3), where)
        scale = _number(camera, "depth_scale", where)
        if "cam_R_w2c" in camera:
            pose = _camera_to_world(camera, "w2c", where)
        elif here:
            said = f"image {number} of {folder / 'scene_gt.json'}"
            pose, from_model = _camera_to_world(instances[here[0]], "m2c", said), True
        else:
            instead = (
                "name an object with --object-id, and its pose in scene_gt.json will do"
                if objects
                else ("without it scene_gt.json has to tell the object's pose")
            )
            raise DatasetError(f"{where}: lacks the camera's pose (cam_R_w2c, cam_t_w2c); {instead}")
        frames.append(
            CapturedFrame(
                f"{number:06d}",
                folder / "depth" / f"{number:06d}.png",
                scale * MILLIMETRES,
                k if intrinsics is None else intrinsics,
                pose,
                _mask(folder, number, here) if masks else None,
                _picture(folder, number),
            )
        )
    if from_model:
        notes.append("there are no camera poses: the world is the object's model in scene_gt.json")
    if any(frame.mask for frame in frames):
        notes.append("masks of mask_visib")
    return frames, notes


def _read(path: Path, what: str) -> dict[str, Any]:
    try:
        return read_object(path, what)
    except FileNotFoundError:
        raise DatasetError(f"{path}: there is no such file") from None
    except ModelError as error:
        raise DatasetError(str(error)) from None


def _of_images(cameras: dict[str, Any], path: Path) -> list[int]:
    strange = [key for key in cameras if not re.fullmatch(r"[0-9]{1,9}", key)]
    if strange or not cameras:
        what = f"and {strange[0]!r} is none" if strange else "and there is none"
        raise DatasetError(f"{path}: the cameras are listed by the numbers of images, {what}")
    return sorted(map(int, cameras))


def _fields(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise DatasetError(f"{where}: is not a JSON object")
    return value


def _list(value: Any, folder: Path) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(one, dict) for one in value):
        raise DatasetError(f"{folder / 'scene_gt.json'}: an image has a list of objects")
    return value


def _id(one: dict[str, Any], folder: Path) -> int:
    found = one.get("obj_id")
    if isinstance(found, bool) or not isinstance(found, int):
        raise DatasetError(f"{folder / 'scene_gt.json'}: an object has no whole number as its obj_id")
    return found


def _number(values: dict[str, Any], name: str, where: str) -> float:
    number = _matrix(values, name, (), where)
    if not number > 0:
        raise DatasetError(f"{where}: {name!r} is not positive")
    return float(number)


def _matrix(values: dict[str, Any], name: str, shape: tuple[int, ...], where: str) -> Float:
    count = int(np.prod(shape))
    try:
        fields = Fields({name: values[name]} if name in values else {}, where)
        found = fields.numbers(name, 1) if shape else np.array(fields.number(name))
    except ModelError as error:
        raise DatasetError(str(error)) from None
    if found.size != count:
        raise DatasetError(f"{where}: {name!r} has {found.size} numbers, not {count}")
    return found.reshape(shape)


def _camera_to_world(values: dict[str, Any], between: str, where: str) -> Float:
    rotation = _matrix(values, f"cam_R_{between}", (3, 3), where)
    translation = _matrix(values, f"cam_t_{between}", (3,), where) * MILLIMETRES
    return rigid(inverse(rotation, translation), where)


def _mask(folder: Path, number: int, instances: list[int]) -> Path | None:
    """That of the object's only instance; without scene_gt.json, the only one there is."""
    if instances:
        path = folder / "mask_visib" / f"{number:06d}_{instances[0]:06d}.png"
        return path if len(instances) == 1 and path.exists() else None
    found = list((folder / "mask_visib").glob(f"{number:06d}_*.png"))
    return found[0] if len(found) == 1 else None


def _picture(folder: Path, number: int) -> Path | None:
    for name in (f"rgb/{number:06d}.png", f"rgb/{number:06d}.jpg", f"gray/{number:06d}.png"):
        if (folder / name).exists():
            return folder / name
    return None
