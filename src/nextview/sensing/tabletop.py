"""All things that stand on the support plane of one frame, each with its pixels."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from nextview.errors import ObservationError
from nextview.sensing import clusters, planes, segmentation, support
from nextview.sensing.clusters import Joins
from nextview.sensing.convex_pieces import STANDS, Pieces, cut
from nextview.sensing.facets import Noise, noise_of
from nextview.sensing.frame import Frame, within
from nextview.sensing.levels import Supports, SurfaceLevel
from nextview.sensing.mask_edges import trimmed
from nextview.sensing.object_frame import Box, upright_axes
from nextview.sensing.planes import LEAST_SUPPORT, Plane, Samples, sample
from nextview.sensing.sighting import FEWEST_OBJECT_PIXELS, Sighting, sighting_of
from nextview.sensing.support import GroundPlane
from nextview.sensing.support_plane import (
    MASK_POINTS,
    NO_SUPPORT,
    find_support_plane,
    refuse_mistakes,
)
from nextview.sensing.view_warning import ViewWarning
from nextview.sensing.walls import before_walls, find_walls
from nextview.types import Float, Float32, Index, Mask

# metres above the plane that a thing reaches, at least: else it is a stain
LOWEST_TOP = 0.008
# the same as a part of its distance, where the depth is less exact
LOWEST_SHARE = 0.012
# share of a thing's pixels that are below its top, flying pixels left out
TOP_SHARE = 0.9
# square metres that are seen of a thing, at least: of a die a little more
SMALLEST_AREA = 1.5e-4
THINNEST = 0.006  # metres across a thing at its thickest, at least: scraps of edges are thinner
# metres from the plane within which what is seen is likely to be the plane's
NEAR_TABLE = 0.015
# deviations of the plane's own pixels above which something stands on it
UNEVEN_DEVIATIONS = 3.0
MEDIAN_DEVIATION = 1.4826  # of a Gaussian, by the median of what it deviates
TOUCHING_GAP = 0.006  # metres between two things that touch, at most
TOUCHING_STEP = 0.015  # metres between their depths where they are nearest, at most
BESIDE_POINTS = 200  # pixels at a border that are compared


@dataclass(frozen=True, eq=False)
class TableTop:
    """What one frame shows on its support plane.

    Attributes:
        frame: the frame.
        noise: of its depth.
        ground: that things stand on.
        up: direction against gravity, (3,), world.
        above: pixels above the plane, before all walls and inside the region, (H, W) bool.
        free: pixels before all walls, (H, W) bool; None where there is no wall.
        height: of each pixel over the plane, (H, W) float32, metres; where a segmentation tells
            surfaces, over the one that carries what it shows.
        levels: level planes over a ground that may be a part of a thing, the highest first: table
            tops, seats. On one of them another thing may stand.
        lower: whether the frame shows that the ground of earlier frames is none, and a lower one.
        shows_ground: whether the ground is in the picture.
        warnings: about the frame.
        given: pixels of each thing by a segmentation of the user's own, (H, W) bool each; None
            where there is none.
        supports: the surfaces that a segmentation tells, and what stands on each; None where it
            tells none.
        pieces: that a segmentation may cut things into, (H, W) int, 0 for none; None where it
            tells none.
    """

    frame: Frame
    noise: Noise
    ground: GroundPlane
    up: Float
    above: Mask
    free: Mask | None
    height: Float32
    levels: tuple[Plane, ...] = ()
    lower: bool = False
    shows_ground: bool = True
    warnings: tuple[ViewWarning, ...] = ()
    given: tuple[Mask, ...] | None = None
    supports: Supports | None = None
    pieces: Index | None = None

    @classmethod
    def of(
        cls,
        frame: Frame,
        up: Float | None,
        ground: GroundPlane | None = None,
        known: Sequence[tuple[Float, float]] = (),
        region: Box | None = None,
        widest: float | None = None,
        given: Sequence[Mask] | None = None,
        surface: Mask | None = None,
        pieces: Index | None = None,
        levels: Sequence[SurfaceLevel] = (),
    ) -> TableTop:
        """Find the support plane of a frame, and what is above it.

        Args:
            frame: of a depth camera; a mask, if it has one, says where is looked.
            up: direction against gravity, (3,), world; None: the normal of the plane.
            ground: that things stand on as an earlier frame shows it; None: it is looked for.
            known: centres, (3,), and radii of things that stand on it, metres.
            region: what is outside of this upright box is left out.
            widest: diameter of the largest thing that is looked for, metres: a level plane that is
                no larger may be a part of it. None: it is not known.
            given: pixels of each thing by a segmentation of the user's own, (H, W) bool each; None
                where there is none.
            surface: pixels of the surfaces by this segmentation, (H, W) bool: the ground is the
                one that carries most of the things. None where it tells none.
            pieces: that things may be cut into, by this segmentation, (H, W) int, 0 for none.
            levels: of the surfaces of earlier frames.

        Raises:
            ObservationError: no support plane is seen.
        """
        noise = noise_of(frame)
        inside = frame.depth > 0 if frame.mask is None else frame.mask
        if region is not None:
            inside = inside & segmentation.inside_box(frame, region)
        masks = None if given is None else tuple(mask & inside for mask in given)
        if masks is not None and surface is not None:
            upright = _upright(frame, up)
            if upright is None and ground is not None:
                upright = ground.plane.normal
            supports = Supports.of(frame, masks, surface, noise, upright, levels)
            top = cls._on_surfaces(supports, noise, up, ground, inside, widest)
            return replace(top, pieces=pieces)

        samples = sample(frame, frame.depth > 0, noise)
        lower = False
        shows_ground = True
        if ground is None:
            ground = _find_ground(frame, samples, up, widest)
        else:
            own = None
            if not ground.wide:
                with suppress(ObservationError):
                    own = _find_ground(frame, samples, up, widest)
            if own is not None and own.is_below(ground, samples):
                lower = True
                ground = own
            elif ground.seen:
                near = _near(samples, known)
                plane = planes.find_again(ground.plane, samples, near)
                # few samples fit a plane that leans: a later frame may not show the floor
                enough = bool(plane.holds(samples).mean() > LEAST_SUPPORT)
                shows_ground = enough and planes.is_seen(plane, samples)
                if ground.wide or enough:
                    ground = replace(ground, plane=plane)
        plane = ground.plane
        shows_ground &= ground.seen

        above = segmentation.above_plane(frame, plane, noise)
        free = _free_of_walls(frame, samples, plane, noise)
        if free is not None:
            above &= free
        above &= inside
        height = frame.along(plane.normal, plane.offset)
        above &= height > UNEVEN_DEVIATIONS * _unevenness(frame, height)
        upwards = _upwards(frame, up, plane)
        below = () if ground.wide else support.level_planes(samples, plane)[:-1]
        return cls(
            frame,
            noise,
            ground,
            upwards,
            above,
            free,
            height,
            tuple(below),
            lower,
            shows_ground,
            given=masks,
            pieces=pieces,
        )

    @classmethod
    def _on_surfaces(
        cls,
        supports: Supports,
        noise: Noise,
        up: Float | None,
        ground: GroundPlane | None,
        inside: Mask,
        widest: float | None,
    ) -> TableTop:
        """What stands on the surfaces that a segmentation tells, see ``of``.

        Args:
            supports: the surfaces, and what each of them carries.
            noise: of the frame.
            up: direction against gravity, (3,), world; None: the normal of the plane.
            ground: as an earlier frame shows it; None: it is looked for.
            inside: pixels where is looked, (H, W) bool.
            widest: diameter of the largest thing that is looked for, metres; None: any.
        """
        frame = supports.frame
        level = (
            supports.ground(inside, widest)
            if ground is None
            else supports.again(ground.plane)
        )
        if ground is None:
            upright = _upright(frame, up)
            shown = sample(frame, supports.surface & (frame.depth > 0), noise)
            refuse_mistakes(
                frame, shown, None if level is None else level.plane, upright
            )
            if level is None:
                raise ObservationError(NO_SUPPORT)
            ground = GroundPlane(level.plane)
        elif level is not None:
            ground = replace(ground, plane=level.plane)
        plane = ground.plane

        height = frame.along(plane.normal, plane.offset)
        for other in supports.levels:
            on = other.pixels
            height[on] = frame.along(other.plane.normal, other.plane.offset)[on]
        above = np.zeros(frame.shape, bool)
        for mask, carrier in zip(supports.masks, supports.carriers, strict=True):
            if carrier is None or not mask.any():
                continue
            part = within(mask)
            own = mask[part]
            under = carrier.plane
            raised = frame.along(under.normal, under.offset, part)
            height[part][own] = raised[own]
            above[part] |= own & segmentation.above_plane(frame, under, noise, part)

        samples = sample(frame, frame.depth > 0, noise)
        free = _free_of_walls(frame, samples, plane, noise)
        upwards = _upwards(frame, up, plane)
        return cls(
            frame,
            noise,
            ground,
            upwards,
            above,
            free,
            height,
            shows_ground=level is not None,
            given=supports.masks,
            supports=supports,
        )

    @property
    def plane(self) -> Plane:
        """The plane that things stand on."""
        return self.ground.plane

    @property
    def carried_by_none(self) -> tuple[Mask, ...]:
        """Pixels of each thing that no surface carries, (H, W) bool each.

        None where no segmentation tells surfaces.
        """
        if self.supports is None:
            return ()
        pairs = zip(self.supports.masks, self.supports.carriers, strict=True)
        return tuple(
            mask
            for mask, carrier in pairs
            if carrier is None and np.count_nonzero(mask) >= FEWEST_OBJECT_PIXELS
        )

    @property
    def other_surfaces(self) -> Mask:
        """Pixels of surfaces other than the ground, (H, W) bool."""
        found = np.zeros(self.frame.shape, bool)
        for level in () if self.supports is None else self.supports.levels:
            if level.plane is not self.plane:
                found |= level.pixels
        return found

    def under(self, mask: Mask) -> Plane:
        """The plane that a thing stands on: the highest beside its bottom, or the ground.

        Args:
            mask: its pixels, (H, W) bool.
        """
        if self.supports is not None:
            level = self.supports.under(mask)
            return self.plane if level is None else level.plane
        if not self.levels:
            return self.plane
        rows, columns = np.nonzero(mask & (self.frame.depth > 0))
        if not len(rows):
            return self.plane
        few = slice(None, None, max(1, len(rows) // MASK_POINTS))
        points = self.frame.positions(rows[few], columns[few])
        others = sample(self.frame, (self.frame.depth > 0) & ~mask, self.noise)
        found = support.under_points(others, list(self.levels), points)
        return self.plane if found is None else found

    def sighting(self, mask: Mask) -> Sighting:
        """What the frame shows of a thing.

        Args:
            mask: its pixels, (H, W) bool.

        Raises:
            ObservationError: too little is seen of it.
        """
        seen = sighting_of(self.frame, mask, self.under(mask), self.noise)
        return replace(seen, warnings=self.warnings)

    def segments(
        self,
        pixels: Mask | None = None,
        joins: Joins = "by their border",
    ) -> list[Mask]:
        """Cut what is above the plane into things, by their edges and how they lie from above.

        Args:
            pixels: which of those above the plane are looked at, (H, W) bool; all by default.
            joins: whether what touches is one thing, see ``clusters.clusters``.

        Returns:
            The pixels of each thing, (H, W) bool each, those with most pixels first. Stains and
            scraps of edges are left out. Where masks were given, the things are those, without the
            background at their edges and the plane.
        """
        if self.given is not None:
            return self._given_segments() if pixels is None else self._pieces(pixels)
        above = self.above if pixels is None else self.above & pixels
        if np.count_nonzero(above) < FEWEST_OBJECT_PIXELS:
            return []
        frame = self.frame
        pieces = cut(frame.depth, above, self.height, self.noise, self.free)
        axes = upright_axes(self.up)
        away = float(np.median(frame.depth[above]))
        cell = clusters.FOOTPRINT_CELL * away
        rows, columns = np.nonzero(above)
        few = slice(None, None, max(1, len(rows) // 1000))
        middle = (
            np.median(frame.positions(rows[few], columns[few]), axis=0) @ axes[:2].T
        )
        foot = clusters.footprint(frame, pieces, axes, cell, middle / cell)
        (labels,), _ = clusters.clusters([foot], joins)

        of_piece = _clusters_of_pieces(foot.piece, labels, pieces)
        found = []
        owner = of_piece[pieces.grown]
        pixels_of = np.bincount(owner.ravel())
        pixels_of[0] = 0
        for label in np.flatnonzero(pixels_of >= FEWEST_OBJECT_PIXELS):
            mask = trimmed(
                frame.depth,
                owner == label,
                self.noise,
                self.height > STANDS * frame.depth,
            )
            if self.is_thing(mask):
                found.append(mask)
        return sorted(found, key=lambda mask: -np.count_nonzero(mask))

    def _given_segments(self) -> list[Mask]:
        """The things of the masks that were given, those with most pixels first."""
        assert self.given is not None
        left_out = {id(mask) for mask in self.carried_by_none}
        found = []
        for mask in self.given:
            if id(mask) in left_out:
                continue

            inside = mask & (self.frame.depth > 0)
            if np.count_nonzero(inside) < FEWEST_OBJECT_PIXELS:
                continue
            own = segmentation.inside_mask(
                self.frame,
                inside,
                self.under(inside),
                self.noise,
            )
            if np.count_nonzero(own) >= FEWEST_OBJECT_PIXELS:
                found.append(own)
        return sorted(found, key=lambda mask: -np.count_nonzero(mask))

    def _pieces(self, pixels: Mask) -> list[Mask]:
        """The pieces of the segmentation that was given, within some pixels, (H, W) bool."""
        if self.pieces is None:
            return []
        inside = np.where(pixels & (self.frame.depth > 0), self.pieces, 0)
        sizes = np.bincount(inside.ravel())
        sizes[0] = 0
        numbers = np.flatnonzero(sizes >= FEWEST_OBJECT_PIXELS)
        return [inside == number for number in numbers[np.argsort(-sizes[numbers])]]

    def is_thing(self, mask: Mask) -> bool:
        """Whether some pixels, (H, W) bool, are enough, and high enough, to be a thing."""
        part = within(mask)
        own = mask[part] & (self.frame.depth[part] > 0)
        count = np.count_nonzero(own)
        if count < FEWEST_OBJECT_PIXELS:
            return False

        away = float(np.median(self.frame.depth[part][own]))
        top = float(np.quantile(self.height[part][own], TOP_SHARE))
        focal = self.frame.intrinsics[0, 0] * self.frame.intrinsics[1, 1]
        area = count * away**2 / focal
        if top < max(LOWEST_TOP, LOWEST_SHARE * away) or area < SMALLEST_AREA:
            return False
        half = round(float(np.sqrt(focal)) * THINNEST / 2 / away)
        filled = ndimage.binary_closing(np.pad(mask[part], 1))
        return bool(
            ndimage.binary_erosion(filled, np.ones((3, 3), bool), max(half, 1)).any()
        )

    def neighbours(
        self,
        masks: Sequence[Mask | None],
        gap: float = TOUCHING_GAP,
    ) -> list[tuple[int, int]]:
        """Which pairs of things are so near in the picture that they may touch.

        Args:
            masks: the pixels of each, (H, W) bool; None where the frame does not show it.
            gap: metres between two things that touch, at most.

        Returns:
            Their places in ``masks``, the smaller one first.
        """
        shown = [row for row, mask in enumerate(masks) if mask is not None]
        parts = np.array(
            [
                [(side.start, side.stop) for side in within(mask)]
                for mask in masks
                if mask is not None
            ]
        ).reshape(-1, 2, 2)
        nearest = self.frame.depth[self.frame.depth > 0].min(initial=np.inf)
        focal = float(self.frame.intrinsics[[0, 1], [0, 1]].max())
        reach = max(2.0, gap * focal / nearest) + 1
        low, high = parts[..., 0], parts[..., 1]
        apart = np.maximum(low[:, None] - high, low - high[:, None]).max(-1)
        pairs = np.argwhere(np.triu(apart <= reach, 1))
        return [(shown[one], shown[other]) for one, other in pairs]

    def touching(
        self,
        one: Mask,
        other: Mask,
        gap: float = TOUCHING_GAP,
        step: float = TOUCHING_STEP,
    ) -> bool:
        """Whether two things meet in the picture and in depth.

        Args:
            one: the pixels of one of them, (H, W) bool.
            other: those of the other.
            gap: metres between them in the picture, at most.
            step: metres between their depths where they are nearest, at most.
        """
        part = within(one)
        away_from_camera = self.frame.depth[part][one[part]]
        if not away_from_camera.any():
            return False

        focal = float(self.frame.intrinsics[[0, 1], [0, 1]].mean())
        reach = max(
            2.0,
            gap * focal / float(np.median(away_from_camera[away_from_camera > 0])),
        )
        near = within(one, int(reach) + 1)
        if not other[near].any():
            return False

        away, nearest = ndimage.distance_transform_edt(~one[near], return_indices=True)
        beside = np.nonzero(other[near] & (away <= reach))
        if not len(beside[0]):
            return False

        few = slice(None, None, max(1, len(beside[0]) // BESIDE_POINTS))
        rows, columns = beside[0][few], beside[1][few]
        depth = self.frame.depth[near]
        own = depth[nearest[0][rows, columns], nearest[1][rows, columns]]
        its = depth[rows, columns]
        known = (own > 0) & (its > 0)
        apart = np.abs(own - its)[known]

        return bool(len(apart)) and float(np.median(apart)) < step


def _find_ground(
    frame: Frame,
    samples: Samples,
    up: Float | None,
    widest: float | None,
) -> GroundPlane:
    """What things stand on, by one frame alone.

    Args:
        frame: of a depth camera.
        samples: of it.
        up: direction against gravity, (3,), world; None: the normal of the plane.
        widest: diameter of the largest thing that is looked for, metres; None: it is not known.

    Raises:
        ObservationError: no support plane is seen.
    """
    rng = np.random.default_rng(0)
    plane = find_support_plane(frame, samples, _upright(frame, up), rng)
    if plane is None:
        raise ObservationError(NO_SUPPORT)
    if widest is None:
        return GroundPlane(plane)
    return support.ground_of(samples, plane, widest)


def _free_of_walls(
    frame: Frame, samples: Samples, plane: Plane, noise: Noise
) -> Mask | None:
    """Pixels before the walls that are seen, (H, W) bool; None where none is."""
    walls = find_walls(samples, plane, np.random.default_rng(0))
    return before_walls(frame, walls, noise) if walls else None


def _upwards(frame: Frame, up: Float | None, plane: Plane) -> Float:
    """Direction against gravity, (3,); the normal of a plane where a frame does not tell it."""
    return plane.normal if up is None or frame.pose is None else up


def _upright(frame: Frame, up: Float | None) -> Float | None:
    """Direction against gravity, (3,), of unit length; None where a frame does not tell it."""
    return None if up is None or frame.pose is None else upright_axes(up)[2]


def _unevenness(frame: Frame, height: Float32) -> float:
    """How far the plane's own pixels deviate from it, metres: noise that they have in common."""
    few = (slice(None, None, 4), slice(None, None, 4))
    seen = height[few][(frame.depth[few] > 0) & (np.abs(height[few]) < NEAR_TABLE)]
    return MEDIAN_DEVIATION * float(np.median(np.abs(seen))) if len(seen) else 0.0


def _near(samples: Samples, known: Sequence[tuple[Float, float]]) -> Mask:
    """Which samples lie in one of some spheres, (N,) bool."""
    near = np.zeros(len(samples.points), bool)
    for centre, radius in known:
        near |= np.linalg.norm(samples.points - centre, axis=1) < radius
    return near


def _clusters_of_pieces(piece: Index, labels: Index, pieces: Pieces) -> Index:
    """The cluster of each piece, (pieces + 1,), 0 for none."""
    found = np.zeros(len(pieces.stands), np.int64)
    found[piece] = labels
    return found
