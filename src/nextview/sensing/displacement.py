"""Measure the displacement of an object in a frame relative to earlier frames.

The pose of a camera on an arm has errors: hand-eye calibration, joint angles and time stamps are
inexact, and the object may have been pushed. The surfaces of both frames are aligned along their
normals (point to plane, Chen and Medioni, "Object modelling by registration of multiple range
images", 1992) and by their outlines, with robust Gauss-Newton steps. An error of the camera's
orientation also rotates the object, but so little for its size that only a translation is
estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from nextview.sensing.facets import Facets
from nextview.sensing.sighting import Sighting
from nextview.types import Float, Index, Mask

CAMERA_PLACE = 0.003  # metres, standard deviation of the camera position
CAMERA_AIM = 0.006  # radians, standard deviation of the viewing direction
FARTHEST_SHIFT = (
    5.0  # standard deviations beyond which a shift is not a calibration error
)
DISPLACEMENT_POINTS = 200  # points of a surface that are compared with another frame
FACETS = 3000  # of a surface to which points are compared
COMPARED_FRAMES = 2  # earlier frames with the most similar viewing directions
ALIKE = 60.0  # effective number of independent points, as neighbouring errors are correlated
RELATIVE_DEPTH_ERROR = 0.003  # relative error of the depth, in addition to the noise
PLANE_ERROR = 0.002  # error of the height of a support plane, relative to the distance
OUTLINE_PITCHES = 1.5  # uncertainty of an outline, in spacings of the facets
NOT_HIDDEN = (
    0.02  # least relative depth of the background behind a point that is seen past
)
SAME_SIDE = (
    0.8  # cosine of the largest angle between normals of one surface in two frames
)
REACHES = (4.0, 2.5, 1.5, 1.0, 1.0)
"""Standard deviations at which a residual has half its weight, in each step."""
FURTHER = (1.0, 0.6, 0.3, 0.0, 0.0)
"""Additional tolerance of the points in each step, as a share of the expected shift."""
WORST_FIT = np.log(2)
"""Largest mean of log(1 + squared deviation) after the last step: one standard deviation. Surfaces
that have moved far do not fit."""
FEWEST_PULLS = 20  # least number of residuals
DEPTH_ERROR = 0.01
"""Metres at a distance of 1 m, standard deviation of a shift due to depth errors common to all
pixels; it grows with the square of the distance. For a real Kinect with exact poses one shift in
twenty is larger than twice this value.
"""
# a shift is corrected if it exceeds the noise by so many standard deviations
MENDED_DEVIATIONS = 3.0
# relative to the distance from the camera: smaller shifts are not corrected
LEAST_MENDED = 0.006
NOT_WORTH = 0.3  # as a share of the smallest shift that is corrected
# a shift is reported if it exceeds noise and depth errors by so many standard deviations
DISPLACEMENT_NOTICED = 2.5


@dataclass(frozen=True)
class Displacement:
    """Displacement of an object in a frame relative to earlier frames.

    Attributes:
        shift: of the visible surface, (3,), world, metres.
        further: shift relative to the last of the earlier frames, with the original poses of both,
            (3,), metres.
        covariance: of the shift, (3, 3), square metres.
        distance: of the object from the camera, metres.
        lasting: whether the object is where the last of the earlier frames showed it displaced.
    """

    shift: Float
    further: Float
    covariance: Float
    distance: float
    lasting: bool

    @property
    def length(self) -> float:
        """Length of ``further``, metres."""
        return float(np.linalg.norm(self.further))

    @property
    def mended(self) -> bool:
        """True if the shift exceeds the noise of the frames and is to be corrected."""
        large = float(np.linalg.norm(self.shift)) > LEAST_MENDED * self.distance
        return large and (
            self.lasting or _deviations(self.shift, self.covariance) > MENDED_DEVIATIONS
        )

    @property
    def noticed(self) -> bool:
        """True if ``further`` exceeds noise and depth errors, and is to be reported."""
        common = (DEPTH_ERROR * self.distance**2) ** 2 * np.eye(3)
        return (
            self.mended
            and _deviations(self.further, self.covariance + common)
            > DISPLACEMENT_NOTICED
        )


def _deviations(shift: Float, covariance: Float) -> float:
    """Return the length of a shift in standard deviations."""
    return float(np.sqrt(shift @ np.linalg.solve(covariance, shift)))


@dataclass(frozen=True)
class _ShiftEquations:
    """Linear equations ``directions @ shift = distances`` with standard deviations.

    ``directions`` is (N, 3), the others (N,); metres.
    """

    directions: Float
    distances: Float
    deviations: Float


def displacement(latest: Sighting, earlier: Sequence[Sighting]) -> Displacement | None:
    """Estimate the displacement of an object relative to earlier frames.

    Args:
        latest: sighting in the new frame.
        earlier: sightings in earlier frames, in order, at least one. The search starts at 0 and at
            the displacement of the last of them, since a pushed object stays displaced.

    Returns:
        The displacement; None if the common surface is too small or the displacement too large.
    """
    there = [sighting for sighting in earlier if len(sighting.facets.planes)]
    if not there or not len(latest.facets.planes):
        return None

    ahead = latest.frame.camera_to_world[:3, 2]
    there.sort(key=lambda one: -float(ahead @ one.frame.camera_to_world[:3, 2]))
    surface = _Surface.of(latest)
    others = [_Surface.of(sighting) for sighting in there[:COMPARED_FRAMES]]
    last = -earlier[-1].shift
    starts = [np.zeros(3), last] if last.any() else [last]
    found = [_searched(surface, others, start) for start in starts]
    best = min(
        (one for one in found if one is not None),
        key=lambda one: one.cost,
        default=None,
    )
    if best is None:
        return None
    lasting = bool(last.any()) and best is found[-1]
    return Displacement(
        best.shift,
        best.shift - last,
        best.covariance,
        surface.distance,
        lasting,
    )


@dataclass(frozen=True)
class _Surface:
    """The facets of a sighting in the world frame, with their pixels."""

    sighting: Sighting
    facets: Facets
    points: Float
    normals: Float
    deviations: Float
    rays: cKDTree
    pitch: float
    sample: Index

    @classmethod
    def of(cls, sighting: Sighting) -> _Surface:
        facets = sighting.facets
        coarse = max(
            1,
            round(float(facets.pitch[0]) * float(sighting.frame.intrinsics[0, 0])),
        )
        side = int(np.ceil(np.sqrt(len(facets.rows) / FACETS)))
        if side > 1:
            kept = (facets.rows // coarse % side == 0) & (
                facets.columns // coarse % side == 0
            )
            facets = replace(facets.some(kept), pitch=side * facets.pitch)
        turn = sighting.frame.camera_to_world[:3, :3]
        points = facets.points
        depth = points[:, 2]
        normals = -facets.planes / np.linalg.norm(facets.planes, axis=1, keepdims=True)
        noise = sighting.noise.at(depth) * depth**2
        every = max(1, len(depth) // DISPLACEMENT_POINTS)

        return cls(
            sighting=sighting,
            facets=facets,
            points=points @ turn.T + sighting.frame.camera_to_world[:3, 3],
            normals=normals @ turn.T,
            deviations=np.hypot(noise, RELATIVE_DEPTH_ERROR * depth),
            rays=cKDTree(facets.rays[:, :2]),
            pitch=float(facets.pitch.mean()),
            sample=np.arange(every // 2, len(depth), every),
        )

    @property
    def distance(self) -> float:
        """Distance from the camera, metres."""
        camera = self.sighting.frame.camera_to_world[:3, 3]
        return float(np.linalg.norm(np.median(self.points, 0) - camera))

    def pulls(self, other: _Surface, shift: Float, reach: float) -> _ShiftEquations:
        """Return the residuals between this surface and the shifted points of another surface.

        Args:
            other: the other surface.
            shift: of the other surface, world, (3,), metres.
            reach: distance beyond which points are ignored, metres.

        Returns:
            The equations for the shift.
        """
        pose = self.sighting.frame.camera_to_world
        points = other.points[other.sample] + shift
        inside = (points - pose[:3, 3]) @ pose[:3, :3]
        z = np.maximum(inside[:, 2], 1e-6)
        rays = inside[:, :2] / z[:, None]
        away, nearest = self.rays.query(rays)

        met = away < OUTLINE_PITCHES * self.pitch
        normals = self.normals[nearest]
        off = np.einsum("ni,ni->n", normals, self.points[nearest] - points)
        alike = np.einsum("ni,ni->n", normals, other.normals[other.sample]) > SAME_SIDE
        deviations = np.hypot(self.deviations[nearest], other.deviations[other.sample])
        on = met & alike & (np.abs(off) < 3 * (deviations + reach))

        outside = ~met & self._looks_past(rays, z)
        aside = (self.facets.rays[nearest, :2] - rays) * z[:, None]
        length = np.maximum(np.linalg.norm(aside, axis=1), 1e-9)
        towards = (aside / length[:, None]) @ pose[:3, :2].T
        slack = OUTLINE_PITCHES * self.pitch * z
        return _ShiftEquations(
            np.concatenate([normals[on], towards[outside]]),
            np.concatenate([off[on], (length - slack)[outside]]),
            np.concatenate([deviations[on], np.hypot(slack, deviations)[outside]]),
        )

    def _looks_past(self, rays: Float, z: Float) -> Mask:
        """Return where the frame measures something behind points.

        The points are given by their rays, (N, 2), and depths.
        """
        frame = self.sighting.frame
        at = frame.pinhole.project(np.column_stack([rays, np.ones(len(rays))]))
        column, row = np.floor(at).astype(int).T
        height, width = frame.shape
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        depth = frame.depth[np.where(inside, row, 0), np.where(inside, column, 0)]
        return inside & (depth > (1 + NOT_HIDDEN) * z)


@dataclass(frozen=True)
class _Fit:
    """An estimated shift, (3,), metres, its covariance, (3, 3), and its residual."""

    shift: Float
    covariance: Float
    cost: float


def _searched(
    latest: _Surface,
    earlier: Sequence[_Surface],
    start: Float,
) -> _Fit | None:
    """Optimise a shift from a start value.

    Returns None if there are too few residuals, the shift is too large, or the surfaces do not fit.
    """
    expected = float(np.hypot(CAMERA_PLACE, CAMERA_AIM * latest.distance))
    looked_up = sum(len(one.sample) + len(latest.sample) for one in earlier)
    moved = -start
    information = np.eye(3) / expected**2
    cost = np.inf
    for reach, part in zip(REACHES, FURTHER, strict=True):
        further = part * expected
        pulls = [one.pulls(latest, moved, further) for one in earlier]
        pulls += [_reversed(latest.pulls(one, -moved, further)) for one in earlier]
        pulls.append(_heights(latest, earlier, moved))
        directions, distances, deviations = (
            np.concatenate([getattr(pull, name) for pull in pulls])
            for name in ("directions", "distances", "deviations")
        )
        if len(distances) < FEWEST_PULLS:
            return None

        scale = np.hypot(deviations, further)
        robust = 1 / (1 + (distances / (reach * scale)) ** 2)
        weight = robust / scale**2 * min(1.0, ALIKE / looked_up)
        information = (directions.T * weight) @ directions + np.eye(3) / expected**2
        pull = (directions.T * weight) @ distances - (moved + start) / expected**2
        moved = moved + np.linalg.solve(information, pull)
        if (
            part == FURTHER[1]
            and np.linalg.norm(moved) < NOT_WORTH * LEAST_MENDED * latest.distance
        ):
            break  # after two small steps no shift that is corrected would be found
        cost = float(np.log1p((distances / deviations) ** 2).mean())
    shift = -moved
    if np.linalg.norm(shift - start) > FARTHEST_SHIFT * expected or cost > WORST_FIT:
        return None
    return _Fit(shift, np.asarray(np.linalg.inv(information), np.float64), cost)


def _reversed(pulls: _ShiftEquations) -> _ShiftEquations:
    """Return the same residuals for the shift of the other surface."""
    return _ShiftEquations(-pulls.directions, pulls.distances, pulls.deviations)


def _heights(
    latest: _Surface,
    earlier: Sequence[_Surface],
    moved: Float,
) -> _ShiftEquations:
    """Return the height differences of the shifted support plane to those of earlier frames."""
    plane = latest.sighting.plane
    here = latest.points.mean(0)
    others = [one.sighting.plane for one in earlier if one.sighting.plane is not None]
    if plane is None or not others:
        return _ShiftEquations(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    foot = here - plane.height(here) * plane.normal + moved
    below = -np.array([float(other.height(foot)) for other in others])
    normals = np.array([other.normal for other in others])
    leans = np.array(
        [float(np.hypot(plane.lean_error, other.lean_error)) for other in others]
    )

    return _ShiftEquations(
        normals,
        below,
        latest.distance * np.hypot(PLANE_ERROR, leans),
    )
