"""An object as a camera comes to know it: frames in, observations out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from nextview.errors import ObservationError, UsageError
from nextview.geometry.axes import three, upright_axes
from nextview.geometry.observation import Observation
from nextview.segmentation.instances import Instances, Segmenter, instances_of
from nextview.sensing import plausibility
from nextview.sensing.choosing import Parting, choose_instance
from nextview.sensing.displacement import displacement
from nextview.sensing.facets import Noise, noise_of
from nextview.sensing.frame import Frame
from nextview.sensing.known_frames import KnownFrames
from nextview.sensing.levels import Supports
from nextview.sensing.masks import (
    SPHERE_MARGIN,
    above_plane,
    inside_box,
    inside_mask,
    inside_sphere,
)
from nextview.sensing.object_frame import Box, ObjectFrame
from nextview.sensing.planes import Plane, find_again, sample
from nextview.sensing.resampling import observation_of
from nextview.sensing.sighting import (
    FEWEST_OBJECT_PIXELS,
    Sighting,
    object_frame_of,
    sighting_of,
)
from nextview.sensing.surface_checks import refuse_mistakes
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float, Mask

# share of an object's pixels by which another parting differs, at least
OTHER_SHARE = 0.03
# change of the centre or the radius, in object radii, below which the object frame is left as it is
SAME_FRAME = 0.01
NO_OUTLINE = (
    "an object that stands on no plane (support=False) is told from what holds it by a mask in each"
    " frame, Frame(..., mask=...), or by a box, ObservedObject(box=...); a point selects a thing on"
    " a support plane only"
)
NO_PLANE = ViewWarning(
    "support",
    "no support plane is seen, so where the object ends below is guessed: support=False if it"
    " stands on none",
)


@dataclass(frozen=True)
class ObjectState:
    """What is known of an object after some frames.

    Attributes:
        frame: the object frame; None before the object is found.
        sightings: what each frame shows of the object.
        observations: of the frames, in the latest object frame.
        warnings: about the latest frame.
        revision: how often the object frame changed.
        parting: what of the segmentation is the object.
        partings: by which the latest frame shows it in other pixels.
    """

    frame: ObjectFrame | None = None
    sightings: tuple[Sighting, ...] = ()
    observations: tuple[Observation, ...] = ()
    warnings: tuple[ViewWarning, ...] = ()
    revision: int = 0
    parting: Parting = "instance"
    partings: tuple[Parting, ...] = ()


class ObservedObject:
    """One object, seen in more and more frames. ``add`` takes a frame and gives an observation.

    The object is found in each frame: by the frame's mask; else as what lies in a ``box``; else as
    the instance of the segmentation that is nearest to a ``point``, or at which the first camera is
    aimed. Its centre and radius are those of the box, or estimated from all frames that show enough
    of it. When they get better the earlier frames are expressed anew: ``observations`` are always
    all in the same, latest object frame, and ``revision`` counts how often it changed. Its x axis
    points towards the first camera, unless a box or a known frame says otherwise.

    >>> thing = ObservedObject()                                                # doctest: +SKIP
    >>> observation = thing.add(Frame(depth, intrinsics, pose))                 # doctest: +SKIP

    Args:
        up: direction against gravity in the world, (3,); z by default. None: the normal of the
            support plane of the first frame. Frames without a pose have no other way.
        point: near the object, world, metres, (3,).
        box: upright, into which the object just fits.
        support: whether the object stands on a plane in view. False for a gripper or a turntable:
            then the object is given by the mask of each frame, by a box or by its known frame.
        known: the object frame, if it need not be estimated; the object is what lies in its sphere.
        denoise: smooth depth, fill holes and drop flying pixels. For sensors; renders need it not.
        life_size: whether the object is as large as its kind is in life: then the radius is
            evidence of the class.
        segmentation: that tells the things in frames, see ``nextview.Scene``; None for the bundled
            network.
        parting: what of the segmentation is the object: an "instance"; or, as for a thing that
            stands alone, one with all that is "touching" it; or a "piece" of one.
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
        parting: Parting = "instance",
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
        self.state = ObjectState(self.known, parting=parting)

    @property
    def object_frame(self) -> ObjectFrame:
        """Where the object is, as far as it is known; ObservationError before the first frame."""
        if self.state.frame is None:
            raise ObservationError(
                "no frame was added yet, so nothing is known of the object"
            )
        return self.state.frame

    @property
    def sightings(self) -> tuple[Sighting, ...]:
        """What each frame shows of the object, in order."""
        return self.state.sightings

    @property
    def observations(self) -> list[Observation]:
        """One for each frame, in order, all in the latest object frame."""
        return list(self.state.observations)

    @property
    def warnings(self) -> list[ViewWarning]:
        """What is likely to be wrong with the last frame; usually nothing."""
        return list(self.state.warnings)

    @property
    def revision(self) -> int:
        """How often earlier observations changed."""
        return self.state.revision

    def add(self, frame: Frame) -> Observation:
        """Take in a frame and return its observation from three object radii.

        ObservationError where the object is not found in it; the frame is then not taken in.

        Args:
            frame: of a depth camera.
        """
        self.state = self._after(frame)
        return self.state.observations[-1]

    def part_otherwise(
        self,
        p_value: Callable[[Sequence[Observation]], float],
    ) -> None:
        """Decide what of the segmentation is the object, by what explains its views best.

        It may be an instance, an instance with all that touches it, or a piece of one.

        Args:
            p_value: of some views of it as views of a known thing.
        """
        found = [self.state]
        for parting in self.state.partings:
            other = copy(self)
            revision = self.revision + 1
            other.state = ObjectState(self.known, revision=revision, parting=parting)
            with suppress(ObservationError):
                for sighting in self.sightings:
                    other.add(sighting.frame_as_given)
                found.append(other.state)
        if len(found) > 1:
            values = [p_value(state.observations) for state in found]
            self.state = found[int(np.argmax(values))]

    def _after(self, frame: Frame) -> ObjectState:
        """The state after a frame: all stages from the frame to its observation, in order."""
        before = self.state
        known = self._known_frames
        known.refuse(frame)

        noise = noise_of(frame)
        up = self._up(frame)
        instances = None
        supports = None
        if self.support:
            instances = self._instances(frame, up)
            supports = Supports.of(frame, instances.masks, instances.surface, noise, up)
        parting = before.parting
        pixels = self._pixels(frame, supports, instances, parting)
        partings: tuple[Parting, ...] = ()
        if frame.mask is None and self.known is None:
            partings = tuple(
                other
                for other in get_args(Parting)
                if other != parting
                and _differ(pixels, self._pixels(frame, supports, instances, other))
            )
        plane = self._plane_under(pixels, frame, noise, supports, up)
        if up is None and plane is None:
            raise ObservationError(
                "no support plane is seen, so there is no telling where up is: give it, and the"
                " camera's pose"
            )
        warnings = known.check(frame, plane)

        mask = self._without_plane(pixels, frame, plane, noise)
        seen = sighting_of(frame, mask, plane, noise, self.denoise)
        displaced = None
        if before.sightings and self.known is None:
            displaced = displacement(seen, before.sightings)
        if displaced is not None and displaced.mended:
            seen = seen.shifted(-displaced.shift)

        if up is None:
            assert plane is not None
            up = plane.normal
        after = self._known_by([*before.sightings, seen], up)
        warnings += self._check(after, plane)
        if not any(warning.holds for warning in warnings):
            warnings += plausibility.check_last_view(after.observations)
        warnings += plausibility.check_place(displaced)
        return replace(after, warnings=tuple(warnings), partings=partings)

    def take_sightings(self, sightings: Sequence[Sighting], up: Float) -> None:
        """Know the object by some sightings, whatever was known of it before.

        Sightings that were known already keep their observations as long as the object frame stays
        as it was.

        Args:
            sightings: at least one, see ``sighting_of``.
            up: direction against gravity, (3,), world.

        Raises:
            ObservationError: what is seen of the object has no size.
        """
        self.state = replace(self._known_by(sightings, up), warnings=())
        self.state = replace(self.state, warnings=self.warnings_of_view(-1))

    def warnings_of_view(self, number: int) -> tuple[ViewWarning, ...]:
        """What is likely to be wrong with a view, by its frame and by the views before it.

        Args:
            number: of the view, from 0, or from -1 backwards.
        """
        observations = self.state.observations
        warnings = list(self.state.sightings[number].warnings)
        warnings += plausibility.check_observation(observations[number])
        if not any(warning.holds for warning in warnings):
            last = range(len(observations))[number]
            found = plausibility.check_last_view(observations[: last + 1])
            if found:  # errors of the poses alone are no contradiction
                found = plausibility.check_last_view(self._without_displacements(last))
            warnings += found
        return tuple(warnings)

    def _without_displacements(self, last: int) -> list[Observation]:
        """The observations up to one, as if no pose displaced the object."""
        first, *others = self.state.sightings[: last + 1]
        mended = [first]
        for sighting in others:
            displaced = displacement(sighting, mended)
            if displaced is not None and displaced.mended:
                sighting = sighting.shifted(-displaced.shift)
            mended.append(sighting)
        frame = self.object_frame
        return [observation_of(one, frame, self.life_size) for one in mended]

    @property
    def _known_frames(self) -> KnownFrames:
        """What is known before another frame."""
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
        """Direction against gravity, (3,), world; None where nothing tells it yet."""
        if self.state.frame is not None:
            return self.state.frame.axes[2]
        return None if frame.pose is None else self.up

    def _instances(self, frame: Frame, up: Float | None) -> Instances:
        """The instances of a frame and its surfaces; a mask of the frame is the only one."""
        found = instances_of(self.segmentation, frame, up)
        if frame.mask is None:
            return found
        outside = ~frame.mask
        return Instances(
            (frame.mask,), found.surface & outside, found.background & outside
        )

    def _pixels(
        self,
        frame: Frame,
        supports: Supports | None,
        instances: Instances | None,
        parting: Parting,
    ) -> Mask:
        """Where the object is: in the mask, in its box or sphere, or an instance, (H, W) bool.

        Raises:
            ObservationError: nothing is there.
        """
        if frame.mask is not None:
            return frame.mask
        if self.box is not None:
            return inside_box(frame, self.box)
        if self.known is not None:
            return inside_sphere(
                frame, self.known.centre, SPHERE_MARGIN * self.known.radius
            )
        if supports is None or instances is None:
            raise ObservationError(NO_OUTLINE)
        known = self.state.frame
        return choose_instance(supports, self.point, known, parting, instances.pieces)

    def _plane_under(
        self,
        pixels: Mask,
        frame: Frame,
        noise: Noise,
        supports: Supports | None,
        up: Float | None,
    ) -> Plane | None:
        """The plane on which the object stands; None if it is not seen.

        Raises:
            ObservationError: a first frame's pose is wrong, or its depth is a range.
        """
        if supports is None:
            return None
        level = supports.under(pixels, stands=True)
        before = self.state
        if not before.sightings:
            shown = supports.surface & (frame.depth > 0)
            plane = None if level is None else level.plane
            refuse_mistakes(frame, sample(frame, shown, noise), plane, up)
            return plane
        if level is not None:
            return level.plane

        earlier = [s.plane for s in before.sightings if s.plane is not None]
        if not earlier or before.frame is None:
            return None
        samples = sample(frame, (frame.depth > 0) & ~pixels, noise)
        away = np.linalg.norm(samples.points - before.frame.centre, axis=1)
        return find_again(earlier[0], samples, away < before.frame.radius)

    def _without_plane(
        self,
        pixels: Mask,
        frame: Frame,
        plane: Plane | None,
        noise: Noise,
    ) -> Mask:
        """The object's pixels without those of its support, (H, W) bool.

        Raises:
            ObservationError: too little is seen of it.
        """
        if frame.mask is not None and self.known is not None:
            return pixels  # its size does not hang on pixels at the edge
        if frame.mask is not None or self.known is None:
            return inside_mask(frame, pixels, plane, noise)
        mask = pixels if plane is None else pixels & above_plane(frame, plane, noise)
        if np.count_nonzero(mask) < FEWEST_OBJECT_PIXELS:
            raise ObservationError(
                "nothing is seen where the object should be: a wrong pose, or a wrong box?"
            )
        return mask

    def _known_by(self, sightings: Sequence[Sighting], up: Float) -> ObjectState:
        """The state by some sightings: estimate the object frame, and resample what changed."""
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
        """The object frame by some sightings; that of earlier frames where it stays the same."""
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
        """Return likely faults of what a frame shows of the object."""
        before = self.state
        assert after.frame is not None
        warnings = plausibility.check_observation(after.observations[-1])
        if before.frame is not None:
            radius = after.frame.radius
            warnings += plausibility.check_size(radius, before.frame.radius)
        if self.point is not None:
            aside = after.frame.axes[:2] @ (self.point - after.frame.centre)
            warnings += plausibility.check_point(aside, after.frame.radius)
        if self.support and plane is None and self.known is None:
            warnings.append(NO_PLANE)
        return warnings


def _same(new: ObjectFrame, old: ObjectFrame) -> bool:
    moved = np.linalg.norm(new.centre - old.centre) / old.radius
    return bool(
        moved < SAME_FRAME
        and abs(new.radius / old.radius - 1) < SAME_FRAME
        and np.allclose(new.axes, old.axes)
    )


def _differ(one: Mask, other: Mask) -> bool:
    """Whether two sets of pixels, (H, W) bool, differ by more than noise."""
    return bool(np.count_nonzero(one != other) > OTHER_SHARE * np.count_nonzero(one))
