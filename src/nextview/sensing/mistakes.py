"""The mistakes with which depth and poses are read, and the readings of a frame without them.

To add a mistake, with the change that undoes it, add an entry to ``mistakes``. A folder of frames
is checked by ``captured.check``.

A frame has several readings: as it was handed in, or with one of the mistakes undone. The
score of a reading is the sum of the evidence of several facts, in nats: the logarithm of how much
likelier each is for a right reading than for one of which nothing is known. The scores and the
prior probabilities of the mistakes give the probability that the frame is right as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from nextview.errors import ObservationError
from nextview.sensing.agreement import WORLD_CHANGED, SurfaceView, agree, in_one_place
from nextview.sensing.frame import CAMERA_AXES, Frame
from nextview.sensing.known_frames import KnownFrames
from nextview.sensing.planes import TILT, Plane, find_plane, gain_as_range, steep
from nextview.sensing.segmented_frame import SegmentedFrame
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float

UNITS = {
    1.0: "metres",
    0.01: "centimetres",
    0.001: "millimetres",
    0.0254: "inches",
    0.3048: "feet",
}
UNUSUAL = 1e-4  # prior of centimetres, and of a pose of which one half is inverse
REFUSED = 0.01  # probability that a frame is right below which it is refused
TOLD = np.log(10)  # nats of a fact that is told
RARE_FACT = np.log(1e-4)  # of what few right frames show
IMPOSSIBLE = np.log(1e-6)  # of what no right frame shows
LEVEL_ERROR = np.radians(3.0)  # tilt of a level plane by errors of pose and depth
# A camera sees its target, and moves, within so many times the farthest depth that it measures.
TOO_FAR = 2.5
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Stored:
    """Storage conventions of frames and poses, so that messages can name the expected ones.

    Attributes:
        focal_length: of the frames, pixels.
        median_depth: of the frames, metres.
        to_world: whether the poses are camera-to-world; otherwise world-to-camera.
        unit: of the translations, metres.
        step: unit of the depth images, metres; 0 for float metres.
        step_told_by: source of that unit.
    """

    focal_length: float
    median_depth: float = 1.0
    to_world: bool = True
    unit: float = 1.0
    step: float = 0.0
    step_told_by: str = "as uint16 is taken; hand it in as float metres"


@dataclass(frozen=True)
class PosedViews:
    """Frames, and the poses of their cameras, camera-to-world, (N, 4, 4), metres."""

    views: Sequence[SurfaceView]
    poses: Float


@dataclass(frozen=True)
class Mistake:
    """A mistake, with the change that undoes it.

    Attributes:
        name: of the affected quantity; two whose names share a word are not combined.
        sentence: description, the end of a sentence.
        right_poses: function that corrects poses, camera-to-world, (N, 4, 4).
        prior: probability that a single frame has it; 0 if only many frames tell.
        combines: whether it is also tried together with another one.
        scale: factor by which the depth is too large, or the translations are too small.
        focal: factor by which the focal length is too small.
    """

    name: str
    sentence: str
    right_poses: Callable[[Float], Float] = lambda poses: poses
    prior: float = 1e-3
    combines: bool = False
    scale: float = 1.0
    focal: float = 1.0

    def undone(self, posed: PosedViews) -> PosedViews:
        """Return the frames without the mistake."""
        views = posed.views
        if self.focal != 1:
            views = [view.with_focal_length(self.focal) for view in views]
        return PosedViews(views, self.right_poses(posed.poses))

    def with_another(self, other: Mistake) -> Mistake:
        """Return both mistakes, of which this one is undone first."""
        return Mistake(
            f"{self.name}, {other.name}",
            f"{self.sentence} and {other.sentence}",
            lambda poses: other.right_poses(self.right_poses(poses)),
        )

    def of_single_pose(self, row: int, frame: str) -> Mistake:
        """Return the mistake in the pose of one frame alone.

        Args:
            row: of the pose.
            frame: name of the frame.
        """
        return replace(
            self,
            sentence=f"in frame {frame} alone, {self.sentence}",
            right_poses=lambda poses: np.where(
                np.arange(len(poses))[:, None, None] == row,
                self.right_poses(poses),
                poses,
            ),
        )


def mistakes(stored: Stored) -> list[Mistake]:
    """Return all mistakes that frames, or a single one, may have.

    Late poses depend on the order of the frames, see ``captured.late_poses``.

    Args:
        stored: storage conventions of the frames.
    """
    steps = 1e-2 if stored.step else 1e-3  # of frames in 16 bits, one in twenty
    priors = {0.001: 1e-3, 0.01: UNUSUAL, 1 / 0.3048: 1e-3, 1 / 0.0254: 1e-3}
    # The depth units of cameras are 1, 0.5, 0.25, 0.2, 0.125 and 0.1 mm.
    priors |= dict.fromkeys((2, 4, 5, 8, 10), steps)
    units = {round(unit / stored.unit, 6) for unit in UNITS if unit != stored.unit}
    others = (1000, 100, 2.5, 0.5, 0.4, 0.25, 0.2, 0.1, 0.01, 0.001)
    return [
        Mistake(
            "range",
            "the depth is measured along the rays, a range: give it along the optical axis",
        ),
        *in_poses(stored.to_world),
        *(_of_scale(scale, stored, prior) for scale, prior in priors.items()),
        *(_of_scale(scale, stored, 0) for scale in {*others, *units} - {*priors}),
        *(_of_focal_length(k / 20, stored) for k in range(-14, 15) if k),
    ]


def in_poses(to_world: bool = True) -> list[Mistake]:
    """Return the mistakes of single poses: axes, inverse poses, rotated and mirrored images.

    Args:
        to_world: whether camera-to-world poses were expected.
    """
    expected, other = "camera-to-world", "world-to-camera"
    if not to_world:
        expected, other = other, expected

    wrong = f"{expected} ones are expected, and"
    opencv = "and OpenCV's are expected (x right, y down, z forward)"
    by_a_quarter = "the picture is turned to the {} by a quarter turn"
    return [
        Mistake(
            "inverse pose",
            f"the poses are inverse: {wrong} these are {other}",
            _inverted,
            combines=True,
        ),
        Mistake(
            "inverse rotation",
            f"the rotations are inverse: {wrong} only the translations are",
            _in_stored(_rotation_inverted, to_world),
            UNUSUAL,
            combines=True,
        ),
        Mistake(
            "inverse translation",
            f"the translations are those of inverse poses: {wrong} only the rotations are",
            _in_stored(lambda poses: _inverted(_rotation_inverted(poses)), to_world),
            UNUSUAL,
            combines=True,
        ),
        *(
            Mistake(name, sentence, partial(_turned, by=by), combines="axes" in name)
            for name, sentence, by in (
                (
                    "opengl axes",
                    "the camera's axes are those of OpenGL (x right, y up, z backward),"
                    f" {opencv}",
                    CAMERA_AXES["opengl"],
                ),
                (
                    "ros axes",
                    "the camera's axes are those of a ROS body (x forward, y left, z up),"
                    f" {opencv}",
                    CAMERA_AXES["ros"],
                ),
                ("turned", by_a_quarter.format("left"), QUARTER_TURN),
                ("turned", by_a_quarter.format("right"), QUARTER_TURN.T),
                (
                    "turned",
                    "the picture stands on its head, turned by half a turn",
                    np.diag([-1.0, -1, 1]),
                ),
                (
                    "mirrored",
                    "the picture is flipped left to right",
                    np.diag([-1.0, 1, 1]),
                ),
                (
                    "mirrored",
                    "the picture is flipped top to bottom",
                    np.diag([1.0, -1, 1]),
                ),
            )
        ),
        *(
            Mistake(
                "quaternions",
                f"the quaternions are in the order {order}, and were taken for {taken}",
                _in_stored(partial(_quaternions_rolled, steps=steps), of_world),
                combines=True,
            )
            for steps, order, taken in (
                (1, "w, x, y, z", "x, y, z, w"),
                (-1, "x, y, z, w", "w, x, y, z"),
            )
            for of_world in (True, False)
        ),
    ]


def _of_scale(scale: float, stored: Stored, prior: float) -> Mistake:
    """Return the mistake in the unit of translations or of depth, which are equivalent up to scale.

    Translations are multiplied by the scale, or depths divided by it.
    """
    unit = stored.unit * scale
    other = min(UNITS, key=lambda each: abs(np.log(each / unit)))
    translations = ""
    if abs(np.log(other / unit)) < 0.01:
        translations = (
            f"the translations are in {UNITS[other]}, where {UNITS[stored.unit]} are"
            " expected"
        )
    times = max(scale, 1 / scale)
    if stored.step:
        why = (
            f"its steps are of {1000 * stored.step / scale:.3g} mm, not of"
            f" {1000 * stored.step:.3g} mm ({stored.step_told_by})"
        )
    else:
        own = min(UNITS, key=lambda each: abs(np.log(each * scale)))
        named = abs(np.log(own * scale)) < 0.01
        why = f"is it in {UNITS[own] if named else 'another unit'}"
    size = "large" if scale > 1 else "small"
    sentence = f"the depth is {times:g} times too {size}: {why}"
    # a capture of an object has a median depth of 5 cm to 15 m
    if translations and 0.05 <= stored.median_depth <= 15:
        # a large factor is rarely an error of the depth unit
        sentence = translations if times >= 25 else f"{sentence}; or {translations}"
    return Mistake(
        "scale",
        sentence,
        partial(_scaled, scale=scale),
        prior,
        combines=scale in (1000, 0.001, 10, 0.1, 5, 0.2, 4, 0.25),
        scale=scale,
    )


def _of_focal_length(log_times: float, stored: Stored) -> Mistake:
    """Return the mistake of a focal length that must be multiplied by exp(log_times)."""
    times = float(np.exp(log_times))
    wrong = 1 / times - 1
    given = stored.focal_length
    sentence = (
        f"the focal length is some {100 * abs(wrong):.0f} % too"
        f" {'long' if wrong > 0 else 'short'} ({given:.0f} pixels, about {times * given:.0f} fit):"
        " are these the intrinsics of another camera or picture size?"
    )
    return Mistake("focal length", sentence, prior=3e-3, focal=times)


# Changes of camera-to-world poses, (N, 4, 4)


def _in_stored(
    change: Callable[[Float], Float], to_world: bool
) -> Callable[[Float], Float]:
    """Apply a change of the stored poses to camera-to-world poses."""
    if to_world:
        return change
    return lambda poses: _inverted(change(_inverted(poses)))


def _changed(poses: Float, rotations: Float, places: Float) -> Float:
    """Return poses with other rotations, (N, 3, 3), and places, (N, 3)."""
    found = poses.copy()
    found[:, :3, :3] = rotations
    found[:, :3, 3] = places
    return found


def _turned(poses: Float, by: Float) -> Float:
    return _changed(poses, poses[:, :3, :3] @ by, poses[:, :3, 3])


def _scaled(poses: Float, scale: float) -> Float:
    return _changed(poses, poses[:, :3, :3], scale * poses[:, :3, 3])


def _inverted(poses: Float) -> Float:
    return np.asarray(np.linalg.inv(poses), np.float64)


def _rotation_inverted(poses: Float) -> Float:
    return _changed(poses, poses[:, :3, :3].transpose(0, 2, 1), poses[:, :3, 3])


def _quaternions_rolled(poses: Float, steps: int) -> Float:
    """Return the rotations for another order of the quaternion components x, y, z, w."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    # e.g. (x, y, z, w) as read are w, x, y, z: roll to the left by one
    right = Rotation.from_quat(np.roll(quaternions, -steps, axis=1)).as_matrix()
    return _changed(poses, right, poses[:, :3, 3])


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
    read = Reading(frame, known, plane, frame.depth_range, poses)
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
