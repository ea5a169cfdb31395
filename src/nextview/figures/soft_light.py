"""Render the observed surface of an object in soft light, for the figures of episodes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, median_filter

from nextview.figures.style import GROUND, WOOD, rgb
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster, Triangles, embree_scene
from nextview.sensing.observation import Observation
from nextview.types import Floats

# a larger depth step between neighbouring pixels separates surfaces, object radii
TORN = 0.08
# half the side of the ground with computed shadows, object radii, and its grid points per side
SHADOW_REACH = 2.6
SHADOW_GRID = 72
# random directions, not normalised
SKY = np.random.default_rng(0).normal(size=(150, 3))
# colour factor of the ground in full shadow: a warm tint
SHADE = np.array([0.52, 0.57, 0.64])
# direction to the lamp, camera frame: above, left of and behind the camera
LAMP_DIRECTION = np.array([-0.45, -0.75, -0.8])


def surface(seen: Observation) -> Triangles:
    """Triangulate a depth image, object frame."""
    depth = (
        seen.depth
        if seen.exact
        else np.where(seen.depth > 0, median_filter(seen.depth, 5), 0)
    )
    points = (
        PinholeCamera.of(seen.intrinsics, depth.shape).rays * depth[..., None]
    ).reshape(-1, 3)
    k = np.arange(depth.size).reshape(depth.shape)
    a, b, c, d = (
        part.ravel() for part in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:])
    )
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    corners = depth.ravel()[faces]
    faces = faces[(corners.min(1) > 0) & (np.ptp(corners, axis=1) < TORN)]
    points = points @ seen.pose[:3, :3].T + seen.pose[:3, 3]
    edges, times = np.unique(
        np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)),
        axis=0,
        return_counts=True,
    )
    rim = edges[times == 1]  # boundary edges, smoothed to remove pixel steps
    count = np.maximum(np.bincount(rim.ravel(), minlength=len(points)), 1)[:, None]

    for _ in range(5):
        beside = np.stack(
            [
                np.bincount(rim.ravel(), points[rim[:, ::-1].ravel(), k], len(points))
                for k in range(3)
            ],
            1,
        )
        points = np.where(count > 1, 0.5 * points + 0.5 * beside / count, points)

    return points, faces.astype(np.int32)


class SoftLight:
    """Lighting of the observed surface of an object and of the ground below it."""

    def __init__(self, observations: Sequence[Observation]) -> None:
        seen: list[Floats] = [
            np.zeros((1, 3)),
            *(o.points for o in observations if o.seen),
        ]
        self.surfaces = [surface(o) for o in observations]
        self._caster = RayCaster(self.surfaces)
        # with sensor noise the views of one surface do not coincide
        self._off = 0.02 if all(o.exact for o in observations) else 0.15
        self.floor = float(np.percentile(np.concatenate(seen)[:, 2], 0.5)) - 0.01
        x, y = np.meshgrid(*[np.linspace(-SHADOW_REACH, SHADOW_REACH, SHADOW_GRID)] * 2)
        ground = np.stack([x, y, np.full_like(x, self.floor)], -1).reshape(-1, 3)
        light = self._sky(
            ground,
            np.tile([0.0, 0.0, 1.0], (len(ground), 1)),
            SKY,
        ).reshape(SHADOW_GRID, SHADOW_GRID)
        self._ground = gaussian_filter(light, 1.2, mode="nearest")

    def _sky(self, points: Floats, normals: Floats, balls: Floats) -> Floats:
        """Return the share of the sky that is visible from each point."""
        free = np.zeros(len(points))
        for ball in balls / np.linalg.norm(balls, axis=1, keepdims=True):
            free += np.isinf(
                self._caster.cast(points + self._off * normals, normals + 0.97 * ball)[
                    0
                ]
            )
        return free / len(balls)

    def picture(
        self,
        surfaces: Sequence[Triangles],
        pose: Floats,
        intrinsics: Floats,
        shape: tuple[int, int],
    ) -> tuple[NDArray[np.uint8], Floats]:
        """Render surfaces on the ground.

        Args:
            surfaces: the surfaces.
            pose: camera-to-world, (4, 4).
            intrinsics: pinhole matrix, (3, 3), pixels.
            shape: rows and columns of the image.

        Returns:
            The image, (H, W, 3) uint8, and the distance along each pixel's ray, (H, W).
        """
        rays = (
            PinholeCamera.of(np.asarray(intrinsics, np.float64), shape).rays.reshape(
                -1,
                3,
            )
            @ pose[:3, :3].T
        )
        origins = np.tile(pose[:3, 3], (len(rays), 1)).astype(np.float32)
        hits = embree_scene(surfaces).run(origins, rays.astype(np.float32), output=1)
        hit = hits["primID"] >= 0
        colours = np.tile(np.array(rgb(GROUND), float), (len(rays), 1))

        with np.errstate(divide="ignore", invalid="ignore"):
            down = (self.floor - pose[2, 3]) / rays[:, 2]
        below = (
            np.where((down > 0) & np.isfinite(down), down, 0)[:, None] * rays + origins
        )
        at = (below[:, 1::-1] / SHADOW_REACH + 1) * (SHADOW_GRID - 1) / 2
        light = map_coordinates(self._ground, at.T, order=1, cval=1.0)
        colours *= 1 - np.outer((down > 0) * np.clip(0.97 - light, 0, 1), SHADE)

        normals = hits["Ng"][hit] / np.maximum(
            np.linalg.norm(hits["Ng"][hit], axis=1, keepdims=True),
            1e-12,
        )
        normals *= -np.sign((normals * rays[hit]).sum(1, keepdims=True))
        facing = 0.5 + 0.5 * normals @ (pose[:3, :3] @ LAMP_DIRECTION) / np.linalg.norm(
            LAMP_DIRECTION
        )
        points = origins[hit] + hits["tfar"][hit, None] * rays[hit]
        bright = (0.35 + 0.65 * self._sky(points, normals, SKY[:24])) * (
            0.5 + 0.62 * facing
        )
        colours[hit] = np.array(rgb(WOOD)) * bright[:, None]

        far = np.where(hit, hits["tfar"], np.inf).reshape(shape)
        return np.clip(colours, 0, 255).astype(np.uint8).reshape(*shape, 3), far
