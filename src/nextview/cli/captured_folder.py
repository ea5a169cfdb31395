"""A folder of captured views, as the options of ``nextview recognise`` say."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nextview.cameras.captured import read_box, read_capture
from nextview.cameras.captured_camera import UP, CapturedCamera
from nextview.cli.progress import console
from nextview.errors import UsageError
from nextview.sensing.object_frame import Box, upright_axes

Three = tuple[float, float, float]


def captured_camera(
    folder: Path,
    up: str | Three | None,
    point: Three | None,
    box: tuple[float, ...] | Path | None,
    object_id: int | None,
    intrinsics: tuple[float, float, float, float] | Path | None,
    raw: bool,
    any_size: bool,
) -> CapturedCamera:
    """Say what was found in a folder, and make a camera of it."""
    capture = read_capture(folder, intrinsics, object_id)
    console.print(f"{capture!r}", highlight=False)
    direction = UP[up] if isinstance(up, str) else up
    if isinstance(box, Path):
        found = read_box(box)
    elif box is not None:
        upwards = direction or capture.up
        if upwards is None:
            raise UsageError(f"{folder}: a box is upright, and in this layout nothing tells where up is: give --up")
        found = Box(np.array(box[:3]), np.array(box[3:]), upright_axes(upwards))
    return CapturedCamera(capture, direction, point, None if box is None else found, not raw, not any_size)
