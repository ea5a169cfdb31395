"""Polygons fall into triangles that cover them exactly: concave, bent, degenerate, and in every
format.
"""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline
from scipy.spatial.transform import Rotation

from nextview.errors import MeshError
from nextview.geometry import triangles as limits
from nextview.geometry.mesh import load_mesh, make_mesh
from nextview.geometry.triangles import triangulate
from nextview.geometry.viewsphere import ViewSphere
from nextview.simulation.simulated import SimulatedCamera

BENCH = [
    (0, 0),
    (0.1, 0),
    (0.1, 0.6),
    (1.1, 0.6),
    (1.1, 0),
    (1.2, 0),
    (1.2, 0.7),
    (0, 0.7),
]
TURNS = np.linspace(0, 2 * np.pi, 12, endpoint=False)
OUTLINES = {
    "square": [(0, 0), (1, 0), (1, 1), (0, 1)],
    "a U": BENCH,
    "a U from a reflex corner": BENCH[2:] + BENCH[:2],
    "a U clockwise": BENCH[::-1],
    "an L": [(0, 0), (3, 0), (3, 1), (1, 1), (1, 4), (0, 4)],
    "an arrow of four corners": [(0, 0), (2, 1), (0, 2), (0.5, 1)],
    "a star": [
        ((1 + k % 2) * np.cos(a), (1 + k % 2) * np.sin(a)) for k, a in enumerate(TURNS)
    ],
    "a comb": [(x, 5 * (x % 2)) for x in range(20)] + [(19, 6), (0, 6)],
    "corners on its edges": [
        (0, 0),
        (1, 0),
        (2, 0),
        (2, 1),
        (1, 1),
        (1, 2),
        (0, 2),
        (0, 1),
    ],
    "corners twice": [p for p in BENCH for _ in range(2)],
    "a frame with a slit": [
        (0, 0),
        (4, 0),
        (4, 4),
        (0, 4),
        (0, 0),
        (1, 1),
        (1, 3),
        (3, 3),
        (3, 1),
        (1, 1),
    ],
}


def shoelace(outline: np.ndarray) -> float:
    x, y = outline.T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


def cut(points: np.ndarray) -> np.ndarray:
    return triangulate(points, np.arange(len(points)), np.array([len(points)]))


def areas(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area vectors of triangles, (F, 3)."""
    a, b, c = (points[corner] for corner in faces.T)
    return np.cross(b - a, c - a) / 2


@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("name", OUTLINES)
def test_the_triangles_cover_the_polygon_and_nothing_else(name, first):
    outline = np.roll(np.array(OUTLINES[name], float), -2 * first, axis=0)
    turn = Rotation.random(rng=first).as_matrix()
    points = np.column_stack([outline, np.zeros(len(outline))]) @ turn.T + (
        100,
        -200,
        300,
    )
    faces = cut(points)
    found = areas(points, faces)
    # All of them are wound as the polygon is, and none lies over another one: then the areas add up
    # to the polygon's.
    np.testing.assert_allclose(
        np.linalg.norm(found, axis=1).sum(),
        abs(shoelace(outline)),
    )
    np.testing.assert_allclose(found.sum(0), shoelace(outline) * turn[:, 2], atol=1e-9)
    middles = outline[faces[np.linalg.norm(found, axis=1) > 1e-9]].mean(1)
    assert Outline(outline).contains_points(middles).all()


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.floats(0.05, 1), min_size=4, max_size=60),
    st.floats(0, 0.02),
    st.integers(0, 100),
)
def test_any_polygon_without_crossings_bent_or_not(radii, bend, seed):
    rng = np.random.default_rng(seed)
    turns = np.linspace(0, 2 * np.pi, len(radii), endpoint=False)
    outline = np.array(radii)[:, None] * np.stack([np.cos(turns), np.sin(turns)], 1)
    points = np.column_stack([outline, bend * rng.standard_normal(len(outline))])
    found = areas(points, cut(points))
    assert found[:, 2].min() > -1e-3
    assert found[:, 2].sum() == pytest.approx(shoelace(outline), rel=0.02)


@pytest.mark.parametrize("first", range(4))
def test_a_polygon_that_crosses_itself_is_still_seen(first):
    points = np.roll([(0, 0, 0), (1, 1, 0), (1, 0, 0), (0, 1, 0.0)], first, axis=0)
    # two wings of a quarter each
    assert 0.5 <= np.linalg.norm(areas(points, cut(points)), axis=1).sum() <= 1


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((5, 3)),
        np.arange(5)[:, None] * np.ones(3),
        np.array([(0, 0, 0), (1, 0, 0)]),
        np.array([(0, 0, 0), (1, 0, 0), (np.nan, 1, 0), (0, 1, 0)]),
        np.array([(0, 0, 0), (1, 0, 0), (0.1, 0.1, np.inf), (0, 1, 0)]),
        1e200 * np.array([(0, 0, 0), (2, 1, 0), (0, 2, 0), (0.5, 1, 0)]),
        1e-200 * np.array([(0, 0, 0), (2, 1, 0), (0, 2, 0), (0.5, 1, 0)]),
    ],
    ids=["a point", "a line", "two corners", "NaN", "infinite", "huge", "tiny"],
)
def test_a_degenerate_polygon_breaks_nothing(points):
    faces = cut(points.astype(float))
    assert len(faces) == max(len(points) - 2, 0)
    assert ((faces >= 0) & (faces < len(points))).all()


def test_polygons_of_many_sizes_keep_their_order():
    points = np.array([(*p, 0.0) for p in [*BENCH, (9, 9)]])
    corners = [
        [0, 1, 8],
        [0, 1, 2, 8],
        list(range(8)),
        [0, 1],
        [],
        [5, 6, 7],
        [8, 7, 6, 5],
    ]
    together = triangulate(
        points,
        np.concatenate(corners).astype(int),
        np.array([len(c) for c in corners]),
    )
    alone = [triangulate(points, np.array(c, int), np.array([len(c)])) for c in corners]
    np.testing.assert_array_equal(together, np.concatenate(alone))


def test_a_corner_that_is_none_and_too_many_triangles_are_refused():
    with pytest.raises(MeshError, match="vertex 7, but there are only 4"):
        triangulate(np.zeros((4, 3)), np.array([0, 1, 2, 7]), np.array([4]))
    with pytest.raises(MeshError, match="5,000 triangles, more than 100"):
        triangulate(np.zeros((4, 3)), np.zeros(5002, int), np.array([5002]), 100)


def test_a_polygon_that_would_take_minutes_is_refused(monkeypatch):
    monkeypatch.setattr(limits, "MAX_CUTTING_STEPS", 100.0)
    comb = np.array([(*p, 0.0) for p in OUTLINES["a comb"]])
    with pytest.raises(MeshError, match="of up to 22 corners, take too long"):
        cut(comb)
    around = np.column_stack([np.cos(TURNS), np.sin(TURNS), 0 * TURNS])
    assert len(cut(around)) == 10  # a convex one takes no time


# Files


def bench() -> tuple[np.ndarray, list[list[int]]]:
    """A prism whose ends are U-shaped polygons of eight corners, and whose sides are quads."""
    count = len(BENCH)
    points = np.array([(x, y, z) for y in (0.0, 0.5) for x, z in BENCH])
    sides = [
        [k, (k + 1) % count, count + (k + 1) % count, count + k] for k in range(count)
    ]
    faces = [list(range(count))[::-1], *sides, list(range(count, 2 * count))]
    return points, [face[::-1] for face in faces]


def as_obj(points, faces) -> bytes:
    rows = ["v {} {} {}".format(*p) for p in points] + [
        "f " + " ".join(str(i + 1) for i in face) for face in faces
    ]
    return "\n".join(rows).encode()


def as_off(points, faces) -> bytes:
    rows = ["{} {} {}".format(*p) for p in points] + [
        " ".join(map(str, [len(face), *face])) for face in faces
    ]
    return "\n".join(["OFF", f"{len(points)} {len(faces)} 0", *rows]).encode()


def as_ply(points, faces, kind="ascii", order="<") -> bytes:
    header = [
        f"ply\nformat {kind} 1.0\nelement vertex {len(points)}",
        *(f"property double {axis}" for axis in "xyz"),
    ]
    header += [
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    if kind == "ascii":
        rows = ["{} {} {}".format(*p) for p in points] + [
            " ".join(map(str, [len(face), *face])) for face in faces
        ]
        return ("\n".join(header) + "\n".join(rows)).encode()
    rows = [np.array(face, f"{order}i4").tobytes() for face in faces]
    body = np.array(points, f"{order}f8").tobytes() + b"".join(
        bytes([len(r) // 4]) + r for r in rows
    )
    return "\n".join(header).encode() + body


def as_stl(points, faces) -> bytes:
    loops = [
        "".join("vertex {} {} {}\n".format(*points[i]) for i in face) for face in faces
    ]
    facets = [
        f"facet normal 0 0 0\nouter loop\n{loop}endloop\nendfacet" for loop in loops
    ]
    return "\n".join(["solid bench", *facets, "endsolid"]).encode()


WRITERS = {
    "bench.obj": as_obj,
    "bench.off": as_off,
    "text.ply": as_ply,
    "little.ply": lambda *shape: as_ply(*shape, "binary_little_endian"),
    "big.ply": lambda *shape: as_ply(*shape, "binary_big_endian", ">"),
    "loops.stl": as_stl,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_prism_of_polygons_is_the_solid_that_it_is_drawn_as(tmp_path: Path, name):
    points, faces = bench()
    path = tmp_path / name
    path.write_bytes(WRITERS[name](points, faces))
    mesh = load_mesh(path)
    closed = trimesh.Trimesh(mesh.vertices * mesh.radius, mesh.faces)
    assert closed.is_watertight
    assert closed.volume == pytest.approx(0.5 * abs(shoelace(np.array(BENCH))))

    # Seen from everywhere, it is three boxes: two legs and a top.
    legs = [((0.1, 0.5, 0.7), (x, 0.25, 0.35)) for x in (0.05, 1.15)]
    boxes = [
        trimesh.creation.box(size).apply_translation(at)
        for size, at in [*legs, ((1.2, 0.5, 0.1), (0.6, 0.25, 0.65))]
    ]
    drawn = trimesh.util.concatenate(boxes)
    cameras = [
        SimulatedCamera(each, 64)
        for each in (mesh, make_mesh(drawn.vertices, drawn.faces))
    ]
    for pose in ViewSphere.named("12").poses:
        found, expected = (camera.observe(pose).depth for camera in cameras)
        assert (
            np.abs(found - expected) > 1e-4
        ).mean() < 0.002  # of pixels that look along an edge
