"""Objects under way: the pixels of each in every frame, what it is, and what that explains."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nextview.recognition.poses import PoseCandidate
from nextview.sensing.frame import Frame, Part, spans
from nextview.sensing.observed_object import ObservedObject
from nextview.sensing.sighting import Sighting
from nextview.sensing.tabletop import TableTop
from nextview.session.result import Recognition
from nextview.things.surface import Surface, SurfaceCaster
from nextview.types import Float, Float32, Mask

# rows and columns in which a scan is rendered into a frame, at most
RENDERED_ROWS = 120
AGREES = 0.006  # metres by which depth may be off from a scan, beside the noise
AGREES_NOISE = 3.0  # standard deviations of the noise by which it may
# metres by which a frame may show a thing displaced that was not aligned with it
OTHER_VIEW = 0.008
EDGE_WIDTH = 4  # pixels around a scan's outline in which depth says nothing
WINDOW_EDGE = 12  # pixels of a window around an outline


@dataclass(frozen=True, eq=False)
class Track:
    """One object of a scene.

    Attributes:
        number: stays the same as long as the object is there.
        thing: the object as the frames show it.
        frames: number of the frame of each of its sightings.
        result: what it is.
        tries: in how many frames its pixels were parted otherwise in vain.
        again: frames that show it where it was known to be, with its pixels in each: they were not
            taken in as sightings.
        absorbed: numbers of objects whose pixels all became its own since the last frame.
        lately_named: whether it had a name before the last frame that shows it.
    """

    number: int
    thing: ObservedObject
    frames: tuple[int, ...]
    result: Recognition | None = None
    tries: int = 0
    again: tuple[tuple[int, Mask], ...] = ()
    absorbed: tuple[int, ...] = ()
    lately_named: bool = False

    @property
    def confident(self) -> bool:
        """Whether its name may be acted on."""
        return self.result is not None and self.result.confident

    @property
    def posed(self) -> PoseCandidate | None:
        """The likeliest pose of the thing that it was named as; None for an unknown object."""
        result = self.result
        if result is None or result.answer is None or result.pose is None:
            return None
        label = result.classes.index(result.answer)
        return next(each for each in result.pose_candidates if each.label == label)

    @property
    def likeliest(self) -> PoseCandidate | None:
        """The likeliest pose of all, also of an object that is called unknown."""
        result = self.result
        if result is None or not result.pose_candidates:
            return None
        return result.pose_candidates[0]

    @property
    def pixels(self) -> dict[int, Mask]:
        """Its pixels in all frames that show it, (H, W) bool, by the number of the frame."""
        taken = zip(self.frames, self.thing.sightings, strict=True)
        every = {number: sighting.mask for number, sighting in taken} | dict(self.again)
        return dict(sorted(every.items()))

    def mask_in(self, number: int) -> Mask | None:
        """Its pixels in a frame, (H, W) bool; None where the frame does not show it."""
        for frame, mask in self.again:
            if frame == number:
                return mask
        if number not in self.frames:
            return None
        return self.thing.sightings[self.frames.index(number)].mask

    def seen_as(
        self,
        sightings: Sequence[Sighting],
        frames: Sequence[int],
        up: Float,
    ) -> Track:
        """The same object by other sightings, not judged yet.

        Args:
            sightings: at least one.
            frames: the number of the frame of each.
            up: direction against gravity, (3,), world.

        Raises:
            ObservationError: what is seen of the object has no size.
        """
        thing = copy(self.thing)
        thing.take_sightings(sightings, up)
        return replace(self, thing=thing, frames=tuple(frames), result=None)

    def without(self, number: int, up: Float) -> Track | None:
        """The same object without what a frame shows of it; None if no other frame shows it.

        Args:
            number: of the frame.
            up: direction against gravity in the world, (3,).

        Raises:
            ObservationError: what is seen of the object has no size.
        """
        pairs = zip(self.frames, self.thing.sightings, strict=True)
        kept = [(frame, one) for frame, one in pairs if frame != number]
        if not kept:
            return None
        return self.seen_as([one for _, one in kept], [frame for frame, _ in kept], up)

    def with_mask(self, number: int, mask: Mask, top: TableTop) -> Track:
        """The same object with other pixels in a frame, which it may be new in.

        Args:
            number: of the frame.
            mask: its pixels, (H, W) bool.
            top: what the frame shows.

        Raises:
            ObservationError: too little is seen of the object.
        """
        sighting = top.sighting(mask)
        kept = [
            (frame, one)
            for frame, one in zip(self.frames, self.thing.sightings, strict=True)
            if frame != number
        ]

        kept.append((number, sighting))
        kept.sort(key=lambda pair: pair[0])
        track = replace(
            self,
            again=tuple(pair for pair in self.again if pair[0] != number),
        )
        return track.seen_as(
            [one for _, one in kept],
            [frame for frame, _ in kept],
            top.up,
        )


@dataclass(frozen=True, eq=False)
class RenderedObject:
    """What a frame would see of an object that was named, where it was found.

    Attributes:
        part: rows and columns of the frame that hold its outline.
        depth: of its scan there, (h, w) float32, metres; infinity where it does not show.
        agrees: pixels there whose depth is that of the scan, (h, w) bool.
        hidden: pixels there in which something nearer hides the scan, (h, w) bool.
        through: pixels there in which what is behind the scan is seen, (h, w) bool.
        near: pixels there that are on the scan's outline or inside of it, (h, w) bool.
    """

    part: Part
    depth: Float32
    agrees: Mask
    hidden: Mask
    through: Mask
    near: Mask = field(repr=False)

    def explained(self, shape: tuple[int, int]) -> Mask:
        """Pixels of the whole frame that the scan explains, (H, W) bool."""
        found = np.zeros(shape, bool)
        found[self.part] = self.agrees
        return found

    def around(self, shape: tuple[int, int]) -> Mask:
        """Pixels of the whole frame on the scan or at its outline, (H, W) bool."""
        found = np.zeros(shape, bool)
        found[self.part] = self.near
        return found

    def fit(self, mask: Mask) -> tuple[int, int]:
        """How well a scan explains some pixels.

        Args:
            mask: that are taken for the object, (H, W) bool.

        Returns:
            How many of them it explains; and how many are either of them or would have to be.
        """
        own = mask[self.part]
        agreeing = int(np.count_nonzero(own & self.agrees))
        beyond = int(np.count_nonzero(self.through & ~own & ~_rim(self.depth)))
        return agreeing, int(np.count_nonzero(mask)) + beyond


def render_track(
    track: Track,
    top: TableTop,
    number: int,
    posed: PoseCandidate | None,
) -> RenderedObject | None:
    """Render the scan of an object into a frame.

    Args:
        track: the object.
        top: what the frame shows.
        number: of the frame.
        posed: the thing in its pose, one of ``Track.posed`` and ``Track.likeliest``.

    Returns:
        What would be seen; None without a pose, or where it is out of the picture.
    """
    if posed is None or posed.vertices is None or posed.faces is None:
        return None
    pose = posed.pose.copy()
    slack = OTHER_VIEW
    if number in track.frames and len(posed.displacements) == len(track.frames):
        pose[:3, 3] += posed.displacements[track.frames.index(number)]
        slack = 0.0

    frame = top.frame
    in_camera = np.linalg.inv(frame.camera_to_world) @ pose
    part = window_around(
        posed.vertices @ in_camera[:3, :3].T + in_camera[:3, 3],
        frame,
        WINDOW_EDGE,
    )
    if part is None:
        return None
    depth = _cast(posed, in_camera, frame.rays, part)
    if not np.isfinite(depth).any():
        return None

    seen = frame.depth[part]
    shows = np.isfinite(depth)
    error = AGREES + slack + AGREES_NOISE * top.noise.at(seen) * seen**2
    off = np.where(shows & (seen > 0), seen - np.where(shows, depth, 0), np.inf)
    agrees = np.abs(off) < error
    hidden = shows & (seen > 0) & (off < -error)
    through = shows & (seen > 0) & (off > error)
    near = ndimage.binary_dilation(shows, iterations=EDGE_WIDTH)
    return RenderedObject(part, depth, agrees, hidden, through, near)


def window_around(corners: Float, frame: Frame, margin: float) -> Part | None:
    """Rows and columns that hold points.

    Args:
        corners: the points, (N, 3), camera frame, metres.
        frame: the frame.
        margin: pixels around them.

    Returns:
        The part of the frame; None if they are out of view.
    """
    ahead = corners[corners[:, 2] > 0.01]
    if not len(ahead):
        return None
    at = frame.camera.project(ahead)
    low = at.min(0)[::-1] - margin
    high = at.max(0)[::-1] + margin
    part = spans(low, high, frame.shape)
    if part[0].start >= part[0].stop or part[1].start >= part[1].stop:
        return None
    return part


def _cast(
    posed: PoseCandidate,
    in_camera: Float,
    rays: tuple[Float32, Float32],
    part: Part,
) -> Float32:
    """Depth of a scan in a part of a frame, (h, w) float32, metres; infinity where it is not."""
    x = rays[0][part[1]]
    y = rays[1][part[0]]
    step = max(1, -(-max(len(x), len(y)) // RENDERED_ROWS))
    columns, rows = np.meshgrid(x[step // 2 :: step], y[step // 2 :: step])
    directions = np.stack([columns, rows, np.ones_like(columns)], -1).reshape(-1, 3)

    caster = caster_of(posed)
    turn = in_camera[:3, :3].astype(np.float32)
    origin = (-in_camera[:3, 3] @ in_camera[:3, :3]).astype(np.float32)
    depth, _ = caster.cast(
        np.zeros(1, np.int64),
        origin[None],
        (directions @ turn)[None],
    )
    coarse = depth.reshape(columns.shape)
    fine = np.repeat(np.repeat(coarse, step, 0), step, 1)
    height, width = len(y), len(x)
    padded = np.full((height, width), np.float32(np.inf))
    rows_there = min(height, fine.shape[0])
    columns_there = min(width, fine.shape[1])
    padded[:rows_there, :columns_there] = fine[:rows_there, :columns_there]
    return padded


class _Triangles:
    """Vertices and faces as a key. Two are equal if their numbers are."""

    def __init__(self, vertices: Float32, faces: NDArray[np.int32]) -> None:
        self.vertices = vertices
        self.faces = faces
        content = hashlib.blake2b(np.ascontiguousarray(vertices).tobytes())
        content.update(np.ascontiguousarray(faces).tobytes())
        self.content = content.digest()

    def __hash__(self) -> int:
        return hash(self.content)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Triangles) and self.content == other.content


def caster_of(posed: PoseCandidate) -> SurfaceCaster:
    """The scan of a thing, which has one, ready for casting."""
    assert posed.vertices is not None
    assert posed.faces is not None
    return _caster(posed.thing, _Triangles(posed.vertices, posed.faces))


@lru_cache(maxsize=256)
def _caster(name: str, triangles: _Triangles) -> SurfaceCaster:
    """A scan, ready for casting."""
    return SurfaceCaster([Surface(name, triangles.vertices, triangles.faces)])


def _rim(depth: Float32) -> Mask:
    """Pixels at the outline of a scan, (h, w) bool."""
    shows = np.isfinite(depth)
    return shows & ~ndimage.binary_erosion(shows, iterations=EDGE_WIDTH)
