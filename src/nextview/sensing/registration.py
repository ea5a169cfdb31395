"""Register what frames show: the error of a camera's pose, or the displacement of an object.

The surfaces of two frames are aligned along their normals (point to plane, Chen and Medioni,
"Object modelling by registration of multiple range images", 1992) with robust Gauss-Newton steps.

The pose of a camera on an arm has errors: hand-eye calibration, joint angles and time stamps are
inexact, and an object may have been pushed. Of an object a translation is estimated: an error of
the camera's orientation also rotates it, but little for its size. An error of the calibration of a
camera is a rigid motion in its own axes that is the same for all of its frames. It is estimated for
all cameras together, and relative to the first one: an error that all of them have in common cannot
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
from nextview.sensing.facets import Facets
from nextview.sensing.frame import Frame
from nextview.sensing.noise import Noise
from nextview.sensing.planes import find_plane, sample
from nextview.sensing.sighting import Sighting, sighting_of
from nextview.types import Float, Index, Mask

CAMERA_PLACE = 0.003  # metres, standard deviation of the camera position
CAMERA_AIM = 0.006  # radians, standard deviation of the viewing direction
# standard deviations beyond which a motion is not a calibration error
FARTHEST_MOTION = 5.0
DEPTH_SHARE = 0.003  # relative error of the depth, in addition to the noise
FEWEST_PULLS = 20  # least number of pairs of points
# standard deviations at which the weight of a distance is a quarter, in each step. Of the many
# points of a whole frame those that agree best may decide, and wrong pairs, at edges, are many too.
OF_OBJECT = 4.0, 2.5, 1.5, 1.0, 1.0
OF_CAMERA = 4.0, 2.5, 1.0, 0.5, 0.3
FURTHER = (
    1.0,
    0.6,
    0.3,
    0.0,
    0.0,
)  # additional tolerance, as a share of the farthest motion


def tolerance_of(depth: Float, noise: Noise, share: float = DEPTH_SHARE) -> Float:
    """Return how far points at some depths may be from their surface, metres.

    Args:
        depth: of the points, metres.
        noise: of their frame.
        share: relative error of the depth, in addition to three deviations of the noise.
    """
    return np.asarray(3.0 * noise.at(depth) * depth**2 + share * depth)


def deviations_of(motion: Float, covariance: Float) -> float:
    """Return the length of a motion, (6,), in standard deviations, by its covariance, (6, 6)."""
    return float(np.sqrt(motion @ np.linalg.solve(covariance, motion)))


@dataclass(frozen=True, eq=False)
class Surface:
    """What a frame shows, in the axes of its camera.

    Attributes:
        camera: its number.
        frame: with its stated pose.
        points: of the surface, (N, 3), metres.
        normals: there, (N, 3).
        deviations: standard deviations of the points along their normals, (N,), metres.
        flat: whether a point is on a large plane, (N,) bool.
        rays: slopes of the rays through the points, for the search of the nearest one.
        reach: largest distance of a ray from that of the nearest point, at depth 1.
        compared: points that are compared with other frames, (K,).
        ends: whether it is that of an object, beside which the frame shows what is behind.
    """

    camera: int
    frame: Frame
    points: Float
    normals: Float
    deviations: Float
    flat: Mask
    rays: cKDTree
    reach: float
    compared: Index
    ends: bool

    @classmethod
    def of(
        cls,
        facets: Facets,
        frame: Frame,
        noise: Noise,
        camera: int,
        most: int,
        depth: Float | None = None,
    ) -> Surface:
        """Return the surface of facets.

        Args:
            facets: of a frame.
            frame: the frame, with its pose.
            noise: of the frame.
            camera: number of its camera.
            most: number of points of each kind that are compared with other frames, about.
            depth: of each facet, (N,), metres; None for that of the facets, and to leave large
                planes as they are.
        """
        points = facets.points if depth is None else facets.rays * depth[:, None]
        z = points[:, 2]
        normals = -facets.planes / np.linalg.norm(facets.planes, axis=1, keepdims=True)
        deviations = np.hypot(noise.at(z) * z**2, DEPTH_SHARE * z)
        flat = np.zeros(len(points), bool)
        if depth is not None:
            # The points of a large plane get its normal: the noise of single normals would
            # outweigh the few points that tell how the frames are shifted along the plane.
            unposed = frame.with_pose(np.eye(4))
            rng = np.random.default_rng(0)
            left = sample(unposed, unposed.depth > 0, noise)
            while (plane := find_plane(left, rng)) is not None:
                left = left.some(~plane.holds(left))
                height = plane.height(points)
                on = np.abs(height) < tolerance_of(z, noise)
                on &= (normals @ plane.normal > 0.8) & ~flat
                points[on] -= height[on, None] * plane.normal
                normals[on] = plane.normal
                flat |= on
        kinds = [np.flatnonzero(flat == kind) for kind in (False, True)]
        return cls(
            camera,
            frame,
            points,
            normals,
            # error of the points of a large plane, relative to the distance
            np.where(flat, 0.002 * z, deviations),
            flat,
            cKDTree(facets.rays[:, :2]),
            1.5 * float(facets.pitch.mean()),
            np.concatenate([rows[:: 1 + len(rows) // most] for rows in kinds]),
            ends=depth is None,
        )

    def equations(
        self, other: Surface, poses: Float, further: float, reach: float
    ) -> tuple[Float, Float, Float, Float]:
        """Return the equations of the distances of another frame's points to this surface.

        Args:
            other: the surface of the other frame.
            poses: corrections of the poses of all cameras, (C, 4, 4).
            further: additional tolerance of the points, metres.
            reach: standard deviations at which a distance has a quarter of its weight.

        Returns:
            Coefficients of the motions of all cameras, (M, 6 C), distances, weights and
            standard deviations, (M,) each.
        """
        here = self.frame.camera_to_world @ poses[self.camera]
        there = other.frame.camera_to_world @ poses[other.camera]
        there = np.linalg.inv(here) @ there
        own = other.points[other.compared]
        points = own @ there[:3, :3].T + there[:3, 3]
        ahead = points[:, 2] > 1e-6
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
            self.deviations[nearest], other.deviations[other.compared]
        )
        met = ahead & (away < self.reach)
        fits = np.abs(off) < 2 * np.hypot(deviations, further)
        fits &= np.einsum("ni,ni->n", one, two) > 0.8  # one side of a thing
        if self.ends:
            # Points that the frame looks past are pulled into the outline.
            past = ahead & ~met & self._looks_past(rays, points[:, 2])
            aside = (self.rays.data[nearest] - rays) * points[:, 2:]
            length = np.maximum(np.linalg.norm(aside, axis=1), 1e-9)
            slack = self.reach * points[:, 2]
            normals[past] = 0
            normals[past, :2] = (aside / length[:, None])[past]
            off = np.where(past, length - slack, off)
            deviations = np.where(past, np.hypot(slack, deviations), deviations)
            fits |= past
            met |= past
        met &= fits

        scale = np.hypot(deviations, further)
        weights = 1 / (1 + (off / (reach * scale)) ** 2) ** 2 / scale**2
        both_flat = flat_one & flat_two
        for kind in (both_flat, ~both_flat):
            # neighbouring errors are correlated: as if there were 60 independent points
            weights[kind] *= min(1.0, 60 / max(1, int(np.count_nonzero(met & kind))))

        coefficients = np.zeros((np.count_nonzero(met), 6 * len(poses)))
        back = normals[met] @ there[:3, :3]
        for surface, at, towards in (
            (other, own[met], back),
            (self, points[met], -normals[met]),
        ):
            columns = slice(6 * surface.camera, 6 * (surface.camera + 1))
            coefficients[:, columns] = np.hstack([np.cross(at, towards), towards])
        return coefficients, off[met], weights[met], deviations[met]

    def _looks_past(self, rays: Float, depth: Float) -> Mask:
        """Return where the frame measures something behind points, by ray, (N, 2), and depth."""
        at = self.frame.pinhole.project(np.column_stack([rays, np.ones(len(rays))]))
        column, row = np.floor(at).astype(int).T
        height, width = self.frame.shape
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        shown = self.frame.depth[np.where(inside, row, 0), np.where(inside, column, 0)]
        return inside & (shown > 1.02 * depth)


@dataclass(frozen=True)
class Fit:
    """Registered frames of C cameras.

    Attributes:
        motions: of each camera, in its axes, (C, 6): rotation vector, radians, and translation,
            metres.
        covariance: of all of them, (6 C, 6 C).
        met: number of pairs of points of each camera in the last step, (C,).
        cost: mean of log(1 + squared deviation) of the pairs of points in the last step.
    """

    motions: Float
    covariance: Float
    met: Index
    cost: float


def registered(
    pairs: Sequence[tuple[Surface, Surface]],
    start: Float,
    deviations: Float,
    steps: Sequence[tuple[float, float]],
) -> Fit:
    """Register pairs of frames by Gauss-Newton steps over the motions of all cameras.

    Args:
        pairs: of surfaces.
        start: expected motion of each camera, (C, 6). The first camera is the reference.
        deviations: of the motions from it, (6,).
        steps: standard deviations at which a distance has a quarter of its weight, and additional
            tolerance of the points, metres.
    """
    count = len(start)
    known = np.tile(deviations**-2.0, count)
    known[:6] = 1e18
    motions = start.copy()
    information = np.diag(known)
    met = np.zeros(count, np.int64)
    costs = np.zeros(0)

    for reach, further in steps:
        poses = np.array([rigid(motion) for motion in motions])
        information = np.diag(known)
        pull = known * (start - motions).ravel()
        met[:] = 0
        costs = np.zeros(0)
        for one, other in pairs:
            rows, off, weights, errors = one.equations(other, poses, further, reach)
            information += (rows.T * weights) @ rows
            pull += (rows.T * weights) @ off
            met[[one.camera, other.camera]] += len(off)
            costs = np.append(costs, np.log1p((off / errors) ** 2))
        motions = motions + np.linalg.solve(information, pull).reshape(count, 6)
    cost = float(costs.mean()) if len(costs) else np.inf
    return Fit(motions, np.asarray(np.linalg.inv(information)), met, cost)


def rigid(motion: Float) -> Float:
    """Return the matrix, (4, 4), of a rotation vector and a translation, (6,)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(motion[:3]).as_matrix()
    pose[:3, 3] = motion[3:]
    return pose


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
    def mended(self) -> bool:
        """True if the shift exceeds the noise of the frames and is to be corrected."""
        # relative to the distance from the camera
        large = float(np.linalg.norm(self.shift)) > 0.006 * self.distance
        return large and (
            self.lasting or deviations_of(self.shift, self.covariance) > 3.0
        )

    @property
    def noticed(self) -> bool:
        """True if ``further`` exceeds noise and depth errors, and is to be reported.

        Errors of the depth that all pixels share displace by 1 cm at 1 m, and grow with the square
        of the distance. For a real Kinect with exact poses one shift in twenty is larger than twice
        this value.
        """
        common = (0.01 * self.distance**2) ** 2 * np.eye(3)
        return (
            self.mended and deviations_of(self.further, self.covariance + common) > 2.5
        )


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
    turn = latest.frame.camera_to_world[:3, :3]
    # the two frames with the most similar viewing directions
    there.sort(key=lambda one: -float(turn[:, 2] @ one.frame.camera_to_world[:3, 2]))
    surface, *others = (
        Surface.of(one.facets, one.frame, one.noise, number, 200)
        for number, one in zip((1, 0, 0), (latest, *there), strict=False)
    )
    distance = float(np.linalg.norm(np.median(surface.points, 0)))
    expected = float(np.hypot(CAMERA_PLACE, CAMERA_AIM * distance))
    steps = [
        (reach, FARTHEST_MOTION * expected * further)
        for reach, further in zip(OF_OBJECT, FURTHER, strict=True)
    ]
    deviations = np.repeat([1e-9, expected], 3)
    pairs = [pair for one in others for pair in permutations((one, surface), 2)]

    last = -earlier[-1].shift
    best = None
    least = np.log(2)  # one standard deviation: surfaces that have moved far do not fit
    for start in (np.zeros(3), last) if last.any() else (last,):
        motions = np.zeros((2, 6))
        motions[1, 3:] = -start @ turn
        fit = registered(pairs, motions, deviations, steps)
        shift = -turn @ fit.motions[1, 3:]
        far = np.linalg.norm(shift - start) > FARTHEST_MOTION * expected
        if far or fit.met[1] < FEWEST_PULLS or fit.cost > least:
            continue
        least = fit.cost
        covariance = turn @ fit.covariance[9:, 9:] @ turn.T
        lasting = bool(last.any()) and start is last
        best = Displacement(shift, shift - last, covariance, distance, lasting)
    return best


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
        turn, shift = np.sqrt(np.diagonal(self.covariance).reshape(2, 3).mean(1))
        return 1000 * float(shift), float(np.degrees(turn))

    @property
    def noticed(self) -> bool:
        """True if the error exceeds its uncertainty; of exact cameras one in a thousand does."""
        squared = deviations_of(self.motion, self.covariance) ** 2
        return bool(squared > chdtri(6, 0.001))

    @property
    def correction(self) -> Float:
        """Matrix, (4, 4), by which a stated pose is multiplied from the right."""
        return rigid(self.motion)

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
        seen = [_whole(frame, names.index(frame.camera)) for frame in frames]
        shown = [surface for surface in seen if surface is not None]
        pairs += [
            (one, other)
            for one, other in permutations(shown, 2)
            if one.camera != other.camera
        ]
    expected = FARTHEST_MOTION * CAMERA_PLACE
    deviations = np.repeat([FARTHEST_MOTION * CAMERA_AIM, expected], 3)
    # three times, as a camera also turns
    steps = [
        (reach, expected * further)
        for reach, further in zip(OF_CAMERA, FURTHER, strict=True)
        for _ in range(3)
    ]
    fit = registered(pairs, np.zeros((len(names), 6)), deviations, steps)
    return [
        CameraOffset(
            name,
            names[0],
            fit.motions[number],
            fit.covariance[6 * number : 6 * number + 6, 6 * number : 6 * number + 6],
        )
        for number, name in enumerate(names)
        if number and fit.met[number] >= FEWEST_PULLS
    ]


def _whole(frame: Frame, camera: int) -> Surface | None:
    """Return the surface of everything in a frame; None if too little is visible."""
    noise = frame.noise
    unposed = frame.with_pose(np.eye(4))
    try:
        facets = sighting_of(unposed, frame.depth > 0, None, noise).facets
    except ObservationError:
        return None
    # A facet of a curved surface lies behind it: only its normal is used, with the measured depth.
    depth = frame.depth[facets.rows, facets.columns].astype(np.float64)
    off = np.abs(depth - facets.points[:, 2])
    kept = (depth > 0) & (off < tolerance_of(depth, noise))
    return Surface.of(facets.some(kept), frame, noise, camera, 4000, depth[kept])
