"""An object as a camera comes to know it: frames in, observations out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from nextview.checks import one_line
from nextview.errors import ObservationError, UsageError
from nextview.geometry.observation import Observation, SceneView, pinhole
from nextview.geometry.viewsphere import CAMERA_DISTANCE
from nextview.sensing import clusters, plausibility, segmentation, support
from nextview.sensing.clusters import Footprint
from nextview.sensing.convex_pieces import STANDS, cut
from nextview.sensing.displacement import Displacement, displacement
from nextview.sensing.facets import (
    ROWS_MEASURED,
    Facets,
    Noise,
    estimate_noise,
    fit_facets,
    look_again,
    virtual_pose,
)
from nextview.sensing.frame import Frame, within
from nextview.sensing.lean import lean_of
from nextview.sensing.mask_edges import trimmed
from nextview.sensing.object_frame import Box, ObjectFrame, enclose, three, upright_axes
from nextview.sensing.outliers import without_outliers
from nextview.sensing.plausibility import (
    ViewWarning,
    check_frame,
    check_observation,
    check_views,
)
from nextview.sensing.segmentation import Plane, Samples, find_plane, sample
from nextview.sensing.sighting import Sighting
from nextview.sensing.walls import before_walls, find_walls
from nextview.types import Float, Index, Mask

# earlier and new, the side of a cell, whether it may be two things
FoundSightings = tuple[list["Sighting"], float, bool]

SIZE = 224  # side of the observations' images: what the bundled networks take
FEWEST_OBJECT_PIXELS = 60  # pixels that an object has to have in a frame
# metres between the camera and the point that names an object: nothing nearer can be measured
NEAREST_POINT = 0.01
# share of an object's pixels in an earlier frame that has to change before they are looked at again
MENDED_SHARE = 0.03
# of the most pixels that a frame shows of an object: others say too little of its size
LEAST_VIEW_PART = 0.1
# the novelty score has to be so much lower for an object to be joined or taken apart otherwise
LESS_NOVEL = 1.0
SIZE_CHANGE = (
    2.0  # factor by which the radius may change where an object is looked at anew
)
# object radii that a pixel of the scene may show: half a voxel of ``expected_visibility``
FINEST_PITCH = 1 / 32
# change of the centre or the radius, in object radii, below which the object frame is left as it is
SAME_FRAME = 0.01
# metres below the support plane at which the point of an object may lie: on it, but for a pose's
# error
BELOW = 0.02
AHEAD = 16  # half the width of the middle of the picture, as a part of the picture
MASK_POINTS = 2000  # pixels of a mask that tell where its bottom is
# share of what is seen that may lie lower than the lowest that counts: noise
LOWEST_SEEN = 0.01
TOO_LITTLE = "too little is seen of the object"
NO_SUPPORT = (
    "no support plane is seen below the camera: give a mask or a box, or check the pose (inverse?"
    " OpenGL axes?) and which way is up"
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
class ObjectState:
    """What is known of an object after some frames.

    Attributes:
        rng: source of all random numbers.
        frame: the object frame; None before the object is found.
        sightings: what each frame shows of the object.
        observations: of the frames, in the latest object frame.
        warnings: about the latest frame.
        revision: how often the object frame changed.
        cell: side of a cell of the footprints, metres.
        joins: whether what touches it is a part of it.
    """

    rng: np.random.Generator
    frame: ObjectFrame | None = None
    sightings: tuple[Sighting, ...] = ()
    observations: tuple[Observation, ...] = ()
    warnings: tuple[ViewWarning, ...] = ()
    revision: int = 0
    cell: float = 0.0
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
        support: whether the object stands on a plane in view. False for a gripper or a turntable
            that masks cut out.
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

    def add(self, frame: Frame) -> Observation:
        """Take in a frame and return its observation from three object radii.

        ObservationError where the object is not found in it; the frame is then not taken in.
        """
        self.state = self._after(frame)
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
                    other.add(sighting.told)
                if 1 / SIZE_CHANGE < other.object_frame.radius / radius < SIZE_CHANGE:
                    found.append(
                        (novelty(other.observations) + LESS_NOVEL, other.state)
                    )

        self.state = min(found, key=lambda pair: pair[0])[1]

    def other_joins(self) -> list[clusters.Joins]:
        """Other rules for what touches the object, by which it has other pixels."""
        old = [
            (s.footprint, s.chosen)
            for s in self.sightings
            if s.footprint is not None and s.chosen is not None
        ]
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

    def _after(self, frame: Frame) -> ObjectState:
        before = self.state
        last = before.sightings[-1].told if before.sightings else None
        self._refuse(frame, last)

        noise = noise_of(frame)
        seen = (
            frame.depth > 0 if frame.mask is None else (frame.depth > 0) & ~frame.mask
        )
        # Where no plane is looked for nothing else needs them.
        samples = sample(frame, seen, noise) if self.support else None
        plane, up, rng = self._support(frame, samples)

        sightings, cell, two = self._find(
            frame,
            upright_axes(up),
            plane,
            samples,
            noise,
        )
        displaced = None if two else self._displaced(sightings)
        if displaced is not None and displaced.mended:
            sightings[-1] = sightings[-1].shifted(-displaced.shift)
        latest, made, revision = self._seen_as(sightings, up)

        warnings = self._warnings(frame, latest, made, up, two)
        if self.support and plane is None and self.known is None:
            warnings.append(NO_PLANE)
        for view in made[-4:-1]:
            warnings = warnings or check_views(view, made[-1])
        warnings += plausibility.check_place(displaced)
        if plane is not None and frame.pose is not None and not before.sightings:
            height = float(plane.height(frame.camera_to_world[:3, 3]))
            plausibility.refuse_millimetres(frame.camera_to_world, height, up)
            warnings += plausibility.check_steps(frame, height, up)
        if frame.pose is not None and self.up is not None:
            warnings += self._check_lean(sightings)

        return ObjectState(
            rng,
            latest,
            tuple(sightings),
            tuple(made),
            tuple(warnings),
            revision,
            cell,
            before.joins,
        )

    def find_support(self, frame: Frame) -> Plane:
        """Find the plane in a first frame on which the object would stand.

        Args:
            frame: the frame; it is not taken in.

        Raises:
            ObservationError: no support plane is seen.
        """
        plane, _, _ = self._support(
            frame,
            sample(frame, frame.depth > 0, noise_of(frame)),
        )
        if plane is None:
            raise ObservationError(NO_SUPPORT)
        return plane

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
        before = self.state
        latest, made, revision = self._seen_as(sightings, up)
        warnings = check_observation(made[-1])
        for view in made[-4:-1]:
            warnings = warnings or check_views(view, made[-1])
        self.state = replace(
            before,
            frame=latest,
            sightings=tuple(sightings),
            observations=tuple(made),
            warnings=tuple(warnings),
            revision=revision,
        )

    def _seen_as(
        self,
        sightings: Sequence[Sighting],
        up: Float,
    ) -> tuple[ObjectFrame, list[Observation], int]:
        """The object frame by some sightings, an observation of each, and the new revision."""
        before = self.state
        first = sightings[0].frame.camera_to_world
        ahead = first[:3, 2]
        front = (
            -ahead if abs(ahead @ up) < 0.99 else first[:3, 1]
        )  # from above: the bottom
        axes = upright_axes(up, front) if before.frame is None else before.frame.axes

        latest = self._estimate(sightings, axes)
        if before.frame is not None and _same(latest, before.frame):
            latest = before.frame
        known = zip(before.sightings, before.observations, strict=True)
        kept = {id(old): seen for old, seen in known if latest is before.frame}
        made = [kept.get(id(one)) or self._observe(one, latest) for one in sightings]
        changed = any(
            new is not old for new, old in zip(made, before.observations, strict=False)
        )
        return latest, made, before.revision + changed

    def _refuse(self, frame: Frame, last: Frame | None) -> None:
        """Refuse what is no frame, does not fit those before, or is too far from the object."""
        if not isinstance(frame, Frame):
            raise ObservationError(
                f"what a depth camera gave is a Frame, not {one_line(repr(frame))}"
            )
        sightings = self.state.sightings
        if sightings and (frame.pose is None or sightings[0].frame.pose is None):
            raise ObservationError(
                "a second frame needs a pose, and the first one too: how else do they fit together?"
            )

        target = self.point if self.known is None else self.known.centre
        radius = 0.0 if self.known is None else self.known.radius
        plausibility.refuse_far(frame, last, target, radius)

    def _support(
        self,
        frame: Frame,
        samples: Samples | None,
    ) -> tuple[Plane | None, Float, np.random.Generator]:
        """Return the support plane, if it is seen, the direction up, (3,), and the generator."""
        before = self.state
        up = None if frame.pose is None else self.up
        if before.frame is not None:
            up = before.frame.axes[2]

        rng = before.rng
        plane = None
        if samples is not None:
            earlier = [s.plane for s in before.sightings if s.plane is not None]
            if earlier:
                plane = segmentation.find_again(
                    earlier[0],
                    samples,
                    self._near(samples),
                )
            else:
                rng = deepcopy(rng)
                plane = self._plane(frame, samples, up, rng)

        if up is None:
            if plane is None:
                why = "no support plane is seen, so there is no telling where up is"
                raise ObservationError(f"{why}: give it, and the camera's pose")
            up = plane.normal
        return plane, up, rng

    def _warnings(
        self,
        frame: Frame,
        latest: ObjectFrame,
        made: Sequence[Observation],
        up: Float,
        two: bool,
    ) -> list[ViewWarning]:
        """Return likely faults of a frame, beside those taken before.

        ``two`` says that the object may be two.
        """
        before = self.state
        warnings = check_frame(frame) + check_observation(made[-1])
        if two:
            warnings.append(MAY_BE_TWO)
        if before.sightings:
            warnings += plausibility.check_pose_moved(frame, before.sightings[-1].told)
        if before.frame is not None:
            warnings += plausibility.check_size(latest.radius, before.frame.radius)
        if self.point is not None:
            aside = upright_axes(up)[:2] @ (self.point - latest.centre)
            warnings += plausibility.check_point(aside, latest.radius)
        return warnings

    def _displaced(self, sightings: Sequence[Sighting]) -> Displacement | None:
        """By how much the last of some sightings shows the object beside the earlier ones."""
        if self.known is not None or len(sightings) == 1:
            return None
        return displacement(sightings[-1], sightings[:-1])

    def _check_lean(self, sightings: Sequence[Sighting]) -> list[ViewWarning]:
        """See ``plausibility.check_lean``; of the plane that the object stands on."""
        shown = [sighting for sighting in sightings if sighting.plane is not None]
        if (
            self.up is None or len(shown) < 2
        ):  # of one frame it may be an error of its depth
            return []
        planes = [sighting.plane for sighting in shown if sighting.plane is not None]
        poses = [sighting.frame.camera_to_world for sighting in shown]
        return plausibility.check_lean(lean_of(planes, poses, upright_axes(self.up)))

    def _near(self, samples: Samples) -> Mask:
        """Return which samples lie in the object's sphere of earlier frames, (N,) bool."""
        known = self.state.frame
        if known is None:
            return np.zeros(len(samples.points), bool)
        away = np.linalg.norm(samples.points - known.centre, axis=1)
        return np.asarray(away < known.radius)

    def _plane(
        self,
        frame: Frame,
        samples: Samples,
        up: Float | None,
        rng: np.random.Generator,
    ) -> Plane | None:
        """The support plane of the first frame."""
        every = samples
        if up is not None:  # the foot of a wall is no part of the floor
            samples = samples.some(~segmentation.steep(samples, up))
        plane = find_plane(samples, rng, up, self._above())
        share = 0.0 if plane is None else float(plane.holds(samples).mean())
        # A fit that rises over the point, above which no plane was tried, cuts through a surface.
        cuts = (
            plane is not None
            and self.point is not None
            and plane.height(self.point) < 0
        )
        if self.point is not None and up is not None and (cuts or share < 1 / 3):
            # The point may lie on the plane, or a little below.
            higher = self.point + (2 * np.median(samples.tolerance) + BELOW) * up
            under = find_plane(samples, deepcopy(rng), up, higher)
            more = 0.0 if under is None else float(under.holds(samples).mean())
            if more > (1 if cuts else 2) * share:
                plane = under
                share = more
        # else no other is twice as large
        if up is not None and frame.mask is None and share < 1 / 3:
            largest = find_plane(every, rng)
            mistake = (
                None
                if largest is None
                else segmentation.mistake_in_pose(largest, frame.camera_to_world, up)
            )
            if (
                largest is not None
                and mistake
                and largest.holds(every).mean() > 2 * share
            ):
                raise ObservationError(
                    f"the largest plane in view is not level: {mistake} Or up is another direction"
                )
        if segmentation.lies_better_as_range(
            frame,
            plane,
            samples,
            rng,
            up,
            self._above(),
        ):
            raise ObservationError(
                "the depth is measured along the rays, a range: give it along the optical axis"
            )
        if plane is None or up is None:
            return plane
        plane = self._under_the_object(frame, every, plane)
        asked = None if frame.mask is not None else self.point
        return (
            None
            if support.is_named(every, plane, _target_in(frame, every, asked))
            else plane
        )

    def _under_the_object(self, frame: Frame, samples: Samples, plane: Plane) -> Plane:
        """Return the level plane of the first frame on which the object stands."""
        planes = support.level_planes(samples, plane)
        if len(planes) == 1 or self.known is not None:
            return plane
        if frame.mask is not None:
            rows, columns = np.nonzero(frame.mask & (frame.depth > 0))
            few = slice(None, None, max(1, len(rows) // MASK_POINTS))
            return (
                support.under_points(
                    samples,
                    planes,
                    frame.positions(rows[few], columns[few]),
                )
                or plane
            )

        walls = find_walls(samples, planes[-1], np.random.default_rng(0), self.point)
        of_walls = np.zeros(len(samples.points), bool)
        for wall in walls:
            of_walls |= wall.height(samples.points) < samples.tolerance
        return support.aimed_at(
            samples,
            planes,
            of_walls,
            _target_in(frame, samples, self.point),
        )

    def _above(self) -> Float | None:
        """A point that is known to be above the support plane."""
        if self.box is not None:
            quarter = (self.box.low + self.box.high) / 2
            quarter[2] = self.box.low[2] + (self.box.high[2] - self.box.low[2]) / 4
            return quarter @ self.box.axes
        return (
            self.point
            if self.known is None
            else self.known.centre - 0.2 * self.known.radius * self.known.axes[2]
        )

    def _find(
        self,
        frame: Frame,
        axes: Float,
        plane: Plane | None,
        samples: Samples | None,
        noise: Noise,
    ) -> FoundSightings:
        if frame.mask is not None:
            mask = frame.mask
            if self.known is None:  # else its size does not hang on pixels at the edge
                high = (
                    None
                    if plane is None
                    else frame.along(plane.normal, plane.offset) > STANDS * frame.depth
                )
                mask = trimmed(frame.depth, mask, noise, high)
                above = mask.copy()
                if plane is not None:
                    part = within(mask)
                    above[part] &= segmentation.above_plane(frame, plane, noise, part)
                # a plane may lie above what is hidden or flat
                mask = (
                    above
                    if 2 * np.count_nonzero(above) > np.count_nonzero(mask)
                    else mask
                )
        elif self.known is not None:
            if self.box is not None:
                mask = segmentation.inside_box(frame, self.box)
            else:
                mask = segmentation.inside_sphere(
                    frame,
                    self.known.centre,
                    1.02 * self.known.radius,
                )
            if plane is not None:
                mask &= segmentation.above_plane(frame, plane, noise)
            if np.count_nonzero(mask) < FEWEST_OBJECT_PIXELS:
                raise ObservationError(
                    "nothing is seen where the object should be: a wrong pose, or a wrong box?"
                )
        elif samples is not None:
            base = self._base(samples, axes[2]) if plane is None else plane
            if base is None:
                raise ObservationError(NO_SUPPORT)
            return self._above_the_base(frame, axes, base, plane, samples, noise)
        else:
            raise ObservationError(NO_SUPPORT)
        return (
            [*self.state.sightings, self.sighting_of(frame, mask, plane, noise)],
            self.state.cell,
            False,
        )

    def _base(self, samples: Samples, up: Float) -> Plane | None:
        """The level plane through the lowest points of a frame whose support is out of the picture.

        It is used if the object is selected by a point, and a level plane is seen, but above the
        point.

        Such a plane is a part of the object, as the top is of a table; that it is level tells that
        the pose is right. None where no plane tells it.
        """
        if self.point is None:
            return None
        level = samples.some(~segmentation.steep(samples, up))
        if find_plane(level, np.random.default_rng(0), up) is None:
            return None
        lowest = float(np.quantile(samples.points @ up, LOWEST_SEEN))
        margin = segmentation.TOLERANCES_ASIDE * float(np.median(samples.tolerance))
        return Plane(up, -min(lowest, float(self.point @ up) - margin))

    def _above_the_base(
        self,
        frame: Frame,
        axes: Float,
        base: Plane,
        plane: Plane | None,
        samples: Samples,
        noise: Noise,
    ) -> FoundSightings:
        """Find the object among what rises above a plane.

        It is the plane on which the object stands, if that is seen, or else one as low as all that
        is seen.
        """
        earlier = self.state.sightings
        cell = self.state.cell
        height = frame.along(base.normal, base.offset)
        above = segmentation.above_plane(frame, base, noise)
        place = self._place()
        walls = find_walls(samples, base, np.random.default_rng(0), place)
        free = before_walls(frame, walls, noise)
        above &= free
        ground = base.extent(samples) @ axes[:2].T
        if not cell:
            cell = clusters.FOOTPRINT_CELL * self._distance(
                frame,
                axes,
                above,
                ground,
                noise,
            )

        pieces = cut(frame.depth, above, height, noise, free if walls else None)
        middle = axes[:2] @ (_ahead(frame) if place is None else place)
        if place is None:  # what is far ahead, such as a wall, is no place on the plane
            middle = np.clip(middle, ground.min(0), ground.max(0))
        foot = clusters.footprint(frame, pieces, axes, cell, middle / cell)
        footprints = [*(s.footprint for s in earlier if s.footprint is not None), foot]
        labels, two = clusters.clusters(footprints, self.state.joins)

        target = self._target(
            labels,
            footprints,
            ground / cell,
            axes[:2] / cell,
            frame.intrinsics[:2, 2],
        )
        for now, s in zip(
            labels,
            (s for s in earlier if s.footprint is not None),
            strict=False,
        ):
            was = int(np.bincount(now[s.chosen], minlength=1).argmax())
            # another side of the object
            if was and not any(was in label and target in label for label in labels):
                for label in labels:
                    label[label == was] = target

        chosen = labels[-1] == target
        mask = foot.pixels_of(chosen)
        if (
            labels[-1][~chosen] > 0
        ).any():  # cells at the border may hold pixels of a neighbour
            mask = trimmed(frame.depth, mask, noise, height > STANDS * frame.depth)
        if target == 0 or np.count_nonzero(mask) < FEWEST_OBJECT_PIXELS:
            where = "of the object known so far" if earlier else "on the support plane"
            raise ObservationError(
                f"this frame shows nothing {where}: check its pose, or aim the camera at the object"
            )

        sightings = self._reconsidered(labels[:-1], target)
        latest = replace(
            self.sighting_of(frame, mask, plane, noise),
            footprint=foot,
            chosen=chosen,
        )
        return [*sightings, latest], cell, bool(two[target])

    def _distance(
        self,
        frame: Frame,
        axes: Float,
        above: Mask,
        ground: Float,
        noise: Noise,
    ) -> float:
        """Return the distance from the camera to the object, metres."""
        camera = frame.camera_to_world[:3, 3]
        if self.point is not None:
            distance = float(np.linalg.norm(self.point - camera))
            if distance < NEAREST_POINT:
                raise ObservationError(
                    f"the object's point is {distance:.2g} m from the camera: of the world?"
                )
            return distance

        points = sample(frame, above, noise).points
        points = points[clusters.on_ground(points @ axes[:2].T, ground)]
        points = points if len(points) else _ahead(frame)[None]
        return float(np.median(np.linalg.norm(points - camera, axis=1)))

    def _reconsidered(self, labels: Sequence[Index], target: int) -> list[Sighting]:
        """The earlier sightings, each with what now counts as the object in it."""
        sightings = list[Sighting]()
        old_labels = iter(labels)
        for s in self.state.sightings:
            if s.footprint is not None and s.chosen is not None:
                now = next(old_labels) == target
                if _changed(s.footprint, s.chosen, now):
                    mended = replace(
                        s,
                        facets=s.facets.some(slice(0)),
                        mask=np.zeros_like(s.mask),
                        hull=s.hull[:0],
                    )
                    # what was taken for the object was what hid it
                    with suppress(ObservationError):
                        mended = self.sighting_of(
                            s.frame,
                            s.footprint.pixels_of(now),
                            s.plane,
                            s.noise,
                        )
                    s = replace(
                        mended,
                        footprint=s.footprint,
                        chosen=now,
                        shift=s.shift,
                    )
            sightings.append(s)
        return sightings

    def _place(self) -> Float | None:
        """Return the known place of the object, (3,), world, metres."""
        if self.point is not None:
            return self.point
        return None if self.state.frame is None else self.state.frame.centre

    def _target(
        self,
        labels: list[Index],
        footprints: list[Footprint],
        ground: Float,
        to_cells: Float,
        optical_axis: Float,
    ) -> int:
        """Return the object's label: by the point, by earlier cells, or as aimed at."""
        if self.point is not None:
            asked = to_cells @ self.point
            here = labels[-1]
            target = clusters.nearest(footprints, labels, asked)
            return (
                target
                if target in here
                else clusters.nearest(footprints[-1:], [here], asked)
            )

        before = [s.chosen for s in self.sightings if s.chosen is not None]
        votes = np.concatenate(
            [[0], *(now[then] for now, then in zip(labels[:-1], before, strict=True))]
        ).astype(int)
        count = np.bincount(votes)
        count[0] = 0
        if count.any():
            target = int(count.argmax())
            here = labels[-1]
            if (
                target not in here
            ):  # what was found was a part: the whole stands in the same place
                off = np.linalg.norm(
                    footprints[-1].cells + 0.5 - to_cells @ self.object_frame.centre,
                    axis=1,
                )
                there = here[
                    (off < self.object_frame.radius * np.linalg.norm(to_cells[0]))
                    & (here > 0)
                ]
                target = int(np.bincount(there).argmax()) if len(there) else 0
            return target
        if self.sightings:
            return clusters.nearest(
                footprints[-1:],
                labels[-1:],
                to_cells @ self.object_frame.centre,
            )

        return clusters.central(footprints[-1], labels[-1], ground, optical_axis)

    def sighting_of(
        self,
        frame: Frame,
        mask: Mask,
        plane: Plane | None,
        noise: Noise,
    ) -> Sighting:
        """What the pixels of the object show of it.

        Args:
            frame: the frame.
            mask: the object's pixels, (H, W) bool.
            plane: that the object stands on; None if it is not seen.
            noise: of the frame's depth.

        Raises:
            ObservationError: too little is seen of the object.
        """
        if np.count_nonzero(mask) < FEWEST_OBJECT_PIXELS:
            raise ObservationError(TOO_LITTLE)

        part = within(mask, 2)
        corner = (part[0].start, part[1].start)
        coarse = max(1, max(mask[part].shape) // SIZE)
        facets = fit_facets(
            frame.depth[part],
            mask[part],
            frame.intrinsics,
            corner,
            self.denoise,
            coarse,
            noise,
        )
        if self.denoise and len(facets.planes):
            facets = without_outliers(facets, noise, coarse)
        if len(facets.planes) * coarse**2 < FEWEST_OBJECT_PIXELS:
            raise ObservationError(TOO_LITTLE)

        pose = frame.camera_to_world
        few = slice(None, None, max(1, len(facets.planes) // 3000))
        points = facets.some(few).points @ pose[:3, :3].T + pose[:3, 3]

        with suppress(QhullError):  # all in one plane: they do as they are
            points = points[ConvexHull(points).vertices]

        return Sighting(frame, noise, facets, mask, points, plane)

    def _estimate(self, sightings: Sequence[Sighting], axes: Float) -> ObjectFrame:
        if self.known is not None:
            return self.known

        shown = np.array([np.count_nonzero(s.mask) for s in sightings])
        points = np.concatenate(
            [
                s.hull
                for s, n in zip(sightings, shown, strict=True)
                if n >= LEAST_VIEW_PART * shown.max()
            ]
        )
        planes = [s.plane for s in sightings if s.plane is not None]
        floor = None
        here = points.mean(0)
        if planes:  # their height along up, where the object is: they may lean a little
            floor = float(
                np.median(
                    [
                        axes[2] @ here - p.height(here) / (p.normal @ axes[2])
                        for p in planes
                    ]
                )
            )

        return enclose(points, axes, floor)

    def _observe(self, sighting: Sighting, latest: ObjectFrame) -> Observation:
        pose = latest.pose_in_object(sighting.frame.camera_to_world)
        depth, facet = look_again(sighting.facets, pose, latest.radius, SIZE)
        image = _resampled(sighting.frame.image, sighting.facets, facet)
        colour = _resampled(sighting.frame.colour, sighting.facets, facet)
        radius = latest.radius if self.life_size else None
        scene = _scene(sighting, pose, latest.radius)

        return Observation(
            depth,
            virtual_pose(pose),
            pinhole(SIZE, CAMERA_DISTANCE),
            radius,
            image,
            scene,
            colour=colour,
        )


def _resampled(
    picture: NDArray[np.uint8] | None,
    facets: Facets,
    facet: Index,
) -> NDArray[np.uint8] | None:
    """The picture of a frame, (H, W) or (H, W, 3), at the facets that a camera sees, (S, S)."""
    if picture is None:
        return None
    shown = np.zeros((*facet.shape, *picture.shape[2:]), np.uint8)
    hit = facet >= 0
    shown[hit] = picture[facets.rows[facet[hit]], facets.columns[facet[hit]]]
    return shown


def _scene(sighting: Sighting, pose: Float, radius: float) -> SceneView:
    """Return all that a frame shows, in the object frame and object radii."""
    k = sighting.frame.intrinsics.copy()
    step = max(
        1,
        int(
            FINEST_PITCH
            * min(k[0, 0], k[1, 1])
            / max(float(np.linalg.norm(pose[:3, 3])), 1.0)
        ),
    )

    k[:2] /= step
    k[:2, 2] += 0.5 - (step // 2 + 0.5) / step
    few = (slice(step // 2, None, step),) * 2
    return SceneView(
        sighting.frame.depth[few] / np.float32(radius),
        sighting.mask[few],
        pose,
        k,
    )


def _target_in(frame: Frame, samples: Samples, place: Float | None) -> support.Target:
    """Where the object is looked for in a frame: at a place, (3,), world, if one is given."""
    side = frame.shape[1] / (samples.columns.max() + 1)
    axis = frame.intrinsics[[1, 0], [2, 2]] / side
    return support.Target(axis, frame.shape[1] / side, place)


def noise_of(frame: Frame) -> Noise:
    """The noise of all that a frame shows."""
    few = slice(None, None, max(1, frame.shape[0] // ROWS_MEASURED))
    return estimate_noise(frame.depth[few], frame.depth[few] > 0)


def _ahead(frame: Frame) -> Float:
    """Return the median position in the middle of the picture, (3,), world, metres."""
    height, width = frame.shape
    down = height // AHEAD + 1
    across = width // AHEAD + 1
    depth = frame.depth[
        height // 2 - down : height // 2 + down,
        width // 2 - across : width // 2 + across,
    ]
    if not depth.any():
        depth = frame.depth
    pose = frame.camera_to_world
    return pose[:3, 3] + float(np.median(depth[depth > 0])) * pose[:3, 2]


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
