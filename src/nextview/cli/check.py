"""``nextview check``: check captured frames and the poses of cameras, or a view store."""

from pathlib import Path

from nextview.captured.check import check_capture, errors_of_cameras
from nextview.captured.folders import read_capture
from nextview.captured.frames import Capture
from nextview.cli.common_options import Workers, check_there
from nextview.cli.progress import console, track_all
from nextview.data import store as view_store
from nextview.data.store import ViewStore
from nextview.errors import DatasetError


def check(
    path: Path,
    /,
    intrinsics: tuple[float, float, float, float] | Path | None = None,
    depth_scale: float | None = None,
    workers: Workers = Workers(),
) -> None:
    """Check captured frames, or a view store.

    Captured frames are compared with each other: wrong poses, units and axes are named. If several
    cameras took them, the error of the pose of each camera is estimated from the surfaces that it
    sees in common with others, relative to the first camera by name.

    Of a view store the checksum of every object is verified.

    The exit status is 2 if the frames contradict each other, or if an object is damaged.

    Args:
        path: folder or bag of captured frames, or view store made by nextview render.
        intrinsics: for captured frames: FX FY CX CY in pixels, or a camera file; by default read
            from the folder.
        depth_scale: for captured frames: metres per unit of the depth images, such as 0.001 for
            millimetres; by default read from the folder.
    """
    check_there(path)
    if path.suffix == ".zarr" or (path / "zarr.json").exists():
        _check_store(path, workers)
    else:
        _check_frames(read_capture(path, intrinsics, depth_scale=depth_scale))


def _check_frames(read: Capture) -> None:
    """Check the poses of captured frames and of their cameras."""
    console.print(f"{read!r}", soft_wrap=True)
    capture, left_out = check_capture(read, masked=False)
    for name, reason in left_out.items():
        console.print(f"left out: {name}: {reason}", style="yellow", soft_wrap=True)
    console.print(
        f"{capture.folder}: {len(capture.frames)} frames contradict each other nowhere",
        soft_wrap=True,
    )
    cameras = capture.cameras
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


def _check_store(store: Path, workers: Workers) -> None:
    """Verify the checksum of every object in a view store."""
    views = ViewStore.open(store)
    done = int(views.done.sum())

    damaged = track_all(
        view_store.check(store, **vars(workers)),
        done,
        f"checking {store.name}",
    )
    for reason in views.attributes.failures.values():
        console.print(f"left out: {reason}", style="yellow")

    missing = len(views) - done - len(views.attributes.failures)
    console.print(
        f"{store}: {done - len(damaged)} objects are sound, {len(damaged)} damaged, {missing} not"
        " rendered"
    )

    if damaged:
        raise DatasetError(
            f"{store}: {len(damaged)} of {done} objects are damaged; remove the store and render"
            " again"
        )
