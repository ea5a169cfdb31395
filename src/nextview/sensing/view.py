"""A frame with what is in it: what may be one thing, what carries things, what is behind them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from nextview.segmentation.instances import Instances
from nextview.sensing.frame import Frame, one_stand
from nextview.sensing.noise import ALIKE, LEAST_ERROR, LEAST_NOISE, Noise
from nextview.types import Float, Float32, Index, Mask

GRID_COLUMNS = 400  # columns of the grid on which hypotheses are scored, about
LEVEL = 2.5  # standard deviations of the depth, within which a pixel lies on a plane
ON_PLANE = 0.015  # metres from a plane, within which a pixel may show it
LEAST_PLANE = 0.1  # share of an image that shows a plane on which noise is measured
MEAN_OF_HALF = 0.3246  # mean of the smaller half of the sizes of normal errors
LARGER = 1.2  # times the largest thing, above which an instance is none
OUTLIERS = 0.05, 0.95  # quantiles of the coordinates of an instance
FEWEST_PIXELS = 30  # grid pixels of a segment that is searched for things, at least
NEIGHBOURS_APART = 0.015  # metres of depth between the pixels of two parts of one thing
STEEPEST_SLOPE = 6.0  # depth over width of the steepest surface that is measured


@dataclass(frozen=True, eq=False)
class Grid:
    """Every so many pixels of a view.

    Attributes:
        depth: (h, w) float32, metres; 0 where nothing was measured.
        x: slope x/z of each column, (w,) float64.
        y: slope y/z of each row, (h,) float64.
        sigma: standard deviation of the depth, (h, w) float32, metres.
        piece: number of the piece that each pixel belongs to, (h, w); 0 for none.
        sizes: number of pixels of each piece, (pieces + 1,).
        surface: pixels of what carries things, (h, w) bool.
        height: above what carries it, (h, w) float32, metres; infinite where nothing is known.
        pitch: angle between neighbouring pixels, radians.
    """

    depth: Float32
    x: Float
    y: Float
    sigma: Float32
    piece: NDArray[np.int32]
    sizes: Index
    surface: Mask
    height: Float32
    pitch: float


@dataclass(frozen=True, eq=False)
class View:
    """A frame with what is in it.

    Attributes:
        frame: the frame.
        camera: camera-to-world as it is believed, (4, 4) float64: the pose of the frame, without
            its error.
        noise: of the depth.
        labels: number of the instance that each pixel shows, (H, W) int32; 0 for none.
        parted: number of the part of an instance, which ends where the depth jumps, (H, W) int32.
        pieces: number of the piece that each pixel belongs to, (H, W) int32; 0 for none.
        surface: pixels of what carries things, (H, W) bool.
        inside: pixels that are to be explained, (H, W) bool.
        height: of each pixel above what carries it, (H, W) float32, metres; infinite where nothing
            is known.
        up: direction of this height, (3,), world.
    """

    frame: Frame
    camera: Float
    noise: Noise
    labels: NDArray[np.int32]
    parted: NDArray[np.int32]
    pieces: NDArray[np.int32]
    surface: Mask
    inside: Mask
    height: Float32
    up: Float
    _grids: dict[int, Grid] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls,
        frame: Frame,
        instances: Instances,
        inside: Mask,
        height: Float32,
        up: Float,
        widest: float,
        known: Mask | None = None,
    ) -> View:
        """Return the view of a frame.

        Args:
            frame: of a depth camera.
            instances: what its segmentation says.
            inside: pixels that are to be explained, (H, W) bool.
            height: of each pixel above the plane that carries it, (H, W) float32, metres; infinite
                where none is known.
            up: direction of this height, (3,), world.
            widest: diameter of the largest thing, metres.
            known: pixels that show what was there before all things, (H, W) bool; None for none.
        """
        noise = _as_on_plane(frame.noise, frame, height)
        sigma = noise.at(np.maximum(frame.depth, 0.1)) * frame.depth**2
        # what lies on a plane within the noise is explained by the plane
        level = (np.abs(height) < LEVEL * sigma) & (frame.depth > 0)
        if known is not None:
            level |= known
        inside = inside & ~level
        labels = np.zeros(frame.shape, np.int32)
        for number, mask in enumerate(instances.masks, 1):
            labels[mask & inside & (frame.depth > 0)] = number
        # a table, a wall, a room: no thing is as large
        alone = _not_large(frame, labels, LARGER * widest)
        given = labels if instances.pieces is None else instances.pieces
        pieces = np.where(inside & (frame.depth > 0), given, 0).astype(np.int32)
        pieces = _not_large(frame, _connected(pieces, frame, sigma), LARGER * widest)
        # a table of which little shows may be one instance with what lies on it
        large = (labels > 0) & (alone == 0) & (pieces == 0)
        surface = level | large
        inside &= ~large
        # a mask that is given is one thing, wherever the depth jumps
        parted = alone if given is labels else _connected(alone, frame, sigma)
        return cls(
            frame,
            frame.camera_to_world,
            noise,
            alone,
            parted,
            pieces,
            surface,
            inside,
            height,
            up,
        )

    def seen_from(self, camera: Float) -> View:
        """Return the view from another pose of its camera, camera-to-world, (4, 4)."""
        return replace(self, camera=camera)

    def without(self, cells: Mask) -> View:
        """Return the view without some pixels of its grid, (h, w) bool: they say nothing more."""
        depth = self.depth.copy()
        depth[self.enlarged(cells)] = 0
        left = replace(self, frame=self.frame.with_depth(depth))
        object.__setattr__(left, "_grids", {})
        return left

    def alike(self, frame: Frame) -> Mask:
        """Return the pixels of the grid of a frame that this view shows alike, (h, w) bool.

        There are none if the frame was not taken from where this view was.
        """
        stride = stride_of(frame)
        now = frame.depth[::stride, ::stride]
        if frame.shape != self.frame.shape or not one_stand(self.frame, frame):
            return np.zeros(now.shape, bool)
        grid = self.grid()
        return (grid.depth > 0) & (np.abs(grid.depth - now) < ALIKE * grid.sigma)

    @property
    def depth(self) -> Float32:
        """Depth of the frame, (H, W) float32, metres; 0 where nothing was measured."""
        return self.frame.depth

    @property
    def stride(self) -> int:
        """Pixels of the frame from one pixel of the grid to the next."""
        return stride_of(self.frame)

    def grid(self, coarser: int = 1) -> Grid:
        """Return the grid of pixels on which hypotheses are scored.

        Args:
            coarser: factor of the distance between pixels.
        """
        if coarser not in self._grids:
            self._grids[coarser] = self._sampled(self.stride * coarser)
        return self._grids[coarser]

    def _sampled(self, stride: int) -> Grid:
        """Take every pixel at such a distance."""
        depth = self.depth[::stride, ::stride]
        x, y = self.frame.rays
        piece = self.pieces[::stride, ::stride]
        noise = self.noise.at(np.maximum(depth, 0.1)) * depth**2
        return Grid(
            depth,
            x[::stride].astype(np.float64),
            y[::stride].astype(np.float64),
            np.hypot(noise, LEAST_ERROR * depth).astype(np.float32),
            piece,
            np.bincount(piece.ravel()),
            self.surface[::stride, ::stride],
            self.height[::stride, ::stride],
            stride / float(self.frame.intrinsics[0, 0]),
        )

    def enlarged(self, cells: NDArray[Any]) -> NDArray[Any]:
        """Return the value of the cell of the grid, (h, w), that each pixel belongs to, (H, W)."""
        large = np.repeat(np.repeat(cells, self.stride, 0), self.stride, 1)
        return large[: self.depth.shape[0], : self.depth.shape[1]]

    def points(self, cells: NDArray[np.integer]) -> Float:
        """Return the measured points of pixels of the grid, (N,), in the world, (N, 3), metres."""
        grid = self.grid()
        line, column = np.divmod(cells, grid.depth.shape[1])
        z = grid.depth[line, column].astype(np.float64)
        own = np.stack([grid.x[column] * z, grid.y[line] * z, z], 1)
        return own @ self.camera[:3, :3].T + self.camera[:3, 3]

    @cached_property
    def fewest(self) -> int:
        """Pixels of the smallest segment that is searched for things."""
        return FEWEST_PIXELS * self.stride**2 // 2

    def instances(self) -> Iterator[Mask]:
        """Return what is likely to be one thing each, (H, W) bool."""
        return _parts(self.labels, self.fewest)

    def strangers(self) -> Iterator[Mask]:
        """Return the instances, parted where the depth jumps: another thing begins there.

        Returns:
            Pixels of each part, (H, W) bool.
        """
        return _parts(self.parted, self.fewest)

    def fragments(self) -> Iterator[Mask]:
        """Return the pieces of instances: a thing that was joined to its neighbour is one."""
        return self._smaller(self.pieces)

    def leftovers(self, shown: Mask) -> Iterator[Mask]:
        """Return what is left of instances that are explained in part.

        Args:
            shown: pixels that are explained, (H, W) bool.
        """
        return self._smaller(np.where(shown, 0, self.labels))

    def _smaller(self, labels: NDArray[np.int32]) -> Iterator[Mask]:
        """Return parts that are not a whole instance, and larger than a scrap."""
        for mask in _parts(labels, 6 * self.fewest):
            owner = int(np.bincount(self.labels[mask]).argmax())
            whole = np.count_nonzero(self.labels == owner)
            if not owner or np.count_nonzero(mask) < whole:
                yield mask

    def unions(self) -> Iterator[Mask]:
        """Return neighbouring instances as one: a thing that was cut in two or more is one.

        Those that touch each other most for their size are joined first, and so on: as many unions
        as there are joins.
        """
        touching = self._touching()
        sizes = np.bincount(self.labels.ravel()).astype(np.float64)
        group = np.arange(len(sizes))
        while True:
            smaller = np.sqrt(np.minimum(sizes[:, None], sizes))
            close = touching / (smaller + 1)
            low, high = np.unravel_index(close.argmax(), close.shape)
            if close[low, high] <= 0:
                return

            touching[low] += touching[high]
            touching[:, low] += touching[:, high]
            touching[high] = touching[:, high] = touching[low, low] = 0
            sizes[low] += sizes[high]
            group[group == high] = low

            mask = np.isin(self.labels, np.flatnonzero(group == low))
            if np.count_nonzero(mask) >= self.fewest:
                yield mask

    def _touching(self) -> Float:
        """Count the pixels along which each two instances touch, (N, N) float64."""
        count = int(self.labels.max(initial=0)) + 1
        found = np.zeros((count, count))
        depth = self.depth
        for gap in (self.stride, 2 * self.stride + 1):
            for one, two in (
                (np.s_[:, :-gap], np.s_[:, gap:]),
                (np.s_[:-gap], np.s_[gap:]),
            ):
                first, second = self.labels[one], self.labels[two]
                beside = (first != second) & (first > 0) & (second > 0)
                beside &= np.abs(depth[one] - depth[two]) < NEIGHBOURS_APART
                key = first[beside] * count + second[beside]
                found += np.bincount(key, minlength=count**2).reshape(count, count)
        return found + found.T


def stride_of(frame: Frame) -> int:
    """Return the pixels of a frame from one pixel of its grid to the next."""
    return max(1, round(frame.shape[1] / GRID_COLUMNS))


def _as_on_plane(noise: Noise, frame: Frame, height: Float32) -> Noise:
    """Return the noise as it is on the plane that carries things: real depth is bent there, too.

    Args:
        noise: between neighbouring pixels.
        frame: its frame.
        height: of each pixel above the plane, (H, W) float32, metres.
    """
    depth = frame.depth
    near = (depth > 0) & (np.abs(height) < ON_PLANE)
    sigma = np.maximum(noise.at(depth[near]), LEAST_NOISE) * depth[near] ** 2
    off = np.abs(height[near]) / sigma
    if len(off) < LEAST_PLANE * depth.size:
        return noise
    half = np.partition(off, len(off) // 2)[: len(off) // 2]
    return replace(noise, sigmas=noise.sigmas * half.mean() / MEAN_OF_HALF)


def _connected(
    pieces: NDArray[np.int32], frame: Frame, sigma: Float
) -> NDArray[np.int32]:
    """Return pieces, (H, W) int, that are parted where the depth jumps, (H, W) int32.

    Args:
        pieces: 0 for none.
        frame: its frame.
        sigma: standard deviation of the depth, (H, W), metres.
    """
    depth = frame.depth
    steepest = STEEPEST_SLOPE / float(frame.intrinsics[0, 0]) * depth
    most = np.maximum(np.maximum(NEIGHBOURS_APART, 4 * sigma), steepest)
    at = np.cumsum(pieces.ravel() > 0).reshape(pieces.shape) - 1
    count = int(at[-1, -1]) + 1

    pairs = []
    for one, two in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        joined = (pieces[one] == pieces[two]) & (pieces[one] > 0)
        joined &= np.abs(depth[one] - depth[two]) < most[one]
        pairs.append(np.stack([at[one][joined], at[two][joined]]))

    ends = np.concatenate(pairs, 1)
    graph = coo_array((np.ones(ends.shape[1], bool), ends), shape=(count, count))
    found = np.zeros(pieces.shape, np.int32)
    found[pieces > 0] = connected_components(graph, directed=False)[1] + 1
    return found


def _not_large(
    frame: Frame, labels: NDArray[np.int32], most: float
) -> NDArray[np.int32]:
    """Return labels of measured pixels, (H, W) int32, without what is larger, metres."""
    large = np.zeros(int(labels.max(initial=0)) + 1, bool)
    enough = np.bincount(labels.ravel()) >= FEWEST_PIXELS
    for number, box in enumerate(ndimage.find_objects(labels), 1):
        if box is not None and enough[number]:
            rows, columns = np.nonzero(labels[box] == number)
            place = rows + box[0].start, columns + box[1].start
            large[number] = _extent(frame, *place) > most
    return np.where(large[labels], 0, labels).astype(np.int32)


def _extent(frame: Frame, rows: Index, columns: Index) -> float:
    """Return how far apart the measured points of some pixels lie, without outliers, metres."""
    few = slice(None, None, max(1, len(rows) // 500))
    points = frame.positions_in_camera(rows[few], columns[few])
    low, high = np.quantile(points, OUTLIERS, axis=0)
    return float(np.linalg.norm(high - low))


def _parts(labels: NDArray[np.int32], fewest: int) -> Iterator[Mask]:
    """Return the pixels of each label with at least so many, (H, W) bool."""
    counts = np.bincount(labels.ravel())
    for number in np.flatnonzero(counts >= fewest):
        if number:
            yield labels == number
