"""Proposals for things in any orientation: what is seen, compared with pictures from all around.

Each thing is rendered from directions all around it, as template matching does (Hinterstoisser et
al., "Model based training, detection and pose estimation of texture-less 3D objects in heavily
cluttered scenes", 2012). A picture is a small grid over the outline, centred and scaled by the
moments of the outline, so that where the thing is and how far away does not matter. What is seen is
turned in the image plane instead of the templates. Outlines are compared by their intersection over
union, depths by the mean squared difference where both show, and sizes by the ratio of the
outlines. All of it is a few matrix products.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.viewsphere import rotation_z
from nextview.things.depth_view import THING, MetricImage
from nextview.things.surface import SurfaceCaster
from nextview.types import Float, Float32, Index, Mask

TEMPLATE_DIRECTIONS = 162  # from which each thing is rendered: some 15 degrees apart
TURNS = 24  # in the image plane, in which what is seen is compared: 15 degrees apart
TEMPLATE_SIDE = 16  # rows and columns of a picture
TEMPLATE_REACH = 2.2  # from its centre to its borders, root mean squares of the outline
RENDERING_PIXELS = 28  # rows and columns of pixels of a rendering
TEMPLATE_DISTANCE = 5.0  # of the camera from the centre, radii
MOST_ORIENTATIONS = 16  # of one thing that are proposed
THINGS_PROPOSED = 40  # things that are proposed, the likeliest by their outlines
FEWEST_OUTLINE_PIXELS = 12  # of an outline that can be compared
SPECK = 0.05  # of the largest part of an outline, below which a part is noise

OUTLINE_WEIGHT = 8.0
DEPTH_WEIGHT = 4.0
SIZE_WEIGHT = 3.0
"""How much a unit of the mismatch of outlines, depths and sizes costs."""
SIZE_DEVIATION = 0.1  # of the logarithm of the ratio of sizes, as large as is usual
LARGEST_SIZE_COST = 3.0  # half squared deviations: something may be hidden


@dataclass(frozen=True, eq=False)
class Pictures:
    """Small pictures of outlines and depths, N of them, C cells each.

    Attributes:
        outline: which cells show the thing, 0 or 1, (N, C) float32.
        depth: behind the mean of the outline, root mean squares of the outline; 0 where nothing
            shows, (N, C) float32.
        size: root mean square of the outline, metres, (N,) float64.
    """

    outline: Float32
    depth: Float32
    size: Float


@dataclass(frozen=True, eq=False)
class OrientedProposals:
    """Hypotheses of things in any orientation.

    Attributes:
        things: thing of each, (M,) int64.
        ranks: how many orientations of its thing suit its view better, (M,) int64.
        rotations: from the axes of the scan files to the object frame, (M, 3, 3) float64.
        log_belief: in each thing by outline, size and the shape of the depth, up to a constant,
            (T,) float64.
    """

    things: Index
    ranks: Index
    rotations: Float
    log_belief: Float


class ViewTemplates:
    """Pictures of things from all around.

    Attributes:
        things: thing of each template, (N,) int64.
        rotations: from the axes of the scan file to those of the camera, (N, 3, 3) float64.
        pictures: what the camera sees.
    """

    def __init__(self, caster: SurfaceCaster) -> None:
        """Render all surfaces of a caster from all around.

        Args:
            caster: of the things.
        """
        looks = looking_from(spread_directions(TEMPLATE_DIRECTIONS))
        things = []
        rotations = []
        found = []

        for thing in range(len(caster.surfaces)):
            for look, picture in _rendered(caster, thing, looks):
                things.append(thing)
                rotations.append(look)
                found.append(picture)
        self.things = np.array(things)
        self.rotations = np.array(rotations)
        self.pictures = Pictures(
            np.stack([one[0] for one in found]),
            np.stack([one[1] for one in found]),
            np.array([one[2] for one in found]),
        )

    def propose(self, images: Sequence[MetricImage]) -> OrientedProposals:
        """Orientations of the likeliest things, given what some views show.

        Each view proposes orientations, of things that suit all of the views.

        Args:
            images: the views, of one thing.

        Returns:
            Up to MOST_ORIENTATIONS of each of THINGS_PROPOSED things; none where too little is
            seen.
        """
        known = int(self.things.max()) + 1
        views = [one for one in map(seen, images) if one is not None]
        if not views:
            nothing = np.zeros(0, np.int64)
            return OrientedProposals(
                nothing, nothing, np.zeros((0, 3, 3)), np.zeros(known)
            )

        fits = [self._fit(pictures) for pictures, _ in views]
        of_things = np.full((len(views), known), np.inf)
        for row, (best, _) in enumerate(fits):
            np.minimum.at(of_things[row], self.things, best)
        together = of_things.sum(0)
        likely = np.zeros(known, bool)
        likely[np.argsort(together, kind="stable")[:THINGS_PROPOSED]] = True

        of_one = max(1, MOST_ORIENTATIONS // len(views))
        proposed = []
        for (best, turn), (_, look) in zip(fits, views, strict=True):
            order = np.argsort(best, kind="stable")
            order = order[likely[self.things[order]]]
            rank = rank_within(self.things[order])
            order = order[rank < of_one]
            turns = rotation_z(2 * np.pi * turn[order] / TURNS)
            rotations = look @ turns @ self.rotations[order]
            proposed.append((self.things[order], rank[rank < of_one], rotations))
        things, ranks, rotations = (
            np.concatenate(parts) for parts in zip(*proposed, strict=True)
        )
        return OrientedProposals(things, ranks, rotations, -together / len(views))

    def _fit(self, pictures: Pictures) -> tuple[Float32, Index]:
        """Least cost of each template, and the turn in the image plane that has it, (N,) each."""
        costs = mismatch(pictures, self.pictures)
        turn = costs.argmin(0)
        return costs[turn, np.arange(len(turn))], turn


def rank_within(things: Index) -> Index:
    """How many earlier elements are the same, for each element, (N,).

    Args:
        things: numbers, (N,).
    """
    order = np.argsort(things, kind="stable")
    first = np.searchsorted(things[order], things[order])
    rank = np.empty(len(things), np.int64)
    rank[order] = np.arange(len(things)) - first
    return rank


def spread_directions(count: int) -> Float:
    """Unit vectors that are spread evenly over the sphere, on a spiral, (count, 3)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    azimuth = np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], 1)


def looking_from(directions: Float) -> Float:
    """Rotations to the axes of cameras that look at the origin, (N, 3, 3), of directions, (N, 3).

    Their rows are the camera's axes: x right, y down, z forward.
    """
    forward = -directions
    aside = np.where(np.abs(forward[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    right = np.cross(forward, aside)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], 1)


def _rendered(
    caster: SurfaceCaster,
    thing: int,
    looks: Float,
) -> Iterator[tuple[Float, tuple[Float32, Float32, float]]]:
    """The pictures of one thing from cameras with these axes, (N, 3, 3)."""
    radius = float(caster.radii[thing])
    focal = RENDERING_PIXELS / 2 * np.sqrt(TEMPLATE_DISTANCE**2 - 1)
    lines = (np.arange(RENDERING_PIXELS) + 0.5 - RENDERING_PIXELS / 2) / focal
    rays = np.stack(
        [*np.meshgrid(lines, lines), np.ones((RENDERING_PIXELS, RENDERING_PIXELS))],
        -1,
    ).reshape(-1, 3)

    origins = caster.centres[thing] - TEMPLATE_DISTANCE * radius * looks[:, 2]
    depth, _ = caster.cast(
        np.full(len(looks), thing),
        origins.astype(np.float32),
        (rays @ looks).astype(np.float32),
    )
    for look, image in zip(
        looks,
        depth.reshape(-1, RENDERING_PIXELS, RENDERING_PIXELS),
        strict=True,
    ):
        picture = _picture(image, np.isfinite(image), focal, np.zeros(1))
        if picture is not None:
            yield look, (picture[0][0], picture[1][0], picture[2])


def seen(image: MetricImage) -> tuple[Pictures, Float] | None:
    """What a view shows of the thing, turned in the image plane by TURNS angles.

    Returns:
        The pictures; and the axes of a camera in the same place that looks at the middle of the
        outline, columns, (3, 3), object frame. None where too little is seen.
    """
    shown = without_specks(image.kind == THING)
    focal = float(image.intrinsics[[0, 1], [0, 1]].mean())
    found = _picture(image.depth, shown, focal, 2 * np.pi * np.arange(TURNS) / TURNS)
    if found is None:
        return None
    outline, depth, size = found

    rows, columns = np.nonzero(shown)
    camera = PinholeCamera.of(image.intrinsics, image.depth.shape)
    x, y = camera.slopes(rows.mean(), columns.mean())
    ahead = np.array([x, y, 1.0]) / np.sqrt(x**2 + y**2 + 1)
    look = image.pose[:3, :3] @ _from_z_to(ahead)
    return Pictures(outline, depth, np.full(TURNS, size)), look


def without_specks(shown: Mask) -> Mask:
    """Leave out parts of an outline that are far smaller than its largest: noise of the surface.

    Args:
        shown: pixels of a thing, (H, W).

    Returns:
        Pixels of its larger parts, (H, W).
    """
    parts, count = ndimage.label(shown, np.ones((3, 3), int))
    if count < 2:
        return shown
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return (sizes >= SPECK * sizes.max())[parts]


def _from_z_to(direction: Float) -> Float:
    """The smallest rotation that takes z to a unit vector, (3, 3)."""
    axis = np.array([-direction[1], direction[0], 0.0])  # z x direction
    skew = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + direction[2])


def _picture(
    depth: NDArray,
    shown: Mask,
    focal: float,
    turns: Float,
) -> tuple[Float32, Float32, float] | None:
    """Outlines and depths on grids that are turned by some angles, (A, C), and the size, metres.

    None where too few pixels show the thing.
    """
    rows, columns = np.nonzero(shown)
    if len(rows) < FEWEST_OUTLINE_PIXELS:
        return None
    centre = np.array([columns.mean(), rows.mean()])
    spread = float(np.sqrt(columns.var() + rows.var() + 1 / 6))  # a pixel is a square
    middle = float(np.median(depth[rows, columns]))
    size = spread * middle / focal

    lines = (np.arange(TEMPLATE_SIDE) + 0.5) / TEMPLATE_SIDE * 2 - 1
    cells = (
        TEMPLATE_REACH * spread * np.stack(np.meshgrid(lines, lines), -1).reshape(-1, 2)
    )
    turned = np.einsum("aij,cj->aci", rotation_z(turns)[:, :2, :2], cells) + centre
    column, row = np.rint(turned).astype(np.int64).transpose(2, 0, 1)
    inside = (
        (row >= 0) & (row < shown.shape[0]) & (column >= 0) & (column < shown.shape[1])
    )
    row = np.where(inside, row, 0)
    column = np.where(inside, column, 0)

    outline = inside & shown[row, column]
    behind = np.where(outline, (depth[row, column] - middle) / size, 0)
    return outline.astype(np.float32), np.clip(behind, -3, 3).astype(np.float32), size


def mismatch(seen: Pictures, known: Pictures) -> Float32:
    """Return how badly pictures fit others.

    Args:
        seen: A pictures.
        known: N pictures.

    Returns:
        Costs, (A, N) float32; 0 for a perfect fit.
    """
    both = seen.outline @ known.outline.T
    one = seen.outline.sum(1)[:, None] + known.outline.sum(1) - both
    overlap = both / np.maximum(one, 1)

    # The mean squared difference where both show, without its mean.
    count = np.maximum(both, 1)
    mean = (seen.depth @ known.outline.T - seen.outline @ known.depth.T) / count
    squares = (seen.depth**2) @ known.outline.T + seen.outline @ (known.depth**2).T
    squares = (squares - 2 * seen.depth @ known.depth.T) / count - mean**2

    ratio = np.log(seen.size[:, None] / known.size)
    size = np.minimum((ratio / SIZE_DEVIATION) ** 2 / 2, LARGEST_SIZE_COST)
    costs = OUTLINE_WEIGHT * (1 - overlap) + DEPTH_WEIGHT * np.sqrt(squares.clip(0))
    return costs + SIZE_WEIGHT * size.astype(np.float32)
