"""Likelihood of the pixels of a frame if an object is in some place, or nowhere in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from nextview.recognition.poses import PoseCandidate
from nextview.sensing.frame import Frame, Part
from nextview.sensing.sighting import Sighting
from nextview.sensing.tabletop import TableTop
from nextview.session.tracks import caster_of, window_around
from nextview.things.expected_images import LOWEST_COSINE
from nextview.things.registration import RegistrationPrior, scan_errors
from nextview.things.surface import SurfaceCaster
from nextview.things.verification import PixelModel
from nextview.types import Float, Float32, Index

DEPTH_RANGE = 1.0  # metres over which depth is spread that nothing known explains
COMPARED_SIDE = 36  # rows and columns of pixels in which an object is compared
MOTION_STEPS = (0.012, 0.006, 0.003, 0.0015, 0.001)  # metres, steps of a fit
STEP_ROUNDS = 3  # largest number of rounds with each step
ROUND_GAIN = 0.5  # nats that a round has to gain for another one
# largest number, as neighbours err alike
INDEPENDENT_PIXELS = RegistrationPrior().pixels
SEEN_THROUGH = float(np.exp(PixelModel().outlier))  # share of pixels


@dataclass(frozen=True, eq=False)
class MotionFit:
    """The likeliest motion of an object.

    Attributes:
        motion: rotation vector about its centre, radians, and shift, metres, (6,).
        information: of the pixels on it, (6, 6).
        gain: log-likelihood of the pixels, against that without the object.
    """

    motion: Float
    information: Float
    gain: float

    @classmethod
    def none(cls) -> MotionFit:
        """Return that of an object that was not looked for."""
        return cls(np.zeros(6), np.zeros((6, 6)), 0.0)

    def evidence(self, mean: Float, covariance: Float) -> float:
        """Log-likelihood of the pixels over all motions, against that without the object.

        This is Laplace's approximation of the integral (MacKay, "Bayesian interpolation", 1992): a
        hypothesis that leaves the motion open has to gain more than this freedom costs.

        Args:
            mean: of the motions, (6,).
            covariance: of the motions, (6, 6).
        """
        off = self.motion - mean
        worth = self.gain - 0.5 * off @ np.linalg.solve(covariance, off)
        _, volume = np.linalg.slogdet(np.eye(6) + covariance @ self.information)
        return float(worth - 0.5 * volume)


@dataclass(frozen=True, eq=False)
class PlacedSurface:
    """The surface of an object at its known place, and the pixels of a frame around it.

    Attributes:
        frame: the frame.
        posed: the surface in its pose.
        centre: of the object, about which it is turned, (3,), world, metres.
        radius: of the object, metres.
        rays: of the pixels in the camera frame, z = 1, (P, 3).
        depth: measured, (P,), metres, above 0.
        sigma: standard deviation of the depth, (P,), metres.
        without: log-density of the depth without the object, (P,).
        others: depth of other known objects, (K, P), metres, infinity beside them.
        weight: of each pixel, as neighbours err alike.
        area: pixels of the image for each one here.
    """

    frame: Frame
    posed: PoseCandidate
    centre: Float
    radius: float
    rays: Float
    depth: Float
    sigma: Float
    without: Float
    others: Float
    weight: float = 1.0
    area: int = 1

    @classmethod
    def of(
        cls, posed: PoseCandidate, top: TableTop, shift: Float | None = None
    ) -> PlacedSurface | None:
        """Cut out the pixels around an object; None if no pixel with depth can show it.

        Args:
            posed: a surface with vertices and faces, in its pose in the world.
            top: support surfaces of the frame.
            shift: the object may also be this far away, (3,), metres.
        """
        assert posed.vertices is not None
        frame = top.frame
        placed = posed.vertices @ posed.pose[:3, :3].T + posed.pose[:3, 3]
        corners = placed
        if shift is not None:
            corners = np.concatenate([placed, placed + shift])
        to_camera = np.linalg.inv(frame.camera_to_world)
        in_camera = corners @ to_camera[:3, :3].T + to_camera[:3, 3]
        part = window_around(in_camera, frame)
        if part is None:
            return None
        step = [max(1, (one.stop - one.start) // COMPARED_SIDE) for one in part]
        rays, depth = _pixels_of(frame, part, step)
        if not len(depth):
            return None

        centre = (placed.min(0) + placed.max(0)) / 2
        radius = float(np.linalg.norm(placed - centre, axis=1).max())
        sigma = np.hypot(top.noise.at(depth) * depth**2, scan_errors(radius))
        nothing = np.zeros((0, len(depth)))
        alone = cls(
            frame, posed, centre, radius, rays, depth, sigma, np.zeros(1), nothing
        )
        alone = alone.beside([], top)
        count = int(np.isfinite(alone.shown()).sum())
        independent = float(np.prod(np.minimum(1.0, np.array(step) / top.noise.grain)))
        weight = min(independent, INDEPENDENT_PIXELS / max(count, 1))
        return replace(alone, weight=weight, area=int(np.prod(step)))

    def weighed_like(self, other: PlacedSurface) -> PlacedSurface:
        """Return the same with the weights of another surface of the object.

        The likelihoods of two surfaces can be compared only if each pixel counts alike in both.

        Args:
            other: the other surface, in the same frame.
        """
        return replace(self, weight=other.weight * self.area / other.area)

    def beside(self, others: Sequence[PoseCandidate], top: TableTop) -> PlacedSurface:
        """Return the same among other known objects, which may hide it.

        Args:
            others: surfaces in their poses.
            top: support surfaces of the frame.
        """
        shown = [replace(self, posed=other).shown() for other in others]
        known = [_depth_of_plane(top, self.rays), *shown]
        off = np.min([np.abs(self.depth - one) for one in known], axis=0)
        return replace(
            self,
            others=np.reshape(shown, (-1, len(self.depth))),
            without=log_density(off, self.sigma, 0.5),
        )

    def pose(self, motion: Float) -> Float:
        """Pose of the surface after a motion, (6,), in the world, (4, 4)."""
        return np.asarray(self._poses(motion[None])[0])

    def _poses(self, motions: Float) -> Float:
        """Return the pose of the surface after each motion, (M, 4, 4)."""
        matrices = np.tile(np.eye(4), (len(motions), 1, 1))
        turns = Rotation.from_rotvec(motions[:, :3]).as_matrix()
        matrices[:, :3, :3] = turns
        matrices[:, :3, 3] = self.centre - turns @ self.centre + motions[:, 3:]
        return np.asarray(matrices @ self.posed.pose)

    def shown(self) -> Float:
        """Depth of the surface in its pose, (P,), metres, infinity beside it."""
        return np.asarray(self._cast(np.zeros((1, 6)))[0][0], np.float64)

    def gain(self, motion: Float) -> float:
        """Log-likelihood of the pixels after a motion, (6,), against that without the object."""
        return float(self._gains(motion[None]).sum())

    def slope(self, motion: Float, step: float) -> tuple[Float, Float]:
        """Compute how the gain depends on the motion.

        Args:
            motion: (6,).
            step: of the differences, metres.

        Returns:
            The gradient, (6,), and the information of the pixels on the motion, (6, 6): the sum of
            their squared gradients (Berndt, Hall, Hall and Hausman, 1974).
        """
        steps = step * self.lengths
        each = np.diag(steps)
        up, down = np.split(self._gains(motion + np.concatenate([each, -each])), 2)
        slopes = ((up - down) / (2 * steps)[:, None]).T
        # the weighted sum of squares of gradients that were weighted already
        return slopes.sum(0), np.asarray(slopes.T @ slopes / self.weight)

    @property
    def lengths(self) -> Float:
        """Motions, (6,), that displace the surface by a metre."""
        return np.repeat([1 / self.radius, 1.0], 3)

    def _gains(self, motions: Float) -> Float:
        """Return the gain of each pixel after each motion, (M, P)."""
        depths, slopes, hits = self._rendered(motions)
        _, pixels = hits
        depth = self.depth[pixels]
        sideways = depths / self.frame.intrinsics[0, 0] * slopes
        off = np.abs(depth - depths)
        for one in self.others:
            other = one[pixels]
            nearer = np.minimum(off, np.abs(depth - other))
            off = np.where(other < depths, nearer, off)
        # something unknown may hide the surface, but the camera rarely sees through it
        otherwise = np.where(depth < depths, 0.5, SEEN_THROUGH)
        found = log_density(off, np.hypot(self.sigma[pixels], sideways), otherwise)
        gains = np.zeros((len(motions), len(self.depth)))
        gains[hits] = self.weight * (found - self.without[pixels])
        return gains

    @cached_property
    def _caster(self) -> SurfaceCaster:
        return caster_of(self.posed)

    @cached_property
    def _directions(self) -> Float:
        """Unit vectors along the rays, (P, 3)."""
        return self.rays / np.linalg.norm(self.rays, axis=1, keepdims=True)

    def _cast(self, motions: Float) -> tuple[Float32, Float32, Float32]:
        """Return depth, (M, P), normals, (M, P, 3), and turns from the camera's axes, (M, 3, 3)."""
        to_camera = np.linalg.inv(self.frame.camera_to_world)
        poses = to_camera @ self._poses(motions)
        turns = poses[:, :3, :3].astype(np.float32)
        origins = -np.einsum("mji,mj->mi", poses[:, :3, :3], poses[:, :3, 3])
        depth, normals = self._caster.cast(
            np.zeros(len(motions), np.int64),
            origins.astype(np.float32),
            self.rays.astype(np.float32) @ turns,
        )
        return depth, normals, turns

    def _rendered(self, motions: Float) -> tuple[Float, Float, tuple[Index, Index]]:
        """Return what the rays that meet the surface see after each motion.

        Returns:
            Depth, (N,), metres; the tangent of the slope, (N,); and the motion and the pixel of
            each, (N,).
        """
        depth, normals, turns = self._cast(motions)
        rows, pixels = np.nonzero(np.isfinite(depth))
        hits = rows, pixels
        directions = (self._directions @ turns)[hits]
        inwards = np.einsum("ni,ni->n", normals[hits], directions)
        cosine = np.clip(np.abs(inwards), LOWEST_COSINE, 1)
        slope = np.sqrt(1 - cosine**2) / cosine
        return depth[hits].astype(np.float64), np.asarray(slope, np.float64), hits


def likeliest(
    surfaces: Sequence[PlacedSurface],
    ways: Sequence[tuple[Float, Float]],
    start: Float,
    mean: Float,
    covariance: Float,
) -> Float:
    """Find the likeliest value of a vector on which the motions of surfaces depend, (6,).

    Args:
        surfaces: in their known places.
        ways: matrix, (6, 6), and offset, (6,), from the vector to the motion of each surface.
        start: value with which the search starts, (6,).
        mean: expected value, (6,).
        covariance: of the expected value, (6, 6).
    """
    prior = np.linalg.inv(covariance)

    def worth(value: Float) -> float:
        gain = sum(
            surface.gain(matrix @ value + offset)
            for surface, (matrix, offset) in zip(surfaces, ways, strict=True)
        )
        return gain - float(0.5 * (value - mean) @ prior @ (value - mean))

    value = start.copy()
    here = worth(value)
    settled = 0.0  # step with which nothing is left to gain
    for step in np.repeat(MOTION_STEPS, STEP_ROUNDS):
        if step == settled:
            continue
        pull = -prior @ (value - mean)
        information = prior
        for surface, (matrix, offset) in zip(surfaces, ways, strict=True):
            slope, told = surface.slope(matrix @ value + offset, step)
            pull = pull + matrix.T @ slope
            information = information + matrix.T @ told @ matrix
        change = np.linalg.solve(information, pull)
        longest = max(
            np.abs(matrix @ change / surface.lengths).max()
            for surface, (matrix, _) in zip(surfaces, ways, strict=True)
        )
        change *= min(1.0, 4 * step / max(longest, 1e-12))
        before = here
        for part in (1.0, 0.5, 0.25):
            there = worth(value + part * change)
            if there > here:
                value = value + part * change
                here = there
                break
        if here < before + ROUND_GAIN:
            settled = step
    return value


def fitted(
    surface: PlacedSurface,
    start: Float,
    mean: Float,
    covariance: Float,
) -> MotionFit:
    """Find the likeliest motion of a surface, given what motions are expected.

    Args:
        surface: in its known place.
        start: motion with which the search starts, (6,).
        mean: of the expected motions, (6,).
        covariance: of the expected motions, (6, 6).
    """
    itself = (np.eye(6), np.zeros(6))
    motion = likeliest([surface], [itself], start, mean, covariance)
    _, information = surface.slope(motion, MOTION_STEPS[-1])
    return MotionFit(motion, information, surface.gain(motion))


def seen_surface(sighting: Sighting) -> PoseCandidate | None:
    """Triangulate the visible surface of an object, in the world; None if it is too small.

    Args:
        sighting: of the object.
    """
    frame = sighting.frame
    rows, columns = np.nonzero(sighting.mask)
    longest = max(len(np.unique(rows)), len(np.unique(columns)))
    step = max(1, -(-longest // COMPARED_SIDE))
    part = np.s_[
        rows.min() : rows.max() + 1 : step, columns.min() : columns.max() + 1 : step
    ]
    row, column = np.mgrid[part]
    depth = frame.depth[row, column]
    number = np.arange(depth.size).reshape(depth.shape)

    corners = np.stack(
        [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], -1
    ).reshape(-1, 4)
    of_corners = depth.ravel()[corners]
    inside = (sighting.mask[row, column] & (depth > 0)).ravel()[corners].all(1)
    steepest = step / frame.intrinsics[0, 0] * of_corners.max(1) / LOWEST_COSINE
    corners = corners[inside & (np.ptp(of_corners, axis=1) < steepest)]
    if not len(corners):
        return None
    used, faces = np.unique(corners[:, [[0, 1, 2], [0, 2, 3]]], return_inverse=True)
    points = frame.positions(row.ravel()[used], column.ravel()[used])
    return PoseCandidate(
        "",
        -1,
        np.eye(4),
        1.0,
        vertices=points.astype(np.float32),
        faces=faces.reshape(-1, 3).astype(np.int32),
    )


def log_density(off: Float, sigma: Float, otherwise: Float | float) -> Float:
    """Log-density of depths that are off a surface, or are otherwise anywhere.

    Args:
        off: distance from the surface along the ray, metres.
        sigma: standard deviation, metres.
        otherwise: share of the depths that are anywhere; half of them are on the surface.
    """
    peak = 0.5 / (np.sqrt(2 * np.pi) * sigma)
    with np.errstate(over="ignore", under="ignore"):
        near = peak * np.exp(-0.5 * (off / sigma) ** 2)
    return np.asarray(np.log(near + otherwise / DEPTH_RANGE))


def _pixels_of(frame: Frame, part: Part, step: Sequence[int]) -> tuple[Float, Float]:
    """Return rays, (P, 3), and depths, (P,), of pixels of a grid that have depth."""
    rows, columns = (
        np.arange(one.start, one.stop)[each // 2 :: each]
        for one, each in zip(part, step, strict=True)
    )
    row, column = (one.ravel() for one in np.meshgrid(rows, columns, indexing="ij"))
    seen = frame.depth[row, column] > 0
    row = row[seen]
    column = column[seen]
    rays = np.column_stack(
        (frame.rays[0][column], frame.rays[1][row], np.ones(len(row)))
    )
    depth = frame.depth[row, column]
    return rays.astype(np.float64), depth.astype(np.float64)


def _depth_of_plane(top: TableTop, rays: Float) -> Float:
    """Return the depth of the ground along rays, (P, 3), as (P,), metres, or infinity."""
    pose = top.frame.camera_to_world
    away = rays @ pose[:3, :3].T @ top.plane.normal
    height = top.plane.height(pose[:3, 3])
    return np.where(away < 0, -height / np.minimum(away, -1e-9), np.inf)
