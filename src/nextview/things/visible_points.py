"""What cameras in all directions see of taught things: points, and their normals."""

from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial
from hashlib import sha256
from weakref import WeakValueDictionary

import numpy as np

from nextview.cores import cores
from nextview.geometry.axes import looking_from
from nextview.geometry.pinhole import PinholeCamera
from nextview.things.moments import Moments
from nextview.things.point_pairs import PointPairs
from nextview.things.surface import SurfaceCaster
from nextview.types import Float, Float32, Index, Mask

DIRECTIONS = 162  # from which a thing is seen, some 15 degrees apart
RENDERING_PIXELS = 20  # rows and columns of a rendering
POINTS = 128  # points that are kept of what a direction sees
DISTANCE = 5.0  # of the camera from the centre, radii


class VisiblePoints:
    """Points that cameras in all directions see of things.

    Attributes:
        directions: from a thing to its cameras, unit vectors, (D, 3) float64.
        points: points that each direction sees of each thing, relative to its centre, (T, D,
            POINTS, 3) float32, metres.
        normals: their unit normals, (T, D, POINTS, 3) float32.
        fill: share of the picture that shows the thing, (T, D) float32.
    """

    def __init__(
        self, caster: SurfaceCaster, threads: int = 1, directions: Float | None = None
    ) -> None:
        """Render all surfaces.

        Args:
            caster: surfaces of the things.
            threads: number of threads; 0 for one on each core.
            directions: from a thing to its cameras, unit vectors, (D, 3); None for all around.
        """
        self.directions = ALL_AROUND if directions is None else directions
        looks = looking_from(self.directions)
        with ThreadPoolExecutor(threads or cores()) as pool:
            render = partial(_rendered, caster, looks=looks)
            each = list(pool.map(render, range(len(caster.surfaces))))
        points, normals, fill = zip(*each, strict=True)
        self.points = np.stack(points)
        self.normals = np.stack(normals)
        self.fill = np.stack(fill)

    @cached_property
    def pairs(self) -> PointPairs:
        """Pairs of these points, by what no motion changes."""
        count = len(self.points)
        return PointPairs.of(
            self.points.reshape(count, -1, 3), self.normals.reshape(count, -1, 3)
        )

    @cached_property
    def moments(self) -> Moments:
        """Moments of what each direction sees."""
        return Moments.of(self.points, looking_from(self.directions))


_IN_USE: WeakValueDictionary[bytes, VisiblePoints] = WeakValueDictionary()


def visible_points(caster: SurfaceCaster, threads: int = 1) -> VisiblePoints:
    """Visible points of surfaces; those of the same surfaces are shared while they are in use.

    Args:
        caster: surfaces of the things.
        threads: number of threads; 0 for one on each core.
    """
    digest = sha256()
    for surface in caster.surfaces:
        digest.update(surface.vertices.tobytes())
        digest.update(surface.faces.tobytes())
    points = _IN_USE.get(digest.digest())
    if points is None:
        points = VisiblePoints(caster, threads)
        _IN_USE[digest.digest()] = points
    return points


def spread_directions(count: int) -> Float:
    """Directions that are spread evenly over the sphere, on a spiral.

    Args:
        count: number of directions.

    Returns:
        Unit vectors, (count, 3).
    """
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    azimuth = np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], 1)


ALL_AROUND = spread_directions(DIRECTIONS)


def _rendered(
    caster: SurfaceCaster, thing: int, looks: Float
) -> tuple[Float32, Float32, Float32]:
    """Render one thing from D cameras with these axes, (D, 3, 3): see ``VisiblePoints``."""
    radius = float(caster.radii[thing])
    focal = RENDERING_PIXELS / 2 * np.sqrt(DISTANCE**2 - 1)
    camera = PinholeCamera.centred(focal, (RENDERING_PIXELS, RENDERING_PIXELS))
    lines = np.arange(RENDERING_PIXELS)
    row, column = (each.ravel() for each in np.meshgrid(lines, lines, indexing="ij"))
    rays = np.stack([*camera.slopes(row, column), np.ones(len(row))], -1)

    origins = caster.centres[thing] - DISTANCE * radius * looks[:, 2]
    towards = (rays @ looks).astype(np.float32)
    depth, across = caster.from_all_sides(thing, origins.astype(np.float32), towards)
    shown = np.isfinite(depth)
    picked = _picked(shown)
    each = np.arange(len(looks))[:, None]
    points = origins[:, None] + towards[each, picked] * depth[each, picked][..., None]
    count = shown.sum(1)
    points = np.where(count[:, None, None] > 0, points - caster.centres[thing], 0)
    fill = (count / shown.shape[1]).astype(np.float32)
    return points.astype(np.float32), across[each, picked], fill


def _picked(shown: Mask) -> Index:
    """Pixels of each picture, (D, P), that show the thing, in random order, (D, POINTS).

    Pixels are repeated where there are fewer; any pixel where there is none.
    """
    chance = np.random.default_rng(0).random(shown.shape)
    order = np.argsort(np.where(shown, chance, 2), axis=1)
    count = np.maximum(shown.sum(1), 1)[:, None]
    return np.take_along_axis(order, np.arange(POINTS)[None] % count, 1)
