"""The parts of a mesh, and the likely faults of a scan.

The faults are a table in it, loose pieces, and a lost shape.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist

from nextview.errors import MeshError, option
from nextview.types import Float

# odd, of many bits
HASH_FACTORS = np.array(
    [0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9],
    np.uint64,
)
FLAT_PART = 0.05  # thickness of a part, over its width, below which it is a plate
SMALL_PART = 0.01  # of the surface of the largest part: smaller ones are crumbs
# how many times as large as its main part a mesh has to be to be asked about
FAR_PARTS = 3.0
WIDE_PLANE = 2.0  # how many times as large as what stands on it
MOST_WIDE_PLANE = 25.0  # more, and what is beside it is no object but a bump
# how much more of what is not in the plane is on one side of it: 0 as much on both, 1 all
ONE_SIDED = 0.8
# of the mesh's size: what lies no farther from a plane belongs to it
PLANE_THICKNESS = 0.07
CELLS_FOLLOWED = 8  # of directions, in search of the one that most of a surface faces
# share of the largest spread of points below which they do not spread at all
LEAST_SPREAD = 1e-9
FARTHEST_AT_ONCE = 500  # of a hull, whose distances from all others are taken together
PLANE_FACES = 100_000  # that are looked at in search of a plane
PLANE_ANGLE = np.cos(np.radians(15))  # between its normal and those of its faces
# object radii between two numbers of single precision, from where on a shape is lost
LOST_STEP = 0.05
# share of coordinates that are odd multiples of such a step, half of them by chance
USED_STEPS = 0.2


@dataclass(frozen=True)
class Parts:
    """The connected parts of a mesh: pieces of surface that share no position.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3), indices into the vertices.
        part: which part each face belongs to, (F,) int.
        areas: the surface of each part, (P,) float64.
    """

    vertices: Float
    faces: NDArray[np.integer]
    part: NDArray[np.integer]
    areas: Float

    @classmethod
    def of(cls, vertices: Float, faces: NDArray[np.integer]) -> "Parts":
        """Find the connected parts of a mesh.

        Vertices in the same place count as one, as STL files require.

        Args:
            vertices: (V, 3) float64.
            faces: indices of vertices, (F, 3).

        Returns:
            The parts of the mesh.
        """
        places = _places(vertices)[faces]
        count = int(places.max()) + 1 if len(places) else 0
        ends = np.concatenate([places[:, :2], places[:, 1:]]).astype(np.int32)
        graph = coo_array(
            (np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])),
            shape=(count, count),
        )
        _, component = connected_components(graph, directed=False)
        _, part = np.unique(component[places[:, 0]], return_inverse=True)
        areas = np.bincount(part, _areas(vertices, faces)).astype(np.float64)
        return cls(vertices, faces, part, areas)

    @cached_property
    def main(self) -> int:
        """The part with the largest surface; a plate only if there is nothing else but crumbs."""
        order = np.argsort(-self.areas, kind="stable")
        for part in order:
            if self.areas[part] < SMALL_PART * self.areas[order[0]]:
                break
            if not _is_flat(self.points_of(part)):
                return int(part)
        return int(order[0])

    def points_of(self, part: int) -> Float:
        """The positions of a part, (n, 3)."""
        return self.vertices[np.unique(self.faces[self.part == part])]


def _places(vertices: Float) -> NDArray[np.intp]:
    """A number for each vertex, (V,), the same for those in the same place."""
    # of zeros there are two
    bits = np.ascontiguousarray(vertices + 0.0).view(np.uint64)
    mixed = bits ^ (bits >> np.uint64(32))
    _, places = np.unique(
        (mixed * HASH_FACTORS).sum(1, dtype=np.uint64),
        return_inverse=True,
    )
    return places


def _areas(vertices: Float, faces: NDArray[np.integer]) -> Float:
    a, b, c = (vertices[corner] for corner in faces.T)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def _size(points: Float) -> float:
    """Half the largest distance between two points, however they are turned; 0 for none."""
    if len(points) < 2:
        return 0.0
    corners = hull_corners(points)
    farthest = max(
        float(cdist(corners[at : at + FARTHEST_AT_ONCE], corners[at:]).max())
        for at in range(0, len(corners), FARTHEST_AT_ONCE)
    )
    return farthest / 2


def hull_corners(points: Float) -> Float:
    """Those of some points, (N, D), between which all others lie, (C, D)."""
    some = np.unique(points, axis=0)
    try:
        return some[ConvexHull(some).vertices]
    except (QhullError, ValueError):
        pass  # all in a plane, on a line or in a point
    centred = some - some.mean(0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    flat = axes[spread > LEAST_SPREAD * spread.max(initial=0)]
    if len(flat) in (0, some.shape[1]):
        return some
    if len(flat) == 1:
        along = centred @ flat[0]
        return some[[along.argmin(), along.argmax()]]
    try:
        return some[ConvexHull(centred @ flat.T).vertices]
    except QhullError:
        return some


def thickness(points: Float) -> float:
    """The least distance of two parallel lines or planes with all points between them.

    Args:
        points: (N, 2) or (N, 3).
    """
    try:
        sides = ConvexHull(points).equations[:, :-1]
    except (QhullError, ValueError):
        return 0.0  # all in a plane, or on a line
    corners = hull_corners(points)
    return min(float(np.ptp(corners @ side)) for side in np.unique(sides, axis=0))


def _is_flat(points: Float) -> bool:
    """Whether points lie in a plate that is much wider than thick both ways."""
    centred = points - points.mean(0)
    normal, *within = np.linalg.eigh(centred.T @ centred)[1].T
    width = thickness(centred @ np.stack(within, 1))
    return bool(np.ptp(centred @ normal) < FLAT_PART * width)


def keep_largest_part(
    vertices: Float,
    faces: NDArray[np.int32],
) -> tuple[NDArray[np.int32], tuple[str, ...]]:
    """Leave out what is not connected to the largest part of a mesh.

    The largest part has the largest surface. A plate, thinner than a twentieth of its width, is
    taken for what the object stood on, and only counts if the other parts are crumbs.

    Args:
        vertices: (V, 3).
        faces: (F, 3), indices into the vertices.

    Returns:
        The faces of the part, and a sentence about what was left out; none if there is one part
        alone.
    """
    parts = Parts.of(vertices, faces)
    if len(parts.areas) == 1:
        return faces, ()
    share = parts.areas[parts.main] / max(parts.areas.sum(), np.finfo(float).tiny)
    said = f"the largest of its {len(parts.areas):,} parts was taken, {share:.0%} of the surface"
    return faces[parts.part == parts.main], (said,)


def refuse_lost_shape(vertices: Float, radius: float, name: str) -> None:
    """Refuse an object far from the origin whose shape single precision has lost.

    Args:
        vertices: (V, 3), as they stand in the file.
        radius: of the object, the same unit.
        name: of the file.

    Raises:
        MeshError: neighbouring numbers of single precision are more than a twentieth of the radius
            apart there, and the positions are such numbers.
    """
    column = vertices[:, np.abs(vertices).max(0).argmax()]
    farthest = np.abs(column).max()
    # What single precision cannot hold at all is none of its numbers.
    with np.errstate(over="ignore", invalid="ignore"):
        step = float(np.spacing(np.float32(farthest)))
        if step < LOST_STEP * radius:
            return
        steps = column / np.spacing(np.abs(column).astype(np.float32)).astype(
            np.float64
        )
    rounded = bool((steps == np.round(steps)).all())
    # A building whose corners stand at whole metres is not rounded: half of rounded numbers are odd
    # multiples.
    if rounded and (step > radius or (steps % 2 == 1).mean() > USED_STEPS):
        where = (
            f"it lies {farthest:,.0f} from its origin, where single precision has steps of"
            f" {step:.2g}"
        )
        raise MeshError(
            f"{name}: {where}, and has lost its shape; move it to the origin before it is saved"
        )


def mesh_doubts(vertices: Float, faces: NDArray[np.integer]) -> tuple[str, ...]:
    """What is likely to be wrong with the mesh of one object, a sentence each; usually nothing.

    Args:
        vertices: (V, 3), any unit.
        faces: (F, 3), indices into the vertices.
    """
    doubts = []
    parts = Parts.of(vertices, faces)
    size = _size(vertices)
    times = size / _size(parts.points_of(parts.main))

    if times >= FAR_PARTS:
        largest = (
            f"it has {len(parts.areas):,} parts, and is {times:.1f} "
            "times as large as its main part"
        )
        doubts.append(
            f"{largest}: does a table or a loose piece belong to it?"
            f" {option('largest_part', True)} leaves them out"
        )
    elif (times := _plane_times(vertices, faces)) >= WIDE_PLANE:
        plane = f"a plane in it is {times:.1f} times as large as all that stands on it"
        doubts.append(
            f"{plane}: is it a table? Cut it off, or use {option('largest_part', True)} if it is a"
            " part of its own"
        )

    return tuple(doubts)


def _plane_times(vertices: Float, faces: NDArray[np.integer]) -> float:
    """Return how many times a plane makes a mesh larger than the rest of it.

    The plane has to reach beyond the rest on all sides.

    1 if there is no such plane, or nothing beside it.
    """
    some = faces[:: len(faces) // PLANE_FACES + 1]
    a, b, c = (vertices[corner] for corner in some.T)
    crosses = np.cross(b - a, c - a)
    areas = np.linalg.norm(crosses, axis=1)
    normals = crosses / np.maximum(areas, np.finfo(float).tiny)[:, None]
    size = _size(vertices)
    if not areas.any():  # of those that were drawn
        return 1.0

    normal = _main_direction(normals, areas)
    facing = (np.abs(normals @ normal) > PLANE_ANGLE) & (areas > 0)
    if not facing.any():
        return 1.0
    heights = ((a + b + c) / 3)[facing] @ normal
    height = _fullest_height(heights, areas[facing], PLANE_THICKNESS * size)

    used = vertices[np.unique(faces)]
    offsets = used @ normal - height
    above = np.abs(offsets) > PLANE_THICKNESS * size
    rest = _size(used[above])
    one_sided = 2 * abs((offsets[above] > 0).mean() - 0.5) if above.any() else 0
    if rest * MOST_WIDE_PLANE < size or one_sided < ONE_SIDED:
        return 1.0
    width = thickness(used[~above] @ _across(normal)) / 2
    return size / rest if width > rest else 1.0


def _across(normal: Float) -> Float:
    """Two directions across a third, (3, 2)."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)], 1)


def _fullest_height(heights: Float, areas: Float, most: float) -> float:
    """The mean height of the most surface that lies within so much of each other."""
    order = np.argsort(heights)
    heights, areas = heights[order], areas[order]
    before = np.concatenate([[0.0], np.cumsum(areas)])
    ends = np.searchsorted(heights, heights + most, side="right")
    first = int((before[ends] - before[: len(heights)]).argmax())
    some = slice(first, ends[first])
    return float(np.average(heights[some], weights=areas[some]))


def _main_direction(normals: Float, areas: Float) -> Float:
    """The direction, of either sign, that most of a surface faces, (3,)."""
    upper = np.where(normals[:, 2:] < 0, -normals, normals)
    cells = np.round(upper * 4).astype(int) + 4  # directions some 15 degrees apart
    which = np.ravel_multi_index(tuple(cells.T), (9, 9, 9))
    full = np.bincount(which, areas)
    found = []
    # A plane may be split by the borders of cells: each part leads to all of it.
    for cell in np.argsort(-full, kind="stable")[:CELLS_FOLLOWED]:
        if not full[cell]:
            break
        direction = _mean_direction(upper[which == cell], areas[which == cell])
        for _ in range(3):  # the cell's edges cut off some of the faces around it
            near = np.abs(normals @ direction) > PLANE_ANGLE
            towards = normals[near] * np.sign(normals[near] @ direction)[:, None]
            direction = _mean_direction(towards, areas[near])
        near = np.abs(normals @ direction) > PLANE_ANGLE
        found.append((float(areas[near].sum()), direction))
    return max(found, key=lambda one: one[0])[1]


def _mean_direction(normals: Float, areas: Float) -> Float:
    mean = (normals * areas[:, None]).sum(0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 0 else normals[0]
