"""Depth images in metres, sampled on a coarse grid for the comparison with surfaces."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from nextview.errors import ObservationError
from nextview.geometry.observation import Observation
from nextview.geometry.pinhole import PinholeCamera
from nextview.sensing.facets import Noise, estimate_noise
from nextview.sensing.masks import PLANE_NOISE, PLANE_SHARE
from nextview.things.ground import Ground, find_planes, floor_under
from nextview.types import Float, Float32, Index, Mask

NOT_MEASURED, ELSEWHERE, THING = np.arange(3, dtype=np.uint8)
"""Label of a pixel: no measurement; another object or free background; the thing."""

WINDOW_MARGIN = 0.35  # margin around the outline of the thing, relative to its size
# share of thing pixels in the window, below which the grid gets denser
USUAL_FILL = 0.2
MOST_DENSE = 2.0  # largest increase of rows and columns
SMALLEST_MARGIN = 4  # smallest margin around the outline, pixels of the image
NOISE_ROWS = 40  # image rows in which the noise is estimated
NOISIEST = 0.005  # relative depth noise, at most, if no ground is visible
# margin of the search for the ground, relative to the size of the outline
GROUND_MARGIN = 1.0
GROUND_SIDE = 48  # rows and columns of pixels in the search for the ground
# smallest distance between an occluder and the surface behind it, metres
HIDING = 0.005
HIDING_NOISE = 4.0  # the same distance, standard deviations of the depth
KEPT_IMAGES = 12  # cached images: poses are computed after the names


@dataclass(frozen=True, eq=False)
class DepthView:
    """Sampled pixels of one view in the object frame, in metres.

    The pixels form a grid over the outline of the thing and a margin around it.

    Attributes:
        origin: position of the camera, (3,) float64.
        camera_axes: x, y and z axes of the camera in the object frame, as columns, (3, 3) float64.
        rays: rays through the pixels, scaled to one metre along the optical axis, (P, 3) float32.
        depth: depth along the optical axis, (P,) float32, of the thing and its surroundings;
            infinity where the background is free, 0 without a measurement.
        kind: NOT_MEASURED, ELSEWHERE or THING, (P,) uint8.
        noise: standard deviation of the depth, (P,) float32.
        edge: signed distance to the outline of the thing, (P,) float32, pixels of the image;
            negative inside.
        towards: direction in the image, x and y, to the nearest pixel of the thing, (P, 2) float32,
            unit vectors; zero inside the outline.
        ground: level plane under the thing, if it is visible; it may be the top of other things.
        floor: plane below which nothing can be, if the ground is visible: see ``floor_under``.
        level: pixels on the ground within its noise, (P,) bool. They may show the thing or the
            ground, whatever their segmentation.
        shape: rows and columns of the grid; P is their product.
        step: spacing of the rows and of the columns, (2,) float64, pixels of the image.
        pitch: angle between neighbouring pixels of the image, radians.
        whole: number of pixels of the image that show the thing.
        camera: name of the camera; "" for the one camera.
    """

    origin: Float
    camera_axes: Float
    rays: Float32
    depth: Float32
    kind: NDArray[np.uint8]
    noise: Float32
    edge: Float32
    towards: Float32
    ground: Ground | None
    floor: Ground | None
    level: Mask
    shape: tuple[int, int]
    step: Float
    pitch: float
    whole: int
    camera: str = ""

    @property
    def thing_points(self) -> Float32:
        """Measured points of the thing, (N, 3) float32, object frame, metres."""
        thing = self.kind == THING
        return (
            self.origin.astype(np.float32) + self.rays[thing] * self.depth[thing, None]
        )


def depth_view(
    observation: Observation,
    side: int,
    radius: float | None = None,
) -> DepthView | None:
    """Sample the pixels of an observation for the comparison with surfaces.

    Args:
        observation: a view of the thing.
        side: approximate number of rows and of columns; larger if the thing is thin.
        radius: object radius, metres, for an observation without a scale.

    Returns:
        The sampled pixels; None if the observation does not show the thing.

    Raises:
        ObservationError: neither the observation nor the caller gives the scale.
    """
    image = MetricImage.of(observation, radius)
    return None if image is None else image.view(side)


@dataclass(frozen=True, eq=False)
class MetricImage:
    """All pixels of one view in metres, from which a grid of any density can be sampled.

    Attributes:
        depth: depth along the optical axis, (H, W) float32; infinity where the background is free,
            0 without a measurement.
        kind: NOT_MEASURED, ELSEWHERE or THING, (H, W) uint8.
        pose: camera-to-object, (4, 4), metres.
        intrinsics: pinhole matrix, (3, 3), pixels; the first pixel's centre is at 0.5.
        noise: noise of single pixels.
        ground: level plane under the thing, if it is visible; it may be the top of other things.
        floor: plane below which nothing can be, if the ground is visible.
        hiding: pixels around the thing that show an occluder, or lie in its shadow, where nothing
            is measured, (H, W) bool.
        camera: name of the camera; "" for the one camera.
    """

    depth: Float32
    kind: NDArray[np.uint8]
    pose: Float
    intrinsics: Float
    noise: Noise
    ground: Ground | None
    floor: Ground | None
    hiding: Mask
    camera: str = ""

    @classmethod
    def of(
        cls,
        observation: Observation,
        radius: float | None = None,
    ) -> "MetricImage | None":
        """Convert an observation to metres; None if it does not show the thing.

        An observation with its scene keeps all measured pixels. Without a scene, pixels beside the
        thing count as free background if the depth is exact, and as not measured otherwise.

        Args:
            observation: a view of the thing.
            radius: object radius, metres, for an observation without a scale.

        Returns:
            The image; None if the observation does not show the thing.

        Raises:
            ObservationError: neither the observation nor the caller gives the scale.
        """
        metres = observation.radius if observation.radius is not None else radius
        if metres is None:
            raise ObservationError(
                "the object radius in metres is not known, and the comparison with scans needs it"
            )
        return _metric_image(observation, float(metres))

    def turned(self, rotation: Float) -> "MetricImage":
        """The same image in an object frame that is rotated about its origin.

        Args:
            rotation: from the old axes to the new axes, (3, 3).

        Returns:
            The image with a rotated pose and ground.
        """
        pose = self.pose.copy()
        pose[:3] = rotation @ pose[:3]
        ground, floor = (
            None if one is None else replace(one, normal=rotation @ one.normal)
            for one in (self.ground, self.floor)
        )
        return replace(self, pose=pose, ground=ground, floor=floor)

    def find_planes(self) -> tuple[Ground | None, Ground | None]:
        """Find the ground and the floor of the thing: see ``ground.find_planes``."""
        rows, columns = _window(self.kind == THING, GROUND_SIDE, GROUND_MARGIN)
        chosen = np.ix_(rows, columns)
        depth = self.depth[chosen].ravel()
        kind = self.kind[chosen].ravel()
        origin = self.pose[:3, 3]
        some = (depth > 0) & np.isfinite(depth)
        points = origin + self._rays(rows, columns)[some] * depth[some, None].astype(
            np.float64
        )
        thing = kind[some] == THING
        return find_planes(points[~thing], points[thing], origin, self.pose[:3, 2])

    def find_hiding(self) -> Mask:
        """Find the pixels around the thing that show an occluder in front of it, or its shadow.

        The floor is no occluder. A pixel without a measurement is in the shadow of an occluder if
        that is the nearest of what is measured beside the thing.

        Returns:
            Mask of the occluders and their shadows, (H, W) bool.
        """
        rows, columns = (
            slice(lines[0], lines[-1] + 1)
            for lines in _window(self.kind == THING, GROUND_SIDE, GROUND_MARGIN)
        )
        depth = self.depth[rows, columns]
        kind = self.kind[rows, columns]

        nearest = distance_transform_edt(
            kind != THING, return_distances=False, return_indices=True
        )
        beside = depth[tuple(nearest)]
        noise = self.noise.at(beside) * beside**2
        apart = np.hypot(HIDING, HIDING_NOISE * np.minimum(noise, NOISIEST * beside))
        hiding = (kind == ELSEWHERE) & (depth < beside - apart)

        if self.floor is not None and hiding.any():
            at = np.nonzero(hiding)
            x, y = PinholeCamera.of(self.intrinsics, self.depth.shape).slopes(
                at[0] + rows.start, at[1] + columns.start
            )
            rays = np.stack([x, y, np.ones(len(x))], -1) @ self.pose[:3, :3].T
            points = self.pose[:3, 3] + rays * depth[at][:, None].astype(np.float64)
            heights = self.floor.heights(points)
            allowed = np.hypot(HIDING, HIDING_NOISE * self.floor.noise * depth[at] ** 2)
            hiding[at] = heights > allowed

        if hiding.any():
            measured = distance_transform_edt(
                kind != ELSEWHERE, return_distances=False, return_indices=True
            )
            hiding |= (kind == NOT_MEASURED) & hiding[tuple(measured)]

        every = np.zeros(self.kind.shape, bool)
        every[rows, columns] = hiding
        return every

    def _rays(self, rows: Index, columns: Index) -> Float:
        """Rays through the pixels of some rows and columns, (rows * columns, 3), object frame."""
        x, y = PinholeCamera.of(self.intrinsics, self.depth.shape).slopes(rows, columns)
        ahead = np.ones((len(rows), len(columns)))
        return (
            np.stack([*np.meshgrid(x, y), ahead], -1).reshape(-1, 3)
            @ self.pose[:3, :3].T
        )

    def view(self, side: int) -> DepthView:
        """Sample pixels on a grid over the outline of the thing and a margin around it.

        Args:
            side: approximate number of rows and of columns; larger if the thing is thin.

        Returns:
            The sampled pixels.
        """
        mask = self.kind == THING
        rows, columns = _window(mask, side, WINDOW_MARGIN)
        top = rows[0]
        left = columns[0]
        every = mask[top : rows[-1] + 1, left : columns[-1] + 1]
        edge, towards = outline(every, np.ones(2))
        in_window = np.ix_(rows - top, columns - left)
        in_image = np.ix_(rows, columns)

        origin = self.pose[:3, 3]
        rays = self._rays(rows, columns).astype(np.float32)
        depth = self.depth[in_image].ravel()
        kind = self.kind[in_image].ravel()

        finite = np.where(np.isfinite(depth), depth, 0)
        level = np.zeros(len(depth), bool)
        if self.ground is None:
            # Edges inflate the noise estimate of single pixels.
            noise = np.minimum(self.noise.at(finite) * finite**2, NOISIEST * finite)
        else:
            # The ground gives a better estimate than single pixels, which are few beside edges.
            noise = self.ground.noise * finite**2
            heights = self.ground.heights(
                origin + rays * finite[:, None].astype(np.float64)
            )
            rise = np.abs(rays @ self.ground.normal)
            low = PLANE_NOISE * noise * rise + PLANE_SHARE * finite
            level = (finite > 0) & (np.abs(heights) < low)

        return DepthView(
            origin=origin,
            camera_axes=self.pose[:3, :3],
            rays=rays,
            depth=depth,
            kind=kind,
            noise=noise.astype(np.float32),
            edge=edge[in_window].ravel(),
            towards=towards[in_window].reshape(-1, 2),
            ground=self.ground,
            floor=self.floor,
            level=level,
            shape=(len(rows), len(columns)),
            step=np.array([_step(rows), _step(columns)]),
            pitch=float(1 / self.intrinsics[[0, 1], [0, 1]].mean()),
            whole=int(mask.sum()),
            camera=self.camera,
        )


@lru_cache(maxsize=KEPT_IMAGES)
def _metric_image(observation: Observation, metres: float) -> MetricImage | None:
    """Convert an observation of a thing of this radius, metres; None if it is not visible."""
    depth, kind, pose, intrinsics = _what_is_seen(observation)
    if not (kind == THING).any():
        return None

    depth = depth * np.float32(metres)
    pose = pose.copy()
    pose[:3, 3] *= metres
    some_rows = depth[:: max(1, len(depth) // NOISE_ROWS)]
    noise = estimate_noise(some_rows, (some_rows > 0) & np.isfinite(some_rows))
    nowhere = np.zeros(kind.shape, bool)
    camera = "" if observation.scene is None else observation.scene.camera
    image = MetricImage(
        depth, kind, pose, intrinsics, noise, None, None, nowhere, camera
    )
    ground, floor = image.find_planes()
    support = None if observation.scene is None else observation.scene.support
    if ground is not None and support is not None:
        floor = floor_under(ground, support * (1, 1, 1, metres))
    image = replace(image, ground=ground, floor=floor)
    return replace(image, hiding=image.find_hiding())


def _what_is_seen(
    observation: Observation,
) -> tuple[Float32, NDArray[np.uint8], Float, Float]:
    """Depth in object radii, labels of the pixels, pose and intrinsics."""
    scene = observation.scene
    if scene is None:
        mask = observation.depth > 0
        depth = observation.depth
        nothing_there = observation.exact
        pose = observation.pose
        intrinsics = observation.intrinsics
    else:
        mask = scene.target & (scene.depth > 0)
        depth = scene.depth
        nothing_there = scene.background_free
        pose = scene.pose
        intrinsics = scene.intrinsics

    kind = np.where(depth > 0, ELSEWHERE, NOT_MEASURED)
    if nothing_there:
        kind = np.full(depth.shape, ELSEWHERE)
        depth = np.where(depth > 0, depth, np.float32(np.inf))
    kind[mask] = THING
    return depth, kind, pose, intrinsics


def _window(mask: Mask, side: int, relative_margin: float) -> tuple[Index, Index]:
    """Rows and columns, ascending, spread evenly over an outline and a margin around it."""
    ends = []
    for axis in (1, 0):
        filled = np.flatnonzero(mask.any(axis))
        length = filled[-1] + 1 - filled[0]
        margin = max(SMALLEST_MARGIN, int(np.ceil(relative_margin * length)))
        first = max(0, filled[0] - margin)
        last = min(mask.shape[1 - axis] - 1, filled[-1] + margin)
        ends.append((first, last))

    # A thin oblique thing fills little of the window.
    area = np.prod([last + 1 - first for first, last in ends])
    fill = np.count_nonzero(mask) / area
    denser = np.clip(np.sqrt(USUAL_FILL / fill), 1, MOST_DENSE)
    count = int(np.ceil(side * denser))
    rows, columns = (
        np.unique(np.rint(np.linspace(first, last, count)).astype(np.int64))
        for first, last in ends
    )
    return rows, columns


def _step(lines: Index) -> float:
    """Mean spacing of the sampled rows or columns, pixels."""
    return float(lines[-1] - lines[0]) / max(1, len(lines) - 1)


def outline(mask: Mask, step: Float) -> tuple[Float32, Float32]:
    """Signed distance of each pixel of a grid to the outline of a thing, and the direction to it.

    Where the thing is cut off by the edge of the grid, it has no outline.

    Args:
        mask: pixels that show the thing, (R, C) bool.
        step: spacing of rows and columns, (2,), pixels of the image.

    Returns:
        Distances, (R, C) float32, pixels of the image, negative inside, infinite without an
        outline; and directions, x and y, (R, C, 2) float32, unit vectors, zero inside.
    """
    if mask.all() or not mask.any():
        distance = -np.inf if mask.all() else np.inf
        nowhere = np.zeros((*mask.shape, 2), np.float32)
        return np.full(mask.shape, distance, np.float32), nowhere

    outside, nearest = distance_transform_edt(~mask, step, return_indices=True)
    within = distance_transform_edt(mask, step)
    down, aside = (nearest - np.indices(mask.shape)) * step[:, None, None]
    towards = np.stack([aside, down], -1) / np.maximum(outside, 1)[..., None]
    return (outside - within).astype(np.float32), towards.astype(np.float32)
