"""Renderings of the leading hypotheses from candidate cameras, with occlusion.

Each hypothesis, a thing in a pose, is rendered from each candidate camera at low resolution.
Obstacles that earlier views measured occlude parts of it, and the support surface is visible behind
it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from nextview.sensing.view import View
from nextview.things.surface import SurfaceCaster
from nextview.types import Float, Float32, Mask
from nextview.views.expected_model import Leading
from nextview.views.unseen_space import MeasuredDepth, chance_of_sight

LOWEST_COSINE = 0.15  # smallest cosine of incidence in the likelihood of a pixel
# distance from the support surface within which a point belongs to it, metres
SUPPORT_NEAR = 0.01
# margin around the thing within which a point may belong to it, metres
OWN_MARGIN = 0.005
# distance within which an obstacle may occlude the thing, radii of the thing
OBSTACLE_REACH = 4.0
OBSTACLE_EVERY = 5  # pixels of the grid from one measured obstacle to the next
# distance within which unobserved space may occlude the thing, radii of the thing
UNSEEN_REACH = 4.0
UNSEEN_EVERY = 2  # unobserved space is looked up at every second row and column


@dataclass(frozen=True)
class ExpectedSensor:
    """The camera of future views.

    Attributes:
        pitch: angle between neighbouring pixels, radians.
        noise: standard deviation of the inverse depth, 1/metres.
    """

    pitch: float
    noise: float


@dataclass(frozen=True, eq=False)
class SeenSurroundings:
    """Measured surroundings of the thing.

    Attributes:
        obstacles: points of other objects that may occlude the thing, (N, 3) float64, object frame,
            metres.
        floor: height of the support surface, metres; minus infinity for none.
        reach: distance from the origin up to which the support surface was measured, metres. Beyond
            it, rays past the thing measure nothing.
        seen: depth images of the views so far. Space outside them may contain further obstacles.
    """

    obstacles: Float
    floor: float = -np.inf
    reach: float = 0.0
    seen: tuple[MeasuredDepth, ...] = ()

    @classmethod
    def nothing(cls) -> "SeenSurroundings":
        """An isolated thing, without obstacles and without a measurable background."""
        return cls(np.zeros((0, 3)))

    @classmethod
    def of(
        cls,
        views: Sequence[View],
        owners: Sequence[Mask],
        own: Float,
        to_object: Float,
    ) -> "SeenSurroundings":
        """Collect what some views measured around a thing.

        Args:
            views: of the thing.
            owners: pixels of their grids that show the thing, (P,) bool each.
            own: points on the thing, (N, 3), object frame, metres.
            to_object: from the world to the object frame, (4, 4).

        Returns:
            Obstacles and the support surface.
        """
        floor = float(own[:, 2].min())
        radius = float(np.linalg.norm(own - own.mean(0), axis=1).max())
        found = [np.zeros((0, 3))]
        for view, mine in zip(views, owners, strict=True):
            others = np.flatnonzero(~mine & (view.grid().depth.ravel() > 0))
            found.append(view.points(others[::OBSTACLE_EVERY]))
        points = np.concatenate(found) @ to_object[:3, :3].T + to_object[:3, 3]
        height = points[:, 2] - floor
        away = np.linalg.norm(points[:, :2], axis=1)
        on_support = np.abs(height) < SUPPORT_NEAR
        reach = float(np.quantile(away[on_support], 0.95)) if on_support.any() else 0.0
        near = np.linalg.norm(points, axis=1) < OBSTACLE_REACH * radius
        near &= cKDTree(own).query(points)[0] > OWN_MARGIN
        seen = (
            MeasuredDepth(view.depth, to_object @ view.camera, view.frame.intrinsics)
            for view in views
        )
        return cls(points[near & (height > SUPPORT_NEAR)], floor, reach, tuple(seen))


@dataclass(frozen=True, eq=False)
class HypothesisImages:
    """Renderings of H hypotheses from V cameras, with P pixels each.

    Attributes:
        rays: rays through the pixels, scaled to one metre of depth, (V, P, 3) float32.
        lengths: lengths of the rays, (V, P) float32.
        depth: depth of each hypothesis, (V, H, P) float32, metres; infinity where it is absent or
            occluded.
        hidden: pixels where a hypothesis is occluded, (V, H, P) bool.
        clear: probability that no unobserved obstacle occludes a pixel, (V, P) float32.
        normals: surface normals towards the camera, (V, H, P, 3) float32, object frame.
        cosine: cosine of the angle of incidence, (V, H, P) float32.
        behind: whether a background is measured where no hypothesis is visible, (V, P) bool.
        origins: positions of the cameras, (V, 3) float32.
        centre: centre of rotation of the hypotheses, (3,) float32.
        step: spacing of the pixels, tangents, (V, 2) float32, rows and columns.
        side: rows and columns.
    """

    rays: Float32
    lengths: Float32
    depth: Float32
    hidden: Mask
    clear: Float32
    normals: Float32
    cosine: Float32
    behind: Mask
    origins: Float32
    centre: Float32
    step: Float32
    side: int

    @property
    def sight(self) -> Float:
        """Probability that no unobserved obstacle occludes what is expected to show, (V,)."""
        shown = np.isfinite(self.depth).any(1)
        return (self.clear * shown).sum(1) / np.maximum(shown.sum(1), 1)

    def pixels_shown(self, pitch: float) -> Float:
        """Expected number of camera pixels that show each hypothesis.

        Args:
            pitch: angle between neighbouring pixels of the camera, radians.

        Returns:
            Numbers of pixels, (V, H) float64.
        """
        some = np.where(np.isfinite(self.depth), self.clear[:, None], 0).sum(2)
        return some * (self.step / pitch).prod(1)[:, None].astype(np.float64)


def rendered_images(
    caster: SurfaceCaster,
    hypotheses: Leading,
    cameras: Float,
    scene: SeenSurroundings,
    side: int,
) -> HypothesisImages:
    """Render all hypotheses from all cameras at low resolution.

    Args:
        caster: surfaces of the things.
        hypotheses: things in poses.
        cameras: camera-to-world, (V, 4, 4), metres, object frame.
        scene: occluders and the support surface.
        side: rows and columns of each image.

    Returns:
        The images.
    """
    things = hypotheses.things
    turns = hypotheses.poses[:, :3, :3].astype(np.float32)
    places = hypotheses.poses[:, :3, 3]
    origins = cameras[:, :3, 3]
    x, y, step = _windows(caster, hypotheses, cameras, side)

    views = len(cameras)
    count = len(things)
    in_camera = np.ones((views, side, side, 3))
    in_camera[..., 0] = x[:, None, :]
    in_camera[..., 1] = y[:, :, None]
    turned = in_camera.reshape(views, -1, 3) @ cameras[:, :3, :3].swapaxes(1, 2)
    rays = turned.astype(np.float32)

    # Order of the rows: all hypotheses of the first camera, then of the second, and so on.
    from_place = origins[:, None] - places
    in_file = np.einsum("vhj,hji->vhi", from_place, hypotheses.poses[:, :3, :3])
    directions = rays[:, None] @ turns
    depth, normals = caster.cast(
        np.tile(things, views),
        in_file.reshape(-1, 3).astype(np.float32),
        directions.reshape(views * count, -1, 3),
    )
    depth = depth.reshape(views, count, -1)
    normals = normals.reshape(views, count, -1, 3)
    lengths = np.sqrt(np.einsum("vpi,vpi->vp", rays, rays))
    cosine = -np.einsum("vhpi,vhpi->vhp", normals, directions) / lengths[:, None]

    before = _obstacle_depth(scene.obstacles, cameras, x, y, step)
    hidden = np.isfinite(depth) & (depth > before[:, None])
    radius = max(caster.surfaces[thing].radius for thing in np.unique(things).tolist())
    clear = _clear(scene, origins, rays, depth.min(1), before, radius)
    behind = np.isfinite(before) | _support_shows(scene, origins, rays)
    centre = np.mean(
        np.einsum("hij,hj->hi", turns, caster.centres[things]) + places,
        axis=0,
    )
    return HypothesisImages(
        rays=rays,
        lengths=lengths.astype(np.float32),
        depth=np.where(hidden, np.float32(np.inf), depth),
        hidden=hidden,
        clear=clear,
        normals=normals @ turns.swapaxes(1, 2),
        cosine=np.clip(cosine, LOWEST_COSINE, 1).astype(np.float32),
        behind=behind,
        origins=origins.astype(np.float32),
        centre=centre.astype(np.float32),
        step=step.astype(np.float32),
        side=side,
    )


def _windows(
    caster: SurfaceCaster,
    hypotheses: Leading,
    cameras: Float,
    side: int,
) -> tuple[Float, Float, Float]:
    """Tangents of columns and rows, (V, side) each, that cover all hypotheses, and their steps."""
    boxes = []
    for thing, pose in zip(hypotheses.things, hypotheses.poses, strict=True):
        vertices = caster.surfaces[thing].vertices
        ends = np.stack([vertices.min(0), vertices.max(0)])
        corners = np.stack(np.meshgrid(*ends.T), -1).reshape(-1, 3)
        boxes.append(corners @ pose[:3, :3].T + pose[:3, 3])
    corners = np.concatenate(boxes)

    in_camera = (corners - cameras[:, None, :3, 3]) @ cameras[:, :3, :3]
    ahead = np.maximum(in_camera[..., 2:], 1e-3)
    tangents = in_camera[..., :2] / ahead
    low = tangents.min(1)
    step = (tangents.max(1) - low) / side
    middles = np.arange(side) + 0.5
    x = low[:, :1] + step[:, :1] * middles
    y = low[:, 1:] + step[:, 1:] * middles
    return x, y, step[:, ::-1]


def _obstacle_depth(
    obstacles: Float,
    cameras: Float,
    x: Float,
    y: Float,
    step: Float,
) -> Float32:
    """Depth of the nearest obstacle at each pixel, (V, P) float32; infinity where there is none."""
    views, side = x.shape
    depth = np.full((views, side, side), np.inf, np.float32)
    if not len(obstacles):
        return depth.reshape(views, -1)

    in_camera = (obstacles - cameras[:, None, :3, 3]) @ cameras[:, :3, :3]
    z = in_camera[..., 2]
    ahead = np.maximum(z, 1e-3)
    column = np.floor(
        (in_camera[..., 0] / ahead - x[:, :1]) / step[:, 1:] + 0.5
    ).astype(np.int64)
    row = np.floor((in_camera[..., 1] / ahead - y[:, :1]) / step[:, :1] + 0.5).astype(
        np.int64
    )

    inside = (z > 1e-3) & (row >= 0) & (row < side) & (column >= 0) & (column < side)
    view, point = np.nonzero(inside)
    at = (view, row[view, point], column[view, point])
    np.minimum.at(depth, at, z[view, point].astype(np.float32))
    # The points may be sparser than the pixels: close the gaps between them.
    wider = minimum_filter(depth, (1, 3, 3))
    return maximum_filter(wider, (1, 3, 3)).reshape(views, -1)


def _clear(
    scene: SeenSurroundings,
    origins: Float,
    rays: Float32,
    depth: Float32,
    before: Float32,
    radius: float,
) -> Float32:
    """Probability that no unobserved obstacle occludes each pixel, (V, P) float32."""
    views, pixels = depth.shape
    if not scene.seen or not len(scene.obstacles):
        return np.ones((views, pixels), np.float32)

    side = round(pixels**0.5)
    some = np.arange(pixels).reshape(side, side)[::UNSEEN_EVERY, ::UNSEEN_EVERY].ravel()
    shows = np.isfinite(depth[:, some])
    along = np.where(shows, depth[:, some], np.nan)
    ends = origins.astype(np.float32)[:, None] + rays[:, some] * along[..., None]
    lengths = np.linalg.norm(rays[:, some], axis=2, keepdims=True)
    hidden = shows & (depth[:, some] > before[:, some])

    top = float(scene.obstacles[:, 2].max())
    chance = chance_of_sight(
        scene.seen,
        ends,
        rays[:, some] / lengths,
        hidden,
        UNSEEN_REACH * radius,
        scene.floor,
        top,
    )

    coarse = chance.reshape(views, -(-side // UNSEEN_EVERY), -1)
    fine = coarse.repeat(UNSEEN_EVERY, 1).repeat(UNSEEN_EVERY, 2)
    return fine[:, :side, :side].reshape(views, pixels)


def _support_shows(scene: SeenSurroundings, origins: Float, rays: Float32) -> Mask:
    """Pixels with the measured support surface in the background, (V, P) bool."""
    if not np.isfinite(scene.floor) or scene.reach == 0:
        return np.zeros(rays.shape[:2], bool)
    height = origins[:, 2] - scene.floor
    down = -rays[..., 2]
    along = height[:, None] / np.where(down > 0, down, np.inf)
    there = origins[:, None, :2] + along[..., None] * rays[..., :2]
    away = np.linalg.norm(there, axis=2)
    return (down > 0) & (height[:, None] > 0) & (away < scene.reach)
