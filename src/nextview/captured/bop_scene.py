"""A scene of a BOP dataset: its cameras, its objects and its images (Hodan et al., ECCV 2018).

A folder with ``scene_camera.json``, ``depth/000000.png`` and, if there, ``scene_gt.json``,
``rgb/`` or ``gray/``, and ``mask_visib/``. Poses go from the world, or from a model, to the camera;
lengths are in millimetres.
"""

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
SCENE_OBJECTS = "scene_gt.json"


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


def _bop_mask(folder: Path, name: str, here: list[int]) -> Path | None:
    """Read the mask of an object by its number in an image."""
    which = f"{here[0]:06d}" if here else "*"
    masks = list(folder.glob(f"mask_visib/{name}_{which}.png"))
    return masks[0] if len(masks) == 1 else None


def read_bop_cameras(folder: Path) -> dict[int, BopCamera]:
    """The cameras of a scene, by the numbers of the images.

    Args:
        folder: of the scene.

    Raises:
        DatasetError: ``scene_camera.json`` is missing or damaged.
    """
    what = "the cameras of a BOP scene"
    return read_record(folder / SCENE_CAMERAS, dict[int, BopCamera], what, DatasetError)


def read_bop_objects(folder: Path) -> dict[int, list[BopObject]]:
    """The objects of a scene, by the numbers of the images; empty without ``scene_gt.json``.

    Args:
        folder: of the scene.

    Raises:
        DatasetError: the file is damaged.
    """
    path = folder / SCENE_OBJECTS
    if not path.exists():
        return {}
    what = "the objects of a BOP scene"
    return read_record(path, dict[int, list[BopObject]], what, DatasetError)


def read_bop_scene(
    folder: Path,
    intrinsics: Float | None = None,
    object_id: int | None = None,
) -> LayoutViews:
    """Views of scene_camera.json.

    Without camera poses, the world is the object's model, by scene_gt.json.

    Args:
        folder: of the scene.
        intrinsics: pinhole matrix, (3, 3), if not those of the folder.
        object_id: which object, of several.

    Raises:
        DatasetError: a file is damaged, there is no such object, or nothing tells the poses.
    """
    path = folder / SCENE_CAMERAS
    truth = folder / SCENE_OBJECTS
    cameras = read_bop_cameras(folder)
    all_objects = read_bop_objects(folder)
    numbers = sorted({one.obj_id for many in all_objects.values() for one in many})
    named = ", ".join(map(str, numbers))
    if object_id is not None and object_id not in numbers:
        known = f"there are {named}" if numbers else "there is no scene_gt.json"
        raise DatasetError(f"{folder}: no object has the number {object_id}; {known}")
    single = numbers[0] if object_id is None and len(numbers) == 1 else object_id

    notes = ["intrinsics of scene_camera.json"] if intrinsics is None else []
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
        mask = _bop_mask(folder, name, here) if len(here) == 1 or not numbers else None
        image = picture_beside(folder, name)
        depth = DepthFile(folder / f"depth/{name}.png")
        step = taken.depth_scale * MILLIMETRES
        views.frames.append(CapturedFrame(name, depth, step, k, pose, mask, image))
    if from_model:
        notes.append(
            "there are no camera poses: the world is the object's model in scene_gt.json"
        )
        views.object_is_world = True
    if any(frame.mask for frame in views.frames):
        notes.append("masks of mask_visib")
    return views


def picture_beside(folder: Path, name: str) -> Path | None:
    """The colour or grey image of a depth image, if there is one.

    Args:
        folder: of the scene.
        name: of the depth image, six digits.
    """
    files = (f"rgb/{name}.png", f"rgb/{name}.jpg", f"gray/{name}.png")
    return next((folder / file for file in files if (folder / file).exists()), None)


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
