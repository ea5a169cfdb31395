"""An object observed in a sequence of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from nextview.errors import ObservationError, UsageError
from nextview.geometry.axes import three, upright_axes
from nextview.segmentation.instances import Instances, Segmenter, instances_of
from nextview.sensing.choosing import choose_instance
from nextview.sensing.frame import Frame
from nextview.sensing.known_frames import REPEATED, KnownFrames
from nextview.sensing.masks import (
    SPHERE_MARGIN,
    above_plane,
    inside_box,
    inside_mask,
    inside_sphere,
)
from nextview.sensing.mistakes import check_mistakes
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.sensing.observation import Observation
from nextview.sensing.planes import Plane
from nextview.sensing.plausibility import check_last_view, check_observation
from nextview.sensing.registration import Displacement, displacement
from nextview.sensing.resampling import observation_of
from nextview.sensing.segmented_frame import (
    SegmentedFrame,
    segmented_frame,
    without_surfaces,
)
from nextview.sensing.sighting import (
    FEWEST_OBJECT_PIXELS,
    Sighting,
    object_frame_of,
    sighting_of,
)
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float, Mask

# change of centre or radius, in object radii, below which the object frame is kept
SAME_FRAME = 0.01
NO_OUTLINE = (
    "an object that stands on no plane (support=False) needs a mask in each frame, Frame(...,"
    " mask=...), a point on it, ObservedObject(point=...), or a box, ObservedObject(box=...), which"
    " separates it from what grips it"
)
NO_PLANE = ViewWarning(
    "support",
    "no support plane is seen, so where the object ends below is guessed: support=False if it"
    " stands on none",
)


@dataclass(frozen=True)
class ObjectState:
    """State of an object after some frames.

    Attributes:
        frame: the object frame; None before the object is found.
        sightings: of the object, one per frame.
        observations: of the frames, in the latest object frame.
        warnings: about the latest frame.
        revision: number of changes of the object frame.
    """

    frame: ObjectFrame | None = None
    sightings: tuple[Sighting, ...] = ()
    observations: tuple[Observation, ...] = ()
    warnings: tuple[ViewWarning, ...] = ()
    revision: int = 0


class ObservedObject:
    """One object observed in a sequence of frames. ``add`` turns a frame into an observation.

    The object is located in each frame by the frame's mask; otherwise by a ``box``; otherwise it is
    the segmented instance nearest to a ``point``, or at which the first camera is aimed. Its centre
    and radius are those of the box, or are estimated from all frames that show enough of it. When
    the estimate improves, earlier frames are recomputed: all ``observations`` are in the latest
    object frame, and ``revision`` counts its changes. The x axis points towards the first camera,
    unless a box or a known frame defines it.

    >>> thing = ObservedObject()                                                # doctest: +SKIP
    >>> observation = thing.add(Frame(depth, intrinsics, pose))                 # doctest: +SKIP

    Args:
        up: direction against gravity in the world, (3,); z by default. With None, and for frames
            without a pose, the normal of the support plane in the first frame is used.
        point: near the object, world, metres, (3,).
        box: upright bounding box of the object.
        support: whether the object stands on a visible plane. Set False for a gripper or a
            turntable; the object must then be given by the mask of each frame, by a point on it, by
            a box or by its known frame.
        known: the object frame, if it need not be estimated; the object is everything in its
            sphere.
        denoise: smooth depth, fill holes and drop flying pixels. For real sensors; not needed for
            renders.
        life_size: whether the object has the usual size of its class, so that the radius is
            evidence.
        segmentation: segments the objects in frames, see ``nextview.Scene``; None for the bundled
            network.
        alone: whether the object stands alone, so that every instance that touches it is a part of
            it.
    """

    def __init__(
        self,
        up: ArrayLike | None = (0.0, 0.0, 1.0),
        point: ArrayLike | None = None,
        box: Box | None = None,
        support: bool = True,
        known: ObjectFrame | None = None,
        denoise: bool = True,
        life_size: bool = True,
        segmentation: Segmenter | None = None,
        alone: bool = False,
    ) -> None:
        if sum(asked is not None for asked in (point, box, known)) > 1:
            raise UsageError(
                "an object is asked for by a point, by a box or by its known frame: by one of them"
            )

        self.point = None if point is None else three(point, "a point")
        self.up = None if up is None else upright_axes(up)[2]
        self.box = box
        self.support = support
        self.known = known if box is None else box.object_frame
        self.denoise = denoise
        self.life_size = life_size
        self.segmentation = segmentation
        self.alone = alone
        self.state = ObjectState(self.known)

    @property
    def object_frame(self) -> ObjectFrame:
        """Latest object frame; an ObservationError is raised before the first frame."""
        if self.state.frame is None:
            raise ObservationError(
                "no frame was added yet, so nothing is known of the object"
            )
        return self.state.frame

    @property
    def sightings(self) -> tuple[Sighting, ...]:
        """Sightings of the object in all frames, in order."""
        return self.state.sightings

    @property
    def observations(self) -> list[Observation]:
        """Observations of all frames, in order, in the latest object frame."""
        return list(self.state.observations)

    @property
    def warnings(self) -> list[ViewWarning]:
        """Likely problems of the last frame; usually empty."""
        return list(self.state.warnings)

    @property
    def revision(self) -> int:
        """Number of times that earlier observations have changed."""
        return self.state.revision

    def add(self, frame: Frame) -> Observation:
        """Process a frame and return its observation from three object radii.

        An ObservationError is raised if the object is not found; the frame is then not used.

        Args:
            frame: of a depth camera.
        """
        self.state = self._after(frame)
        return self.state.observations[-1]

    def add_again(self, frame: Frame, number: int) -> None:
        """Process a frame that repeats an earlier one, whose sighting is used again.

        An ObservationError is raised if the frame has no pose.

        Args:
            frame: of a depth camera.
            number: of the earlier frame, from 0.
        """
        self._known_frames.refuse(frame)
        state = self.state
        self.state = replace(
            state,
            sightings=(*state.sightings, state.sightings[number]),
            observations=(*state.observations, state.observations[number]),
            warnings=(REPEATED,),
        )

    def _after(self, frame: Frame) -> ObjectState:
        """Return the state after a frame, running all stages from frame to observation."""
        known = self._known_frames
        known.refuse(frame)
        up = self._up(frame)
        segmented = self._segmented(frame, up)
        warnings = tuple(check_mistakes(segmented, known))

        pixels = self._pixels(segmented)
        return self._with_pixels(pixels, segmented, up, warnings)

    def _with_pixels(
        self,
        pixels: Mask,
        segmented: SegmentedFrame,
        up: Float | None,
        warnings: tuple[ViewWarning, ...],
    ) -> ObjectState:
        """Return the state after a frame in which some pixels, (H, W) bool, are the object."""
        frame = segmented.frame
        before = self.state
        plane = self._plane_under(pixels, segmented)
        if up is None and plane is None:
            raise ObservationError(
                "no support plane is seen, so there is no telling where up is: give it, and the"
                " camera's pose"
            )
        warnings += tuple(self._known_frames.check(frame, plane))

        mask = self._without_plane(pixels, segmented, plane)
        seen = sighting_of(frame, mask, plane, frame.noise, self.denoise)
        seen = replace(seen, warnings=warnings)
        displaced = None
        if before.sightings and self.known is None:
            seen, displaced = _mended(seen, before.sightings)

        if up is None:
            assert plane is not None
            up = plane.normal
        after = self._known_by([*before.sightings, seen], up)
        warnings = self._warnings_of_view(after, -1, self._check(after, plane))
        if displaced is not None and displaced.noticed:
            message = (
                f"this frame shows the object {1000 * np.linalg.norm(displaced.further):.0f} mm"
                " beside where earlier ones do, which is allowed for: was it nudged, or does the"
                " camera's pose err (hand-eye calibration, a late time stamp)?"
            )
            warnings += (ViewWarning("displaced", message, holds=False),)
        return replace(after, warnings=warnings)

    def _warnings_of_view(
        self, state: ObjectState, number: int, more: Sequence[ViewWarning] = ()
    ) -> tuple[ViewWarning, ...]:
        """Return likely problems of a view in a state of the object, after some known ones."""
        observations = state.observations
        warnings = [*state.sightings[number].warnings]
        warnings += check_observation(observations[number])
        warnings += more
        if not any(warning.holds for warning in warnings):
            last = range(len(observations))[number]
            found = check_last_view(observations[: last + 1])
            if found and self.known is None:  # pose errors are no contradiction
                found = check_last_view(self._without_displacements(state, last))
            warnings += found
        return tuple(warnings)

    def _without_displacements(
        self, state: ObjectState, last: int
    ) -> list[Observation]:
        """Return the observations up to one, without the displacements caused by pose errors."""
        assert state.frame is not None
        first, *others = state.sightings[: last + 1]
        mended = [first]
        for sighting in others:
            mended.append(_mended(sighting, mended)[0])
        return [observation_of(one, state.frame, self.life_size) for one in mended]

    @property
    def _known_frames(self) -> KnownFrames:
        """Known world against which a new frame is checked."""
        sightings = self.state.sightings
        known = self.known
        return KnownFrames(
            tuple(sighting.frame_as_given for sighting in sightings),
            tuple(sighting.plane for sighting in sightings),
            self.up,
            self.point if known is None else known.centre,
            0.0 if known is None else known.radius,
        )

    def _up(self, frame: Frame) -> Float | None:
        """Return the direction against gravity, (3,), world; None if it is not known yet."""
        if self.state.frame is not None:
            return self.state.frame.axes[2]
        return None if frame.pose is None else self.up

    def _segmented(self, frame: Frame, up: Float | None) -> SegmentedFrame:
        """Segment a frame; its mask, if any, is the only instance."""
        held = self.point is not None and frame.mask is None
        if not self.support and not held:
            return without_surfaces(frame)
        found = instances_of(self.segmentation, frame, up)
        if not self.support:
            return without_surfaces(frame, found.masks)
        if frame.mask is not None:
            outside = ~frame.mask
            surface = found.surface & outside
            found = Instances((frame.mask,), surface, found.background & outside)
        return segmented_frame(frame, found, up)

    def _pixels(self, seen: SegmentedFrame) -> Mask:
        """Return the object's pixels: its mask, box, sphere or instance, (H, W) bool.

        Raises:
            ObservationError: there are none.
        """
        frame = seen.frame
        if frame.mask is not None:
            return frame.mask
        if self.box is not None:
            return inside_box(frame, self.box)
        if self.known is not None:
            return inside_sphere(
                frame, self.known.centre, SPHERE_MARGIN * self.known.radius
            )
        if not self.support and self.point is None:
            raise ObservationError(NO_OUTLINE)
        return choose_instance(seen, self.point, self.state.frame, self.alone)

    def _plane_under(self, pixels: Mask, seen: SegmentedFrame) -> Plane | None:
        """Return the support plane of the object, by earlier frames if this one does not show it.

        Returns:
            The plane; None if no frame shows it.
        """
        if not self.support:
            return None
        level = seen.under(pixels, stands=True)
        if level is not None:
            return level.plane
        earlier = [one.plane for one in self.sightings if one.plane is not None]
        if not earlier:
            return None
        level = seen.again(earlier[-1])
        return earlier[-1] if level is None else level.plane

    def _without_plane(
        self, pixels: Mask, seen: SegmentedFrame, plane: Plane | None
    ) -> Mask:
        """Return the object's pixels without those of its support, (H, W) bool.

        Raises:
            ObservationError: too little of it is visible.
        """
        frame = seen.frame
        if frame.mask is not None and self.known is not None:
            return pixels  # the size does not depend on pixels at the edge
        if frame.mask is not None or self.known is None:
            return inside_mask(frame, pixels, plane, frame.noise)
        mask = pixels
        if plane is not None:
            mask = pixels & above_plane(frame, plane, frame.noise)
        if np.count_nonzero(mask) < FEWEST_OBJECT_PIXELS:
            raise ObservationError(
                "nothing is seen where the object should be: a wrong pose, or a wrong box?"
            )
        return mask

    def _known_by(self, sightings: Sequence[Sighting], up: Float) -> ObjectState:
        """Return the state for some sightings, with changed views resampled."""
        before = self.state
        object_frame = self._estimate_frame(sightings, up)
        kept = {}
        if object_frame is before.frame:
            known = zip(before.sightings, before.observations, strict=True)
            kept = {id(sighting): seen for sighting, seen in known}
        observations = [
            kept.get(id(sighting))
            or observation_of(sighting, object_frame, self.life_size)
            for sighting in sightings
        ]

        pairs = zip(observations, before.observations, strict=False)
        changed = any(new is not old for new, old in pairs)
        return replace(
            before,
            frame=object_frame,
            sightings=tuple(sightings),
            observations=tuple(observations),
            revision=before.revision + changed,
        )

    def _estimate_frame(self, sightings: Sequence[Sighting], up: Float) -> ObjectFrame:
        """Return the object frame of some sightings; the earlier one if the change is small."""
        if self.known is not None:
            return self.known
        before = self.state.frame
        if before is not None:
            estimated = object_frame_of(sightings, before.axes)
            return before if _same(estimated, before) else estimated

        first = sightings[0].frame.camera_to_world
        ahead = first[:3, 2]
        from_above = abs(ahead @ up) >= 0.99
        front = first[:3, 1] if from_above else -ahead
        return object_frame_of(sightings, upright_axes(up, front))

    def _check(self, after: ObjectState, plane: Plane | None) -> list[ViewWarning]:
        """Return likely problems of the size and the place of the object after a frame."""
        before = self.state.frame
        assert after.frame is not None
        radius = after.frame.radius
        warnings = []
        # closer to ten times than to once as large
        if before is not None and radius > np.sqrt(10) * before.radius:
            message = (
                f"the radius of the object grows from {before.radius:.2g} to {radius:.2g} m by this"
                " frame: is its pose wrong, so that the support or a neighbour is taken for a part"
                " of it?"
            )
            warnings.append(ViewWarning("size", message))
        if self.point is not None:
            aside = after.frame.axes[:2] @ (self.point - after.frame.centre)
            away = float(np.linalg.norm(aside))
            if away > 3 * radius:
                message = (
                    f"the thing nearest to the point is {away:.2g} m away from it, of"
                    f" {radius:.2g} m radius: is the point of another world, or what stands"
                    " there out of view?"
                )
                warnings.append(ViewWarning("point", message))
        if self.support and plane is None and self.known is None:
            warnings.append(NO_PLANE)
        return warnings


def _mended(
    latest: Sighting, earlier: Sequence[Sighting]
) -> tuple[Sighting, Displacement | None]:
    """Return a sighting without its displacement from earlier ones, and the displacement."""
    displaced = displacement(latest, earlier)
    if displaced is None or not displaced.mended:
        return latest, displaced
    return latest.shifted(-displaced.shift), displaced


def _same(new: ObjectFrame, old: ObjectFrame) -> bool:
    moved = np.linalg.norm(new.centre - old.centre) / old.radius
    return bool(
        moved < SAME_FRAME
        and abs(new.radius / old.radius - 1) < SAME_FRAME
        and np.allclose(new.axes, old.axes)
    )
