"""What a frame says of each known object: it stands where it stood, it is not seen, or it does not.

Every pixel around the place of an object has a likelihood under each of three rivals: the
object stands where it stood; it is gone, and the picture shows what else is known to be there;
it stands elsewhere nearby. Where it stood is known but for the error of the camera's pose,
which displaces all objects of a frame together: it is estimated by those that have not moved.
A rival that leaves the pose open is weighed over all poses (MacKay, "Bayesian interpolation",
1992), as the likeliest of many poses fits noise, too. Few objects move from one frame to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from nextview.recognition.poses import PoseCandidate, uncertainty_of
from nextview.scene.tracks import Track, caster_of, window_around
from nextview.sensing.displacement import CAMERA_AIM, CAMERA_PLACE, FARTHEST_SHIFT
from nextview.sensing.frame import Frame, Part
from nextview.sensing.tabletop import TableTop
from nextview.things.registration import RegistrationPrior, scan_errors
from nextview.things.verification import PixelModel
from nextview.types import Float, Index, Mask

LEAST_ODDS = 12.0
"""Nats by which a frame has to show an object rather than not, or the other way round. It is no
rate of errors: a name or a pose may be wrong in a way that no rival has."""
MOVES = 0.001
"""Share of the objects that are expected to stand elsewhere in the next frame. As many of those
that stand are called moved at most, if the likelihoods are right."""
DEPTH_RANGE = 1.0  # metres within which a depth may be that nothing explains
COMPARED_SIDE = 48  # rows and columns in which an object is compared
STEPS = (0.006, 0.003, 0.0015, 0.001, 0.001)
"""Metres by which an object is moved to find out where it fits better, in each step."""
CAMERA_ROUNDS = 2  # in which objects and the error of the camera's pose tell each other
PIXELS = RegistrationPrior().pixels
SEEN_THROUGH = float(np.exp(PixelModel().outlier))
POINTS_OF_OBJECT = 400
DEVIATIONS_BEHIND = 3.0  # standard deviations by which something lies behind an object
MOVE_SCALES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Standard deviations of how far what moves goes along the ground, metres: all as likely, from a
nudge to the width of a table. What goes farther also turns more."""
LARGEST_TURN = 2.0  # standard deviation of a turn of which nothing is known, radians


@dataclass(frozen=True, eq=False)
class CameraError:
    """By how much a frame shows everything displaced because its pose is not exact.

    Attributes:
        origin: place about which it turns, that of the camera, (3,), world, metres.
        motion: rotation vector, radians, and shift, metres, (6,).
        covariance: of ``motion``, (6, 6).
    """

    origin: Float
    motion: Float
    covariance: Float

    @classmethod
    def expected(cls, frame: Frame, first: bool) -> CameraError:
        """What is known before anything was compared.

        Args:
            frame: the frame.
            first: whether it is the first, by whose pose the world is what it is.
        """
        origin = frame.camera_to_world[:3, 3]
        if first:
            return cls(origin, np.zeros(6), np.zeros((6, 6)))
        # the first one errs as much
        variances = 2 * np.repeat([CAMERA_AIM**2, CAMERA_PLACE**2], 3)
        return cls(origin, np.zeros(6), np.diag(variances))

    def at(self, place: Float) -> Float:
        """Matrix, (6, 6), from ``motion`` to that of an object at a place, (3,)."""
        x, y, z = place - self.origin
        matrix = np.eye(6)
        matrix[3:, :3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        return matrix

    @property
    def far(self) -> bool:
        """Whether it is none of an arm."""
        variances = 2 * np.repeat([CAMERA_AIM**2, CAMERA_PLACE**2], 3)
        return bool((self.motion**2 / variances).sum() > FARTHEST_SHIFT**2)


@dataclass(frozen=True, eq=False)
class Change:
    """What a frame says of an object.

    Attributes:
        stands: log-likelihood of that it stands where it stood, against that it is gone.
        moved: log-odds of that it stands elsewhere, against that it stands where it stood.
        pose: where it then stands, of its scan file in the world, (4, 4), metres; None where it is
            not seen.
    """

    stands: float = 0.0
    moved: float = -np.inf
    pose: Float | None = field(default=None, repr=False)

    @property
    def contradicts(self) -> bool:
        """Whether the object cannot be where it was."""
        return self.stands < -LEAST_ODDS or self.moved > 0

    @property
    def confirms(self) -> bool:
        """Whether the object is where it was."""
        return self.stands > LEAST_ODDS and not self.contradicts


@dataclass(frozen=True, eq=False)
class _Window:
    """A part of a frame in which an object is compared.

    Attributes:
        frame: the frame.
        posed: the object where it was known to be.
        centre: about which it is turned, (3,), world.
        radius: of the object, metres.
        rays: in the camera's frame, z = 1, (P, 3).
        depth: measured, (P,), metres, all of them above 0.
        sigma: its standard deviation, (P,), metres.
        without: log-likelihood of each pixel without the object, (P,).
        others: depth of the other objects, (K, P), metres, infinity where they do not show.
        weight: of each pixel, as neighbours err together.
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

    def pose(self, motion: Float) -> Float:
        """Pose of the scan file after a motion, (6,), in the world, (4, 4)."""
        return _about(self.centre, motion) @ self.posed.pose

    def rendered(self, motions: Float) -> tuple[Float, Float]:
        """Depth after each motion, (M, P), infinity where it does not show; and its slope."""
        caster = caster_of(self.posed)
        to_camera = np.linalg.inv(self.frame.camera_to_world)
        poses = to_camera @ np.stack([self.pose(motion) for motion in motions])
        turns = poses[:, :3, :3].astype(np.float32)
        origins = -np.einsum("mji,mj->mi", poses[:, :3, :3], poses[:, :3, 3])
        depth, normals = caster.cast(
            np.zeros(len(motions), np.int64),
            origins.astype(np.float32),
            self.rays.astype(np.float32) @ turns,
        )
        directions = self.rays / np.linalg.norm(self.rays, axis=1, keepdims=True)
        inwards = np.einsum("mpi,mij,pj->mp", normals, turns.swapaxes(1, 2), directions)
        cosine = np.clip(np.abs(inwards), 0.15, 1)
        slope = np.sqrt(1 - cosine**2) / cosine
        return np.asarray(depth, np.float64), np.asarray(slope, np.float64)

    def gains(self, motions: Float) -> Float:
        """Log-likelihood of each pixel with the object after motions, less that without, (M, P)."""
        depth, slope = self.rendered(motions)
        shows = np.isfinite(depth)
        depth = np.where(shows, depth, 0)
        aside = depth / self.frame.intrinsics[0, 0] * slope
        sigma = np.hypot(self.sigma, aside)
        found = with_surface(self.depth, depth, sigma, self.others) - self.without
        return self.weight * np.where(shows, found, 0.0)

    def gain(self, motion: Float) -> float:
        """The same of one motion, (6,), summed over the pixels."""
        return float(self.gains(motion[None]).sum())


def _about(centre: Float, motion: Float) -> Float:
    """Matrix, (4, 4), of a motion, (6,): a turn about a place, (3,), and a shift."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(motion[:3]).as_matrix()
    matrix[:3, 3] = centre - matrix[:3, :3] @ centre + motion[3:]
    return matrix


def with_surface(
    measured: Float,
    surface: Float,
    sigma: Float,
    others: Sequence[Float] | Float = (),
) -> Float:
    """Log-likelihood of depths where a surface is, against an exact match.

    What is nearer hides it: one of the ``others`` that are known, or what is as likely anywhere.
    What is farther should not be seen.
    """
    anywhere = np.sqrt(2 * np.pi) * sigma / DEPTH_RANGE
    other = anywhere * np.where(measured < surface, 0.5, SEEN_THROUGH)
    off = np.abs(measured - surface)
    for one in others:
        off = np.where(one < surface, np.minimum(off, np.abs(measured - one)), off)
    return np.asarray(np.log(0.5 * np.exp(-0.5 * (off / sigma) ** 2) + other))


def without_object(measured: Float, known: Sequence[Float], sigma: Float) -> Float:
    """The same where nothing but the ground and other objects is known, or anything may be."""
    off = np.min([np.abs(measured - one) for one in known], axis=0)
    anywhere = np.sqrt(2 * np.pi) * sigma / DEPTH_RANGE
    return np.asarray(np.log(0.5 * np.exp(-0.5 * (off / sigma) ** 2) + 0.5 * anywhere))


def _window_of(
    posed: PoseCandidate,
    top: TableTop,
    others: Sequence[PoseCandidate],
    shift: Float,
) -> _Window | None:
    """Where a frame may show an object, in its old place or shifted, (3,); None: nowhere."""
    assert posed.vertices is not None
    frame = top.frame
    to_camera = np.linalg.inv(frame.camera_to_world)
    placed = posed.vertices @ posed.pose[:3, :3].T + posed.pose[:3, 3]
    margin = frame.intrinsics[0, 0] * (CAMERA_PLACE + CAMERA_AIM)
    both = np.concatenate([placed, placed + shift])
    part = window_around(
        both @ to_camera[:3, :3].T + to_camera[:3, 3],
        frame,
        margin,
    )
    if part is None:
        return None
    rays, depth = _some_pixels(frame, part)
    if not len(depth):
        return None

    centre = (placed.min(0) + placed.max(0)) / 2
    radius = float(np.linalg.norm(placed - centre, axis=1).max())
    sigma = np.hypot(top.noise.at(depth) * depth**2, scan_errors(radius))
    nothing = np.zeros((0, len(depth)))
    window = _Window(
        frame, posed, centre, radius, rays, depth, sigma, np.zeros(1), nothing
    )
    window = _beside(window, top, others)
    surface = window.rendered(np.zeros((1, 6)))[0][0]
    count = int(np.isfinite(surface).sum())
    return replace(window, weight=min(1.0, PIXELS / max(count, 1)))


def _beside(window: _Window, top: TableTop, others: Sequence[PoseCandidate]) -> _Window:
    """The same part of a frame beside other objects in their poses."""
    shown = np.zeros((0, len(window.depth)))
    if others:
        besides = [replace(window, posed=other) for other in others]
        shown = np.stack([one.rendered(np.zeros((1, 6)))[0][0] for one in besides])
    known = [_depth_of_plane(top, window.rays), *shown]
    without = without_object(window.depth, known, window.sigma)
    return replace(window, others=shown, without=without)


def _some_pixels(frame: Frame, part: Part) -> tuple[Float, Float]:
    """Rays, (P, 3), and depths, (P,), of the measured pixels of a grid over a part of a frame."""
    rows, columns = (
        np.arange(one.start, one.stop)[
            (step := max(1, (one.stop - one.start) // COMPARED_SIDE)) // 2 :: step
        ]
        for one in part
    )
    at = np.meshgrid(rows, columns, indexing="ij")
    depth = frame.depth[tuple(at)]
    seen = depth > 0
    row, column = at[0][seen], at[1][seen]
    rays = np.column_stack(
        [frame.rays[0][column], frame.rays[1][row], np.ones(len(row))]
    )
    return rays.astype(np.float64), depth[seen].astype(np.float64)


def _depth_of_plane(top: TableTop, rays: Float) -> Float:
    """Depth at which rays, (P, 3), meet the ground, (P,); infinity where they do not."""
    pose = top.frame.camera_to_world
    away = rays @ pose[:3, :3].T @ top.plane.normal
    height = top.plane.height(pose[:3, 3])
    with np.errstate(divide="ignore"):
        return np.where(away < 0, -height / np.minimum(away, -1e-9), np.inf)


@dataclass(frozen=True, eq=False)
class _MotionFit:
    """The likeliest motion near another one: (6,), its information, (6, 6), and its gain."""

    motion: Float
    information: Float
    gain: float


def _fitted(
    window: _Window,
    start: Float,
    mean: Float,
    covariance: Float,
    steps: Sequence[float] = STEPS,
) -> _MotionFit:
    """The likeliest motion of an object, given how it may have moved before it was looked at.

    Each step uses the sum of the squared gradients of the pixels as information (Berndt, Hall, Hall
    and Hausman, 1974).

    Args:
        window: what the frame shows.
        start: where the search begins, (6,).
        mean: motion to be expected, (6,).
        covariance: of it, (6, 6).
        steps: metres.
    """
    prior = np.linalg.inv(covariance)
    motion = start.copy()
    lengths = np.repeat([1 / window.radius, 1.0], 3)

    def worth(one: Float) -> float:
        return window.gain(one) - float(0.5 * (one - mean) @ prior @ (one - mean))

    here = worth(motion)
    for step in steps:
        slopes, information = _slopes(window, motion, step * lengths)
        pull = slopes - prior @ (motion - mean)
        change = np.linalg.solve(information + prior, pull)
        longest = np.abs(change / lengths).max()
        change *= min(1.0, 4 * step / max(longest, 1e-12))
        for part in (1.0, 0.5, 0.25):
            there = worth(motion + part * change)
            if there > here:
                motion = motion + part * change
                here = there
                break
    _, information = _slopes(window, motion, steps[-1] * lengths)
    return _MotionFit(motion, information, window.gain(motion))


def _slopes(window: _Window, motion: Float, steps: Float) -> tuple[Float, Float]:
    """Gradient of the gain at a motion, (6,), by steps, (6,), and the information, (6, 6)."""
    up = window.gains(motion + np.diag(steps))
    down = window.gains(motion - np.diag(steps))
    slopes = ((up - down) / (2 * steps)[:, None]).T
    # a pixel that counts as a part of one tells that part
    return slopes.sum(0), np.asarray(slopes.T @ slopes / window.weight)


def _evidence(fit: _MotionFit, mean: Float, covariance: Float) -> float:
    """Nats by which an object shows rather than not, over all motions that are to be expected.

    This is Laplace's approximation of the integral. A rival that leaves the motion open has to
    gain what its freedom costs.

    Args:
        fit: the likeliest motion.
        mean: of the motions, (6,).
        covariance: of them, (6, 6).
    """
    off = fit.motion - mean
    worth = fit.gain - float(0.5 * off @ np.linalg.solve(covariance, off))
    _, spread = np.linalg.slogdet(np.eye(6) + covariance @ fit.information)
    return worth - float(0.5 * spread)


def _evidence_moved(
    fit: _MotionFit, mean: Float, covariance: Float, up: Float, radius: float
) -> float:
    """The same of an object that may have moved, by any distance."""
    each = [
        _evidence(fit, mean, _free(covariance, up, scale, radius))
        for scale in MOVE_SCALES
    ]
    return float(np.logaddexp.reduce(each) - np.log(len(each)))


def _free(covariance: Float, up: Float, scale: float, radius: float) -> Float:
    """A covariance, (6, 6), of what may also have moved along the ground and turned on it.

    Args:
        covariance: of what stands still, (6, 6).
        up: the vertical, (3,).
        scale: standard deviation of the move, metres.
        radius: of the object, metres.
    """
    vertical = np.outer(up, up)
    free = np.zeros((6, 6))
    free[:3, :3] = min(LARGEST_TURN, scale / radius) ** 2 * vertical
    free[3:, 3:] = scale**2 * (np.eye(3) - vertical)
    return covariance + free


@dataclass(frozen=True, eq=False)
class _Seen:
    """An object that a frame may show, before and after it was looked for."""

    row: int
    window: _Window
    own: Float
    known: tuple[CameraError, ...]
    fit: _MotionFit

    def expected(self, camera: CameraError) -> tuple[Float, Float]:
        """Motion that an error of the camera makes of it, (6,), and covariance, (6, 6)."""
        place = self.window.centre
        matrix = camera.at(place)
        motion = matrix @ camera.motion
        covariance = self.own + matrix @ camera.covariance @ matrix.T
        for one in self.known:
            before = one.at(place)
            motion = motion - before @ one.motion / len(self.known)
            covariance = covariance + before @ one.covariance @ before.T / len(
                self.known
            )
        return motion, covariance


def _own_covariance(track: Track, radius: float) -> Float:
    """How far off a pose itself may be: rotation vector and shift, (6, 6).

    What may be another thing, or stand in another pose, is off by as much.
    """
    posed = track.posed
    assert posed is not None
    assert track.result is not None
    every = track.result.pose_candidates
    off = uncertainty_of(
        sorted(every, key=lambda one: not np.array_equal(one.pose, posed.pose))
    )
    error = float(scan_errors(radius))
    turn = np.hypot(np.radians(off.degrees), error / radius)
    shift = np.hypot(off.millimetres / 1000, error)
    return np.diag(np.repeat([turn**2 / 3, shift**2 / 3], 3))


def _camera_by(seen: Sequence[_Seen], expected: CameraError) -> CameraError:
    """The error of a camera by objects that did not move."""
    if not expected.covariance.any():
        return expected
    information = np.linalg.inv(expected.covariance)
    pull = information @ expected.motion
    for one in seen:
        place = one.window.centre
        matrix = expected.at(place)
        offset, own = one.expected(
            replace(expected, motion=np.zeros(6), covariance=np.zeros((6, 6)))
        )
        told = _reduced(one.fit.information, own)
        information = information + matrix.T @ told @ matrix
        pull = pull + matrix.T @ told @ (one.fit.motion - offset)
    covariance = np.linalg.inv(information)
    return replace(expected, motion=covariance @ pull, covariance=covariance)


def _reduced(information: Float, covariance: Float) -> Float:
    """Information, (6, 6), on what else errs by a covariance, (6, 6)."""
    return np.asarray(
        np.linalg.solve(np.eye(6) + information @ covariance, information), np.float64
    )


def _deviation(one: _Seen, camera: CameraError) -> float:
    """Nats that the motion of an object is off from what an error of the camera makes of it."""
    mean, covariance = one.expected(camera)
    off = one.fit.motion - mean
    return float(0.5 * off @ _reduced(one.fit.information, covariance) @ off)


def _standing(seen: Sequence[_Seen], expected: CameraError) -> list[_Seen]:
    """The objects that agree on an error of the camera: as many as possible, with a small one."""
    best: tuple[float, list[_Seen]] = (np.inf, [])
    for tried in [[], *([one] for one in seen), list(seen)]:
        group = list(tried)
        for _ in range(3):
            camera = _camera_by(group, expected)
            off = [_deviation(one, camera) for one in seen]
            group = [one for one, by in zip(seen, off, strict=True) if by < LEAST_ODDS]
        # this one error of the camera: what is known of it worse would agree with more
        camera = replace(_camera_by(group, expected), covariance=np.zeros((6, 6)))
        off = [_deviation(one, camera) for one in seen]
        cost = sum(min(by, LEAST_ODDS) for by in off)
        if expected.covariance.any():
            known = np.linalg.solve(expected.covariance, camera.motion)
            cost += 0.5 * float(camera.motion @ known)
        if cost < best[0] - 1e-9:
            group = [one for one, by in zip(seen, off, strict=True) if by < LEAST_ODDS]
            best = (cost, group)
    return best[1]


def changes(
    tracks: Sequence[Track],
    top: TableTop,
    segments: Sequence[Mask],
    tops: Sequence[TableTop],
    cameras: Sequence[CameraError],
) -> tuple[list[Change], CameraError]:
    """What a frame, which was not taken in yet, says of each object, and of its own pose.

    Args:
        tracks: the objects, judged.
        top: what the frame shows.
        segments: the pixels of each thing in it, (H, W) bool each.
        tops: what the frames before show.
        cameras: the errors of their poses.
    """
    expected = CameraError.expected(top.frame, first=not tops)
    posed = {row: track.posed for row, track in enumerate(tracks)}
    scans = {
        row: one
        for row, one in posed.items()
        if one is not None and one.vertices is not None
    }
    seen = []
    for row, one in scans.items():
        others = [other for at, other in scans.items() if at != row]
        shift = _shift_to_segment(one, top, segments)
        window = _window_of(one, top, others, shift)
        if window is None:
            continue
        known = tuple(cameras[number] for number in tracks[row].frames)
        own = _own_covariance(tracks[row], window.radius)
        told = _Seen(
            row, window, own, known, _MotionFit(np.zeros(6), np.zeros((6, 6)), 0.0)
        )
        mean, covariance = told.expected(expected)
        free = _free(covariance, top.up, MOVE_SCALES[-1], window.radius)
        starts = [mean, mean + np.append(np.zeros(3), shift)] if shift.any() else [mean]
        fits = [_fitted(window, start, mean, free) for start in starts]
        seen.append(replace(told, fit=max(fits, key=lambda fit: fit.gain)))

    standing = _standing(_visible(seen), expected)
    camera = _camera_by(standing, expected)
    for _ in range(CAMERA_ROUNDS):
        # others are known where they stand, but for the error of the camera
        places = {
            one.row: replace(
                one.window.posed, pose=one.window.pose(one.expected(camera)[0])
            )
            for one in standing
        }
        seen = [
            _refitted(
                one,
                [other for row, other in places.items() if row != one.row],
                camera,
                expected,
                top,
            )
            for one in seen
        ]
        standing = _standing(_visible(seen), expected)
        camera = _camera_by(standing, expected)
    found = [Change()] * len(tracks)
    for each in seen:
        rest = [other for other in standing if other.row != each.row]
        found[each.row] = _change_of(
            each, _camera_by(rest, expected), top, tracks[each.row], tops, cameras
        )
    for row, track in enumerate(tracks):
        if row not in scans:
            found[row] = Change(_stands_by_points(track, top))
        change = found[row]
        if change.pose is None and change.stands < -LEAST_ODDS:
            if track.confident:
                there = _stands_by_points(track, top) > LEAST_ODDS
            else:
                there = not _seen_behind(track, top)
            if there:
                # something stands there, if not what it was called
                found[row] = Change()
    return found, camera


def _visible(seen: Sequence[_Seen]) -> list[_Seen]:
    """Those that the frame shows somewhere."""
    return [one for one in seen if one.fit.gain > LEAST_ODDS]


def _refitted(
    one: _Seen,
    others: Sequence[PoseCandidate],
    camera: CameraError,
    expected: CameraError,
    top: TableTop,
) -> _Seen:
    """The same object beside others, looked for where an error of the camera would show it, too."""
    window = _beside(one.window, top, others)
    start, _ = one.expected(camera)
    mean, covariance = one.expected(expected)
    free = _free(covariance, top.up, MOVE_SCALES[-1], window.radius)
    fit = _fitted(window, start, mean, free, STEPS[1:])
    before = replace(one.fit, gain=window.gain(one.fit.motion))
    best = max(before, fit, key=lambda each: each.gain)
    return replace(one, window=window, fit=best)


def _change_of(
    one: _Seen,
    camera: CameraError,
    top: TableTop,
    track: Track,
    tops: Sequence[TableTop],
    cameras: Sequence[CameraError],
) -> Change:
    """What a frame says of one object, given the error of its pose by the others."""
    window = one.window
    mean, covariance = one.expected(camera)
    # where it fits best is often as well a place of one that stands
    starts = (mean, one.fit.motion)
    fits = [_fitted(window, start, mean, covariance, STEPS[1:]) for start in starts]
    there = max(fits, key=lambda fit: _evidence(fit, mean, covariance))

    free = _free(covariance, top.up, MOVE_SCALES[-1], window.radius)
    away = max(
        (one.fit, _fitted(window, there.motion, mean, free, STEPS[2:])),
        key=lambda fit: fit.gain,
    )
    elsewhere = _evidence_moved(away, mean, covariance, top.up, window.radius)
    # what is likeliest if it may have moved may also be likeliest if it stands
    stands = max(_evidence(fit, mean, covariance) for fit in (there, away))
    odds = elsewhere - stands + float(np.log(MOVES / (1 - MOVES)))
    if elsewhere < LEAST_ODDS or odds < 0:
        return Change(stands)

    if not track.confident:
        # what else it may be shows the same surface
        by_points = _moved_by_points(one, away.motion - mean, camera, track, top)
        odds = min(odds, by_points + float(np.log(MOVES / (1 - MOVES))))
        if odds < 0:
            return Change(stands)

    # where it stands now, but for the error of the camera; did it stand there all the time?
    pose = window.pose(away.motion - mean)
    if _told_before(track, pose, tops) < LEAST_ODDS:
        return Change(elsewhere)
    return Change(stands, odds, window.pose(away.motion))


def _moved_by_points(
    one: _Seen,
    motion: Float,
    camera: CameraError,
    track: Track,
    top: TableTop,
) -> float:
    """Nats by which what was seen of an object last, whatever it is, moved rather than stands.

    Args:
        one: the object.
        motion: by which it moved, (6,).
        camera: the error of the frame's pose by the others.
        track: the object.
        top: what the frame shows.
    """
    place = one.window.centre
    last = one.known[-1]
    stands = camera.at(place) @ camera.motion - last.at(place) @ last.motion
    _, covariance = one.expected(camera)
    error = float(np.sqrt(np.trace(covariance[3:, 3:]) / 3))
    ways = [_about(place, each) for each in (stands, stands + motion)]
    still, moved = (_gain_of_points(track, top, way, error) for way in ways)
    return moved - still


def _told_before(track: Track, pose: Float, tops: Sequence[TableTop]) -> float:
    """Nats by which the frames that show an object tell its pose from another one, (4, 4)."""
    posed = track.posed
    assert posed is not None
    told = 0.0
    for place, number in enumerate(track.frames):
        top = tops[number]
        shift = np.zeros(3)
        if len(posed.displacements) == len(track.frames):
            shift = posed.displacements[place]
        old = posed.pose.copy()
        old[:3, 3] += shift
        new = pose.copy()
        new[:3, 3] += shift
        window = _window_of(replace(posed, pose=old), top, [], new[:3, 3] - old[:3, 3])
        if window is None:
            continue
        other = replace(window, posed=replace(posed, pose=new))
        told += window.gain(np.zeros(6)) - other.gain(np.zeros(6))
    return told


def _shift_to_segment(
    posed: PoseCandidate,
    top: TableTop,
    segments: Sequence[Mask],
) -> Float:
    """How far the segment that overlaps most with an object lies beside it, (3,), on the ground."""
    none = np.zeros(3)
    window = _window_of(posed, top, [], none)
    if window is None:
        return none
    surface = window.rendered(np.zeros((1, 6)))[0][0]
    shows = np.isfinite(surface)
    at = top.frame.camera.project(window.rays[shows])
    column, row = np.floor(at).astype(np.int64).T
    over = [np.count_nonzero(mask[row, column]) for mask in segments]
    if not over or not max(over):
        return none
    mask = segments[int(np.argmax(over))] & (top.frame.depth > 0)
    measured = np.median(top.frame.positions(*np.nonzero(mask)), axis=0)
    pose = top.frame.camera_to_world
    points = (window.rays * np.where(shows, surface, 0)[:, None])[shows]
    shown = np.median(points, axis=0) @ pose[:3, :3].T + pose[:3, 3]
    shift = measured - shown
    return shift - (shift @ top.up) * top.up


@dataclass(frozen=True, eq=False)
class _Points:
    """What was seen of an object last, where another frame measures something.

    Attributes:
        surface: depth of each point in the frame, (P,), metres.
        row, column: the pixel of each, (P,).
        rays: in the camera's frame, z = 1, (P, 3).
    """

    surface: Float
    row: Index
    column: Index
    rays: Float

    @classmethod
    def of(cls, track: Track, frame: Frame, motion: Float) -> _Points:
        """Those of an object in a frame, after a motion in the world, (4, 4)."""
        last = track.thing.sightings[-1]
        few = slice(None, None, max(1, len(last.facets.planes) // POINTS_OF_OBJECT))
        pose = motion @ last.frame.camera_to_world
        points = last.facets.some(few).points @ pose[:3, :3].T + pose[:3, 3]
        now = frame.camera_to_world
        inside = (points - now[:3, 3]) @ now[:3, :3]
        inside = inside[inside[:, 2] > 0.01]
        column, row = np.floor(frame.camera.project(inside)).astype(np.int64).T
        height, width = frame.shape
        shown = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        shown[shown] = frame.depth[row[shown], column[shown]] > 0
        surface = inside[shown, 2]
        rays = inside[shown] / surface[:, None]
        return cls(surface, row[shown], column[shown], rays)


def _stands_by_points(track: Track, top: TableTop) -> float:
    """Nats by which an object of unknown shape stands where it was seen last, against gone."""
    last = track.thing.sightings[-1].frame
    away = np.linalg.norm(track.thing.object_frame.centre - last.camera_to_world[:3, 3])
    error = np.sqrt(2) * np.hypot(CAMERA_PLACE, CAMERA_AIM * away)
    return _gain_of_points(track, top, np.eye(4), float(error))


def _gain_of_points(track: Track, top: TableTop, motion: Float, error: float) -> float:
    """Nats by which what was seen of an object last shows after a motion, against the ground.

    Args:
        track: the object.
        top: what the frame shows.
        motion: in the world, (4, 4).
        error: standard deviation of the place after it, metres.
    """
    seen = _Points.of(track, top.frame, motion)
    if not len(seen.surface):
        return 0.0
    depth = top.frame.depth[seen.row, seen.column].astype(np.float64)
    sigma = np.hypot(top.noise.at(depth) * depth**2, error)
    ground = _depth_of_plane(top, seen.rays)
    gain = with_surface(depth, seen.surface, sigma)
    gain -= without_object(depth, [ground], sigma)
    return float(gain.sum() * min(1.0, PIXELS / len(gain)))


def _seen_behind(track: Track, top: TableTop) -> bool:
    """Whether a frame shows what is behind an object, wherever the error of its pose puts it."""
    frame = top.frame
    seen = _Points.of(track, frame, np.eye(4))
    if not len(seen.surface):
        return False
    aside = np.sqrt(2) * np.hypot(CAMERA_PLACE, CAMERA_AIM * np.median(seen.surface))
    reach = int(np.ceil(frame.intrinsics[0, 0] * aside / np.median(seen.surface)))
    depth = np.where(frame.depth > 0, frame.depth, np.inf)
    nearest = ndimage.minimum_filter(depth, 2 * reach + 1)[seen.row, seen.column]
    noise = top.noise.at(nearest) * nearest**2
    sigma = np.hypot(noise, np.sqrt(2) * CAMERA_PLACE)
    behind = nearest > seen.surface + DEVIATIONS_BEHIND * sigma
    return bool(np.count_nonzero(behind) > len(behind) / 2)


def wrong_pose(found: Sequence[Change], camera: CameraError) -> bool:
    """Whether a frame contradicts so many objects that its pose is wrong, not that they moved."""
    against = sum(one.contradicts for one in found)
    confirmed = sum(one.confirms for one in found)
    return (against >= 2 and against > confirmed) or (confirmed >= 2 and camera.far)
