"""An object as a camera comes to know it: frames in, observations out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from nextview.arguments import as_line, of_kind
from nextview.errors import ObservationError, UsageError
from nextview.observation import Observation, SceneView, pinhole
from nextview.sensing import segmentation
from nextview.sensing.facets import Facets, fit_facets
from nextview.sensing.frame import Frame
from nextview.sensing.noise import ROWS, Noise, estimate_noise
from nextview.sensing.object_frame import Box, ObjectFrame, enclose, three, upright_axes
from nextview.sensing.plausibility import Doubt, check_observation, check_views
from nextview.sensing.segmentation import Footprint
from nextview.sensing.support_plane import Plane, Samples, find_plane, mistake_in_pose, refine_plane, sample
from nextview.sensing.virtual_view import look_again, virtual_pose
from nextview.viewsphere import DISTANCE

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

SIZE = 224
"""Side of the observations' images: what the bundled networks take."""
FEWEST = 60
"""Pixels that an object has to have in a frame."""
NEAREST = 0.01
"""Metres between the camera and the point that names an object: nothing nearer can be measured."""
MENDED = 0.03
"""Share of an object's pixels in an earlier frame that has to change before they are looked at again."""
FINEST = 1 / 32
"""Object radii that a pixel of the scene may show: half a voxel of ``occupancy.expected_visibility``."""
SAME = 0.01
"""Change of the centre or the radius, in object radii, below which the object frame is left as it is."""


@dataclass(frozen=True)
class Sighting:
    """What one frame says of the object.

    Attributes:
        frame: as it came.
        noise: of the whole frame.
        facets: the object's surface, camera frame.
        mask: its pixels that show the object, (H, W) bool.
        hull: corners of the convex hull of that surface, world, (K, 3) float64.
        plane: the support plane as this frame sees it; None if it sees none.
        footprint: of all that is above the plane; None where the object was found otherwise.
        chosen: which of its cells are the object's, (cells,) bool; None without a footprint.
    """

    frame: Frame
    noise: Noise
    facets: Facets
    mask: Mask
    hull: Float
    plane: Plane | None
    footprint: Footprint | None
    chosen: Mask | None


class ObservedObject:
    """One object, seen in more and more frames. ``add`` takes a frame and gives an observation.

    The object is found in each frame: by the frame's mask; else as what lies in a ``box``; else as the cluster on the
    support plane that is nearest to a ``point``, or the largest in the first frame. Its centre and radius are those of
    the box, or estimated from all frames so far. When they get better the earlier frames are expressed anew:
    ``observations`` are always all in the same, latest object frame, and ``revision`` counts how often it changed. Its
    x axis points to the side from which the first frame was taken, unless a box or a known frame says otherwise.

    >>> thing = ObservedObject()                                                # doctest: +SKIP
    >>> observation = thing.add(Frame(depth, intrinsics, pose))                 # doctest: +SKIP

    Args:
        up: direction against gravity in the world, (3,); z by default. None: the normal of the support plane of the
            first frame. Frames without a pose have no other way.
        point: near the object, world, metres, (3,).
        box: upright, into which the object just fits.
        support: whether the object stands on a plane in view. False for a gripper or a turntable that masks cut out.
        known: the object frame, if it need not be estimated; the object is what lies in its sphere.
        denoise: smooth depth, fill holes and drop flying pixels. For sensors; renders need it not.
        life_size: whether the object is as large as its kind is in life. If so the observations tell the radius, which
            is evidence of the class; not for toys and models of things.
        rng: for the search for planes; seed 0 by default.

    Raises:
        UsageError: arguments that make no sense together.
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
            raise UsageError("an object is asked for by a point, by a box or by its known frame: by one of them")
        self.point = None if point is None else three(point)
        if point is not None and self.point is None:
            raise UsageError(f"a point is three numbers, world, metres, not {as_line(point)}")
        of_kind(box, Box | None, "a box is a Box")
        of_kind(known, ObjectFrame | None, "a known frame is an ObjectFrame")
        of_kind(rng, np.random.Generator | None, "rng is a numpy.random.Generator")
        if up is not None:
            upright_axes(up)  # says what is wrong with it
        self.box, self.support, self.known = box, support, known if box is None else box.object_frame
        self.denoise, self.life_size = denoise, life_size
        self.sightings: tuple[Sighting, ...] = ()
        self.revision = 0
        self.doubts: list[Doubt] = []
        self._rng = rng or np.random.default_rng(0)
        self._up = up
        self._cell = 0.0
        self._frame = self.known
        self._made: list[Observation] = []

    @property
    def object_frame(self) -> ObjectFrame:
        """Where the object is, as far as it is known.

        Raises:
            ObservationError: no frame was added yet.
        """
        if self._frame is None:
            raise ObservationError("no frame was added yet, so nothing is known of the object")
        return self._frame

    @property
    def observations(self) -> list[Observation]:
        """One for each frame, in order, all in the latest object frame."""
        return list(self._made)

    @contextmanager
    def undone_by_errors(self) -> Iterator[None]:
        """What is added within the block is as if it had never been, to the last random number, if the block raises."""
        before, drawn = dict(vars(self)), self._rng.bit_generator.state
        try:
            yield
        except BaseException:
            vars(self).clear()
            vars(self).update(before)
            self._rng.bit_generator.state = drawn
            raise

    def add(self, frame: Frame) -> Observation:
        """Take in a frame.

        Returns:
            What the networks take: a square depth image as seen from three object radii in the camera's direction.

        Raises:
            ObservationError: the object is not found in it; the frame is then not taken in.
        """
        of_kind(frame, Frame, "what a depth camera gave is a Frame", ObservationError)
        if self.sightings and (frame.pose is None or self.sightings[0].frame.pose is None):
            raise ObservationError("a second frame needs a pose, and the first one too: how else do they fit together?")
        few = slice(None, None, max(1, frame.shape[0] // ROWS))
        noise = estimate_noise(frame.depth[few], frame.depth[few] > 0)
        seen = frame.depth > 0 if frame.mask is None else (frame.depth > 0) & ~frame.mask
        samples = sample(frame, seen, noise)
        up = self._known_up(frame)
        plane = self._support_plane(frame, samples, up) if self.support else None
        if up is None:
            if plane is None:
                raise ObservationError(
                    "no support plane is seen, so there is no telling where up is: give it, and the camera's pose"
                )
            up = plane.normal
        axes = self._frame.axes if self._frame is not None else upright_axes(up, _towards(frame, up))
        sightings = self._find(frame, upright_axes(up), plane, samples, noise)
        found = self._estimate(sightings, axes)
        same = self._frame is not None and _same(found, self._frame)
        if same and self._frame is not None:
            found = self._frame
        kept = [new is old for new, old in zip(sightings, self.sightings, strict=False)]
        kept += [False] * (len(sightings) - len(kept))
        made = [
            self._made[i] if keep and same else self._observe(sighting, found)
            for i, (sighting, keep) in enumerate(zip(sightings, kept, strict=True))
        ]
        self.revision += bool(self._made) and not (same and all(kept[:-1]))
        self.doubts = check_observation(made[-1])
        for old in made[-4:-1]:
            self.doubts = self.doubts or check_views(old, made[-1])
        self.sightings, self._frame, self._made = tuple(sightings), found, made
        return made[-1]

    # Where up is, and what the object stands on

    def _known_up(self, frame: Frame) -> Float | None:
        if self._frame is not None:
            return self._frame.axes[2]
        return None if self._up is None or frame.pose is None else upright_axes(self._up)[2]

    def _support_plane(self, frame: Frame, samples: Samples, up: Float | None) -> Plane | None:
        earlier = [s.plane for s in self.sightings if s.plane is not None]
        if earlier:
            return refine_plane(earlier[0], samples, loose=2)
        plane = find_plane(samples, self._rng, up, self._above())
        share = 0.0 if plane is None else float(plane.holds(samples).mean())
        if up is not None and frame.mask is None and share < 1 / 3:  # else no other is twice as large
            largest = find_plane(samples, self._rng)
            mistake = None if largest is None else mistake_in_pose(largest, frame.camera_to_world, up)
            if largest is not None and mistake and largest.holds(samples).mean() > 2 * share:
                raise ObservationError(f"the largest plane in view is not level: {mistake} Or up is another direction")
        return plane

    def _above(self) -> Float | None:
        """A point that is known to be above the support plane."""
        if self.box is not None:
            quarter = (self.box.low + self.box.high) / 2
            quarter[2] = self.box.low[2] + (self.box.high[2] - self.box.low[2]) / 4
            return quarter @ self.box.axes
        return self.point if self.known is None else self.known.centre - 0.2 * self.known.radius * self.known.axes[2]

    # Which pixels are the object's

    def _find(self, frame: Frame, axes: Float, plane: Plane | None, samples: Samples, noise: Noise) -> list[Sighting]:
        """The sightings so far, mended where a cluster has grown, and that of a new frame."""
        if frame.mask is not None:
            return [*self.sightings, self._sighting(frame, frame.mask, plane, noise)]
        if self.known is not None:
            if self.box is not None:
                mask = segmentation.inside_box(frame, self.box)
            else:
                mask = segmentation.inside_sphere(frame, self.known.centre, 1.02 * self.known.radius)
            if plane is not None:
                mask &= segmentation.above_plane(frame, plane, noise)
            if mask.sum() < FEWEST:
                raise ObservationError("nothing is seen where the object should be: a wrong pose, or a wrong box?")
            return [*self.sightings, self._sighting(frame, mask, plane, noise)]
        return self._on_the_plane(frame, axes, plane, samples, noise)

    def _on_the_plane(
        self, frame: Frame, axes: Float, plane: Plane | None, samples: Samples, noise: Noise
    ) -> list[Sighting]:
        if plane is None:
            raise ObservationError(
                "no support plane is seen below the camera: give a mask or a box, or check the pose (inverse? OpenGL "
                "axes?) and which way is up"
            )
        above = segmentation.above_plane(frame, plane, noise)
        ground = plane.extent(samples) @ axes[:2].T
        if not self._cell or not self.sightings:
            self._cell = segmentation.CELL * self._distance(frame, sample(frame, above, noise), ground, axes)
        foot = segmentation.footprint(frame, above, axes, self._cell)
        labels = segmentation.clusters([*(s.footprint for s in self.sightings if s.footprint is not None), foot])
        target = self._target(labels, foot, ground, axes)
        chosen = labels[-1] == target
        mask = foot.pixels_over(chosen)
        if target == 0 or mask.sum() < FEWEST:
            where = "of the object known so far" if self.sightings else "on the support plane"
            raise ObservationError(f"this frame shows nothing {where}: check its pose, or aim the camera at the object")
        sightings: list[Sighting] = []
        old_labels = iter(labels[:-1])
        for s in self.sightings:
            if s.footprint is not None and s.chosen is not None:
                now = next(old_labels) == target
                changed = s.footprint.pixels[now != s.chosen].sum()
                if s.frame.mask is None and changed > MENDED * s.footprint.pixels[s.chosen].sum() and now.any():
                    mended = self._sighting(s.frame, s.footprint.pixels_over(now), s.plane, s.noise)
                    s = replace(mended, footprint=s.footprint, chosen=now)
            sightings.append(s)
        new = self._sighting(frame, mask, plane, noise)
        return [*sightings, replace(new, footprint=foot, chosen=chosen)]

    def _distance(self, frame: Frame, above: Samples, ground: Float, axes: Float) -> float:
        """About how far the object is from the camera, metres."""
        camera = frame.camera_to_world[:3, 3]
        if self.point is not None:
            distance = float(np.linalg.norm(self.point - camera))
            if distance < NEAREST:
                raise ObservationError(
                    f"the point of the object lies {distance:.2g} m from the camera: is it in the world, in metres?"
                )
            return distance
        on = above.points[segmentation.on_ground(above.points @ axes[:2].T, ground)]
        return float(np.median(np.linalg.norm(on - camera, axis=1))) if len(on) else 1.0

    def _target(self, labels: list[NDArray[np.int64]], foot: Footprint, ground: Float, axes: Float) -> int:
        """The object's label: that of most cells that were the object's before; else by the point; else the largest."""
        before = [s.chosen for s in self.sightings if s.chosen is not None]
        votes = np.concatenate([[0], *(now[then] for now, then in zip(labels[:-1], before, strict=True))]).astype(int)
        count = np.bincount(votes)
        count[0] = 0
        if count.any():
            return int(count.argmax())
        point = self.object_frame.centre if self.sightings else self.point
        if point is not None:
            return segmentation.nearest(foot, labels[-1], axes[:2] @ point / self._cell)
        return segmentation.largest(foot, labels[-1], ground / self._cell)

    def _sighting(self, frame: Frame, mask: Mask, plane: Plane | None, noise: Noise) -> Sighting:
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        height, width = frame.shape
        top, bottom = max(rows[0] - 2, 0), min(rows[-1] + 3, height)
        left, right = max(columns[0] - 2, 0), min(columns[-1] + 3, width)
        part = slice(top, bottom), slice(left, right)
        coarse = max(1, max(bottom - top, right - left) // SIZE)
        facets = fit_facets(frame.depth[part], mask[part], frame.intrinsics, (top, left), self.denoise, coarse, noise)
        if len(facets.planes) * coarse**2 < FEWEST:
            raise ObservationError("too little is seen of the object")
        pose = frame.camera_to_world
        points = facets.points[:: max(1, len(facets.planes) // 3000)] @ pose[:3, :3].T + pose[:3, 3]
        with suppress(QhullError):  # all in one plane: they do as they are
            points = points[ConvexHull(points).vertices]
        return Sighting(frame, noise, facets, mask, points, plane, None, None)

    # Where the object is, and how it looks from there

    def _estimate(self, sightings: Sequence[Sighting], axes: Float) -> ObjectFrame:
        if self.known is not None:
            return self.known
        points = np.concatenate([s.hull for s in sightings])
        planes = [s.plane for s in sightings if s.plane is not None]
        floor = None
        if planes:
            # Height of the planes along up, where the object is: they may lean a little.
            here = points.mean(0)
            floor = float(np.median([axes[2] @ here - p.height(here) / (p.normal @ axes[2]) for p in planes]))
        return enclose(points, axes, floor)

    def _observe(self, sighting: Sighting, found: ObjectFrame) -> Observation:
        pose = found.pose_in_object(sighting.frame.camera_to_world)
        depth, facet = look_again(sighting.facets, pose, found.radius, SIZE)
        image = None
        if sighting.frame.image is not None:
            facets = sighting.facets
            image = np.where(facet >= 0, sighting.frame.image[facets.rows[facet], facets.columns[facet]], 0)
        radius, scene = found.radius if self.life_size else None, _scene(sighting, pose, found.radius)
        return _observation(depth, virtual_pose(pose), radius, image, scene)


def _towards(frame: Frame, up: Float) -> Float:
    """Direction from what a camera looks at towards the camera; from above that of the bottom of its image."""
    pose = frame.camera_to_world
    return -pose[:3, 2] if abs(pose[:3, 2] @ up) < 0.99 else pose[:3, 1]


def _observation(
    depth: NDArray[np.float32], pose: Float, radius: float | None, image: NDArray[np.uint8] | None, scene: SceneView
) -> Observation:
    """The only place that makes one."""
    intrinsics = pinhole(SIZE, DISTANCE)
    return Observation(depth, pose, intrinsics, radius, image, scene)


def _scene(sighting: Sighting, pose: Float, radius: float) -> SceneView:
    """All that a frame shows, from a pose in the object frame, in object radii; no finer than it has to be."""
    k = sighting.frame.intrinsics.copy()
    step = max(1, int(FINEST * min(k[0, 0], k[1, 1]) / max(float(np.linalg.norm(pose[:3, 3])), 1.0)))
    k[:2] /= step
    k[:2, 2] += 0.5 - (step // 2 + 0.5) / step
    few = (slice(step // 2, None, step),) * 2
    return SceneView(sighting.frame.depth[few] / np.float32(radius), sighting.mask[few], pose, k)


def _same(new: ObjectFrame, old: ObjectFrame) -> bool:
    moved = np.linalg.norm(new.centre - old.centre) / old.radius
    return bool(moved < SAME and abs(new.radius / old.radius - 1) < SAME and np.allclose(new.axes, old.axes))
