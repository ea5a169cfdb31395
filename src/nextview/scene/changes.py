"""What a frame says of each known object: it stands where it stood, stands elsewhere, or is gone.

Each of the three hypotheses gives the pixels around an object a likelihood (``placing``). They are
weighed by their priors: few objects move between two frames, but where some have moved, such as on
a belt, the others may have moved alike. An object that stands is displaced only by the error of the
camera's pose, which is the same for all objects of a frame, and by that of its own pose. The
surface of an object is the scan of its name or, as names may be wrong, the part that was seen last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from nextview.recognition.poses import PoseCandidate, uncertainty_of
from nextview.scene.placing import (
    MotionFit,
    PlacedSurface,
    fitted,
    likeliest,
    seen_surface,
)
from nextview.sensing.displacement import CAMERA_AIM, CAMERA_PLACE, FARTHEST_SHIFT
from nextview.sensing.frame import Frame, stands_still
from nextview.sensing.tabletop import TableTop
from nextview.session.tracks import Track
from nextview.things.registration import scan_errors
from nextview.types import Float, Mask

MOVE_PRIOR = 0.001  # expected share of objects that are elsewhere in the next frame
REMOVAL_PRIOR = 0.001  # expected share of objects that are gone in the next frame
SURPRISE = -float(np.log(MOVE_PRIOR))  # nats that make a change as likely as none
WRONG_NAMES = 0.01  # expected share of wrong names or poses among confident ones
WRONG_DOUBTFUL = 0.5  # the same among those that are not confident
# metres, standard deviations of a move along the ground, equally likely: from a nudge to a table
MOVE_SCALES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
LARGEST_TURN = 2.0  # radians, standard deviation of a turn of which nothing is known


@dataclass(frozen=True, eq=False)
class CameraError:
    """Displacement of all objects in a frame because the camera's pose is not exact.

    Attributes:
        origin: position of the camera, about which it turns, (3,), world, metres.
        motion: rotation vector, radians, and shift, metres, (6,).
        covariance: of ``motion``, (6, 6).
    """

    origin: Float
    motion: Float
    covariance: Float

    @classmethod
    def expected(cls, frame: Frame, first: bool) -> CameraError:
        """Return the error before any comparison.

        Args:
            frame: the frame.
            first: whether it is the first frame, which defines the world.
        """
        variances = np.zeros(6) if first else _variances()
        return cls(frame.camera_to_world[:3, 3], np.zeros(6), np.diag(variances))

    @classmethod
    def before(
        cls,
        frame: Frame,
        tops: Sequence[TableTop],
        cameras: Sequence[CameraError],
    ) -> CameraError:
        """Return the error of a frame before it is compared with known objects.

        A camera that has not moved has the error of its last frame.

        Args:
            frame: the frame.
            tops: support surfaces of the earlier frames.
            cameras: errors of their poses.
        """
        for top, camera in zip(reversed(tops), reversed(cameras), strict=True):
            if stands_still(frame, [top.frame]):
                return camera
        return cls.expected(frame, first=not tops)

    def at(self, place: Float) -> Float:
        """Matrix, (6, 6), from ``motion`` to the motion of an object at a place, (3,)."""
        x, y, z = place - self.origin
        matrix = np.eye(6)
        matrix[3:, :3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        return matrix

    @property
    def far(self) -> bool:
        """Return True if it is too large for an arm."""
        return bool((self.motion**2 / _variances()).sum() > FARTHEST_SHIFT**2)


@dataclass(frozen=True, eq=False)
class Change:
    """What a frame says of an object; log-likelihoods against that the object is gone.

    Attributes:
        stands: log-likelihood that it stands where it stood; 0 if it is not visible.
        elsewhere: log-likelihood that it stands elsewhere nearby.
        there: its surface where it is if it stands elsewhere; None if the frame cannot show it.
    """

    stands: float = 0.0
    elsewhere: float = 0.0
    there: PoseCandidate | None = field(default=None, repr=False)

    @property
    def contradicts(self) -> bool:
        """Return True if the object is likely to be no longer at its known place."""
        stands = self.stands + np.log(1 - MOVE_PRIOR - REMOVAL_PRIOR)
        moved = self.elsewhere + np.log(MOVE_PRIOR)
        return bool(np.logaddexp(moved, np.log(REMOVAL_PRIOR)) > stands)

    @property
    def confirms(self) -> bool:
        """Return True if the frame shows the object at its known place."""
        return self.stands > SURPRISE and not self.contradicts

    @property
    def found(self) -> bool:
        """Return True if the object is seen elsewhere, rather than not at all."""
        return self.contradicts and self.elsewhere > 0


@dataclass(frozen=True, eq=False)
class _Moved:
    """The other objects that moved, such as those on a belt: the next one may have moved alike.

    Attributes:
        ways: shift of each as a motion, (6,), metres, and its covariance, (6, 6).
        share: of all objects in the frame.
    """

    ways: tuple[tuple[Float, Float], ...] = ()
    share: float = 0.0


@dataclass(frozen=True, eq=False)
class _Object:
    """An object that a frame may show.

    Attributes:
        surface: at its known place.
        own: covariance of the error of its own pose, (6, 6).
        known: errors of the cameras by which its pose was found; () if the camera of the frame
            found it from the same place, so that its error is the same in both.
        up: direction against gravity, (3,).
        shift: to the segment that overlaps most with it, (3,), metres.
        fit: its likeliest motion if it may have moved.
    """

    surface: PlacedSurface
    own: Float
    known: tuple[CameraError, ...]
    up: Float
    shift: Float
    fit: MotionFit = field(default_factory=MotionFit.none)

    def expected(self, camera: CameraError) -> tuple[Float, Float]:
        """Motion of an object that stands, (6,), and its covariance, (6, 6)."""
        if not self.known:
            return np.zeros(6), self.own
        place = self.surface.centre
        matrix = camera.at(place)
        motion = matrix @ camera.motion
        covariance = self.own + matrix @ camera.covariance @ matrix.T
        for one in self.known:
            before = one.at(place)
            motion = motion - before @ one.motion / len(self.known)
            spread = before @ one.covariance @ before.T
            covariance = covariance + spread / len(self.known)
        return motion, covariance

    def moved(self, covariance: Float, scale: float) -> Float:
        """Covariance, (6, 6), of the motions of an object that moves along the ground.

        Args:
            covariance: of an object that stands, (6, 6).
            scale: standard deviation of the move, metres.
        """
        vertical = np.outer(self.up, self.up)
        turn = min(LARGEST_TURN, scale / self.surface.radius)
        free = np.zeros((6, 6))
        free[:3, :3] = turn**2 * vertical
        free[3:, 3:] = scale**2 * (np.eye(3) - vertical)
        return covariance + free

    def beside(self, others: Sequence[PoseCandidate], top: TableTop) -> _Object:
        """Return the same among other known objects, see ``PlacedSurface.beside``."""
        return replace(self, surface=self.surface.beside(others, top))

    def looked_for(self, camera: CameraError, starts: Sequence[Float]) -> _Object:
        """Find its likeliest motion if it may have moved.

        Args:
            camera: error of the frame's pose before the comparison.
            starts: motions with which to start, (6,) each.
        """
        mean, covariance = self.expected(camera)
        free = self.moved(covariance, MOVE_SCALES[-1])
        fits = [fitted(self.surface, start, mean, free) for start in starts]
        return replace(self, fit=max(fits, key=lambda fit: fit.gain))

    def standing(self, camera: CameraError) -> float:
        """Log-likelihood that it stands, given the error of the camera's pose."""
        mean, covariance = self.expected(camera)
        near = fitted(self.surface, mean, mean, covariance)
        return near.evidence(mean, covariance)

    def standing_at_best(self, camera: CameraError) -> float:
        """Log-likelihood that it stands; its likeliest motion may be small enough for that."""
        mean, covariance = self.expected(camera)
        return max(self.standing(camera), self.fit.evidence(mean, covariance))

    def elsewhere(self, camera: CameraError, others: _Moved) -> float:
        """Log-likelihood that it moved, by any distance along the ground or as others did."""
        mean, covariance = self.expected(camera)
        each = [
            self.fit.evidence(mean, self.moved(covariance, scale))
            for scale in MOVE_SCALES
        ]
        alone = np.logaddexp.reduce(each) - np.log(len(each))
        if not others.ways or self.fit.gain < SURPRISE:
            return float(alone)
        along = [
            self.fit.evidence(mean + shift, covariance + error)
            for shift, error in others.ways
        ]
        carried = np.logaddexp.reduce(along) - np.log(len(along))
        return float(np.logaddexp(alone, carried + np.log(others.share / MOVE_PRIOR)))

    @property
    def there(self) -> PoseCandidate:
        """The surface after its likeliest motion."""
        posed = self.surface.posed
        return replace(posed, pose=self.surface.pose(self.fit.motion))

    def way(self, camera: CameraError) -> tuple[Float, Float]:
        """Shift by which it moved, as a motion, (6,), metres, and its covariance, (6, 6)."""
        mean, covariance = self.expected(camera)
        moved = self.moved(covariance, MOVE_SCALES[-1])
        shift = np.zeros(6)
        shift[3:] = (self.fit.motion - mean)[3:]
        error = np.zeros((6, 6))
        seen = np.linalg.solve(np.eye(6) + moved @ self.fit.information, moved)
        error[3:, 3:] = (seen + covariance)[3:, 3:]
        return shift, error

    def deviation(self, camera: CameraError) -> float:
        """Nats by which its likeliest motion differs from that of an object that stands."""
        mean, covariance = self.expected(camera)
        off = self.fit.motion - mean
        return float(0.5 * off @ _given(self.fit.information, covariance) @ off)


def changes(
    tracks: Sequence[Track],
    top: TableTop,
    segments: Sequence[Mask],
    tops: Sequence[TableTop],
    cameras: Sequence[CameraError],
) -> tuple[list[Change], CameraError]:
    """Compare a new frame with each known object, and estimate the error of its pose.

    Args:
        tracks: the objects, already judged.
        top: support surfaces of the new frame.
        segments: pixels of each object in it, (H, W) bool each.
        tops: support surfaces of the earlier frames.
        cameras: errors of their poses.

    Returns:
        The change of each object, and the error of the pose of the new frame.
    """
    compared = _Compared.with_frame(tracks, top, segments, tops, cameras)
    ways = {
        row: one.way(compared.by_others[row])
        for row, one in compared.named.items()
        if compared.by_name(row, _Moved()).found
    }
    found = []
    for row in range(len(tracks)):
        along = tuple(way for other, way in ways.items() if other != row)
        moved = _Moved(along, len(along) / max(len(compared.named), 1))
        found.append(compared.change(row, moved))
    return found, compared.camera


@dataclass(frozen=True, eq=False)
class _Compared:
    """A new frame, and the known objects as it may show them.

    Attributes:
        tracks: the objects.
        top: support surfaces of the new frame.
        segments: pixels of each object in it, (H, W) bool each.
        tops: support surfaces of the earlier frames.
        cameras: errors of their poses.
        places: surfaces of the objects with a geometry if none moved, by row.
        named: these objects beside each other, with their likeliest motions, by row.
        camera: error of the frame's pose.
        by_others: the same without the object itself, for each object.
        stands: log-likelihood that each of ``named`` stands, by row.
    """

    tracks: Sequence[Track]
    top: TableTop
    segments: Sequence[Mask]
    tops: Sequence[TableTop]
    cameras: Sequence[CameraError]
    places: dict[int, PoseCandidate]
    named: dict[int, _Object]
    camera: CameraError
    by_others: list[CameraError]
    stands: dict[int, float]

    @classmethod
    def with_frame(
        cls,
        tracks: Sequence[Track],
        top: TableTop,
        segments: Sequence[Mask],
        tops: Sequence[TableTop],
        cameras: Sequence[CameraError],
    ) -> _Compared:
        """Find the likeliest motion of each object, and the error of the frame's pose."""
        expected = CameraError.before(top.frame, tops, cameras)
        known = _known(tracks, top, segments, tops, cameras)
        still = _still(list(known.values()), expected)
        places = {row: _displaced(one, still) for row, one in known.items()}
        named = _searched(known, places, still, expected, top)

        standing, camera = _agreeing(named, expected)
        by_others = [
            _camera_by([named[other] for other in standing if other != row], expected)
            for row in range(len(tracks))
        ]
        stands = {
            row: one.standing_at_best(by_others[row]) for row, one in named.items()
        }

        return cls(
            tracks=tracks,
            top=top,
            segments=segments,
            tops=tops,
            cameras=cameras,
            places=places,
            named=named,
            camera=camera,
            by_others=by_others,
            stands=stands,
        )

    def change(self, row: int, moved: _Moved) -> Change:
        """Return the change of one object, given which others moved."""
        by_name = self.by_name(row, moved) if row in self.named else None
        if by_name is not None and not by_name.contradicts:
            return by_name
        by_part = self._of_last_seen(row, moved)
        if by_part is None:
            return Change()
        if by_name is None:
            return by_part
        return _whatever_it_is(by_name, by_part, self.tracks[row].confident)

    def by_name(self, row: int, moved: _Moved) -> Change:
        """Return the change of an object with a geometry, if its name is right."""
        one = self.named[row]
        there = Change(
            self.stands[row], one.elsewhere(self.by_others[row], moved), one.there
        )
        if not there.found:
            return there
        # it may have stood there all the time, in a pose that the earlier frames show less well
        mean, _ = one.expected(self.by_others[row])
        pose = one.surface.pose(one.fit.motion - mean)
        always = there.elsewhere - _told_before(self.tracks[row], pose, self.tops)
        return replace(there, stands=float(np.logaddexp(there.stands, always)))

    def _of_last_seen(self, row: int, moved: _Moved) -> Change | None:
        """Return the change of the part of an object that was seen last.

        None if the frame cannot show this part.
        """
        camera = self.by_others[row]
        one = self.named.get(row)
        seen = _last_seen(
            self.tracks[row], self.top, self.segments, self.tops, self.cameras
        )
        if seen is None:
            return None
        if one is not None:
            weighed = seen.surface.weighed_like(one.surface)
            seen = replace(seen, surface=weighed)

        change = Change(seen.standing(camera))
        if seen.known:  # from elsewhere the frame shows another part
            return change
        way = None if one is None else one.way(camera)[0][3:]
        beside = seen.beside(_others(self.places, row), self.top)
        return _of_part(change, beside, camera, moved, way)


def wrong_pose(found: Sequence[Change], camera: CameraError) -> bool:
    """Return True if a frame contradicts so many objects that its pose must be wrong.

    Args:
        found: change of each object.
        camera: error of the frame's pose.
    """
    against = sum(one.contradicts for one in found)
    confirmed = sum(one.confirms for one in found)
    return (against >= 2 and against >= confirmed) or (confirmed >= 2 and camera.far)


def _known(
    tracks: Sequence[Track],
    top: TableTop,
    segments: Sequence[Mask],
    tops: Sequence[TableTop],
    cameras: Sequence[CameraError],
) -> dict[int, _Object]:
    """Return the objects with a known geometry that a frame may show, by row."""
    found = {}
    for row, track in enumerate(tracks):
        posed = track.posed
        if posed is None or posed.vertices is None:
            continue
        same = stands_still(top.frame, [tops[k].frame for k in track.frames])
        own = _own_covariance(track, posed, same)
        known = [] if same else [cameras[number] for number in track.frames]
        one = _object_at(posed, own, known, top, segments)
        if one is not None:
            found[row] = one
    return found


def _searched(
    known: dict[int, _Object],
    places: dict[int, PoseCandidate],
    still: CameraError,
    expected: CameraError,
    top: TableTop,
) -> dict[int, _Object]:
    """Find the likeliest motion of each object beside the others.

    Args:
        known: the objects, by row.
        places: surfaces of all of them if none moved.
        still: error of the frame's pose if none moved.
        expected: error of the frame's pose before the comparison.
        top: support surfaces of the frame.
    """
    found = {}
    for row, one in known.items():
        mean, _ = one.expected(still)
        starts = [mean]
        if one.shift.any():
            starts.append(mean + np.append(np.zeros(3), one.shift))
        beside = one.beside(_others(places, row), top)
        found[row] = beside.looked_for(expected, starts)
    return found


def _others(places: dict[int, PoseCandidate], row: int) -> list[PoseCandidate]:
    """Return the surfaces of all objects but one."""
    return [place for other, place in places.items() if other != row]


def _object_at(
    posed: PoseCandidate,
    own: Float,
    known: Sequence[CameraError],
    top: TableTop,
    segments: Sequence[Mask] = (),
) -> _Object | None:
    """Return an object at its known place; None if the frame cannot show it."""
    shift = _shift_to_segment(posed, top, segments)
    surface = PlacedSurface.of(posed, top, shift)
    if surface is None:
        return None
    return _Object(surface, own, tuple(known), top.up, shift)


def _still(objects: Sequence[_Object], expected: CameraError) -> CameraError:
    """Estimate the error of a camera's pose if all objects stand; its covariance is as before."""
    objects = [one for one in objects if one.known]
    if not objects or not expected.covariance.any():
        return expected
    none = replace(expected, motion=np.zeros(6))
    motion = likeliest(
        [one.surface for one in objects],
        [(none.at(one.surface.centre), one.expected(none)[0]) for one in objects],
        expected.motion,
        expected.motion,
        expected.covariance,
    )
    return replace(expected, motion=motion)


def _last_seen(
    track: Track,
    top: TableTop,
    segments: Sequence[Mask],
    tops: Sequence[TableTop],
    cameras: Sequence[CameraError],
) -> _Object | None:
    """Return the part of an object that was seen last; None if the frame cannot show it."""
    posed = seen_surface(track.thing.sightings[-1])
    if posed is None:
        return None
    last = track.frames[-1]
    same = stands_still(top.frame, [tops[last].frame])
    known = [] if same else [cameras[last]]
    radius = track.thing.object_frame.radius
    camera = top.frame.camera_to_world[:3, 3]
    away = float(np.linalg.norm(track.thing.object_frame.centre - camera))
    noise = float(top.noise.at(away) * away**2)  # of both frames, alike in all pixels
    error = float(np.hypot(scan_errors(radius), np.sqrt(2) * noise))
    own = np.diag(np.repeat([(error / radius) ** 2, error**2], 3) / 3)
    return _object_at(posed, own, known, top, segments)


def _of_part(
    change: Change,
    seen: _Object,
    camera: CameraError,
    moved: _Moved,
    way: Float | None,
) -> Change:
    """Consider that the part of an object that was seen last, and is seen again, has moved.

    Args:
        change: of this part, as if nothing stood before it. The poses of the others err, so that
            they may hide less of it than is hidden.
        seen: this part beside the others, which explain what this object need not.
        camera: error of the frame's pose, by the other objects.
        moved: the other objects that moved.
        way: shift of the object by its name, (3,), metres; None without one.
    """
    mean, _ = seen.expected(camera)
    ways = [np.zeros(3), seen.shift, *([] if way is None else [way])]
    starts = [mean + np.append(np.zeros(3), each) for each in ways]
    seen = seen.looked_for(camera, starts)
    stands = max(change.stands, seen.standing(camera))
    return Change(stands, seen.elsewhere(camera, moved), seen.there)


def _whatever_it_is(change: Change, unnamed: Change, confident: bool) -> Change:
    """Consider that a name is wrong: what was seen of the object last stands, or moved.

    Args:
        change: by its name.
        unnamed: by the part that was seen last.
        confident: whether the name is.
    """
    wrong = WRONG_NAMES if confident else WRONG_DOUBTFUL
    right = np.log(1 - wrong)
    stands = np.logaddexp(right + change.stands, np.log(wrong) + unnamed.stands)
    if unnamed.there is None:
        return replace(change, stands=float(stands))
    moves = np.logaddexp(right + change.elsewhere, np.log(wrong) + unnamed.elsewhere)
    return replace(change, stands=float(stands), elsewhere=float(moves))


def _displaced(one: _Object, camera: CameraError) -> PoseCandidate:
    """Return an object that stands as a frame with an error of its pose shows it."""
    mean, _ = one.expected(camera)
    return replace(one.surface.posed, pose=one.surface.pose(mean))


def _own_covariance(track: Track, posed: PoseCandidate, same: bool) -> Float:
    """Covariance of the error of the pose of an object, (6, 6): rotation vector and shift.

    Errors of the scan are a part of it, and other candidates, which may be other things. The same
    view shows both as before, so that they displace nothing between its frames.
    """
    assert track.result is not None
    every = [] if same else track.result.pose_candidates
    off = uncertainty_of([posed, *(one for one in every if one is not posed)])
    radius = track.thing.object_frame.radius
    error = 0.0 if same else float(scan_errors(radius))
    turn = np.hypot(np.radians(off.degrees), error / radius)
    shift = np.hypot(off.millimetres / 1000, error)
    return np.diag(np.repeat([turn**2, shift**2], 3) / 3)


def _agreeing(
    objects: dict[int, _Object],
    expected: CameraError,
) -> tuple[list[int], CameraError]:
    """Find the objects that agree on an error of the camera's pose, and this error.

    Each object that disagrees costs as much as a move is unlikely.

    Args:
        objects: by row.
        expected: error before the comparison.
    """
    seen = {row: one for row, one in objects.items() if one.fit.gain > SURPRISE}
    if not expected.covariance.any():
        return list(seen), expected
    best: tuple[float, list[int], CameraError] = (np.inf, [], expected)
    for tried in [[], *([row] for row in seen), list(seen)]:
        group = tried
        for _ in range(3):
            camera = _camera_by([seen[row] for row in group], expected)
            off = {row: one.deviation(camera) for row, one in seen.items()}
            group = [row for row in seen if off[row] < SURPRISE]
        camera = _camera_by([seen[row] for row in group], expected)
        # an error that is hardly known would agree with everything
        exact = replace(camera, covariance=np.zeros((6, 6)))
        off = {row: one.deviation(exact) for row, one in seen.items()}
        known = np.linalg.solve(expected.covariance, camera.motion)
        cost = 0.5 * float(camera.motion @ known)
        cost += sum(min(one, SURPRISE) for one in off.values())
        if cost < best[0] - 1e-9:
            best = (cost, [row for row in seen if off[row] < SURPRISE], camera)
    return best[1], best[2]


def _camera_by(standing: Sequence[_Object], expected: CameraError) -> CameraError:
    """Estimate the error of a camera's pose by objects that stand."""
    if not expected.covariance.any():
        return expected
    none = replace(expected, motion=np.zeros(6), covariance=np.zeros((6, 6)))
    information = np.linalg.inv(expected.covariance)
    pull = information @ expected.motion

    for one in standing:
        if not one.known:
            continue
        matrix = expected.at(one.surface.centre)
        offset, own = one.expected(none)
        told = _given(one.fit.information, own)
        information = information + matrix.T @ told @ matrix
        pull = pull + matrix.T @ told @ (one.fit.motion - offset)
    covariance = np.linalg.inv(information)
    return replace(expected, motion=covariance @ pull, covariance=covariance)


def _given(information: Float, covariance: Float) -> Float:
    """Information, (6, 6), that is left if something else errs by a covariance, (6, 6)."""
    left = np.linalg.solve(np.eye(6) + information @ covariance, information)
    return np.asarray(left, np.float64)


def _variances() -> Float:
    """Variances of the error between two frames of an arm, (6,)."""
    return 2 * np.repeat([CAMERA_AIM**2, CAMERA_PLACE**2], 3)


def _told_before(track: Track, pose: Float, tops: Sequence[TableTop]) -> float:
    """Nats by which the earlier frames tell the known pose of an object from another, (4, 4)."""
    posed = track.posed
    assert posed is not None
    told = 0.0

    for place, number in enumerate(track.frames):
        old = posed.pose.copy()
        new = pose.copy()
        if len(posed.displacements) == len(track.frames):
            old[:3, 3] += posed.displacements[place]
            new[:3, 3] += posed.displacements[place]
        shift = new[:3, 3] - old[:3, 3]
        before = PlacedSurface.of(replace(posed, pose=old), tops[number], shift)
        if before is not None:
            after = replace(before, posed=replace(posed, pose=new))
            told += before.gain(np.zeros(6)) - after.gain(np.zeros(6))
    return told


def _shift_to_segment(
    posed: PoseCandidate,
    top: TableTop,
    segments: Sequence[Mask],
) -> Float:
    """Distance along the ground, (3,), from an object to the segment that overlaps most with it."""
    none = np.zeros(3)
    surface = PlacedSurface.of(posed, top) if segments else None
    if surface is None:
        return none

    depth = surface.shown()
    shows = np.isfinite(depth)
    points = surface.rays[shows] * depth[shows, None]
    column, row = np.floor(top.frame.pinhole.project(points)).astype(np.int64).T
    over = [np.count_nonzero(mask[row, column]) for mask in segments]
    if not max(over):
        return none

    mask = segments[int(np.argmax(over))] & (top.frame.depth > 0)
    measured = np.median(top.frame.positions(*np.nonzero(mask)), axis=0)
    pose = top.frame.camera_to_world
    shift = measured - np.median(points, axis=0) @ pose[:3, :3].T - pose[:3, 3]
    return np.asarray(shift - (shift @ top.up) * top.up)
