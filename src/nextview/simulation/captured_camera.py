"""A camera that has been everywhere already: the nearest captured view answers a request."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nextview.errors import NoViewLeftError, ObservationError
from nextview.geometry.viewsphere import angle_between
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import Box, ObjectFrame, upright_axes
from nextview.sensing.observed_object import ObservedObject
from nextview.simulation.captured import Capture, CapturedFrame, Float

UP = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}  # the axes of a world that may be called up by name


@dataclass(frozen=True)
class Taken:
    """A captured view that answered a request, and how far off the direction asked for it is, from the object."""

    frame: CapturedFrame
    degrees_off: float


class CapturedCamera:
    """Answers each request with the captured view that is nearest in direction, as seen from the object, and unused.

    The object is found by the masks of the folder, unless a point or a box is given. Views whose picture does not hold
    its centre come last. A view that does not show the object is left out, and the next nearest answers.

    ``up``: against gravity, world, (3,); by default by the layout, or the normal of the support plane. ``point``: near
    the object, world, metres, (3,), if not the largest thing on the support plane is meant. ``box``: upright, into
    which the object just fits. The others as for ``ObservedObject``. ``taken``: the views that answered, in order;
    ``left_out``: why views were left out, by name. ObservationError if the object is found in none of the views.
    """

    knows_reach = True  # the camera stood there when the frames were captured; see ``session.FrameCamera``

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
        self._masked, self._left = point is None and box is None, list(capture.frames)
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

    def observe(self, pose: Float) -> Frame:
        """The nearest unused view to a pose, (4, 4), object frame, object radii; NoViewLeftError if none is left."""
        asked = np.asarray(pose, np.float64)[:3, 3]
        while self._left:
            found = self.object_frame
            costs = [_cost(frame, asked, found) for frame in self._left]
            captured = self._left.pop(int(np.argmin(costs)))
            try:
                frame = captured.read(self._masked)
            except ObservationError as error:
                self.left_out[captured.name] = str(error)
            else:
                self.taken.append(Taken(captured, _degrees_off(captured, asked, found)))
                return frame
        why = f" ({min(self.left_out.values())})" if self.left_out else ""
        raise NoViewLeftError(f"{self.capture.folder}: no view is left that shows the object{why}")

    def refused(self, error: ObservationError) -> None:
        """The last view that answered does not show the object."""
        self.left_out[self.taken.pop().frame.name] = str(error)

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
            if point is None:
                return found
            return ObjectFrame(np.asarray(point, np.float64), found.radius, upright_axes(found.axes[2]))
        raise ObservationError(f"{self.capture.folder}: the object is found in none of the views ({reason})")


def _degrees_off(frame: CapturedFrame, asked: Float, found: ObjectFrame) -> float:
    """Between the direction asked for and the camera's, from the object."""
    return float(np.degrees(angle_between(asked, found.axes @ (frame.pose[:3, 3] - found.centre))))


def _cost(frame: CapturedFrame, asked: Float, found: ObjectFrame) -> float:
    """Degrees off; 180 more where the object's centre is outside the picture."""
    x, y, z = frame.intrinsics @ (frame.pose[:3, :3].T @ (found.centre - frame.pose[:3, 3]))
    inside = z > 0 and 0 <= x / z < frame.size[0] and 0 <= y / z < frame.size[1]
    return _degrees_off(frame, asked, found) + 180 * (not inside)
