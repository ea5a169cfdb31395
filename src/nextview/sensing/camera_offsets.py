"""Estimate the errors of the poses of several cameras from what they see in common.

A camera on a stand or on an arm is calibrated to a base (extrinsic or hand-eye calibration). An
error of this calibration is a rigid motion in the camera's own axes that is the same for all of its
frames. The surfaces of frames of different cameras are aligned along their normals (point to plane,
Chen and Medioni, "Object modelling by registration of multiple range images", 1992), for all
cameras together. The first camera is the reference: an error that all cameras have in common cannot
be seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from nextview.errors import ObservationError
from nextview.sensing.agreement import LEAST_DEPTH, NOISE_TOLERANCE
from nextview.sensing.displacement import (
    ALIKE,
    CAMERA_AIM,
    CAMERA_PLACE,
    FARTHEST_SHIFT,
    FEWEST_PULLS,
    FURTHER,
    OUTLINE_PITCHES,
    PLANE_ERROR,
    RELATIVE_DEPTH_ERROR,
    SAME_SIDE,
)
from nextview.sensing.facets import Noise, noise_of
from nextview.sensing.frame import Frame
from nextview.sensing.planes import Plane, find_plane, sample
from nextview.sensing.sighting import sighting_of
from nextview.types import Float, Index, Mask

# Standard deviations at which the weight of a distance is a quarter, in each step, and beyond which
# it is 0. They end lower than those of a single object: of the many points of a whole frame those
# that agree best may decide, and wrong pairs, at edges, are many too.
CAMERA_REACHES = (4.0, 2.5, 1.0, 0.5, 0.3)
FARTHEST_PAIR = 2.0
WHOLE_POINTS = 4000  # points of a frame that are compared with each other frame
STEPS_PER_REACH = 3  # more than for an object, as a camera also turns
FALSE_ALARMS = 0.001  # share of exact cameras that are reported
MOTION = 6  # unknowns of a camera: rotation vector and translation


@dataclass(frozen=True, eq=False)
class CameraOffset:
    """Error of the poses of a camera, relative to those of the first camera.

    Attributes:
        camera: its name.
        reference: name of the first camera.
        motion: from the stated to the actual pose, in the camera's axes: rotation vector, radians,
            and translation, metres, (6,).
        covariance: of ``motion``, (6, 6).
    """

    camera: str
    reference: str
    motion: Float
    covariance: Float

    @property
    def millimetres(self) -> float:
        """Length of the translation, millimetres."""
        return 1000 * float(np.linalg.norm(self.motion[3:]))

    @property
    def degrees(self) -> float:
        """Angle of the rotation, degrees."""
        return float(np.degrees(np.linalg.norm(self.motion[:3])))

    @property
    def uncertainty(self) -> tuple[float, float]:
        """Standard deviations of translation, millimetres, and rotation, degrees, on each axis."""
        variances = np.diagonal(self.covariance)
        turn = np.sqrt(variances[:3].mean())
        shift = np.sqrt(variances[3:].mean())
        return 1000 * float(shift), float(np.degrees(turn))

    @property
    def noticed(self) -> bool:
        """True if the error exceeds its uncertainty."""
        squared = self.motion @ np.linalg.solve(self.covariance, self.motion)
        return bool(squared > chdtri(MOTION, FALSE_ALARMS))

    @property
    def correction(self) -> Float:
        """Matrix, (4, 4), by which a stated pose is multiplied from the right."""
        return _rigid(self.motion)

    def __str__(self) -> str:
        shift, turn = self.uncertainty
        return (
            f"camera {self.camera} is {self.millimetres:.1f} mm and {self.degrees:.2f} degrees off"
            f" (each axis within {shift:.1f} mm and {turn:.2f} degrees), relative to camera"
            f" {self.reference}"
        )


def camera_offsets(moments: Sequence[Sequence[Frame]]) -> list[CameraOffset]:
    """Estimate the error of each camera relative to the first one.

    Args:
        moments: frames of several cameras that show the same scene, for each of some moments. All
            frames have poses.

    Returns:
        The errors of all cameras but the first, in the order of their first frames. A camera that
        sees too little of what others see is left out.
    """
    names = list(dict.fromkeys(frame.camera for frames in moments for frame in frames))
    pairs = []
    for frames in moments:
        seen = [_Surface.of(frame, names.index(frame.camera)) for frame in frames]
        shown = [surface for surface in seen if surface is not None]
        pairs += [
            (one, other)
            for one, other in permutations(shown, 2)
            if one.camera != other.camera
        ]
    return _registered(pairs, names)


@dataclass(frozen=True, eq=False)
class _Surface:
    """Everything that a frame shows, in the axes of its camera.

    Attributes:
        camera: its number.
        pose: as stated, camera-to-world, (4, 4).
        points: of the surface, (N, 3), metres.
        normals: there, (N, 3).
        deviations: standard deviations of the points along their normals, (N,), metres.
        flat: whether a point is on a large plane, (N,) bool.
        rays: slopes of the rays through the points, for the search of the nearest one.
        reach: largest distance of a ray from that of the nearest point, at depth 1.
        compared: points that are compared with other frames, (K,).
    """

    camera: int
    pose: Float
    points: Float
    normals: Float
    deviations: Float
    flat: Mask
    rays: cKDTree
    reach: float
    compared: Index

    @classmethod
    def of(cls, frame: Frame, camera: int) -> _Surface | None:
        """Return the surface of everything in a frame; None if too little is visible."""
        pose = frame.camera_to_world
        frame = frame.with_pose(np.eye(4))
        noise = noise_of(frame)
        try:
            facets = sighting_of(frame, frame.depth > 0, None, noise).facets
        except ObservationError:
            return None

        # A facet of a curved surface lies behind it: only its normal is used, with the measured
        # depth.
        depth = frame.depth[facets.rows, facets.columns].astype(np.float64)
        off = np.abs(depth - facets.points[:, 2])
        kept = (depth > 0) & (off < _tolerance(depth, noise))
        facets = facets.some(kept)
        depth = depth[kept]
        points = facets.rays * depth[:, None]
        normals = -facets.planes / np.linalg.norm(facets.planes, axis=1, keepdims=True)
        by_noise = noise.at(depth) * depth**2
        deviations = np.hypot(by_noise, RELATIVE_DEPTH_ERROR * depth)

        # The points of a large plane get its normal: the noise of single normals would outweigh
        # the few points that tell how the frames are shifted along the plane.
        flat = np.zeros(len(points), bool)
        for plane in _planes(frame, noise):
            height = plane.height(points)
            on = np.abs(height) < _tolerance(depth, noise)
            on &= (normals @ plane.normal > SAME_SIDE) & ~flat
            points[on] -= height[on, None] * plane.normal
            normals[on] = plane.normal
            flat |= on

        kinds = [np.flatnonzero(flat == kind) for kind in (False, True)]
        few = [rows[:: 1 + len(rows) // WHOLE_POINTS] for rows in kinds]
        return cls(
            camera=camera,
            pose=pose,
            points=points,
            normals=normals,
            deviations=np.where(flat, PLANE_ERROR * depth, deviations),
            flat=flat,
            rays=cKDTree(facets.rays[:, :2]),
            reach=OUTLINE_PITCHES * float(facets.pitch.mean()),
            compared=np.concatenate(few),
        )

    def equations(
        self,
        other: _Surface,
        poses: Float,
        further: float,
        reach: float,
    ) -> _Equations:
        """Return the equations of the distances of another frame's points to this surface.

        Args:
            other: the surface of the other frame.
            poses: corrections of the poses of all cameras, (C, 4, 4).
            further: additional tolerance of the points, metres.
            reach: standard deviations at which a distance has a quarter of its weight.
        """
        here = self.pose @ poses[self.camera]
        there = np.linalg.inv(here) @ other.pose @ poses[other.camera]
        own = other.points[other.compared]
        points = own @ there[:3, :3].T + there[:3, 3]
        ahead = points[:, 2] > LEAST_DEPTH
        rays = points[:, :2] / np.where(ahead, points[:, 2], 1.0)[:, None]
        away, nearest = self.rays.query(rays)

        # The mean of both normals has less noise, unless one of them is that of a plane.
        one = self.normals[nearest]
        two = other.normals[other.compared] @ there[:3, :3].T
        flat_one = self.flat[nearest]
        flat_two = other.flat[other.compared]
        normals = np.where((flat_two & ~flat_one)[:, None], 0, one)
        normals += np.where((flat_one & ~flat_two)[:, None], 0, two)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)

        off = np.einsum("ni,ni->n", normals, self.points[nearest] - points)
        deviations = np.hypot(
            self.deviations[nearest],
            other.deviations[other.compared],
        )
        scale = np.hypot(deviations, further)
        met = ahead & (away < self.reach) & (np.abs(off) < FARTHEST_PAIR * scale)
        met &= np.einsum("ni,ni->n", one, two) > SAME_SIDE

        weights = 1 / (1 + (off / (reach * scale)) ** 2) ** 2 / scale**2
        both_flat = flat_one & flat_two
        for kind in (both_flat, ~both_flat):
            weights[kind] *= min(1.0, ALIKE / max(1, int(np.count_nonzero(met & kind))))

        coefficients = np.zeros((np.count_nonzero(met), MOTION * len(poses)))
        back = normals[met] @ there[:3, :3]
        for surface, at, towards in (
            (other, own[met], back),
            (self, points[met], -normals[met]),
        ):
            columns = slice(MOTION * surface.camera, MOTION * (surface.camera + 1))
            coefficients[:, columns] = np.hstack([np.cross(at, towards), towards])
        return _Equations(coefficients, off[met], weights[met])


@dataclass(frozen=True, eq=False)
class _Equations:
    """Linear equations ``coefficients @ motions = distances``, with weights.

    ``coefficients`` is (M, 6 C) for C cameras, the others (M,); metres.
    """

    coefficients: Float
    distances: Float
    weights: Float


def _tolerance(depth: Float, noise: Noise) -> Float:
    """Largest distance, metres, of points at some depths from a surface that they belong to."""
    return NOISE_TOLERANCE * noise.at(depth) * depth**2 + RELATIVE_DEPTH_ERROR * depth


def _planes(frame: Frame, noise: Noise) -> list[Plane]:
    """Return the large planes of a frame, those with most points first."""
    rng = np.random.default_rng(0)
    left = sample(frame, frame.depth > 0, noise)
    found: list[Plane] = []
    while (plane := find_plane(left, rng)) is not None:
        found.append(plane)
        left = left.some(~plane.holds(left))
    return found


def _registered(
    pairs: Sequence[tuple[_Surface, _Surface]],
    names: Sequence[str],
) -> list[CameraOffset]:
    """Register pairs of frames by Gauss-Newton steps over the motions of all cameras."""
    count = len(names)
    variances = np.repeat([CAMERA_AIM**2, CAMERA_PLACE**2], 3) * FARTHEST_SHIFT**2
    prior = np.tile(1 / variances, count - 1)
    poses = np.tile(np.eye(4), (count, 1, 1))
    motions = np.zeros((count, MOTION))
    information = np.diag(prior)
    met = np.zeros(count, np.int64)

    for step in np.repeat(np.arange(len(CAMERA_REACHES)), STEPS_PER_REACH):
        further = FURTHER[step] * FARTHEST_SHIFT * CAMERA_PLACE
        square = np.zeros((MOTION * count, MOTION * count))
        pull = np.zeros(MOTION * count)
        met[:] = 0
        for one, other in pairs:
            rows = one.equations(other, poses, further, CAMERA_REACHES[step])
            weighted = rows.coefficients.T * rows.weights
            square += weighted @ rows.coefficients
            pull += weighted @ rows.distances
            met[[one.camera, other.camera]] += len(rows.distances)

        # the first camera is the reference
        information = square[MOTION:, MOTION:] + np.diag(prior)
        towards = pull[MOTION:] - prior * motions[1:].ravel()
        change = np.asarray(np.linalg.solve(information, towards), np.float64)
        for number, motion in enumerate(change.reshape(-1, MOTION), 1):
            poses[number] = poses[number] @ _rigid(motion)
            turn = Rotation.from_matrix(poses[number, :3, :3]).as_rotvec()
            motions[number] = [*turn, *poses[number, :3, 3]]

    covariances = np.asarray(np.linalg.inv(information), np.float64)
    covariances = covariances.reshape(2 * (count - 1, MOTION))
    return [
        CameraOffset(
            names[number],
            names[0],
            motions[number],
            covariances[number - 1, :, number - 1],
        )
        for number in range(1, count)
        if met[number] >= FEWEST_PULLS
    ]


def _rigid(motion: Float) -> Float:
    """Return the matrix, (4, 4), of a rotation vector and a translation, (6,)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(motion[:3]).as_matrix()
    pose[:3, 3] = motion[3:]
    return pose
