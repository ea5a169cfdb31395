"""Tracked objects of a scene: their masks, recognition results and explained pixels."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
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

# largest number of rows and columns in which a scan is rendered into a frame
RENDERED_ROWS = 120
AGREES = 0.006  # metres, tolerance of the depth of a scan in addition to the noise
AGREES_NOISE = 3.0  # tolerance in standard deviations of the noise
# metres, additional tolerance in frames that were not used for the registration
OTHER_VIEW = 0.008
ENOUGH_VIEWS = 2  # frames after which an unknown object is settled
EDGE_WIDTH = 4  # pixels around the outline of a scan in which depth is unreliable
WINDOW_EDGE = 12  # pixels, margin of a window around an outline


@dataclass(frozen=True, eq=False)
class Track:
    """One tracked object of a scene.

    Attributes:
        number: identifies the object as long as it is there.
        thing: the observed object.
        frames: frame number of each of its sightings.
        result: of the recognition; None if it is not judged yet.
        tries: number of frames in which splitting its mask failed.
        again: frame numbers and masks of frames that show the object at its known place; they are
            not used as sightings.
        absorbed: numbers of objects that became part of this one since the last frame.
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
    def with_all_names(self) -> Track:
        """The object as it is recognised if no name is ruled out."""
        if self.result is None or self.result.of_all_names is None:
            return self
        return replace(self, result=self.result.of_all_names)

    @property
    def confident(self) -> bool:
        """True if its name is confident enough to act on."""
        return self.result is not None and self.result.confident

    @property
    def settled(self) -> bool:
        """True if another view would hardly change the recognition of the object."""
        if self.result is None:
            return False
        if self.confident:
            return True
        looked_at = not self.lately_named and len(self.frames) >= ENOUGH_VIEWS
        return bool(self.result.unknown and looked_at)

    @property
    def posed(self) -> PoseCandidate | None:
        """Likeliest pose of the named thing; None for an unknown object."""
        result = self.result
        if result is None or result.answer is None or result.pose is None:
            return None
        label = result.classes.index(result.answer)
        return next(each for each in result.pose_candidates if each.label == label)

    @property
    def likeliest(self) -> PoseCandidate | None:
        """Likeliest pose among all hypotheses, even if the object is called unknown."""
        result = self.result
        if result is None or not result.pose_candidates:
            return None
        return result.pose_candidates[0]

    @property
    def pixels(self) -> dict[int, Mask]:
        """Masks in all frames that show the object, (H, W) bool, by frame number."""
        taken = zip(self.frames, self.thing.sightings, strict=True)
        every = {number: sighting.mask for number, sighting in taken} | dict(self.again)
        return dict(sorted(every.items()))

    def mask_in(self, number: int) -> Mask | None:
        """Return its mask in a frame, (H, W) bool; None if the frame does not show it."""
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
        """Return the object with other sightings, not judged yet.

        Args:
            sightings: at least one.
            frames: frame number of each sighting.
            up: direction against gravity, (3,), world.

        Raises:
            ObservationError: the visible part of the object has no extent.
        """
        thing = copy(self.thing)
        thing.take_sightings(sightings, up)
        return replace(self, thing=thing, frames=tuple(frames), result=None)

    def without(self, number: int, up: Float) -> Track | None:
        """Return the object without its sighting in a frame; None if no other frame shows it.

        Args:
            number: of the frame.
            up: direction against gravity in the world, (3,).

        Raises:
            ObservationError: the visible part of the object has no extent.
        """
        pairs = zip(self.frames, self.thing.sightings, strict=True)
        kept = [(frame, one) for frame, one in pairs if frame != number]
        if not kept:
            return None
        return self.seen_as([one for _, one in kept], [frame for frame, _ in kept], up)

    def with_mask(self, number: int, mask: Mask, top: TableTop) -> Track:
        """Return the object with a new or changed mask in a frame.

        Args:
            number: of the frame.
            mask: its pixels, (H, W) bool.
            top: support surfaces of the frame.

        Raises:
            ObservationError: too little of the object is visible.
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


def judged(
    tracks: Sequence[Track],
    judge: Callable[[Sequence[ObservedObject]], list[Recognition]],
) -> list[Track]:
    """Recognise objects from all of their views.

    Args:
        tracks: the objects.
        judge: such as a ``session.judging.Judge``.

    Returns:
        The same with their results.
    """
    results = judge([track.thing for track in tracks])
    pairs = zip(tracks, results, strict=True)
    return [replace(track, result=result) for track, result in pairs]


@dataclass(frozen=True, eq=False)
class RenderedObject:
    """The scan of an object rendered into a frame, and its comparison with the depth.

    Attributes:
        part: rows and columns of the frame that contain its outline.
        depth: of the scan in this part, (h, w) float32, metres; infinity outside the scan.
        agrees: pixels whose depth agrees with the scan, (h, w) bool.
        hidden: pixels in which something nearer occludes the scan, (h, w) bool.
        through: pixels whose depth is behind the scan, (h, w) bool.
        near: pixels on the scan, inside it or at its outline, (h, w) bool.
    """

    part: Part
    depth: Float32
    agrees: Mask
    hidden: Mask
    through: Mask
    near: Mask = field(repr=False)

    def explained(self, shape: tuple[int, int]) -> Mask:
        """Return the pixels of the whole frame that the scan explains, (H, W) bool."""
        found = np.zeros(shape, bool)
        found[self.part] = self.agrees
        return found

    def around(self, shape: tuple[int, int]) -> Mask:
        """Return the pixels of the whole frame on the scan or at its outline, (H, W) bool."""
        found = np.zeros(shape, bool)
        found[self.part] = self.near
        return found

    def fit(self, mask: Mask) -> tuple[int, int]:
        """Count the pixels of a mask that the scan explains.

        Args:
            mask: of the object, (H, W) bool.

        Returns:
            The number of explained pixels; and the number of pixels in the mask or predicted by the
            scan.
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
        top: support surfaces of the frame.
        number: of the frame.
        posed: the thing in its pose, one of ``Track.posed`` and ``Track.likeliest``.

    Returns:
        The rendered object; None without a pose, or if it is outside the image.
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


def window_around(corners: Float, frame: Frame) -> Part | None:
    """Return rows and columns that contain points; None if they are out of view.

    Args:
        corners: the points, (N, 3), camera frame, metres.
        frame: the frame.
    """
    ahead = corners[corners[:, 2] > 0.01]
    if not len(ahead):
        return None
    at = frame.pinhole.project(ahead)
    low = at.min(0)[::-1] - WINDOW_EDGE
    high = at.max(0)[::-1] + WINDOW_EDGE
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
    """Return the depth of a scan in a part of a frame, (h, w) float32, metres; infinity outside."""
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
    """Vertices and faces as a dictionary key, compared by value."""

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
    """Prepare the surface of a thing, which must have one, for ray casting.

    Args:
        posed: the thing.
    """
    assert posed.vertices is not None
    assert posed.faces is not None
    return _caster(posed.thing, _Triangles(posed.vertices, posed.faces))


@lru_cache(maxsize=256)
def _caster(name: str, triangles: _Triangles) -> SurfaceCaster:
    """Prepare a scan for ray casting."""
    return SurfaceCaster([Surface(name, triangles.vertices, triangles.faces)])


def _rim(depth: Float32) -> Mask:
    """Return the pixels at the outline of a scan, (h, w) bool."""
    shows = np.isfinite(depth)
    return shows & ~ndimage.binary_erosion(shows, iterations=EDGE_WIDTH)
