"""Test whether posed depth frames agree with one rigid scene.

Surface points of each frame are projected into all other frames. A point is confirmed if the other
frame measures the same depth, and contradicted if the other frame measures a greater one. Points
that are occluded, outside the image or without measured depth do not count.

Every point is tested twice: with a rough tolerance that accepts usual calibration errors, and with
a sharp tolerance that detects pose errors of a few degrees.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from nextview.sensing.frame import Frame
from nextview.sensing.planes import find_plane, sample
from nextview.sensing.registration import CAMERA_AIM, CAMERA_PLACE, tolerance_of
from nextview.types import Float, Float32, Index, Mask

COLUMNS = 160  # of the image in which points are looked up, about
# standard deviations of the error of two usual camera poses: rough, and sharp
DEVIATIONS = 2.4, 0.7
CONFIRMED = 2.0  # nats of a surface that two frames see in the same place
CONTRADICTED = -4.0  # nats of a surface that one frame sees through
WORLD_CHANGED = np.log(0.05)  # nats of a world in which nothing need agree any more


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """A frame prepared for comparison with others, at low resolution.

    Attributes:
        intrinsics: pinhole matrix of the small image, (3, 3).
        nearest: least depth of each pixel and its neighbours, (h, w), metres; infinite without
            valid depth.
        farthest: greatest depth of each pixel and its neighbours, (h, w), metres; 0 without valid
            depth.
        complete: whether each pixel and all of its neighbours have valid depth, (h, w).
        object_near: pixels on or next to the object's mask, (h, w); None without a mask.
        points: surface points, (N, 3), camera frame, metres.
        noise: depth error of each point due to noise, (N,), metres.
        standing: points above the largest plane, (N,); all of them with a mask or without a plane.
    """

    intrinsics: Float
    nearest: Float32
    farthest: Float32
    complete: Mask
    object_near: Mask | None
    points: Float
    noise: Float
    standing: Mask

    @classmethod
    def of(cls, frame: Frame, rng: np.random.Generator, whole: bool) -> "SurfaceView":
        """Prepare a frame for comparison; its pose is not used.

        Args:
            frame: of a depth camera.
            rng: for drawing the points.
            whole: whether all that is seen is compared. Otherwise points are of the object's mask;
                without a mask of the centre of the image, half of them above the largest plane: a
                table looks the same after any rotation about its normal.
        """
        side = max(1, frame.shape[1] // COLUMNS)
        # Each square becomes one pixel with the depth of its corner.
        intrinsics = frame.intrinsics.copy()
        intrinsics[:2, 2] -= 0.5
        intrinsics[:2] /= side
        intrinsics[:2, 2] += 0.5
        depth = frame.depth[::side, ::side]
        small = Frame(depth.copy(), intrinsics, pixel_centre=0.5)

        measured = np.where(depth > 0, depth, np.float32(np.inf))
        nearest = ndimage.minimum_filter(measured, 3, mode="nearest")
        farthest = ndimage.maximum_filter(depth, 3, mode="nearest")
        mask = None if whole or frame.mask is None else frame.mask[::side, ::side]
        usable = depth > 0
        if mask is not None:
            usable &= mask
        else:
            usable &= farthest - nearest < 0.05 * depth  # no edges
            third = [slice(size // 3, size - size // 3) for size in depth.shape]
            middle = depth[tuple(third)]
            if not whole and middle.any():  # nor the far background
                usable &= depth < 1.5 * np.median(middle[middle > 0])
        points = small.positions_in_camera(*np.nonzero(usable))
        by_noise = tolerance_of(points[:, 2], small.noise, share=0.0)

        standing = np.ones(len(points), bool)
        if not whole and mask is None:
            # The plane is searched in the camera frame, because the pose may be wrong.
            plane = find_plane(sample(small, small.depth > 0, small.noise), rng)
            if plane is not None:
                standing = plane.height(points) > 0.012 * points[:, 2] + by_noise
        most = 500 if whole else 200  # points that are projected into other frames
        if standing.any() and not standing.all():
            most //= 2
        kinds = (np.flatnonzero(standing), np.flatnonzero(~standing))
        kept = np.concatenate([rng.permutation(kind)[:most] for kind in kinds])
        return cls(
            intrinsics,
            nearest,
            farthest,
            ndimage.minimum_filter(depth > 0, 3, mode="constant"),
            None if mask is None else ndimage.maximum_filter(mask, 3),
            points[kept],
            by_noise[kept],
            standing[kept],
        )

    def of_standing(self) -> "SurfaceView":
        """Return the frame with the points above its largest plane alone."""
        return replace(
            self,
            points=self.points[self.standing],
            noise=self.noise[self.standing],
            standing=self.standing[self.standing],
        )

    def with_focal_length(self, times: float) -> "SurfaceView":
        """Return the frame with its focal lengths multiplied by a factor."""
        intrinsics = self.intrinsics * [[times, 1, 1], [1, times, 1], [1, 1, 1]]
        points = self.points / [times, times, 1]
        return replace(self, intrinsics=intrinsics, points=points)

    def tolerance(self, deviations: float) -> Float:
        """Largest depth difference with which another frame confirms each point, (N,), metres."""
        of_pose = np.hypot(CAMERA_PLACE, CAMERA_AIM * self.points[:, 2])
        return np.asarray(deviations * np.sqrt(2) * of_pose + self.noise)


@dataclass(frozen=True)
class Agreement:
    """Number of points of a frame (row) that another frame (column) confirms or contradicts.

    Attributes:
        confirmed: number of judgements, (N, N).
        contradicted: number of judgements, (N, N).
    """

    confirmed: Float
    contradicted: Float

    @property
    def judged(self) -> float:
        """Total number of judgements."""
        return float(self.confirmed.sum() + self.contradicted.sum())

    @property
    def wrong(self) -> float:
        """Contradicted share of the judgements; 0 if there are none."""
        return float(self.contradicted.sum()) / max(self.judged, 1)

    @property
    def nats(self) -> Float:
        """Evidence of each pair for one rigid scene, times the judgements of a surface, (N, N)."""
        return CONFIRMED * self.confirmed + CONTRADICTED * self.contradicted

    def among(self, pairs: Mask) -> "Agreement":
        """Return the agreement of some pairs of frames, (N, N)."""
        return Agreement(self.confirmed * pairs, self.contradicted * pairs)


def compare(
    views: Sequence[SurfaceView],
    poses: Float,
    looked_up_with: Float | None = None,
) -> Agreement:
    """Project the points of every frame into all others, with both tolerances.

    Args:
        views: N frames.
        poses: of their cameras, camera-to-world, (N, 4, 4), metres.
        looked_up_with: poses of the cameras into which the points are projected, (N, 4, 4); by
            default the same.
    """
    count = len(views)
    owner = np.repeat(np.arange(count), [len(view.points) for view in views])
    world = np.concatenate(
        [
            pose[:3, :3] @ view.points.T + pose[:3, 3:]
            for view, pose in zip(views, poses, strict=True)
        ],
        axis=1,
    )
    tolerances = [
        np.concatenate([view.tolerance(deviations) for view in views])
        for deviations in DEVIATIONS
    ]
    confirmed, contradicted = np.zeros((2, count, count))
    there = poses if looked_up_with is None else looked_up_with
    for j, (view, pose) in enumerate(zip(views, there, strict=True)):
        x, y, z = pose[:3, :3].T @ (world - pose[:3, 3:])
        ahead = np.where(z > 1e-6, z, np.inf)
        column = x / ahead * view.intrinsics[0, 0] + view.intrinsics[0, 2]
        row = y / ahead * view.intrinsics[1, 1] + view.intrinsics[1, 2]
        height, width = view.nearest.shape
        # A small pose error moves points near the border out of the image.
        inside = (row >= 1) & (row < height - 1) & (column >= 1) & (column < width - 1)
        which = np.flatnonzero(inside & (z > 1e-6) & (owner != j))
        at = row[which].astype(np.int64) * width + column[which].astype(np.int64)
        for tolerance in tolerances:
            agrees, looks_through = _looked_up(view, at, z[which], tolerance[which])
            found = owner[which]
            confirmed[:, j] += np.bincount(found[agrees], minlength=count)
            contradicted[:, j] += np.bincount(found[looks_through], minlength=count)
    return Agreement(confirmed, contradicted)


def _looked_up(
    view: SurfaceView, at: Index, z: Float, limit: Float
) -> tuple[Mask, Mask]:
    """Return which points an image confirms, and which it contradicts.

    Args:
        view: the image.
        at: pixel of each point, (P,).
        z: depth of the points, (P,), metres.
        limit: tolerance of each depth, (P,), metres.
    """
    nearest = view.nearest.take(at)
    agrees = (z > nearest - limit) & (z < view.farthest.take(at) + limit)
    looks_through = (z <= nearest - limit) & view.complete.take(at)
    if view.object_near is None:
        return agrees, looks_through
    on_object = view.object_near.take(at)
    # Unless it is occluded, a point of the object must be inside the mask, even without depth.
    hidden = nearest < z - limit
    return agrees & on_object, np.where(on_object, looks_through, ~hidden)


def agree(views: Sequence[SurfaceView], poses: Float) -> float:
    """Return the evidence of the surfaces that two frames see in the same places, nats.

    Args:
        views: both frames.
        poses: of their cameras, camera-to-world, (2, 4, 4).
    """
    found = compare(views, poses)
    if found.judged < 100:  # they do not overlap
        return 0.0
    # two frames see some 15 independent surfaces, each point is compared twice
    share = 15 / 2 / sum(len(view.points) for view in views)
    return float(np.logaddexp(share * found.nats.sum(), WORLD_CHANGED))


def in_one_place(poses: Float, middle: float) -> bool:
    """Return True if all cameras are in one place, where rotations cannot be verified.

    Args:
        poses: camera-to-world, (N, 4, 4).
        middle: median depth, metres.
    """
    places = poses[:, :3, 3]
    apart = np.linalg.norm(places - np.median(places, 0), axis=1)
    return bool(np.quantile(apart, 0.9) < 0.02 * middle)
