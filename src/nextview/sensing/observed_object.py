"""An object as a camera comes to know it: frames in, observations out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from nextview.errors import ObservationError, UsageError
from nextview.geometry.observation import Observation
from nextview.sensing import clusters, plausibility, segmentation
from nextview.sensing.clusters import Footprint
from nextview.sensing.convex_pieces import STANDS, cut
from nextview.sensing.displacement import displacement
from nextview.sensing.facets import Noise, noise_of
from nextview.sensing.frame import Frame
from nextview.sensing.known_frames import KnownFrames
from nextview.sensing.mask_edges import trimmed
from nextview.sensing.object_frame import Box, ObjectFrame, three, upright_axes
from nextview.sensing.planes import Plane, Samples, find_again, sample
from nextview.sensing.resampling import observation_of
from nextview.sensing.sighting import (
    FEWEST_OBJECT_PIXELS,
    Sighting,
    object_frame_of,
    sighting_of,
)
from nextview.sensing.support_plane import (
    NO_SUPPORT,
    base_below_view,
    find_support_plane,
    refuse_mistakes,
)
from nextview.sensing.view_warning import ViewWarning
from nextview.sensing.walls import before_walls, find_walls
from nextview.types import Float, Index, Mask

# share of an object's pixels in an earlier frame that has to change before they are looked at again
MENDED_SHARE = 0.03
# the novelty score has to be so much lower for an object to be joined or taken apart otherwise
LESS_NOVEL = 1.0
# factor by which the radius may change where an object is looked at anew
SIZE_CHANGE = 2.0
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
MAY_BE_TWO = ViewWarning(
    "outline",
    "the object may be two things that touch: name it by a mask or a box, or move them apart",
)


@dataclass(frozen=True)
class Carried:
    """What a segmentation says of what an object stands on.

    Attributes:
        plane: of the surface that carries it; None where none that is seen does.
    """

    plane: Plane | None


@dataclass(frozen=True)
class ObjectState:
    """What is known of an object after some frames.

    Attributes:
        rng: source of all random numbers.
        frame: the object frame; None before the object is found.
        sightings: what each frame shows of the object.
        observations: of the frames, in the latest object frame.
        warnings: about the latest frame.
        revision: how often the object frame changed.
        joins: whether what touches it is a part of it.
    """

    rng: np.random.Generator
    frame: ObjectFrame | None = None
    sightings: tuple[Sighting, ...] = ()
    observations: tuple[Observation, ...] = ()
    warnings: tuple[ViewWarning, ...] = ()
    revision: int = 0
    joins: clusters.Joins = "by their border"


class ObservedObject:
    """One object, seen in more and more frames. ``add`` takes a frame and gives an observation.

    The object is found in each frame: by the frame's mask; else as what lies in a ``box``; else as
    the cluster on the support plane that is nearest to a ``point``, or at which the first camera is
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
        rng: for the search for planes, is copied; seed 0 by default.
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
        rng: np.random.Generator | None = None,
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
        self.state = ObjectState(
            np.random.default_rng(0) if rng is None else deepcopy(rng),
            self.known,
        )

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

    def add(self, frame: Frame, carried: Carried | None = None) -> Observation:
        """Take in a frame and return its observation from three object radii.

        ObservationError where the object is not found in it; the frame is then not taken in.

        Args:
            frame: of a depth camera.
            carried: what the object stands on, by a segmentation; None: that is looked for.
        """
        self.state = self._after(frame, carried)
        return self.state.observations[-1]

    def reconsider(self, novelty: Callable[[Sequence[Observation]], float]) -> None:
        """Decide by their novelty whether touching things are parts of the object.

        An object of another order of size is another thing, such as the wall behind it, and is not
        considered.
        """
        found = [(novelty(self.observations), self.state)]
        radius = self.object_frame.radius
        for joins in self.other_joins():
            other = copy(self)
            other.state = ObjectState(
                self.state.rng,
                self.known,
                revision=self.revision + 1,
                joins=joins,
            )
            with suppress(ObservationError):
                for sighting in self.sightings:
                    other.add(sighting.frame_as_given)
                if 1 / SIZE_CHANGE < other.object_frame.radius / radius < SIZE_CHANGE:
                    found.append(
                        (novelty(other.observations) + LESS_NOVEL, other.state)
                    )

        self.state = min(found, key=lambda pair: pair[0])[1]

    def other_joins(self) -> list[clusters.Joins]:
        """Other rules for what touches the object, by which it has other pixels."""
        old = _earlier_footprints(self.sightings)
        found: list[clusters.Joins] = []

        for joins in (
            j for j in get_args(clusters.Joins) if old and j != self.state.joins
        ):
            labels, _ = clusters.clusters([foot for foot, _ in old], joins)
            votes = np.concatenate(
                [label[was] for label, (_, was) in zip(labels, old, strict=True)]
            )
            target = np.bincount(votes, minlength=1).argmax()
            if any(
                _changed(*pair, label == target)
                for pair, label in zip(old, labels, strict=True)
            ):
                found.append(joins)
        return found

    def _after(self, frame: Frame, carried: Carried | None) -> ObjectState:
        """The state after a frame: all stages from the frame to its observation, in order."""
        before = self.state
        known = self._known_frames
        known.refuse(frame)

        noise = noise_of(frame)
        samples = self._samples(frame, noise)
        plane, up, rng = self._find_plane(frame, samples, carried)
        warnings = known.check(frame, plane)
        sightings, may_be_two = self._segment(
            frame,
            upright_axes(up),
            plane,
            samples,
            noise,
        )

        displaced = None
        if before.sightings and self.known is None and not may_be_two:
            displaced = displacement(sightings[-1], sightings[:-1])
        if displaced is not None and displaced.mended:
            sightings[-1] = sightings[-1].shifted(-displaced.shift)

        after = self._known_by(sightings, up)
        warnings += self._check(after, plane, may_be_two)
        if not any(warning.holds for warning in warnings):
            warnings += plausibility.check_last_view(after.observations)
        warnings += plausibility.check_place(displaced)
        return replace(after, rng=rng, warnings=tuple(warnings))

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
            warnings += plausibility.check_last_view(observations[: last + 1])
        return tuple(warnings)

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

    def _samples(self, frame: Frame, noise: Noise) -> Samples | None:
        """Samples of all beside the mask; None where no plane is looked for."""
        if not self.support:
            return None
        seen = frame.depth > 0
        return sample(frame, seen if frame.mask is None else seen & ~frame.mask, noise)

    def _find_plane(
        self,
        frame: Frame,
        samples: Samples | None,
        carried: Carried | None,
    ) -> tuple[Plane | None, Float, np.random.Generator]:
        """Return the support plane, if it is seen, the direction up, (3,), and the generator."""
        before = self.state
        up = None if frame.pose is None else self.up
        if before.frame is not None:
            up = before.frame.axes[2]

        rng = before.rng
        plane = None
        earlier = [s.plane for s in before.sightings if s.plane is not None]
        if samples is not None and carried is not None and carried.plane is not None:
            plane = carried.plane
            if not before.sightings:
                refuse_mistakes(frame, samples, plane, up)
        elif samples is not None and earlier:
            near = np.zeros(len(samples.points), bool)
            if before.frame is not None:
                away = np.linalg.norm(samples.points - before.frame.centre, axis=1)
                near = away < before.frame.radius
            plane = find_again(earlier[0], samples, near)
        elif samples is not None and carried is None:
            rng = deepcopy(rng)
            plane = find_support_plane(
                frame,
                samples,
                up,
                rng,
                self.point,
                self.known,
                self.box,
            )

        if up is None:
            if plane is None:
                raise ObservationError(
                    "no support plane is seen, so there is no telling where up is: give it, and"
                    " the camera's pose"
                )
            up = plane.normal
        return plane, up, rng

    def _segment(
        self,
        frame: Frame,
        axes: Float,
        plane: Plane | None,
        samples: Samples | None,
        noise: Noise,
    ) -> tuple[list[Sighting], bool]:
        """Find the object in a frame.

        Returns:
            The earlier sightings, as they count now, and that of the frame; and whether the object
            may be two things.
        """
        if frame.mask is not None and self.known is not None:
            mask = frame.mask  # its size does not hang on pixels at the edge
        elif frame.mask is not None:
            mask = segmentation.inside_mask(frame, frame.mask, plane, noise)
        elif self.known is not None:
            mask = segmentation.inside_region(frame, self.known, self.box, plane, noise)
        elif not self.support:
            raise ObservationError(NO_OUTLINE)
        else:
            return self._segment_on_plane(frame, axes, plane, samples, noise)

        latest = sighting_of(frame, mask, plane, noise, self.denoise)
        return [*self.state.sightings, latest], False

    def _segment_on_plane(
        self,
        frame: Frame,
        axes: Float,
        plane: Plane | None,
        samples: Samples | None,
        noise: Noise,
    ) -> tuple[list[Sighting], bool]:
        """Find the object among what rises above a plane, seen from above, see ``_segment``.

        It is the plane on which the object stands, if that is seen, or else one as low as all that
        is seen.
        """
        base = plane
        if base is None and samples is not None and self.point is not None:
            base = base_below_view(samples, axes[2], self.point)
        if base is None or samples is None:
            raise ObservationError(NO_SUPPORT)

        height = frame.along(base.normal, base.offset)
        above = segmentation.above_plane(frame, base, noise)
        walls = find_walls(samples, base, np.random.default_rng(0), self._place)
        free = before_walls(frame, walls, noise)
        above &= free
        pieces = cut(frame.depth, above, height, noise, free if walls else None)

        ground = base.extent(samples) @ axes[:2].T
        earlier = _earlier_footprints(self.state.sightings)
        if earlier:
            cell = earlier[0][0].cell
        else:
            cell = clusters.FOOTPRINT_CELL * segmentation.distance_to_object(
                frame,
                above,
                ground,
                axes,
                noise,
                self.point,
            )
        if self._place is None:
            # what is far ahead, such as a wall, is no place on the plane
            ahead = axes[:2] @ segmentation.place_ahead(frame)
            middle = np.clip(ahead, ground.min(0), ground.max(0))
        else:
            middle = axes[:2] @ self._place
        latest = clusters.footprint(frame, pieces, axes, cell, middle / cell)

        footprints = [*(footprint for footprint, _ in earlier), latest]
        chosen = [pairs for _, pairs in earlier]
        labels, may_be_two = clusters.clusters(footprints, self.state.joins)
        target = self._choose(frame, footprints, labels, chosen, ground, axes)
        segmentation.join_other_sides(labels, chosen, target)

        its_own = labels[-1] == target
        mask = latest.pixels_of(its_own)
        if (labels[-1][~its_own] > 0).any():
            # cells at the border may hold pixels of a neighbour
            mask = trimmed(frame.depth, mask, noise, height > STANDS * frame.depth)
        if target == 0 or np.count_nonzero(mask) < FEWEST_OBJECT_PIXELS:
            where = "of the object known so far" if earlier else "on the support plane"
            raise ObservationError(
                f"this frame shows nothing {where}: check its pose, or aim the camera at the object"
            )

        sighting = replace(
            sighting_of(frame, mask, plane, noise, self.denoise),
            footprint=latest,
            chosen=its_own,
        )
        known = self._reconsidered(labels[:-1], target)
        return [*known, sighting], bool(may_be_two[target])

    @property
    def _place(self) -> Float | None:
        """The known place of the object, (3,), world, metres."""
        if self.point is not None:
            return self.point
        return None if self.state.frame is None else self.state.frame.centre

    def _choose(
        self,
        frame: Frame,
        footprints: Sequence[Footprint],
        labels: Sequence[Index],
        chosen: Sequence[Mask],
        ground: Float,
        axes: Float,
    ) -> int:
        """The object's cluster: by the point, by earlier frames, or what the camera is aimed at."""
        to_cells = axes[:2] / footprints[-1].cell
        if self.point is not None:
            point = to_cells @ self.point
            return segmentation.cluster_at_point(footprints, labels, point)

        known = self.state.frame
        if known is not None:
            return segmentation.cluster_seen_before(
                footprints,
                labels,
                chosen,
                to_cells @ known.centre,
                known.radius * float(np.linalg.norm(to_cells[0])),
            )
        return clusters.central(
            footprints[-1],
            labels[-1],
            ground / footprints[-1].cell,
            frame.intrinsics[:2, 2],
        )

    def _reconsidered(self, labels: Sequence[Index], target: int) -> list[Sighting]:
        """The earlier sightings, each with what now counts as the object in it."""
        sightings = list[Sighting]()
        of_footprints = iter(labels)
        for earlier in self.state.sightings:
            if earlier.footprint is None or earlier.chosen is None:
                sightings.append(earlier)
                continue
            now = next(of_footprints) == target
            if not _changed(earlier.footprint, earlier.chosen, now):
                sightings.append(earlier)
                continue

            try:
                sighting = sighting_of(
                    earlier.frame,
                    earlier.footprint.pixels_of(now),
                    earlier.plane,
                    earlier.noise,
                    self.denoise,
                )
            except ObservationError:  # what was taken for the object was what hid it
                sighting = replace(
                    earlier,
                    facets=earlier.facets.some(slice(0)),
                    mask=np.zeros_like(earlier.mask),
                    hull=earlier.hull[:0],
                )
            sightings.append(
                replace(
                    sighting,
                    footprint=earlier.footprint,
                    chosen=now,
                    shift=earlier.shift,
                )
            )
        return sightings

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

    def _check(
        self,
        after: ObjectState,
        plane: Plane | None,
        may_be_two: bool,
    ) -> list[ViewWarning]:
        """Return likely faults of what a frame shows of the object."""
        before = self.state
        assert after.frame is not None
        warnings = plausibility.check_observation(after.observations[-1])
        if may_be_two:
            warnings.append(MAY_BE_TWO)
        if before.frame is not None:
            radius = after.frame.radius
            warnings += plausibility.check_size(radius, before.frame.radius)
        if self.point is not None:
            aside = after.frame.axes[:2] @ (self.point - after.frame.centre)
            warnings += plausibility.check_point(aside, after.frame.radius)
        if self.support and plane is None and self.known is None:
            warnings.append(NO_PLANE)
        return warnings


def _earlier_footprints(sightings: Sequence[Sighting]) -> list[tuple[Footprint, Mask]]:
    """The footprints of those sightings that were found by one, and the object's pairs in each."""
    return [
        (sighting.footprint, sighting.chosen)
        for sighting in sightings
        if sighting.footprint is not None and sighting.chosen is not None
    ]


def _changed(foot: Footprint, old: Mask, new: Mask) -> bool:
    """Whether so much of an object changes in a frame that it is to be looked at again."""
    return bool(foot.pixels[new != old].sum() > MENDED_SHARE * foot.pixels[old].sum())


def _same(new: ObjectFrame, old: ObjectFrame) -> bool:
    moved = np.linalg.norm(new.centre - old.centre) / old.radius
    return bool(
        moved < SAME_FRAME
        and abs(new.radius / old.radius - 1) < SAME_FRAME
        and np.allclose(new.axes, old.axes)
    )
