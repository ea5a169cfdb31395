"""Why a folder is no capture: what is in it, and what is expected there."""

from collections import Counter
from collections.abc import Callable
from itertools import islice
from pathlib import Path

from nextview.captured.pcd import read_pcd_header
from nextview.checks import number_of, one_line
from nextview.geometry.mesh import FORMATS

MOST_FILES = 1000  # that are looked at
LIKELY_IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".npy", ".pgm")


def why_unread(folder: Path, is_capture: Callable[[Path], bool]) -> str:
    """Explain in one sentence why a folder is not a capture, and what to give instead.

    Args:
        folder: that is there, and is in no layout that is read.
        is_capture: tells whether another folder is a capture.

    Raises:
        DatasetError: its clouds are not depth images.
    """
    if cloud := next((path for path in _some(folder, "*.pcd")), None):
        read_pcd_header(cloud)  # raises an error that says why it is no depth image

    above = folder / ".." if folder.name in ("", "..") else folder.parent
    if is_capture(above):
        return f"{folder}: is only a part of a capture: give the folder above, {above}"
    for holder in (folder, above):
        if (holder / "depth").is_dir() and (holder == folder or folder.name == "depth"):
            return _lacks_depth(holder)

    inside = [path for path in _some(folder, "*") if path.is_dir() and is_capture(path)]
    if inside:
        rest = f", or one of {len(inside) - 1} others" if len(inside) > 1 else ""
        return (
            f"{folder}: the frames are in a folder inside it: give {min(inside)}{rest}"
        )

    files = _some(folder, "**/*")
    if mesh := next((file for file in files if file.suffix.lower() in FORMATS), None):
        return (
            f"{folder}: is a folder of meshes, not of captured views; recognise one of them"
            f" ({mesh}), or teach it them: nextview learn {folder} OUT"
        )
    if any(file.suffix.lower() in LIKELY_IMAGES for file in _some(folder, "*")):
        return (
            f"{folder}: {_content(folder)} and has no folder depth/; give one image, or put 16-bit"
            " PNG files into depth/"
        )
    return (
        f"{folder}: no captured views are found; it {_content(folder)}, where depth/NAME.png with"
        " the camera's intrinsics, a ROS 2 bag or another layout of docs/recordings.md is expected"
    )


def _lacks_depth(folder: Path) -> str:
    """Say what is wrong with a folder that contains ``depth/``."""
    if next((folder / "depth").glob("*.png"), None) is None:
        there = _content(folder / "depth")
        return f"{folder}: depth/ {there}; depth images are 16-bit PNG files, depth/NAME.png"
    return f"{folder}: has mask_visib/, as in BOP, but scene_camera.json is missing"


def _content(folder: Path) -> str:
    """Say what a folder contains: "is empty", or "holds 12 .jpg files and 1 folder"."""
    kinds: Counter[str] = Counter()
    for path in _some(folder, "*"):
        ending = one_line(path.suffix, 20)
        kinds["folder" if path.is_dir() else f"{ending} file".lstrip()] += 1
    if not kinds:
        return "is empty"
    *first, last = [number_of(count, kind) for kind, count in kinds.most_common(4)]
    return f"holds {', '.join(first)} and {last}" if first else f"holds {last}"


def _some(folder: Path, pattern: str) -> list[Path]:
    """Return the first files and folders that match a pattern."""
    return list(islice(folder.glob(pattern), MOST_FILES))
