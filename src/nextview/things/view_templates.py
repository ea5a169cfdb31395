"""Proposals of things in any orientation, by matching of depth templates.

Each thing is rendered from directions all around it, as in template matching (Hinterstoisser et
al., "Model based training, detection and pose estimation of texture-less 3D objects in heavily
cluttered scenes", 2012). A template is a small metric grid over the outline, so that a template of
another size does not fit. The view is rotated in the image plane instead of the templates. The
score of outlines is their intersection over union where the view is conclusive: not at occluders,
at pixels without a measurement, or beyond the border of the image. A partly occluded outline is
also shifted towards the occluder. The score of depths is their mean squared difference in the
intersection. All scores are a few matrix products.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from hashlib import sha256
from weakref import WeakValueDictionary

import numpy as np
from scipy import ndimage

from nextview.cores import cores
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.viewsphere import rotation_z
from nextview.sensing.frame import within
from nextview.things.surface import SurfaceCaster
from nextview.types import Float, Float32, Index, Mask

TEMPLATE_DIRECTIONS = 162  # viewing directions of the templates, some 15 degrees apart
TURNS = 24  # rotations of the view in the image plane, 15 degrees apart
TEMPLATE_SIDE = 12  # rows and columns of a template
TEMPLATE_REACH = 2.2  # half width of a template, root mean squares of the outline
RENDERING_PIXELS = 28  # rows and columns of a rendering
POINTS = 128  # points that are kept of what a direction sees
TEMPLATE_DISTANCE = 5.0  # distance of the camera from the centre, radii
MOST_ORIENTATIONS = 16  # most proposed orientations of one thing
FEWEST_OUTLINE_PIXELS = 12  # fewest pixels of an outline that can be matched
NO_FIT = 12.0  # cost of a template of another size
# largest depth difference to the median of an outline, root mean squares of the outline
FARTHEST_BEHIND = 3.0
# size relative to the largest part of an outline, below which a part is noise
SPECK = 0.05

OUTLINE_WEIGHT = 8.0
DEPTH_WEIGHT = 4.0
"""Cost of a unit mismatch of outlines and of depths."""
SIZE_STEP = 0.06  # step between the tested log-sizes of a view
# range of the template's log-size relative to the visible outline
SIZES = (-0.36, 0.36)
SIZES_HIDDEN = (-0.24, 1.2)  # the same for an occluded outline
SHIFTS = (0.5, 1.5)  # step and range of the shifts of an occluded outline, sizes
TOWARDS_OCCLUDER = (
    0.7  # least cosine of the angle between a shift and the way to the occluder
)
HIDDEN_SHARE = (
    0.05  # share of occluders around an outline, from which it counts as occluded
)


@dataclass(frozen=True, eq=False)
class Pictures:
    """N templates of outlines and depths, with C cells each.

    Attributes:
        outline: cells that show the thing, 0 or 1, (N, C) float32.
        depth: depth relative to the median of the outline, in root mean squares of the outline; 0
            for empty cells, (N, C) float32.
    """

    outline: Float32
    depth: Float32

    def __getitem__(self, rows: Index | slice) -> "Pictures":
        """Return some of them."""
        return Pictures(self.outline[rows], self.depth[rows])


@dataclass(frozen=True, eq=False)
class SeenPictures:
    """A rotations of a view, sampled on the grid of templates of one size.

    Attributes:
        outline: cells that show the thing, 0 or 1, (A, C) float32.
        known: cells with a conclusive measurement, 0 or 1, (A, C) float32.
        depth: see ``Pictures``.
        area: area of the whole outline, cells.
    """

    outline: Float32
    known: Float32
    depth: Float32
    area: float


@dataclass(frozen=True, eq=False)
class OrientedProposals:
    """M hypotheses of things in any orientation, the likeliest first.

    Attributes:
        things: thing of each, (M,) int64.
        ranks: number of better orientations of the same thing, (M,) int64.
        rotations: from the axes of the scan files to the world, (M, 3, 3) float64.
        centres: centres of the surfaces in the world, (M, 3) float64, metres.
        of_things: least cost of outline and relative depth of each thing, (T,) float64.
    """

    things: Index
    ranks: Index
    rotations: Float
    centres: Float
    of_things: Float


class ViewTemplates:
    """Templates of things from all directions.

    Attributes:
        things: thing of each template, the smallest outlines first, (N,) int64.
        rotations: from the axes of the scan file to those of a camera that looks at the centre of
            the outline, (N, 3, 3) float64.
        offsets: from the centre of the outline, at its median depth, to the centre of the surface,
            in the camera axes, (N, 3) float64, metres.
        sizes: root mean square of the outline, metres, (N,) float64.
        pictures: the templates.
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
        sizes = np.concatenate([one.sizes for one in each])
        order = np.argsort(sizes, kind="stable")
        things = np.repeat(np.arange(len(each)), [len(one.sizes) for one in each])
        self.sizes = sizes[order]
        self.things = things[order]
        self.rotations = np.concatenate([one.rotations for one in each])[order]
        self.offsets = np.concatenate([one.offsets for one in each])[order]
        self.pictures = Pictures(
            np.concatenate([one.pictures.outline for one in each])[order],
            np.concatenate([one.pictures.depth for one in each])[order],
        )
        self.points = np.stack([one.points for one in each])
        self.normals = np.stack([one.normals for one in each])
        self.fill = np.stack([one.fill for one in each])

    def propose(self, view: "SeenOutline", among: Mask) -> OrientedProposals:
        """Propose orientations of the things that an outline may show.

        Args:
            view: the outline.
            among: things that it may be, (T,) bool.

        Returns:
            Up to MOST_ORIENTATIONS of each thing, the likeliest first.
        """
        known = len(among)
        fit = self._fit(view)
        of_things = np.full(known, NO_FIT)
        np.minimum.at(of_things, self.things, fit.cost)

        order = np.argsort(fit.cost, kind="stable")
        order = order[among[self.things[order]] & (fit.cost[order] < NO_FIT)]
        rank = rank_within(self.things[order])
        order = order[rank < MOST_ORIENTATIONS]
        rank = rank[rank < MOST_ORIENTATIONS]
        rotations, centres = self._poses(fit, view, order)
        return OrientedProposals(
            self.things[order], rank, rotations, centres, of_things
        )

    def _fit(self, view: "SeenOutline") -> "TemplateFit":
        """Best match of each template in a view."""
        count = len(self.things)
        fit = TemplateFit(
            np.full(count, NO_FIT, np.float32),
            np.zeros(count),
            np.zeros((count, 2)),
            np.zeros(count),
        )

        bins = np.rint(np.log(self.sizes / view.size) / SIZE_STEP).astype(int)

        sizes = SIZES_HIDDEN if view.hidden else SIZES
        first, last = (round(one / SIZE_STEP) for one in sizes)
        if not ((bins >= first) & (bins <= last)).any():
            # the templates of the next size are the likeliest
            bins = bins.clip(first, last)

        turns = 2 * np.pi * np.arange(TURNS) / TURNS
        grid = turned_grid(turns)
        for step in range(first, last + 1):
            rows = slice(*np.searchsorted(bins, (step, step + 1)))
            if rows.start == rows.stop:
                continue
            size = view.size * np.exp(step * SIZE_STEP)
            pixels = size * view.focal / view.middle
            seen = view.pictures(size, view.shifts * pixels, grid)
            costs, behind = mismatch(seen, self.pictures[rows])
            which = costs.argmin(0)
            each = np.arange(len(which))
            cost = costs[which, each]
            shift, turn = np.divmod(which, TURNS)
            fit.cost[rows] = np.minimum(cost, NO_FIT)
            fit.turn[rows] = turns[turn]
            fit.shift[rows] = view.shifts[shift] * pixels
            fit.behind[rows] = size * behind[which, each]
        return fit

    def _poses(
        self, fit: "TemplateFit", view: "SeenOutline", rows: Index
    ) -> tuple[Float, Float]:
        """Rotations, (M, 3, 3), and centres, (M, 3), of some templates at their best match."""
        x, y = view.camera.slopes(*(view.centre + fit.shift[rows])[:, ::-1].T)
        ahead = np.stack([x, y, np.ones(len(rows))], -1)
        lengths = np.linalg.norm(ahead, axis=1, keepdims=True)
        axes = _from_z_to(ahead / lengths)
        looks = view.pose[:3, :3] @ axes @ rotation_z(fit.turn[rows])
        middles = ahead * (view.middle + fit.behind[rows])[:, None]
        centres = middles @ view.pose[:3, :3].T + view.pose[:3, 3]
        centres += np.einsum("nij,nj->ni", looks, self.offsets[rows])
        return looks @ self.rotations[rows], centres


_IN_USE: WeakValueDictionary[bytes, ViewTemplates] = WeakValueDictionary()


def templates_of(caster: SurfaceCaster, threads: int = 1) -> ViewTemplates:
    """Templates of surfaces; those of the same surfaces are shared while they are in use.

    Args:
        caster: surfaces of the things.
        threads: number of threads; 0 for one on each core.
    """
    digest = sha256()
    for surface in caster.surfaces:
        digest.update(surface.vertices.tobytes())
        digest.update(surface.faces.tobytes())
    templates = _IN_USE.get(digest.digest())
    if templates is None:
        templates = ViewTemplates(caster, threads)
        _IN_USE[digest.digest()] = templates
    return templates


@dataclass(frozen=True, eq=False)
class TemplateFit:
    """Best matches of N templates in a view.

    Attributes:
        cost: cost of each match, (N,) float32; NO_FIT if the size differs.
        turn: rotation in the image plane, radians, (N,) float64.
        shift: shift of the centre of the outline, x and y, pixels, (N, 2) float64.
        behind: depth of the template's outline relative to the visible outline, metres, (N,)
            float64.
    """

    cost: Float32
    turn: Float
    shift: Float
    behind: Float


def rank_within(things: Index) -> Index:
    """Number of earlier equal elements for each element.

    Args:
        things: numbers, (N,).

    Returns:
        Ranks, (N,) int64.
    """
    order = np.argsort(things, kind="stable")
    first = np.searchsorted(things[order], things[order])
    rank = np.empty(len(things), np.int64)
    rank[order] = np.arange(len(things)) - first
    return rank


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


ALL_AROUND = spread_directions(TEMPLATE_DIRECTIONS)


def looking_from(directions: Float) -> Float:
    """Rotations from the world to cameras that look at the origin.

    Args:
        directions: unit vectors from the origin to the cameras, (N, 3).

    Returns:
        Rotation matrices, (N, 3, 3), whose rows are the camera axes: x right, y down, z forward.
    """
    forward = -directions
    aside = np.where(np.abs(forward[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    right = np.cross(forward, aside)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], 1)


@dataclass(frozen=True, eq=False)
class _Rendered:
    """The templates of one thing: see ``ViewTemplates``."""

    rotations: Float
    offsets: Float
    sizes: Float
    pictures: Pictures
    points: Float32
    normals: Float32
    fill: Float32


def _rendered(caster: SurfaceCaster, thing: int, looks: Float) -> _Rendered:
    """Render one thing from all cameras with these axes, (N, 3, 3).

    The statistics of the outlines are those of ``SeenOutline``, computed for all at once.
    """
    radius = float(caster.radii[thing])
    focal = RENDERING_PIXELS / 2 * np.sqrt(TEMPLATE_DISTANCE**2 - 1)
    camera = PinholeCamera.centred(focal, (RENDERING_PIXELS, RENDERING_PIXELS))
    lines = np.arange(RENDERING_PIXELS)
    row, column = (each.ravel() for each in np.meshgrid(lines, lines, indexing="ij"))
    rays = np.stack([*camera.slopes(row, column), np.ones(len(row))], -1)

    origins = caster.centres[thing] - TEMPLATE_DISTANCE * radius * looks[:, 2]
    towards = (rays @ looks).astype(np.float32)
    depth, across = caster.from_all_sides(thing, origins.astype(np.float32), towards)
    shown = np.isfinite(depth)
    picked = _picked(shown)
    each = np.arange(len(looks))[:, None]
    points = origins[:, None] + towards[each, picked] * depth[each, picked][..., None]
    count = shown.sum(1)
    points = np.where(count[:, None, None] > 0, points - caster.centres[thing], 0)
    normals = across[each, picked]
    fill = (count / shown.shape[1]).astype(np.float32)
    kept = count >= FEWEST_OUTLINE_PIXELS
    looks = looks[kept]
    depth = depth[kept]
    shown = shown[kept]
    count = count[kept]

    # centre and spread of each outline, and its median depth
    pixels = np.stack([column, row], -1).astype(np.float64)
    centre = shown @ pixels / count[:, None]
    squares = shown @ pixels**2 / count[:, None]
    spread = np.sqrt((squares - centre**2).sum(1) + 1 / 6)  # a pixel is a square
    by_depth = np.sort(depth, axis=1)
    half = np.stack([(count - 1) // 2, count // 2], 1)
    middle = np.take_along_axis(by_depth, half, 1).mean(1).astype(np.float64)
    sizes = spread * middle / focal

    x, y = camera.slopes(centre[:, 1], centre[:, 0])
    ahead = np.stack([x, y, np.ones(len(x))], -1)
    towards = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    turns = _from_z_to(towards).swapaxes(1, 2)
    offsets = np.array([0, 0, TEMPLATE_DISTANCE * radius]) - middle[:, None] * ahead

    # contents of the cells
    cells = turned_grid(np.zeros(1))[0] * spread[:, None, None] + centre[:, None]
    at = np.rint(cells).astype(np.int64)
    inside = ((at >= 0) & (at < RENDERING_PIXELS)).all(2)
    index = np.where(inside, at[..., 1] * RENDERING_PIXELS + at[..., 0], 0)
    outline = inside & np.take_along_axis(shown, index, 1)
    there = np.where(outline, np.take_along_axis(depth, index, 1), middle[:, None])
    behind = (there - middle[:, None]) / sizes[:, None]
    return _Rendered(
        turns @ looks,
        np.einsum("nij,nj->ni", turns, offsets),
        sizes,
        Pictures(
            outline.astype(np.float32),
            behind.clip(-FARTHEST_BEHIND, FARTHEST_BEHIND).astype(np.float32),
        ),
        points.astype(np.float32),
        normals,
        fill,
    )


def _picked(shown: Mask) -> Index:
    """Pixels of each picture, (D, P), that show the thing, in random order, (D, POINTS).

    Pixels are repeated where there are fewer; any pixel where there is none.
    """
    chance = np.random.default_rng(0).random(shown.shape)
    order = np.argsort(np.where(shown, chance, 2), axis=1)
    count = np.maximum(shown.sum(1), 1)[:, None]
    return np.take_along_axis(order, np.arange(POINTS)[None] % count, 1)


@dataclass(frozen=True, eq=False)
class SeenOutline:
    """The visible outline of a thing in one view.

    Attributes:
        depth: depth of all pixels, (H, W) float32, metres.
        shown: pixels of the thing, (H, W) bool.
        known: pixels with a conclusive measurement, (H, W) bool.
        camera: camera of the image.
        pose: camera-to-object, (4, 4).
        centre: centre of the outline, x and y, pixels, (2,).
        middle: median depth of the thing, metres.
        size: root mean square of the outline, metres.
        shifts: possible offsets between the centre of the thing and that of its visible part, x and
            y, sizes, (S, 2); the first is zero.
    """

    depth: Float32
    shown: Mask
    known: Mask
    camera: PinholeCamera
    pose: Float
    centre: Float
    middle: float
    size: float
    shifts: Float

    @classmethod
    def of(
        cls,
        depth: Float32,
        shown: Mask,
        unclear: Mask,
        hiding: Mask,
        camera: PinholeCamera,
        pose: Float,
    ) -> "SeenOutline | None":
        """Outline of a thing in an image.

        Args:
            depth: of all pixels, (H, W) float32, metres; 0 where nothing was measured.
            shown: pixels of the thing, (H, W) bool.
            unclear: other pixels that may show it, (H, W) bool.
            hiding: pixels of what may hide it, (H, W) bool.
            camera: camera of the image.
            pose: camera-to-world, (4, 4).

        Returns:
            The outline; None if too little is visible.
        """
        shown = without_specks(shown & (depth > 0))
        if np.count_nonzero(shown) < FEWEST_OUTLINE_PIXELS:
            return None
        known = (depth > 0) & ~unclear & ~hiding
        found = cls.of_depth(depth, shown, known | shown, camera, pose)

        part = within(shown, 2)
        own = shown[part]
        around = ndimage.binary_dilation(own, iterations=2) & ~own
        rows, columns = np.nonzero(around & hiding[part])
        # beyond the border of the image it may go on, too
        ends = np.zeros(shown.shape, bool)
        ends[[0, -1]] = ends[:, [0, -1]] = True
        ends_at = np.nonzero(own & ends[part])
        rows = np.concatenate([rows, ends_at[0]]) + part[0].start
        columns = np.concatenate([columns, ends_at[1]]) + part[1].start
        if len(rows) < HIDDEN_SHARE * np.count_nonzero(around):
            return found

        towards = np.array([columns.mean(), rows.mean()]) - found.centre
        step, reach = SHIFTS
        lines = np.arange(-reach, reach + step / 2, step)
        grid = np.stack(np.meshgrid(lines, lines), -1).reshape(-1, 2)
        far = np.linalg.norm(grid, axis=1)
        ahead = grid @ towards > TOWARDS_OCCLUDER * far * np.linalg.norm(towards)
        grid = grid[(far <= reach) & ahead]
        return replace(found, shifts=np.concatenate([np.zeros((1, 2)), grid]))

    @classmethod
    def of_depth(
        cls,
        depth: Float32,
        shown: Mask,
        known: Mask,
        camera: PinholeCamera,
        pose: Float,
    ) -> "SeenOutline":
        """Outline of given pixels.

        Args:
            depth: depth of all pixels, (H, W) float32, metres.
            shown: pixels of the thing, at least FEWEST_OUTLINE_PIXELS, (H, W) bool.
            known: pixels with a conclusive measurement, (H, W) bool.
            camera: camera of the image.
            pose: camera-to-object, (4, 4).

        Returns:
            The outline.
        """
        part = within(shown)
        rows, columns = np.nonzero(shown[part])
        rows += part[0].start
        columns += part[1].start
        centre = np.array([columns.mean(), rows.mean()])
        # a pixel is a square
        spread = float(np.sqrt(columns.var() + rows.var() + 1 / 6))
        middle = float(np.median(depth[rows, columns]))
        size = spread * middle / np.sqrt(camera.fx * camera.fy)
        shifts = np.zeros((1, 2))
        return cls(depth, shown, known, camera, pose, centre, middle, size, shifts)

    @cached_property
    def area(self) -> int:
        """Number of pixels of the outline."""
        return int(np.count_nonzero(self.shown))

    @cached_property
    def _behind(self) -> Float32:
        """Depth of each pixel behind the median, metres; not finite where it is not of the thing.

        It is infinite where something else was measured, and NaN where nothing is known, as in the
        last element, which stands for all that is beyond the image, (H * W + 1,).
        """
        others = np.where(self.known, np.float32(np.inf), np.float32(np.nan))
        own = self.depth - np.float32(self.middle)
        return np.append(np.where(self.shown, own, others), np.float32(np.nan))

    @property
    def hidden(self) -> bool:
        """Whether something hides a part of the outline."""
        return len(self.shifts) > 1

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return float(np.sqrt(self.camera.fx * self.camera.fy))

    @property
    def ahead(self) -> Float:
        """Vector to the centre of the outline, camera axes, one metre of depth long, (3,)."""
        x, y = self.camera.slopes(*self.centre[::-1])
        return np.array([x, y, 1.0])

    def pictures(self, size: float, shifts: Float, grid: Float32) -> SeenPictures:
        """Sample outline and depth on the grid of templates of one size.

        Args:
            size: root mean square of their outlines, metres.
            shifts: of the grid from the centre of the outline, pixels, (S, 2).
            grid: rotated cells of the grid, see ``turned_grid``, (A, C, 2).

        Returns:
            S * A pictures.
        """
        pixels = size * self.focal / self.middle
        centres = (self.centre + shifts).astype(np.float32)
        turned = grid.transpose(2, 0, 1) * np.float32(pixels)
        turned = turned[:, None] + centres.T[..., None, None]
        column, row = np.rint(turned.reshape(2, -1, grid.shape[1])).astype(np.int32)
        height, width = self.shown.shape
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        behind = self._behind.take(np.where(inside, row * width + column, -1))
        outline = np.isfinite(behind)
        known = ~np.isnan(behind)
        behind = np.where(outline, behind / np.float32(size), 0)
        cell = 2 * TEMPLATE_REACH * pixels / TEMPLATE_SIDE
        return SeenPictures(
            outline.astype(np.float32),
            known.astype(np.float32),
            np.clip(behind, -FARTHEST_BEHIND, FARTHEST_BEHIND),
            self.area / cell**2,
        )


def turned_grid(turns: Float) -> Float32:
    """Cells of a template's grid, rotated in the image plane.

    Args:
        turns: angles, radians, (A,).

    Returns:
        x and y of each cell, sizes, (A, C, 2) float32.
    """
    lines = (np.arange(TEMPLATE_SIDE) + 0.5) / TEMPLATE_SIDE * 2 - 1
    cells = TEMPLATE_REACH * np.stack(np.meshgrid(lines, lines), -1).reshape(-1, 2)
    turned = cells @ rotation_z(turns)[:, :2, :2].swapaxes(1, 2)
    return turned.astype(np.float32)


def without_specks(shown: Mask) -> Mask:
    """Remove parts of an outline that are far smaller than its largest one: they are noise.

    Args:
        shown: pixels of a thing, (H, W).

    Returns:
        Pixels of its larger parts, (H, W).
    """
    part = within(shown)
    parts, count = ndimage.label(shown[part], np.ones((3, 3), int))
    if count < 2:
        return shown
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    kept = np.zeros_like(shown)
    kept[part] = (sizes >= SPECK * sizes.max())[parts]
    return kept


def _from_z_to(directions: Float) -> Float:
    """The smallest rotations that map z to unit vectors, (N, 3) to (N, 3, 3)."""
    x, y, z = directions.T
    none = np.zeros_like(x)
    skew = np.stack(
        [
            np.stack([none, none, x], -1),
            np.stack([none, none, y], -1),
            np.stack([-x, -y, none], -1),
        ],
        1,
    )
    return np.eye(3) + skew + skew @ skew / (1 + z)[:, None, None]


def mismatch(seen: SeenPictures, known: Pictures) -> tuple[Float32, Float32]:
    """Costs of the matches between views and templates of one size.

    Args:
        seen: A pictures of a view.
        known: N templates.

    Returns:
        Costs, (A, N) float32, 0 for a perfect match; and mean depth of the view behind the
        template, sizes, (A, N) float32.
    """
    depth = seen.depth
    views = np.stack([seen.outline, seen.known, depth, np.square(depth)])
    both, told, mean, spread = views @ known.outline.T
    told -= both
    told += max(seen.area, 1.0)
    overlap = np.divide(both, np.maximum(told, both + np.float32(1e-6)), out=told)

    # mean and variance of the depth difference in the intersection
    count: Float32 = np.maximum(both, np.float32(1), out=both)
    of_known, products = views[::2] @ known.depth.T
    mean -= of_known
    mean /= count
    spread += seen.outline @ np.square(known.depth).T
    spread -= np.float32(2) * products
    spread /= count
    spread -= np.square(mean)
    spread = np.sqrt(np.maximum(spread, 0, out=spread), out=spread)
    spread *= DEPTH_WEIGHT
    overlap *= OUTLINE_WEIGHT
    spread -= overlap
    spread += OUTLINE_WEIGHT
    return spread, mean
