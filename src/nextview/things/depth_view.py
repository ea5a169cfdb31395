"""Depth images as they are compared with surfaces: few pixels, metres, and what each shows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from nextview.errors import ObservationError
from nextview.geometry.observation import Observation
from nextview.sensing.facets import estimate_noise

Float32 = NDArray[np.float32]
Float = NDArray[np.float64]

NOT_MEASURED, ELSEWHERE, THING = np.arange(3, dtype=np.uint8)
"""What a pixel shows: nothing was measured; something else, or nothing at all, was; the thing."""

WINDOW_MARGIN = 0.35  # of the size of the thing's outline that is looked at around it
SMALLEST_MARGIN = 4  # pixels of the image around the outline, at least
NOISE_ROWS = 40  # rows of an image in which its noise is measured


@dataclass(frozen=True, eq=False)
class DepthView:
    """Some pixels of one view, in the object frame, in metres.

    The pixels lie on a grid over the outline of the thing and a margin around it.

    Attributes:
        origin: where the camera stands, (3,) float64.
        camera_axes: the camera's x, y and z in the object frame, columns, (3, 3) float64.
        rays: rays through the pixels, as long as one metre of depth, (P, 3) float32.
        depth: along the optical axis, (P,) float32: of the thing and of all else; infinity where
            nothing is there, 0 where nothing was measured.
        kind: NOT_MEASURED, ELSEWHERE or THING, (P,) uint8.
        noise: standard deviation of the depth that was measured, (P,) float32.
        edge: distance to the outline of the thing, (P,) float32, pixels of the image; negative
            within it.
        towards: direction in the image, x and y, to the nearest pixel of the thing, (P, 2) float32,
            unit vectors; zero within it.
        shape: rows and columns of the grid; P is their product.
        step: distance between the grid's rows, and between its columns, (2,) float64, pixels of the
            image.
        pitch: angle between neighbouring pixels of the image, radians.
        whole: number of pixels of the image that show the thing.
    """

    origin: Float
    camera_axes: Float
    rays: Float32
    depth: Float32
    kind: NDArray[np.uint8]
    noise: Float32
    edge: Float32
    towards: Float32
    shape: tuple[int, int]
    step: Float
    pitch: float
    whole: int

    @property
    def thing_points(self) -> Float32:
        """Where the pixels of the thing end, (N, 3) float32, object frame, metres."""
        thing = self.kind == THING
        return self.origin.astype(np.float32) + self.rays[thing] * self.depth[thing, None]


def depth_view(
    observation: Observation, side: int, radius: float | None = None
) -> DepthView | None:
    """Choose the pixels of an observation that are compared with surfaces.

    An observation that knows all that its camera saw is taken as it was measured. Without that,
    pixels beside the thing show that nothing is there if the depth is exact, and nothing otherwise.

    Args:
        observation: a view of the thing.
        side: about so many rows, and so many columns, are chosen.
        radius: object radius, metres, for an observation that knows none.

    Returns:
        The pixels; None if the observation does not show the thing.

    Raises:
        ObservationError: neither the observation nor the caller knows the scale.
    """
    metres = observation.radius if observation.radius is not None else radius
    if metres is None:
        raise ObservationError(
            "the object radius in metres is not known, and surfaces are compared in metres"
        )

    depth, mask, kind, pose, intrinsics = _what_is_seen(observation)
    rows, columns = _window(mask, side)
    if not len(rows):
        return None

    top, left = rows[0], columns[0]
    inside = mask[top : rows[-1] + 1, left : columns[-1] + 1]
    edge, towards = _outline(inside)
    chosen = np.ix_(rows - top, columns - left)
    in_image = np.ix_(rows, columns)

    focal = intrinsics[[0, 1], [0, 1]]
    x = (columns + 0.5 - intrinsics[0, 2]) / focal[0]
    y = (rows + 0.5 - intrinsics[1, 2]) / focal[1]
    rays = np.stack([*np.meshgrid(x, y), np.ones((len(rows), len(columns)))], -1).reshape(-1, 3)

    some_rows = slice(None, None, max(1, len(depth) // NOISE_ROWS))
    measured = (depth[some_rows] > 0) & np.isfinite(depth[some_rows])
    noise = estimate_noise(depth[some_rows] * np.float32(metres), measured)
    here = depth[in_image].ravel() * np.float32(metres)
    finite = np.where(np.isfinite(here), here, 0)

    return DepthView(
        origin=pose[:3, 3] * metres,
        camera_axes=pose[:3, :3],
        rays=(rays @ pose[:3, :3].T).astype(np.float32),
        depth=here.astype(np.float32),
        kind=kind[in_image].ravel(),
        noise=(noise.at(finite) * finite**2).astype(np.float32),
        edge=edge[chosen].ravel(),
        towards=towards[chosen].reshape(-1, 2),
        shape=(len(rows), len(columns)),
        step=np.array([_step(rows), _step(columns)]),
        pitch=float(1 / focal.mean()),
        whole=int(mask.sum()),
    )


def _what_is_seen(
    observation: Observation,
) -> tuple[Float32, NDArray[np.bool_], NDArray[np.uint8], Float, Float]:
    """Depth, object radii, pixels of the thing, what each pixel shows, pose and intrinsics."""
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
    return depth, mask, kind, pose, intrinsics


def _window(mask: NDArray[np.bool_], side: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Ascending rows and columns that lie evenly over an outline and a margin around it."""
    chosen = []
    for axis in (1, 0):
        filled = np.flatnonzero(mask.any(axis))
        if not len(filled):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)

        length = filled[-1] + 1 - filled[0]
        margin = max(SMALLEST_MARGIN, int(np.ceil(WINDOW_MARGIN * length)))
        first = max(0, filled[0] - margin)
        last = min(mask.shape[1 - axis] - 1, filled[-1] + margin)
        chosen.append(np.unique(np.rint(np.linspace(first, last, side)).astype(np.int64)))
    return chosen[0], chosen[1]


def _step(lines: NDArray[np.int64]) -> float:
    """Mean distance between chosen rows or columns, pixels."""
    return float(lines[-1] - lines[0]) / max(1, len(lines) - 1)


def _outline(mask: NDArray[np.bool_]) -> tuple[Float32, Float32]:
    """Distance of each pixel to the outline, negative within, and the direction to it."""
    if mask.all():
        return np.full(mask.shape, -np.inf, np.float32), np.zeros((*mask.shape, 2), np.float32)

    outside, nearest = distance_transform_edt(~mask, return_indices=True)
    within = distance_transform_edt(mask)
    rows, columns = np.indices(mask.shape)
    to_mask = np.stack([nearest[1] - columns, nearest[0] - rows], -1)
    towards = to_mask / np.maximum(outside, 1)[..., None]
    return (outside - within).astype(np.float32), towards.astype(np.float32)
