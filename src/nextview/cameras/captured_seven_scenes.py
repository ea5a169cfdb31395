"""Captured views in the layout of 7-Scenes (Shotton et al., CVPR 2013): frame-000000.depth.png and .pose.txt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.cameras.captured_frame import CapturedFrame, pinhole_of, read_numbers, rigid

KINECT = (585.0, 585.0, 320.0, 240.0)
"""fx, fy, cx, cy of the depth camera, which the data set gives for all of its scenes."""
MILLIMETRES = 0.001


@takes_paths("folder")
def read_seven_scenes(folder: Path, intrinsics: NDArray[np.float64] | None) -> tuple[list[CapturedFrame], list[str]]:
    """The views of one sequence. Its colour images are not registered to the depth, and left alone.

    Beside each depth image there may be a mask of the object, frame-000000.mask.png.

    Args:
        folder: with the images.
        intrinsics: (3, 3); the data set's own if not given.

    Returns:
        The views, and what was assumed.

    Raises:
        DatasetError: a pose is missing or is none.
    """
    notes = []
    if intrinsics is None:
        intrinsics = pinhole_of(*KINECT)
        notes.append("there is no camera-intrinsics.txt: the Kinect's fx = fy = 585, cx = 320, cy = 240 are assumed")
    frames = []
    for depth in sorted(folder.glob("frame-*.depth.png")):
        name = depth.name.removesuffix(".depth.png")
        path, mask = folder / f"{name}.pose.txt", folder / f"{name}.mask.png"
        pose = rigid(read_numbers(path, "the camera's pose", (4, 4)), str(path))
        number = name.removeprefix("frame-")
        frames.append(CapturedFrame(number, depth, MILLIMETRES, intrinsics, pose, mask if mask.exists() else None))
    return frames, notes
