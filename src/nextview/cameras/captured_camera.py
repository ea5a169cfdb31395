"""A camera that has been everywhere already: the nearest captured view answers a request."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nextview.cameras.captured import Capture
from nextview.cameras.captured_frame import CapturedFrame
from nextview.errors import NoViewLeftError, ObservationError
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import Box, ObjectFrame, upright_axes
from nextview.sensing.observed_object import ObservedObject
from nextview.viewsphere import angle_between

Float = NDArray[np.float64]

UP = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
"""The axes of a world that may be called up by name."""


@dataclass(frozen=True)
class Taken:
    """A captured view that answered a request.

    Attributes:
        frame: which one.
        degrees_off: angle at the object's centre between the direction asked for and the camera's.
    """

    frame: CapturedFrame
    degrees_off: float


class CapturedCamera:
    """Answers each request with the captured view that is nearest in direction, as seen from the object, and unused.

    The object is found by the masks of the folder, unless a point or a box is given. Where it is has to be known before
    any view is asked for: from the box; else about, from the first frame in which it is found. Views whose picture does
    not hold the object's centre come last. A view that turns out not to show the object is left out, and the next
    nearest answers.

    Args:
        capture: the views.
        up: direction against gravity in the capture's world, (3,); by default what its layout says, or the normal of
            the support plane.
        point: near the object, world, metres, (3,): the thing on the support plane that is meant, not the largest.
        box: upright, into which the object just fits.
        denoise: as for ``ObservedObject``.
        life_size: as for ``ObservedObject``.

    Attributes:
        object: what is looked for in them.
        taken: the views that answered, in order.
        left_out: why views were left out, by name.

    Raises:
        ObservationError: the object is found in none of the views.
        DatasetError: an image cannot be used.
    """

    def __init__(
        self,
        capture: Capture,
        up: ArrayLike | None = None,
        point: ArrayLike | None = None,
        box: Box | None = None,
        denoise: bool = True,
        life_size: bool = True,
    ) -> None:
        self.capture, self.taken, self.left_out = capture, list[Taken](), dict[str, str]()
        self._masked = point is None and box is None
        self._left = list(range(len(capture.frames)))
        self._pictures: dict[int, tuple[int, int]] = {}
        up = capture.up if up is None else up
        same: dict[str, Any] = {"denoise": denoise, "life_size": life_size}
        if box is not None:
            up = box.axes[2] if up is None else up
            self.object, self._about = ObservedObject(up, box=box, **same), box.object_frame
            return
        self._about = self._find(up, point)
        masked = self._masked and any(frame.mask is not None for frame in capture.frames)
        self.object = ObservedObject(self._about.axes[2], None if masked else self._about.centre, **same)

    @property
    def object_frame(self) -> ObjectFrame:
        """Where the object is, as far as the views so far tell."""
        return self.object.object_frame if self.object.sightings else self._about

    @property
    def left(self) -> int:
        """Views that may still answer."""
        return len(self._left)

    def observe(self, pose: Float) -> Frame:
        """The nearest unused view to a pose, (4, 4), object frame, object radii.

        Raises:
            NoViewLeftError: no view is left that shows the object.
            DatasetError: an image cannot be used.
        """
        asked = np.asarray(pose, np.float64)[:3, 3]
        while self._left:
            i = min(self._left, key=self._cost(asked).__getitem__)
            self._left.remove(i)
            captured, found = self.capture.frames[i], self.object_frame
            try:
                frame = captured.read(self._masked)
            except ObservationError as error:
                self.left_out[captured.name] = str(error)
                continue
            off = angle_between(asked, found.axes @ (captured.pose[:3, 3] - found.centre))
            self.taken.append(Taken(captured, float(np.degrees(off))))
            return frame
        reasons = sorted(set(self.left_out.values()))
        why = f" ({reasons[0]})" if reasons else ""
        raise NoViewLeftError(f"{self.capture.folder}: no view is left that shows the object{why}")

    def refused(self, error: ObservationError) -> None:
        """The last view that answered does not show the object."""
        self.left_out[self.taken.pop().frame.name] = str(error)

    def _cost(self, asked: Float) -> Float:
        """Degrees off of every view, (N,); 180 more where the object's centre is outside the picture."""
        found = self.object_frame
        cost = np.full(len(self.capture.frames), np.inf)
        for i in self._left:
            position = self.capture.frames[i].pose[:3, 3] - found.centre
            cost[i] = np.degrees(angle_between(asked, found.axes @ position)) + 180 * (
                not self._in_picture(i, found.centre)
            )
        return cost

    def _in_picture(self, i: int, position: Float) -> bool:
        frame = self.capture.frames[i]
        x, y, z = frame.intrinsics @ (frame.pose[:3, :3].T @ (position - frame.pose[:3, 3]))
        if z <= 0:
            return False
        if i not in self._pictures:
            self._pictures[i] = frame.size
        width, height = self._pictures[i]
        return bool(0 <= x / z < width and 0 <= y / z < height)

    def _find(self, up: ArrayLike | None, point: ArrayLike | None) -> ObjectFrame:
        """About where the object is."""
        reason = ""
        for frame in self.capture.frames:
            thing = ObservedObject(up, point)
            try:
                thing.add(frame.read(self._masked))
            except ObservationError as error:
                reason = reason or str(error)
                continue
            found = thing.object_frame
            if point is not None:
                axes = upright_axes(found.axes[2])
                return ObjectFrame(np.asarray(point, np.float64), found.radius, axes)
            return found
        raise ObservationError(f"{self.capture.folder}: the object is found in none of the views ({reason})")
