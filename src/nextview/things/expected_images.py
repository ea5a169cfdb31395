"""The leading hypotheses as candidate cameras would see them, with what stands in the way.

Each hypothesis, a thing in a pose, is rendered from each candidate camera with few pixels. What the
views so far measured beside the thing hides parts of it, and the support shows behind it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from nextview.errors import ObservationError
from nextview.geometry.observation import Observation
from nextview.things.depth_view import THING, DepthView
from nextview.things.leading import Hypotheses
from nextview.things.surface import SurfaceCaster
from nextview.things.unseen_space import MeasuredDepth, chance_of_sight
from nextview.types import Float, Float32, Mask

LOWEST_COSINE = 0.15  # of incidence, in the judgement of a pixel
# metres from the height of the support, within which a point lies on it
SUPPORT_NEAR = 0.01
OWN_MARGIN = 0.005  # metres around the thing, within which a point may be its own
OBSTACLE_REACH = 4.0  # radii of the thing, within which an obstacle may hide it
OBSTACLE_ROWS = 120  # rows of a depth image that are looked through for obstacles
# radii of the thing, within which something that no view shows may hide it
UNSEEN_REACH = 4.0
UNSEEN_EVERY = 2  # every so many rows and columns of pixels, unseen space is looked up


@dataclass(frozen=True)
class ExpectedSensor:
    """The camera of the views to come.

    Attributes:
        pitch: angle between neighbouring pixels, radians.
        noise: standard deviation of the inverse depth, 1/metres.
    """

    pitch: float
    noise: float

    @classmethod
    def of(cls, views: Sequence[DepthView]) -> "ExpectedSensor":
        """The camera that took some views of the thing.

        Args:
            views: at least one.

        Raises:
            ObservationError: there is none.
        """
        if not views:
            raise ObservationError(
                "without a view that shows the thing the sensor is not known"
            )
        noise = []
        for view in views:
            thing = view.kind == THING
            noise.append(np.median(view.noise[thing] / view.depth[thing] ** 2))
        pitch = np.mean([view.pitch for view in views])
        return cls(float(pitch), float(np.mean(noise)))


@dataclass(frozen=True, eq=False)
class SeenSurroundings:
    """What is known of the scene around the thing.

    Attributes:
        obstacles: points of other things that may hide it, (N, 3) float64, object frame, metres.
        floor: height of the support, metres; minus infinity for none.
        reach: how far from the origin the support was seen, metres. There it is measured behind the
            thing; elsewhere nothing is.
        seen: the depth images of the views so far: where they did not look, more may stand.
    """

    obstacles: Float
    floor: float = -np.inf
    reach: float = 0.0
    seen: tuple[MeasuredDepth, ...] = ()

    @classmethod
    def nothing(cls) -> "SeenSurroundings":
        """The thing alone, with nothing that is measured behind it."""
        return cls(np.zeros((0, 3)))

    @classmethod
    def of(
        cls,
        observations: Sequence[Observation],
        caster: SurfaceCaster,
        hypotheses: Hypotheses,
    ) -> "SeenSurroundings":
        """Gather what some views saw beside the thing.

        Args:
            observations: views of the thing, with all that their cameras saw. Those without that
                say nothing.
            caster: the surfaces.
            hypotheses: the leading ones. The support is where the first of them stands.

        Returns:
            Obstacles and the support.
        """
        surface = caster.surfaces[hypotheses.things[0]]
        pose = hypotheses.poses[0]
        floor = float((surface.vertices @ pose[2, :3] + pose[2, 3]).min())
        radius = surface.radius

        seen = [_beside(observation) for observation in observations]
        points = np.concatenate([np.zeros((0, 3)), *seen])
        height = points[:, 2] - floor
        away = np.linalg.norm(points[:, :2], axis=1)
        on_support = np.abs(height) < SUPPORT_NEAR
        reach = float(np.quantile(away[on_support], 0.95)) if on_support.any() else 0.0

        in_file = (points - pose[:3, 3]) @ pose[:3, :3]
        low = surface.vertices.min(0) - OWN_MARGIN
        high = surface.vertices.max(0) + OWN_MARGIN
        own = ((in_file > low) & (in_file < high)).all(1)
        near = np.linalg.norm(points, axis=1) < OBSTACLE_REACH * radius
        obstacles = points[(height > SUPPORT_NEAR) & near & ~own]
        images = (MeasuredDepth.of(observation) for observation in observations)
        return cls(
            obstacles,
            floor,
            reach,
            tuple(image for image in images if image is not None),
        )


def _beside(observation: Observation) -> Float:
    """Points that a view measured beside the thing, (N, 3), object frame, metres."""
    scene = observation.scene
    if scene is None or observation.radius is None:
        return np.zeros((0, 3))
    every = max(1, scene.depth.shape[0] // OBSTACLE_ROWS)
    depth = scene.depth[::every, ::every].astype(np.float64) * observation.radius
    target = scene.target[::every, ::every]
    rows, columns = np.nonzero((depth > 0) & np.isfinite(depth) & ~target)
    pixels = np.stack([columns * every + 0.5, rows * every + 0.5, np.ones(len(rows))])
    rays = np.linalg.inv(scene.intrinsics) @ pixels
    in_camera = (rays * depth[rows, columns]).T
    return in_camera @ scene.pose[:3, :3].T + scene.pose[:3, 3] * observation.radius


@dataclass(frozen=True, eq=False)
class HypothesisImages:
    """The hypotheses as V cameras would see them, P pixels each.

    Attributes:
        rays: through the pixels, as long as one metre of depth, (V, P, 3) float32.
        lengths: of these, (V, P) float32.
        depth: of each hypothesis, (V, H, P) float32, metres; infinity where it does not show, or
            something stands before it.
        hidden: where a hypothesis is behind something else, (V, H, P) bool.
        clear: how likely nothing that no view has shown stands before a pixel, (V, P) float32.
        normals: towards the camera, (V, H, P, 3) float32, object frame.
        cosine: of the angle of incidence, (V, H, P) float32.
        behind: whether something is measured where no hypothesis shows, (V, P) bool.
        origins: of the cameras, (V, 3) float32.
        centre: about which hypotheses turn, (3,) float32.
        step: between pixels, tangents, (V, 2) float32, rows and columns.
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

    def pixels_shown(self, pitch: float) -> Float:
        """Expected pixels of the camera that show each hypothesis, (V, H) float64.

        Args:
            pitch: angle between neighbouring pixels of the camera, radians.
        """
        some = np.where(np.isfinite(self.depth), self.clear[:, None], 0).sum(2)
        return some * (self.step / pitch).prod(1)[:, None].astype(np.float64)


def rendered_images(
    caster: SurfaceCaster,
    hypotheses: Hypotheses,
    cameras: Float,
    scene: SeenSurroundings,
    side: int,
) -> HypothesisImages:
    """Render all hypotheses from all cameras with few pixels.

    Args:
        caster: surfaces of the things.
        hypotheses: things in poses.
        cameras: camera-to-world, (V, 4, 4), metres, object frame.
        scene: what hides the things.
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

    # Rows of the call: all hypotheses of the first camera, then of the second.
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
    hypotheses: Hypotheses,
    cameras: Float,
    side: int,
) -> tuple[Float, Float, Float]:
    """Tangents of columns and rows, (V, side) each, that cover all hypotheses, and the steps."""
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
    # Points may lie farther apart than pixels: gaps between them are closed.
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
    """How likely nothing that no view has shown stands before each pixel, (V, P) float32."""
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
    """Where the support was seen behind the thing, (V, P) bool."""
    if not np.isfinite(scene.floor) or scene.reach == 0:
        return np.zeros(rays.shape[:2], bool)
    height = origins[:, 2] - scene.floor
    down = -rays[..., 2]
    along = height[:, None] / np.where(down > 0, down, np.inf)
    there = origins[:, None, :2] + along[..., None] * rays[..., :2]
    away = np.linalg.norm(there, axis=2)
    return (down > 0) & (height[:, None] > 0) & (away < scene.reach)
