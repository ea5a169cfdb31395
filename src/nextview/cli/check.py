"""``nextview check``: check captured frames and the poses of cameras."""

from pathlib import Path

from nextview.captured.check import (
    check_capture,
    errors_of_cameras,
    evenly_spread,
    summary,
)
from nextview.captured.depth_quality import draw_quality, quality_of
from nextview.captured.folders import read_capture
from nextview.cli.common_options import check_file, check_there
from nextview.cli.progress import console
from nextview.sensing.known_frames import REPEATED, repeated


def check(
    path: Path,
    /,
    intrinsics: tuple[float, float, float, float] | Path | None = None,
    depth_scale: float | None = None,
    figure: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Check captured frames, their depth, and the poses of their cameras.

    Captured frames are compared with each other: wrong poses, units and axes are named. For each
    camera it prints how noisy the depth is, by how much it is too long or too short, and which
    things can be told apart at which distance. If several cameras took the frames, the error of
    the pose of each camera is estimated from the surfaces that it sees in common with others,
    relative to the first camera by name.

    The exit status is 2 if the frames contradict each other.

    Args:
        path: folder or bag of captured frames.
        intrinsics: FX FY CX CY in pixels, or a camera file; by default read
            from the folder.
        depth_scale: metres per unit of the depth images, such as 0.001 for
            millimetres; by default read from the folder.
        figure: draw which things the first camera can tell apart at which
            distance, PNG.
        overwrite: replace it.
    """
    check_there(path)
    check_file(figure, overwrite)
    read = read_capture(path, intrinsics, depth_scale=depth_scale)
    console.print(f"{read!r}", soft_wrap=True)
    capture, left_out = check_capture(read, masked=False)
    few = [capture.frames[k] for k in evenly_spread(len(capture.frames), 60)]
    frames = [captured.read(masked=False) for captured in few]
    again = [
        captured.name
        for k, captured in enumerate(few)
        if repeated(frames[k], frames[:k]) is not None
    ]
    if again:
        console.print(
            summary(dict.fromkeys(again, REPEATED.message)),
            style="yellow",
            soft_wrap=True,
        )
    for name, reason in left_out.items():
        console.print(f"left out: {name}: {reason}", style="yellow", soft_wrap=True)
    if len(capture.frames) > 1:
        console.print(
            f"{capture.folder}: all {len(capture.frames)} frames agree",
            soft_wrap=True,
        )
    cameras = capture.cameras
    for camera in cameras:
        quality = quality_of(capture, camera)
        for sentence in quality.sentences():
            said = f"camera {camera}: {sentence}" if camera else sentence
            console.print(said, soft_wrap=True)
        if figure is not None and camera == cameras[0]:
            draw_quality(quality, figure, overwrite)
    if len(cameras) < 2:
        return

    offsets = errors_of_cameras(capture)
    for offset in offsets:
        if offset.noticed:
            console.print(f"{offset}", style="yellow", soft_wrap=True)
        else:
            shift, turn = offset.uncertainty
            console.print(
                f"camera {offset.camera} agrees with camera {offset.reference} (each axis within"
                f" {shift:.1f} mm and {turn:.2f} degrees)",
                soft_wrap=True,
            )
    compared = {offset.camera for offset in offsets}
    for camera in cameras[1:]:
        if camera not in compared:
            console.print(
                f"camera {camera} sees too little of what other cameras see: its pose is not"
                " checked",
                style="yellow",
                soft_wrap=True,
            )
