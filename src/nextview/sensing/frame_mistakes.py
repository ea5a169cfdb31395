"""Find the mistake with which a new frame was read, from what a right frame of its world shows.

A frame has several readings: as it was read, or with one of the usual ``mistakes`` undone. The
score of a reading is the sum of the evidence of several facts, in nats: the logarithm of how much
likelier each is for a right reading than for one of which nothing is known. The scores and the
prior probabilities of the mistakes give the probability that the frame is right as it was read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nextview.errors import ObservationError
from nextview.sensing.agreement import compare, quick_view
from nextview.sensing.frame import Frame
from nextview.sensing.known_frames import KnownFrames
from nextview.sensing.mistakes import (
    LEVEL_ERROR,
    Mistake,
    PosedViews,
    Stored,
    in_one_place,
    judgeable,
    mistakes_of_frame,
)
from nextview.sensing.planes import TILT, Plane, find_plane, gain_as_range, steep
from nextview.sensing.segmented_frame import SegmentedFrame
from nextview.sensing.view_warning import ViewWarning
from nextview.types import Float, Float32

# probabilities that a frame is right below which it is refused, or warned of
REFUSED = 0.01
WARNED = 0.5
AS_LIKELY = np.log(3)  # nats within which several mistakes are named
TOLD = np.log(10)  # nats of a fact that is told
OTHER_WORLD = 1e-3  # prior of a target, or of earlier frames, in another world
RARE_FACT = np.log(1e-4)  # of what few right frames show
IMPOSSIBLE = np.log(1e-6)  # of what no right frame shows

COUNTED = Stored(step_told_by="as uint16 is taken; hand it in as float metres")
MEASURED = Stored(step=0.0)

WORKSPACE = 30.0  # metres from the world's origin within which robots work
FARTHEST_MEDIAN = 10.0  # metres, range of most depth cameras
# A camera sees its target, and moves, within a few times the farthest depth that it measures.
TOO_FAR = 2.5
BEHIND_TARGET = (
    1.2  # multiple of the target's distance beyond which a surface is behind it
)
UNKNOWN_LENGTHS = np.log(
    1e6
)  # range of lengths of which nothing is known, 1 mm to 1 km
HEIGHT_ERROR = 0.03  # relative error of the height of a camera above a plane
TARGET_ERROR = 0.15  # relative distance of an object's surface from its centre
LEVEL_NATS = -2 * np.log(LEVEL_ERROR)  # of a plane that is exactly level
OBLIQUE = 3e-4  # share of frames whose largest plane is neither level nor vertical
LARGE_SHARE = 1 / 3  # of the samples on a plane, so that no other one has twice as many
ALL_FLAT = (
    320.0  # nats if all samples lie on a plane in one reading, and none in the other
)
INDEPENDENT_SURFACES = 15  # that two frames see
CONFIRMED = 2.0  # nats of a surface that both frames see in the same place
CONTRADICTED = -4.0  # nats of a surface that one frame sees through
WORLD_CHANGED = np.log(
    0.05
)  # of a world that has changed since, so that nothing need agree
FEWEST_JUDGED = 100  # judgements without which frames do not overlap


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
class FrameReading:
    """One reading of a frame.

    Attributes:
        frame: as it was read.
        known: what it is compared with.
        plane: the largest plane, in the camera frame, of the depth as it was read; None without.
        depths: nearest, median and farthest depth as it was read, (3,), metres.
        pose: camera-to-world in this reading, (4, 4), metres.
        last_pose: of the last frame in this reading, (4, 4); the identity without.
        depth_scale: number by which the depth is multiplied in this reading.
        agreement: nats of the agreement with the last frame.
        flatness: nats of the samples that lie on planes.
    """

    frame: Frame
    known: KnownFrames
    plane: Plane | None
    depths: Float
    pose: Float
    last_pose: Float
    depth_scale: float = 1.0
    agreement: float = 0.0
    flatness: float = 0.0

    @property
    def nearest(self) -> float:
        """Nearest depth, without flying pixels, metres."""
        return self.depth_scale * float(self.depths[0])

    @property
    def median(self) -> float:
        """Median depth, metres."""
        return self.depth_scale * float(self.depths[1])

    @property
    def farthest(self) -> float:
        """Farthest depth, metres."""
        return self.depth_scale * float(self.depths[2])


# Facts


def place(reading: FrameReading) -> Fact:
    """A robot's camera is near the origin of its world, or sees as far as it is away."""
    away = float(np.linalg.norm(reading.pose[:3, 3]))
    if away < max(WORKSPACE, 20 * reading.median):
        return Fact()
    words = (
        f"the camera is {away:.0f} m from the world's origin, and sees"
        f" {reading.median:.2g} m far"
    )
    return Fact(RARE_FACT, words, "far origin")


def depth(reading: FrameReading) -> Fact:
    """Most depth cameras measure up to ten metres."""
    middle = reading.median
    if middle < FARTHEST_MEDIAN:
        return Fact()
    return Fact(RARE_FACT, f"the depth has a median of {middle:.0f} m", "unit")


def motion(reading: FrameReading) -> Fact:
    """A camera moves through what it sees."""
    last = reading.known.last
    if last is None:
        return Fact()
    moved = np.linalg.norm(reading.pose[:3, 3] - reading.last_pose[:3, 3])
    reach = reading.farthest + reading.depth_scale * float(last.depth.max())
    if moved < TOO_FAR * reach:
        return Fact()
    words = (
        f"the camera is {moved:.0f} m from where it was, and what it sees is within"
        f" {reach:.1f} m"
    )
    return Fact(IMPOSSIBLE, words)


def target(reading: FrameReading) -> Fact:
    """An object is in sight of the camera that looks at it, and not before all that is seen."""
    if reading.known.target is None or reading.frame.mask is not None:
        return Fact()
    pose = reading.pose
    in_camera = pose[:3, :3].T @ (reading.known.target - pose[:3, 3])
    away = float(np.linalg.norm(in_camera))
    radius = reading.known.radius
    if away - radius > TOO_FAR * reading.farthest:
        words = (
            f"the target is {away:.0f} m away, and nothing in the frame is farther than"
            f" {reading.farthest:.1f} m"
        )
        return Fact(IMPOSSIBLE, words)

    words = "nothing is seen where the target is"
    around = _around(reading.frame, in_camera)
    if not len(around):
        return Fact(0.0, words)
    there = reading.depth_scale * float(np.median(around))
    found = _coincidence(np.log(there / in_camera[2]), TARGET_ERROR)
    if min(there, reading.nearest) < BEHIND_TARGET * (in_camera[2] + radius):
        return Fact(found, words)
    return Fact(RARE_FACT, "all that is seen is far behind the target", "unit")


def level(reading: FrameReading) -> Fact:
    """The largest plane is mostly a floor, a table or a wall."""
    if reading.plane is None or reading.known.up is None:
        return Fact()
    rise = _rise(reading)
    sharpness = 1 / LEVEL_ERROR**2
    floor = sharpness * np.exp(sharpness * (rise - 1))
    wall = _normal(rise, LEVEL_ERROR)
    nats = float(np.log(floor + wall + OBLIQUE))
    return Fact(nats, "the largest plane in view is not level")


def height(reading: FrameReading) -> Fact:
    """The largest plane is often level with the world's origin: a table, or the floor."""
    if reading.plane is None:
        return Fact()
    up = reading.known.up
    if up is None:
        up = reading.pose[:3, :3] @ reading.plane.normal
    stands = float(reading.pose[:3, 3] @ up)
    above = reading.depth_scale * reading.plane.offset
    lies = stands - above
    where = f"{abs(lies):.2g} m {'above' if lies > 0 else 'below'}"
    words = f"the largest plane in view lies {where} the world's origin"
    if stands <= 0 or (reading.known.up is not None and _rise(reading) < TILT):
        return Fact(np.log(0.5), words, "unit")
    return Fact(_coincidence(np.log(stands / above), HEIGHT_ERROR), words, "unit")


def agreement(reading: FrameReading) -> Fact:
    """Two frames see the same surfaces in the same places, unless the world has changed."""
    return Fact(reading.agreement, "the frame does not agree with the last one")


def flatness(reading: FrameReading) -> Fact:
    """Floors, tables and walls are flat."""
    return Fact(reading.flatness, "what is flat looks curved")


FACTS = (place, depth, motion, target, level, height, agreement, flatness)


def _coincidence(difference: float, error: float) -> float:
    """Return the evidence of two lengths that half of all right readings have equal, nats.

    Args:
        difference: of their logarithms.
        error: standard deviation of the difference where they are equal.
    """
    return float(np.log(0.5 + 0.5 * UNKNOWN_LENGTHS * _normal(difference, error)))


def _normal(value: float, deviation: float) -> float:
    """Return the density of a normal distribution with mean 0."""
    return float(
        np.exp(-0.5 * (value / deviation) ** 2) / (np.sqrt(2 * np.pi) * deviation)
    )


def _rise(reading: FrameReading) -> float:
    """Return the cosine of the angle between the normal of the largest plane and up."""
    assert reading.plane is not None
    assert reading.known.up is not None
    return float(reading.pose[:3, :3] @ reading.plane.normal @ reading.known.up)


def _around(frame: Frame, in_camera: Float) -> Float32:
    """Return the depths as read around a point in the camera frame, (N,); empty out of sight."""
    none = np.zeros(0, np.float32)
    if in_camera[2] <= 0:
        return none
    height, width = frame.shape
    column, row = frame.pinhole.project(in_camera[None])[0]
    if not (0 <= column < width and 0 <= row < height):
        return none
    column, row = int(column), int(row)
    around = frame.depth[max(0, row - 4) : row + 5, max(0, column - 4) : column + 5]
    return around[around > 0]


# Decision


@dataclass(frozen=True)
class Explained:
    """A reading with the mistake that it undoes.

    Attributes:
        sentence: of the mistake; "" for the frame as it was read.
        facts: one for each of ``FACTS``.
        prior: probability of the mistake.
    """

    sentence: str
    facts: tuple[Fact, ...]
    prior: float = 1.0

    @property
    def nats(self) -> float:
        """Logarithm of the probability, up to a constant."""
        return float(np.log(self.prior)) + sum(fact.nats for fact in self.facts)


def check_mistakes(seen: SegmentedFrame, known: KnownFrames) -> list[ViewWarning]:
    """Warn if a frame was probably read with a mistake, or shows what few right frames do.

    Args:
        seen: the frame with its surfaces.
        known: what it is compared with.

    Raises:
        ObservationError: it was certainly read with a mistake, which is named.
    """
    frame = seen.frame
    known = replace(known, up=None if frame.pose is None else known.upwards)
    views = [] if known.last is None else [quick_view(f) for f in (known.last, frame)]
    last_pose = (known.last or frame).camera_to_world
    poses = np.stack([last_pose, frame.camera_to_world])
    posed = PosedViews(views, poses, COUNTED if frame.counted else MEASURED)
    plane, flatter = _surfaces(seen, known.up)
    read = FrameReading(frame, known, plane, _depths(frame), poses[1], poses[0])
    read = replace(read, agreement=_agreement(posed))
    as_read = Explained("", _facts(read))
    rare = [row for row, fact in enumerate(as_read.facts) if fact.nats <= RARE_FACT]
    mistakes = mistakes_of_frame(posed.stored, frame.pose is not None)
    flatness = ALL_FLAT * flatter
    if not rare and _is_beyond_doubt(as_read, read, mistakes, flatness):
        return []

    others = _other_worlds(read)
    for mistake in mistakes:
        for other in _undone(mistake, read, posed):
            if mistake.kind == "range":
                other = replace(read, flatness=flatness)
            others.append(Explained(mistake.sentence, _facts(other), mistake.prior))
    odds = np.exp([min(one.nats - as_read.nats, 500) for one in others])
    right = 1 / (1 + odds.sum())
    if right >= WARNED:
        others = [one for one in others if any(_gains(one, as_read)[rare] > TOLD)]
        if not others:
            return []

    best = max(others, key=lambda one: one.nats)
    gains = _gains(best, as_read)
    told = [row for row in np.argsort(-gains) if gains[row] >= min(TOLD, gains.max())]
    facts = [as_read.facts[row] for row in told]
    likely = [one.sentence for one in others if one.nats > best.nats - AS_LIKELY]
    named = dict.fromkeys(likely)  # each once
    words = f"{', and '.join(fact.words for fact in facts)}: {'; or '.join(named)}"
    if right < REFUSED:
        raise ObservationError(words)
    return [ViewWarning(facts[0].warning, f"{words}?")]


def _gains(one: Explained, as_read: Explained) -> Float:
    """Return the gain of evidence of each fact by a reading, nats."""
    return np.array([fact.nats for fact in one.facts]) - [f.nats for f in as_read.facts]


def _is_beyond_doubt(
    as_read: Explained,
    read: FrameReading,
    mistakes: Sequence[Mistake],
    flatness: float,
) -> bool:
    """Return True if no mistake could be likely even if all other facts were for it."""
    most = flatness + LEVEL_NATS + _coincidence(0, HEIGHT_ERROR)
    if read.known.target is not None:
        most += _coincidence(0, TARGET_ERROR)
    if read.known.last is not None:
        most += (
            WORLD_CHANGED if read.agreement > 0 else CONFIRMED * INDEPENDENT_SURFACES
        )
    prior = sum(mistake.prior for mistake in mistakes) + 2 * OTHER_WORLD
    return bool(np.log(prior) + most < as_read.nats)


def _undone(
    mistake: Mistake, read: FrameReading, posed: PosedViews
) -> list[FrameReading]:
    """Return the readings of a frame with a mistake undone.

    A mistake in a pose may be in that of the new frame alone, a wrong unit also in that of the last
    one. The depth of both frames is in one unit.
    """
    right = mistake.undone(posed)
    alone = right.with_poses(np.stack([read.last_pose, right.poses[1]]))
    found = []
    for one in (alone, right) if mistake.scale < 1 else (alone,):
        other = replace(read, pose=one.poses[1], last_pose=one.poses[0])
        if mistake.scale > 1:
            other = replace(read, depth_scale=1 / mistake.scale)
            one = right
        if posed.views and mistake.kind != "range":
            # Where the last pose is confirmed, no other one agrees.
            nats = WORLD_CHANGED
            if read.agreement <= 0:
                nats = 0.0 if in_one_place(one) else _agreement(one)
            other = replace(other, agreement=nats)
        found.append(other)
    return found


def _other_worlds(read: FrameReading) -> list[Explained]:
    """Return the readings in which the pose has nothing to do with what is known."""
    known = read.known
    found = []
    if known.target is not None:
        other = replace(read, known=replace(known, target=None))
        words = "target and pose are of different worlds"
        found.append(Explained(words, _facts(other), OTHER_WORLD))
    if known.last is not None:
        other = replace(read, known=replace(known, frames=()), agreement=0.0)
        words = "the pose is of another world than the last one"
        found.append(Explained(words, _facts(other), OTHER_WORLD))
    return found


def _depths(frame: Frame) -> Float:
    """Return the nearest, the median and the farthest depth, (3,), metres."""
    few = frame.depth[::4, ::4]
    few = few[few > 0] if few.any() else frame.depth[frame.depth > 0]
    return np.array([*np.quantile(few, [0.02, 0.5]), frame.depth.max()])


def _facts(reading: FrameReading) -> tuple[Fact, ...]:
    return tuple(fact(reading) for fact in FACTS)


def _surfaces(seen: SegmentedFrame, up: Float | None) -> tuple[Plane | None, float]:
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

    flatter = gain_as_range(frame, plane, flat, rng, up)
    if up is not None and share < LARGE_SHARE:
        largest = find_plane(samples, rng)
        if largest is not None and largest.holds(samples).mean() > 2 * share:
            plane = largest
    if plane is None:
        return None, flatter

    pose = frame.camera_to_world
    normal = pose[:3, :3].T @ plane.normal
    return Plane(normal, float(plane.height(pose[:3, 3]))), flatter


def _agreement(posed: PosedViews) -> float:
    """Return the evidence of the surfaces that two frames see in the same places, nats."""
    if not posed.views:
        return 0.0
    found = compare(posed.views, posed.poses)
    if found.judged < FEWEST_JUDGED:
        return 0.0
    surfaces = INDEPENDENT_SURFACES * found.judged / judgeable(posed.views)
    static = surfaces * (CONFIRMED * found.share + CONTRADICTED * (1 - found.share))
    return float(np.logaddexp(static, WORLD_CHANGED))
