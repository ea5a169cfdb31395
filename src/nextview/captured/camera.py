"""A camera that answers requests with the nearest captured view."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nextview.captured.check import check_capture, refuse_many
from nextview.captured.folders import read_box
from nextview.captured.frames import Capture, CapturedFrame
from nextview.errors import (
    DatasetError,
    NoViewLeftError,
    ObservationError,
    UsageError,
    option,
)
from nextview.geometry.axes import upright_axes
from nextview.geometry.viewsphere import angle_between
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.sensing.observed_object import ObservedObject
from nextview.types import Float

# up axes by name
UP = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
# pixels around the object's centre that are tested for occlusion
PIXELS_AROUND_CENTRE = 3
# object radii, least distance of an occluder in front of the centre
HIDING_DISTANCE = 1.5


@dataclass(frozen=True)
class TakenView:
    """A captured view that answered a request.

    Attributes:
        frame: the captured view.
        degrees_off: angle between its direction and the requested one, degrees.
    """

    frame: CapturedFrame
    degrees_off: float


class CapturedCamera:
    """Camera that answers each request with the unused captured view of the nearest direction.

    The object is located by the masks of the folder, unless a point or a box is given. Views whose
    image does not contain its centre come last. A view that does not show the object is skipped,
    and the next nearest one answers.

    Args:
        capture: captured views, which are checked first, see ``check_capture``. Of cameras that
            stand still, those of the first moment are used, as the scene may change.
        up: against gravity, world, (3,); by default from the layout, or the normal of the support
            plane.
        point: near the object, world, metres, (3,); by default the largest object on the support
            plane is used.
        box: upright bounding box of the object.
        denoise: as for ``ObservedObject``.
        life_size: as for ``ObservedObject``.

    Attributes:
        capture: the usable views.
        taken: the views that answered, in order.
        left_out: reasons for the unused views, by name.
        misses: those of them that should show the object: unreadable views, views that contradict
            the others, and views aimed at the object in which it was not found.

    Raises:
        DatasetError: more than a tenth of the views cannot be used, or their poses must be wrong.
        ObservationError: the object is not found in any view.
    """

    # the captured poses were reachable; see ``session.FrameCamera``
    knows_reach = True

    def __init__(
        self,
        capture: Capture,
        up: ArrayLike | None = None,
        point: ArrayLike | None = None,
        box: Box | None = None,
        denoise: bool = True,
        life_size: bool = True,
    ) -> None:
        self._masked = point is None and box is None
        capture = capture.at_one_moment
        self._total = len(capture.frames) + len(capture.unreadable)
        self.capture, self.left_out = check_capture(capture, self._masked)
        self.taken: list[TakenView] = []
        self.misses: dict[str, str] = dict(self.left_out)
        self._left = list(self.capture.frames)

        up = capture.up if up is None else up
        same: dict[str, Any] = {
            "denoise": denoise,
            "life_size": life_size,
            "alone": True,
        }
        if box is not None:
            up = box.axes[2] if up is None else up
            self.object = ObservedObject(up, box=box, **same)
            self._about = box.object_frame
            return
        self._about = self._find(up, point)
        masked = self._masked and any(
            frame.mask is not None for frame in self.capture.frames
        )
        known_place = None if masked else self._about.centre
        self.object = ObservedObject(self._about.axes[2], known_place, **same)

    @property
    def object_frame(self) -> ObjectFrame:
        """Object frame estimated from the views so far."""
        return self.object.object_frame if self.object.sightings else self._about

    def observe(self, pose: Float) -> Frame:
        """Return the nearest unused view to a pose.

        Args:
            pose: (4, 4), object frame, object radii.

        Raises:
            NoViewLeftError: all views were used or left out.
            DatasetError: more than a tenth of the views cannot be used.
        """
        asked = np.asarray(pose, np.float64)[:3, 3]
        while self._left:
            found = self.object_frame
            costs = [_cost(frame, asked, found) for frame in self._left]
            captured = self._left.pop(int(np.argmin(costs)))

            try:
                frame = captured.read(self._masked)
            except ObservationError as error:
                self.left_out[captured.name] = str(error)
            except DatasetError as error:
                self.left_out[captured.name] = self.misses[captured.name] = str(error)
                refuse_many(self.capture, self.misses, self._total)
            else:
                self.taken.append(
                    TakenView(captured, _degrees_off(captured, asked, found))
                )
                return frame

        why = f" ({min(self.left_out.values())})" if self.left_out else ""
        raise NoViewLeftError(
            f"{self.capture.folder}: no view is left that shows the object{why}"
        )

    def refused(self, error: ObservationError) -> None:
        """Report that the object was not found in the last view."""
        self.left_out[self.taken.pop().frame.name] = str(error)

    def take_all(self, pose: Float) -> ObservedObject:
        """Observe the object in all views, those nearest to a pose first.

        Args:
            pose: (4, 4), object frame, object radii.

        Returns:
            The object with the observations of all views that show it.

        Raises:
            DatasetError: the object is not found in more than a tenth of the views aimed at it.
        """
        while True:
            try:
                frame = self.observe(pose)
            except NoViewLeftError:
                break
            try:
                self.object.add(frame)
            except ObservationError as error:
                captured = self.taken[-1].frame
                self.refused(error)
                if self._looks_at_it(captured, frame):
                    self.misses[captured.name] = str(error)
        refuse_many(self.capture, self.misses, self._total)
        return self.object

    def _looks_at_it(self, captured: CapturedFrame, frame: Frame) -> bool:
        """Return True if the object's centre is inside the image and not occluded."""
        found = self.object_frame
        column, row, depth = _projected(captured, found.centre)
        height, width = frame.shape
        if not (depth > 0 and 0 <= column < width and 0 <= row < height):
            return False
        around = frame.depth[_near(row, height), _near(column, width)]
        measured = around[around > 0]
        return not len(measured) or bool(
            np.median(measured) > depth - HIDING_DISTANCE * found.radius
        )

    def _find(self, up: ArrayLike | None, point: ArrayLike | None) -> ObjectFrame:
        """Locate the object approximately."""
        reason = ""
        for frame in self.capture.frames:
            thing = ObservedObject(up, point, alone=True)
            try:
                thing.add(frame.read(self._masked))
            except (DatasetError, ObservationError) as error:
                reason = reason or str(error)
                continue

            found = thing.object_frame
            if point is None:
                return found
            return ObjectFrame(
                np.asarray(point, np.float64),
                found.radius,
                upright_axes(found.axes[2]),
            )

        raise ObservationError(
            f"{self.capture.folder}: the object is found in none of the views ({reason})"
        )


def _degrees_off(frame: CapturedFrame, asked: Float, found: ObjectFrame) -> float:
    """Return the angle between the requested direction and that of the camera, from the object."""
    return float(
        np.degrees(
            angle_between(asked, found.axes @ (frame.pose[:3, 3] - found.centre))
        )
    )


def _projected(captured: CapturedFrame, point: Float) -> tuple[float, float, float]:
    """Project a point, world, (3,), to column, row and depth, metres."""
    pose = captured.pose
    x, y, z = captured.intrinsics @ (pose[:3, :3].T @ (point - pose[:3, 3]))
    return (x / z, y / z, z) if z > 0 else (-1.0, -1.0, z)


def _near(at: float, size: int) -> slice:
    """Return the rows or columns around one of them."""
    return slice(
        max(0, int(at) - PIXELS_AROUND_CENTRE),
        min(size, int(at) + PIXELS_AROUND_CENTRE + 1),
    )


def _cost(frame: CapturedFrame, asked: Float, found: ObjectFrame) -> float:
    """Return the angle off; 180 degrees more if the object's centre is outside the image."""
    column, row, depth = _projected(frame, found.centre)
    inside = depth > 0 and 0 <= column < frame.size[0] and 0 <= row < frame.size[1]
    return _degrees_off(frame, asked, found) + (0 if inside else 180)


def camera_of(
    capture: Capture,
    up: str | ArrayLike | None = None,
    point: ArrayLike | None = None,
    box: Path | Sequence[float] | None = None,
    denoise: bool = True,
    life_size: bool = True,
) -> CapturedCamera:
    """Create the camera of a capture from user input.

    Args:
        capture: the captured views.
        up: "y", "z", or a direction in the world, (3,); by default from the layout, or the normal
            of the support plane.
        point: near the object, world, metres, (3,).
        box: upright bounding box of the object: its low and its high corner along ``up``, metres,
            (6,), or a JSON file with low, high and axes.
        denoise: as for ``ObservedObject``.
        life_size: as for ``ObservedObject``.

    Returns:
        The camera.

    Raises:
        UsageError: a box is given by its corners, but the vertical is not known.
    """
    vertical = UP[up] if isinstance(up, str) else up
    around = None
    if isinstance(box, Path):
        around = read_box(box)
    elif box is not None:
        upwards = capture.up if vertical is None else vertical
        if upwards is None:
            raise UsageError(
                f"{capture.folder}: a box is upright, and in this layout nothing tells where up is:"
                f" give {option('up')}"
            )
        around = Box(np.array(box[:3]), np.array(box[3:]), upright_axes(upwards))
    return CapturedCamera(capture, vertical, point, around, denoise, life_size)
