"""Cut the polygons of a mesh into triangles, concave and non-planar ones too."""

import numpy as np

from nextview.checks import extras
from nextview.errors import MeshError, option
from nextview.types import Float, Index, Mask

MAX_FACES = 10_000_000  # triangles that a mesh may have if nothing else is asked for
# of polygons that are tested together: the numbers stay in the processor's cache
CORNERS_AT_ONCE = 1 << 18
# sum of the squared numbers of corners of concave polygons; takes some ten seconds at most
MAX_CUTTING_STEPS = 1e9
# of a polygon's area: a triangle that lies the wrong way by less is as good as flat
ROUNDING = 1e-9


def check_faces(faces: int, max_faces: int) -> None:
    """Refuse more triangles than are wanted.

    Args:
        faces: how many there are.
        max_faces: how many there may be.

    Raises:
        MeshError: there are more.
    """
    if faces > max_faces:
        raise MeshError(
            f"it has {faces:,} triangles, more than {max_faces:,}; {option('max_faces')} allows"
            " more"
        )


def no_faces(n_points: int, with_normals: bool = False) -> str:
    """What to say of a file that holds points alone.

    Args:
        n_points: how many.
        with_normals: whether the file has their normals, too.
    """
    if with_normals:
        what = f"{n_points:,} points with normals and no faces"
        how = "MeshLab's Screened Poisson reconstruction"
    else:
        what = f"{n_points:,} points and no faces"
        how = "MeshLab's Compute Normals for Point Sets, then Screened Poisson reconstruction"
    return (
        f"it holds {what}; make a surface of them first, by {how} (docs/get_a_scan.md)"
    )


def triangulate(
    vertices: Float,
    corners: Index,
    sizes: Index,
    max_faces: int = MAX_FACES,
) -> Index:
    """Cut polygons into triangles, in the order of the polygons.

    A polygon becomes a fan from its first corner where the fan covers it exactly, as it does every
    convex polygon. Any other one, seen along its normal, is cut by ear clipping (mapbox_earcut).
    The triangles are wound as the polygon is.

    Args:
        vertices: (V, 3) positions.
        corners: (C,) indices into the vertices: the corners of the first polygon, then those of the
            second, ...
        sizes: (N,) how many corners each polygon has. One with less than three makes no triangle.
        max_faces: how many triangles there may be.

    Returns:
        (F, 3) int64, indices into the vertices.

    Raises:
        MeshError: a corner is no vertex, there are too many triangles, or cutting the polygons
            would take too long.
    """
    counts = np.maximum(sizes - 2, 0)
    check_faces(int(counts.sum()), max_faces)

    if len(corners) and (corners.min() < 0 or corners.max() >= len(vertices)):
        worst = int(corners.min() if corners.min() < 0 else corners.max())
        raise MeshError(
            f"a face refers to vertex {worst}, but there are only {len(vertices)} vertices"
        )
    if (sizes == 3).all():
        return corners.reshape(-1, 3)

    starts = np.cumsum(sizes) - sizes
    places = np.cumsum(counts) - counts
    faces = np.empty((int(counts.sum()), 3), np.int64)
    concave: list[int] = []
    for size, same in _polygons_by_size(sizes):
        polygons = corners[starts[same, None] + np.arange(size)]
        fans = np.stack(
            [
                np.broadcast_to(polygons[:, :1], (len(same), size - 2)),
                polygons[:, 1:-1],
                polygons[:, 2:],
            ],
            2,
        )
        faces[places[same, None] + np.arange(size - 2)] = fans
        if size > 3:
            concave.extend(same[~_fan_is_right(vertices[polygons])].tolist())

    steps = float((sizes[concave].astype(float) ** 2).sum())
    if steps > MAX_CUTTING_STEPS:
        largest = int(sizes[concave].max())
        raise MeshError(
            f"its concave faces, of up to {largest:,} corners, take too long to cut; export"
            " triangles"
        )

    kept = np.ones(len(faces), bool)
    for which in concave:
        polygon = corners[starts[which] : starts[which] + sizes[which]]
        triangles = _clip_ears(vertices[polygon])
        if triangles is not None:
            place = places[which]
            faces[place : place + len(triangles)] = polygon[triangles]
            kept[place + len(triangles) : place + counts[which]] = False
    return faces[kept]


def _polygons_by_size(sizes: Index) -> list[tuple[int, Index]]:
    """Yield the polygons of each number of corners, three or more, and their indices.

    Very many polygons are split into several groups.
    """
    order = np.argsort(sizes, kind="stable")
    bounds = np.flatnonzero(np.diff(sizes[order])) + 1
    groups: list[tuple[int, Index]] = []
    for same in np.split(order, bounds):
        size = int(sizes[same[0]])
        if size < 3:
            continue
        step = max(1, CORNERS_AT_ONCE // size)
        groups.extend(
            (size, same[start : start + step]) for start in range(0, len(same), step)
        )
    return groups


def _fan_is_right(points: Float) -> Mask:
    """Whether the fan from the first corner covers each of some polygons, (N, K, 3), exactly, (N,).

    It does if no triangle of the fan lies the other way than the polygon. A polygon whose triangles
    cancel each other out has no such way.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        spokes = points[:, 1:] - points[:, :1]
        # twice the areas of the fan's triangles
        crosses = np.cross(spokes[:, :-1], spokes[:, 1:])
        normals = crosses.sum(1)
        squares = (normals**2).sum(1)
        along = np.einsum("nki,ni->nk", crosses, normals)
        all_squares = crosses.shape[1] * (crosses**2).sum((1, 2))
        has_way = (squares > ROUNDING * all_squares) | (all_squares == 0)
        right: Mask = has_way & (along >= -ROUNDING * squares[:, None]).all(1)
    return right


def _clip_ears(points: Float) -> Index | None:
    """Cut a polygon, (K, 3), into triangles, (T, 3) corner indices; None without area."""
    with extras():
        from mapbox_earcut import triangulate_float64

    with np.errstate(over="ignore", invalid="ignore"):
        points = points - points[0]
        extent = np.abs(points).max()
    if not 0 < extent < np.inf:
        return None

    points = points / extent
    normal = np.cross(points[1:-1], points[2:]).sum(0)
    # its parts cancel each other out, as in a bow tie: the plane that fits it best
    if np.abs(normal).max() < ROUNDING:
        normal = np.linalg.svd(points - points.mean(0))[2][2]
    axis = int(np.abs(normal).argmax())
    # Seen along an axis instead of the normal, a polygon is sheared: what overlaps does not change.
    flat = np.ascontiguousarray(points[:, [(axis + 1) % 3, (axis + 2) % 3]])
    triangles = (
        triangulate_float64(flat, np.array([len(flat)], np.uint32))
        .astype(np.int64)
        .reshape(-1, 3)
    )
    if len(triangles) == 0:
        return None

    a, b, c = (flat[corner] for corner in triangles.T)
    turns = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    backwards = turns * normal[axis] < 0
    triangles[backwards] = triangles[backwards][:, ::-1]
    return triangles
