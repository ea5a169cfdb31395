"""Captured objects: folders of depth images with poses, in the layouts of BOP, TUM RGB-D and 7-Scenes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.cameras.captured_bop import read_bop
from nextview.cameras.captured_frame import CapturedFrame, pinhole_of, read_numbers
from nextview.cameras.captured_seven_scenes import read_seven_scenes
from nextview.cameras.captured_tum import read_tum
from nextview.errors import DatasetError, ModelError, UsageError
from nextview.json_file import Fields, read_object
from nextview.sensing.object_frame import Box

INTRINSICS = "camera-intrinsics.txt"
"""The pinhole matrix in a folder of TUM or 7-Scenes, three rows of three numbers, as in 3DMatch."""


@dataclass(frozen=True)
class Capture:
    """A folder of captured views of one scene.

    Attributes:
        folder: where it is.
        layout: "BOP", "TUM RGB-D" or "7-Scenes".
        frames: in the folder's order, at least one.
        up: direction against gravity in its world, (3,), by the habit of the layout; None if that says nothing.
        notes: what was assumed or left out, a phrase each.
    """

    folder: Path
    layout: str
    frames: tuple[CapturedFrame, ...]
    up: tuple[float, float, float] | None
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        return f"{self.folder}: {self.layout} layout, {len(self.frames)} frames; " + "; ".join(self.notes)


@takes_paths("folder")
def read_capture(
    folder: str | Path,
    intrinsics: tuple[float, float, float, float] | str | Path | None = None,
    object_id: int | None = None,
) -> Capture:
    """Find out which layout a folder has, and read its poses and intrinsics; the images are read when they are used.

    Args:
        folder: one scene.
        intrinsics: focal lengths and principal point (fx, fy, cx, cy), pixels, first pixel's centre at 0; or a file
            with the pinhole matrix. By default those of the folder.
        object_id: of a BOP scene with several objects: the one that is meant, its obj_id.

    Raises:
        DatasetError: what is missing or wrong, and in which file.
        UsageError: ``object_id`` is given for another layout.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f"{folder}: there is no such folder")
    bop, tum = (folder / "scene_camera.json").exists(), (folder / "depth.txt").exists()
    seven = next(folder.glob("frame-*.depth.png"), None) is not None
    found = [name for name, there in (("BOP", bop), ("TUM RGB-D", tum), ("7-Scenes", seven)) if there]
    if len(found) > 1:
        raise DatasetError(f"{folder}: has the files of two layouts, {found[0]} and {found[1]}; move one of them away")
    if not found:
        raise DatasetError(
            f"{folder}: no captured views are found; there is no scene_camera.json (BOP), depth.txt (TUM RGB-D) or "
            "frame-*.depth.png (7-Scenes)"
        )
    if object_id is not None and not bop:
        raise UsageError(f"objects have numbers in BOP's layout only, and {folder} has the layout of {found[0]}")
    k, said = _intrinsics(folder, intrinsics)
    if bop:
        frames, notes = read_bop(folder, object_id, k)
    elif tum:
        frames, notes = read_tum(folder, k)
    else:
        frames, notes = read_seven_scenes(folder, k)
    if not frames:
        raise DatasetError(f"{folder}: no image shows the object")
    up = None if seven else (0.0, 0.0, 1.0)  # the world of 7-Scenes is that of its first camera
    return Capture(folder, found[0], tuple(frames), up, (*said, *notes))


@takes_paths("path")
def read_box(path: Path) -> Box:
    """An upright box in a JSON file: "low" and "high", its corners, metres, and "axes", rows, the world's by default.

    Raises:
        DatasetError: it is missing or something else.
        UsageError: it has no inside, or its axes are no rotation.
    """
    try:
        fields = Fields(read_object(path, "a box"), str(path))
        low, high = fields.numbers("low", 1), fields.numbers("high", 1)
        axes = fields.numbers("axes", 2, np.eye(3))
        fields.end()
        return Box(low, high, axes)
    except FileNotFoundError:
        raise DatasetError(f"{path}: there is no such file") from None
    except ModelError as error:
        raise DatasetError(str(error)) from None
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None


def _intrinsics(
    folder: Path, given: tuple[float, float, float, float] | str | Path | None
) -> tuple[NDArray[np.float64] | None, list[str]]:
    if isinstance(given, tuple):
        return pinhole_of(*given), ["intrinsics as given"]
    path = folder / INTRINSICS if given is None else Path(given)
    if given is None and not path.exists():
        return None, []
    return read_numbers(path, "the pinhole matrix", (3, 3)), [f"intrinsics of {path.name}"]
