"""Check a new frame against what is known of its world.

A frame has several readings: as it was handed in, or with one of the usual ``mistakes`` undone. The
score of a reading is the sum of the evidence of several facts, in nats: the logarithm of how much
likelier each is for a right reading than for one of which nothing is known. The scores and the
prior probabilities of the mistakes give the probability that the frame is right as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nextview.checks import one_line
from nextview.errors import ObservationError
from nextview.geometry.axes import upright_axes
from nextview.geometry.viewsphere import VISITED_ANGLE, angle_between, direction_of
from nextview.sensing.agreement import SurfaceView, compare
from nextview.sensing.frame import Frame, one_stand, stands_still
from nextview.sensing.mistakes import Mistake, PosedViews, Stored, mistakes
from nextview.sensing.observation import Observation
from nextview.sensing.planes import (
    POSE_SHIFT,
    TILT,
    Plane,
    find_plane,
    gain_as_range,
    steep,
)
from nextview.sensing.plausibility import check_views
from nextview.sensing.registration import camera_offsets
from nextview.sensing.segmented_frame import SegmentedFrame
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float

REFUSED = 0.01  # probability that a frame is right below which it is refused
TOLD = np.log(10)  # nats of a fact that is told
RARE_FACT = np.log(1e-4)  # of what few right frames show
IMPOSSIBLE = np.log(1e-6)  # of what no right frame shows
WORLD_CHANGED = np.log(0.05)  # of a world in which nothing need agree any more
LEVEL_ERROR = np.radians(3.0)  # tilt of a level plane by errors of pose and depth
# A camera sees its target, and moves, within so many times the farthest depth that it measures.
TOO_FAR = 2.5
# least depth that most cameras measure, and that hardly any falls below, metres
NEAR_RANGE = 0.25, 0.1
REPEATED = ViewWarning(
    "repeated",
    "this picture was handed in before, to the last bit, and counts once: is the camera frozen?",
)


@dataclass(frozen=True)
class KnownFrames:
    """Known world before a new frame.

    Attributes:
        frames: used frames, in order, with their original poses.
        planes: the support plane in each of them; None if it is not visible.
        up: direction against gravity in the world, (3,); None for the normal of the support plane.
        target: expected position of an object, (3,), world, metres; None if not known.
        radius: of that object, metres.
    """

    frames: tuple[Frame, ...] = ()
    planes: tuple[Plane | None, ...] = ()
    up: Float | None = None
    target: Float | None = None
    radius: float = 0.0

    def refuse(self, frame: Frame) -> None:
        """Reject input that cannot be another frame of the same world, whatever it shows.

        Args:
            frame: new frame.

        Raises:
            ObservationError: the type is wrong, or the pose is missing.
        """
        if not isinstance(frame, Frame):
            raise ObservationError(
                f"what a depth camera gave is a Frame, not {one_line(repr(frame))}"
            )
        if self.frames and (frame.pose is None or self.frames[0].pose is None):
            raise ObservationError(
                "a second frame needs a pose, and the first one too: without poses they cannot be"
                " put together"
            )

    def stands(self, frame: Frame) -> bool:
        """Return True if the camera of a frame has a name and has never moved.

        Args:
            frame: new frame.
        """
        own = [one for one in self.frames if one.camera == frame.camera]
        return bool(own) and stands_still(frame, own)

    def check(self, frame: Frame, plane: Plane | None) -> list[ViewWarning]:
        """Return likely problems of a frame that was not rejected; usually empty.

        Args:
            frame: new frame.
            plane: the support plane in this frame; None if it is not visible.
        """
        found = []
        height, width = frame.shape
        x, y = frame.intrinsics[:2, 2]
        if max(abs(2 * x / width - 1), abs(2 * y / height - 1)) > 0.25:
            message = (
                f"the principal point ({x:.0f}, {y:.0f}) is far from the middle of an image of"
                f" {width} x {height}: intrinsics of another resolution, unless the image is a"
                " part of a larger one"
            )
            found.append(ViewWarning("intrinsics", message))
        middle = _depths(frame)[1]
        if middle < NEAR_RANGE[1]:
            message = (
                f"the depth has a median of {100 * middle:.1f} cm, and hardly any depth camera"
                " measures so near: is it ten times too small, as by a wrong depth scale?"
            )
            found.append(ViewWarning("unit", message, holds=False))
        own = [one for one in self.frames if one.camera == frame.camera]
        if own and not self.stands(frame) and _has_old_pose(frame, own[-1]):
            message = (
                "the picture changed, the pose did not: an old pose, or a moved object?"
            )
            found.append(ViewWarning("stale pose", message))

        # the error of the pose of a camera relative to the first camera with a name
        named = [one for one in self.frames if one.camera]
        if frame.camera and named and named[0].camera != frame.camera:
            reference = [one for one in named if one.camera == named[0].camera]
            found += [
                ViewWarning("camera", str(offset), holds=False)
                for offset in camera_offsets([[reference[-1], frame]])
                if offset.noticed
            ]
        leans = self._lean((*self.frames, frame), (*self.planes, plane))
        if leans is not None:
            message = (
                f"the support plane leans by {leans:.1f} degrees against up: a tilted table,"
                " is it another surface than the support, or is up another direction?"
            )
            found.append(ViewWarning("lean", message, holds=False))
        return found

    def _lean(
        self, frames: Sequence[Frame], planes: Sequence[Plane | None]
    ) -> float | None:
        """Return the tilt of the support plane, degrees; None if it is none.

        A single frame may have depth errors. With a box, one frame may yield the seat of a chair
        as its plane, and another the floor: the planes of the lowest surface count.
        """
        shown = [
            (plane, frame.camera_to_world)
            for plane, frame in zip(planes, frames, strict=True)
            if plane is not None
        ]
        if self.target is not None and shown:
            above = np.array([float(plane.height(self.target)) for plane, _ in shown])
            lowest = np.flatnonzero(above > above.max() - POSE_SHIFT)
            shown = [shown[row] for row in lowest]
        if self.up is None or len(shown) < 2:
            return None
        own, poses = zip(*shown, strict=True)
        return lean_of(own, poses, upright_axes(self.up))


def check_sizes(
    frame: Frame, sizes: Sequence[Float], smallest: float
) -> list[ViewWarning]:
    """Warn if all that is seen is both too near and too small for what is known.

    Either alone may be right: a camera for short distances, or a table of small strangers.

    Args:
        frame: that shows the objects.
        sizes: extents of each object, (3,), metres; none for no warning.
        smallest: diameter of the smallest known thing, metres.
    """
    middle = _depths(frame)[1]
    largest = max((float(np.linalg.norm(size)) for size in sizes), default=np.inf)
    # a thing may be seen from its small end
    if not NEAR_RANGE[1] <= middle < NEAR_RANGE[0] or largest > smallest / 2:
        return []
    message = (
        f"the depth has a median of {100 * middle:.0f} cm, and the largest object in sight measures"
        f" {100 * largest:.1f} cm, the smallest known one {100 * smallest:.1f} cm: is the depth"
        " several times too small, as by a wrong depth scale?"
    )
    return [ViewWarning("unit", message, holds=False)]


def repeated(
    frame: Frame, earlier: Sequence[Frame], any_mask: bool = False
) -> int | None:
    """Return which earlier frame a frame repeats, as from a camera that is frozen.

    No two images of a depth camera are bitwise identical, so such a frame was not captured at its
    stated pose.

    Args:
        frame: new frame.
        earlier: used frames, in order.
        any_mask: whether it repeats one with another mask, too, as all frames show one object.

    Returns:
        Its position in ``earlier``; None if the frame is new.
    """
    for number, one in enumerate(earlier):
        if np.array_equal(one.depth, frame.depth) and (
            any_mask or one.mask is frame.mask or np.array_equal(one.mask, frame.mask)  # type: ignore[arg-type]
        ):
            return number
    return None


def repeated_observation(seen: Observation, earlier: Sequence[Observation]) -> bool:
    """Return True if an observation repeats the image of an earlier one.

    Two renders of a symmetric object may also be identical, but only after a rotation about the
    vertical.

    Args:
        seen: the observation.
        earlier: the earlier observations.
    """
    towards = direction_of(seen.pose)
    return any(
        one.seen
        and np.array_equal(one.depth, seen.depth)
        and (
            angle_between(direction_of(one.pose), towards) <= VISITED_ANGLE
            or not np.allclose(one.pose[2], seen.pose[2], atol=1e-4)
            or bool(check_views(one, seen))
        )
        for one in earlier
    )


def lean_of(
    planes: Sequence[Plane], cameras: Sequence[Float], axes: Float
) -> float | None:
    """Estimate the tilt of the support plane from several frames.

    Depth errors tilt the plane in a direction fixed to the camera, which changes in the world with
    the viewing direction. The tilt that is constant in the world belongs to the plane. In fifty
    frames of a real Kinect with exact poses, the median tilt is 1.3 degrees, and the largest tenth
    exceeds 2.7 degrees.

    Args:
        planes: the support plane in each frame.
        cameras: camera-to-world poses, (4, 4) each.
        axes: rows x, y and z (up), (3, 3).

    Returns:
        Degrees; None below one degree, and where errors of the cameras explain it.
    """
    of_frame, of_depth, unknown = np.radians([0.5, 2.0, 30.0])
    leans = np.array([axes[:2] @ plane.normal for plane in planes])
    weights = 1 / (of_frame**2 + np.array([plane.lean_error for plane in planes]) ** 2)
    ahead = np.array([axes[:2] @ pose[:3, 2] for pose in cameras])
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)

    # In complex numbers: lean = own + ahead * of_camera + error of the frame.
    measured = leans @ [1, 1j]
    matrix = np.stack([np.ones(len(measured)), ahead @ [1, 1j]], 1)
    prior = np.diag([unknown**-2, of_depth**-2])
    covariance = np.linalg.inv((matrix.conj().T * weights) @ matrix + prior)
    found = covariance @ ((matrix.conj().T * weights) @ measured)

    # Increase the uncertainty if frames disagree by more than their pose errors.
    left = np.abs(measured - matrix @ found) ** 2 * weights / 2
    disagree = max(1.0, float(np.sqrt(left.sum() / max(1, len(left) - 1))))
    deviation = disagree * float(np.sqrt(covariance[0, 0].real))
    size = float(np.abs(found[0]))
    return float(np.degrees(size)) if size > max(3 * deviation, np.radians(1)) else None


def _has_old_pose(frame: Frame, last: Frame) -> bool:
    """Return True if the image has changed since the previous frame, but the pose has not."""
    if frame.shape != last.shape or not one_stand(frame, last):
        return False
    now, then = (one.depth[::4, ::4] for one in (frame, last))
    both = (now > 0) & (then > 0)
    changed = np.abs(now - then)[both] > 0.04 * now[both]
    return len(changed) > 0 and float(changed.mean()) > 0.03


def _depths(frame: Frame) -> Float:
    """Return the nearest, without flying pixels, median and farthest depth, (3,), metres."""
    few = frame.depth[::4, ::4]
    few = few[few > 0] if few.any() else frame.depth[frame.depth > 0]
    return np.array([*np.quantile(few, [0.02, 0.5]), frame.depth.max()])


# The readings of a frame


@dataclass(frozen=True)
class Fact:
    """What one fact tells about a reading.

    Attributes:
        nats: evidence for the reading.
        words: what tells against it, if it does.
        warning: name of the warning about it.
    """

    nats: float = 0.0
    words: str = ""
    warning: str = "pose"


@dataclass(frozen=True)
class Reading:
    """One reading of a frame.

    Attributes:
        frame: as it was handed in.
        known: what it is compared with.
        plane: the largest plane, in the camera frame; None without.
        depths: nearest, median and farthest depth, (3,), metres.
        poses: of the last frame, or the identity, and of this one, camera-to-world, (2, 4, 4).
        scale: number by which the depth is multiplied.
        agreement: nats of the agreement with the last frame.
        flatness: nats of the samples that lie on planes.
        mistake: that is undone; None for none.
    """

    frame: Frame
    known: KnownFrames
    plane: Plane | None
    depths: Float
    poses: Float
    scale: float = 1.0
    agreement: float = 0.0
    flatness: float = 0.0
    mistake: Mistake | None = None

    def facts(self) -> list[Fact]:
        """Return what tells for and against this reading."""
        _, middle, farthest = self.depths
        last, place = self.poses[:, :3, 3]
        # A robot's camera is near the origin of its world, or sees as far as it is away.
        far = median_range = motion = Fact()
        away = float(np.linalg.norm(place))
        if away >= max(30, 20 * middle):
            words = (
                f"the camera is {away:.0f} m from the world's origin, and sees"
                f" {middle:.2g} m far"
            )
            far = Fact(RARE_FACT, words, "far origin")
        if middle >= 10:  # metres, range of most depth cameras
            words = f"the depth has a median of {middle:.0f} m"
            median_range = Fact(RARE_FACT, words, "unit")
        if self.known.frames:  # a camera moves through what it sees
            moved = float(np.linalg.norm(place - last))
            reach = farthest + self.scale * float(self.known.frames[-1].depth.max())
            if moved >= TOO_FAR * reach:
                words = (
                    f"the camera is {moved:.0f} m from where it was, and what it sees is"
                    f" within {reach:.1f} m"
                )
                motion = Fact(IMPOSSIBLE, words)
        return [
            far,
            median_range,
            motion,
            self._of_target(),
            *self._of_plane(),
            Fact(self.agreement, "the frame does not agree with the last one"),
            Fact(self.flatness, "what is flat looks curved"),
        ]

    def _of_target(self) -> Fact:
        """An object is in sight of the camera that looks at it, and not before all that is seen."""
        known = self.known
        if known.target is None or self.frame.mask is not None:
            return Fact()
        nearest, _, farthest = self.depths
        pose = self.poses[1]
        in_camera = pose[:3, :3].T @ (known.target - pose[:3, 3])
        away = float(np.linalg.norm(in_camera))
        if away - known.radius > TOO_FAR * farthest:
            words = (
                f"the target is {away:.0f} m away, and nothing in the frame is farther than"
                f" {farthest:.1f} m"
            )
            return Fact(IMPOSSIBLE, words)

        words = "nothing is seen where the target is"
        if in_camera[2] <= 0:
            return Fact(0.0, words)
        column, row = self.frame.pinhole.project(in_camera[None])[0]
        height, width = self.frame.shape
        if not (0 <= column < width and 0 <= row < height):
            return Fact(0.0, words)
        top, left = max(0, int(row) - 4), max(0, int(column) - 4)
        around = self.frame.depth[top : int(row) + 5, left : int(column) + 5]
        if not around.any():
            return Fact(0.0, words)
        there = self.scale * float(np.median(around[around > 0]))
        if min(there, nearest) < 1.2 * (in_camera[2] + known.radius):
            return Fact(_coincidence(np.log(there / in_camera[2]), 0.15), words)
        return Fact(RARE_FACT, "all that is seen is far behind the target", "unit")

    def _of_plane(self) -> tuple[Fact, Fact]:
        """The largest plane is mostly a floor, table or wall, and often level with the origin."""
        plane = self.plane
        if plane is None:
            return Fact(), Fact()
        pose = self.poses[1]
        level = Fact()
        normal = pose[:3, :3] @ plane.normal
        up = normal if self.known.up is None else self.known.up
        rise = float(normal @ up)
        if self.known.up is not None:
            sharpness = LEVEL_ERROR**-2
            floor = sharpness * np.exp(sharpness * (rise - 1))
            # few largest planes are neither level nor vertical
            nats = float(np.log(floor + _normal(rise, LEVEL_ERROR) + 3e-4))
            level = Fact(nats, "the largest plane in view is not level")

        stands = float(pose[:3, 3] @ up)
        lies = stands - plane.offset
        where = f"{abs(lies):.2g} m {'above' if lies > 0 else 'below'}"
        words = f"the largest plane in view lies {where} the world's origin"
        if stands <= 0 or rise < TILT:
            return level, Fact(np.log(0.5), words, "unit")
        nats = _coincidence(np.log(stands / plane.offset), 0.03)
        return level, Fact(nats, words, "unit")

    def without(self, mistake: Mistake, views: Sequence[SurfaceView]) -> list[Reading]:
        """Return the readings with a mistake undone.

        A mistake in a pose may be in that of the new frame alone, a wrong unit also in that of the
        last one. Depth and focal length of both frames are alike.

        Args:
            mistake: the mistake.
            views: the last frame and this one; none without a last one.
        """
        right = mistake.undone(PosedViews(views, self.poses))
        alone = np.stack([self.poses[0], right.poses[1]])
        plane = self.plane
        if plane is not None and mistake.scale > 1:
            plane = replace(plane, offset=plane.offset / mistake.scale)
        if plane is not None and mistake.focal != 1:
            normal = plane.normal * [mistake.focal, mistake.focal, 1]
            length = float(np.linalg.norm(normal))
            plane = Plane(normal / length, plane.offset / length)

        other = replace(self, plane=plane, mistake=mistake)
        if mistake.scale > 1:
            scale = 1 / mistake.scale
            other = replace(other, depths=scale * self.depths, scale=scale)
            return [other.agreeing(right.views, right.poses)]

        tried = [alone, right.poses] if mistake.scale < 1 else [alone]
        return [
            replace(other, poses=poses).agreeing(right.views, poses) for poses in tried
        ]

    def agreeing(self, views: Sequence[SurfaceView], poses: Float) -> Reading:
        """Return the reading with its agreement with the last frame.

        Where the last frame is confirmed by the frame as it is, no other reading agrees.

        Args:
            views: the last frame and this one; none without a last one.
            poses: of both, camera-to-world, (2, 4, 4).
        """
        if not views:
            return self
        nats = WORLD_CHANGED
        if self.agreement <= 0:
            nats = 0.0 if in_one_place(poses, self.depths[1]) else agree(views, poses)
        return replace(self, agreement=nats)


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


def check_mistakes(seen: SegmentedFrame, known: KnownFrames) -> list[ViewWarning]:
    """Warn if a frame was probably read with a mistake, or shows what few right frames do.

    Args:
        seen: the frame with its surfaces.
        known: what it is compared with.

    Raises:
        ObservationError: it was certainly read with a mistake, which is named.
    """
    frame = seen.frame
    up = known.up
    if up is None:
        shown = [plane for plane in known.planes if plane is not None]
        up = shown[0].normal if shown else None
    known = replace(known, up=None if frame.pose is None else up)
    last = known.frames[-1] if known.frames else frame
    rng = np.random.default_rng(0)
    views = [SurfaceView.of(one, rng, whole=True) for one in (last, frame)]
    poses = np.stack([last.camera_to_world, frame.camera_to_world])
    plane, flatter = _largest_plane(seen, known.up)
    read = Reading(frame, known, plane, _depths(frame), poses)
    if known.frames:
        read = replace(read, agreement=agree(views, poses))
    others = []
    if known.target is not None:
        words = "target and pose are of different worlds"
        other = replace(read, known=replace(known, target=None))
        others.append(replace(other, mistake=Mistake("world", words)))
    if known.frames:
        words = "the pose is of another world than the last one"
        other = replace(read, known=replace(known, frames=()), agreement=0.0)
        others.append(replace(other, mistake=Mistake("world", words)))
    stored = Stored(frame.intrinsics[0, 0], step=0.001 if frame.counted else 0.0)
    of_focal_length = []
    for mistake in mistakes(stored):
        if mistake.name == "range":
            # nats if all samples lie on a plane in one reading, and none in the other
            other = replace(read, flatness=320.0 * flatter, mistake=mistake)
            others.append(other)
        elif mistake.focal != 1:
            of_focal_length += read.without(mistake, views if known.frames else ())
        elif mistake.prior and (frame.pose is not None or mistake.scale > 1):
            others += read.without(mistake, views if known.frames else ())

    told = _told(read, others)
    if told is not None:
        right, warning, kind = told
        if right < REFUSED:
            raise ObservationError(warning.message, kind)
        return [replace(warning, message=f"{warning.message}?")]
    told = _told(read, of_focal_length)
    if told is None:
        return []
    # the plane may be a ramp
    return [ViewWarning("intrinsics", told[1].message, holds=False)]


def _told(
    read: Reading, others: Sequence[Reading]
) -> tuple[float, ViewWarning, str] | None:
    """Return the probability that a frame is right, what is said, and the likeliest mistake's name;
    None for nothing.

    Args:
        read: the frame as it was handed in.
        others: readings with a mistake undone.
    """
    facts = read.facts()
    as_read = np.array([fact.nats for fact in facts])
    gains = np.array([[fact.nats for fact in one.facts()] for one in others]) - as_read
    undone = [one.mistake for one in others if one.mistake is not None]
    nats = gains.sum(1) + np.log([mistake.prior for mistake in undone])
    right = 1 / (1 + np.exp(np.minimum(nats, 500)).sum())
    if right >= 0.5:
        # few right frames show what this one does
        rare = (as_read <= RARE_FACT) & (gains > TOLD).any(0)
        if not rare.any():
            return None
        nats = np.where((gains[:, rare] > TOLD).any(1), nats, -np.inf)

    best = int(nats.argmax())
    order = np.argsort(-gains[best])
    told = order[gains[best, order] >= min(TOLD, gains[best].max())]
    # each mistake once, and of focal lengths the likeliest
    named: dict[str, str] = {}
    for row in np.argsort(-nats, kind="stable"):
        one = undone[row]
        if nats[row] > nats[best] - np.log(3):
            named.setdefault(one.sentence if one.focal == 1 else one.name, one.sentence)
    words = ", and ".join(facts[row].words for row in told)
    message = f"{words}: {'; or '.join(named.values())}"
    return right, ViewWarning(facts[told[0]].warning, message), undone[best].name


def _coincidence(difference: float, error: float) -> float:
    """Return the evidence of two lengths that half of all right readings have equal, nats.

    Of lengths of which nothing is known, all of 1 mm to 1 km are alike likely.

    Args:
        difference: of their logarithms.
        error: standard deviation of the difference where they are equal.
    """
    return float(np.log(0.5 + 0.5 * np.log(1e6) * _normal(difference, error)))


def _normal(value: float, deviation: float) -> float:
    """Return the density of a normal distribution with mean 0."""
    density = np.exp(-0.5 * (value / deviation) ** 2)
    return float(density / (np.sqrt(2 * np.pi) * deviation))


def _largest_plane(
    seen: SegmentedFrame, up: Float | None
) -> tuple[Plane | None, float]:
    """Return the largest plane, in the camera frame, and the gain of a range.

    A level plane is taken for the largest one unless another has twice as many samples.

    Returns:
        The plane; None if there is none. The share of samples that lie on a plane only if the depth
        is read as range along each ray.
    """
    frame = seen.frame
    samples = seen.surface_samples
    rng = np.random.default_rng(0)
    flat = samples if up is None else samples.some(~steep(samples, up))
    shares = [float(level.plane.holds(flat).mean()) for level in seen.levels]
    share = max(shares, default=0.0)
    plane = seen.levels[int(np.argmax(shares))].plane if shares else None

    largest = find_plane(samples, rng)
    flatter = gain_as_range(frame, largest, samples, rng)
    if up is not None and share < 1 / 3 and largest is not None:
        larger = largest.holds(samples).mean() > 2 * share
        plane = largest if larger else plane
    if plane is None:
        return None, flatter
    pose = frame.camera_to_world
    normal = pose[:3, :3].T @ plane.normal
    return Plane(normal, float(plane.height(pose[:3, 3]))), flatter
