"""Measures of a view against closed forms, trimesh and scikit-image; what they must not depend on;
meshes as files have them; the place of measures in the store.
"""

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pipeline import of_depth
from scipy.spatial.transform import Rotation
from skimage.draw import disk, polygon
from skimage.measure import perimeter_crofton

from nextview.data.folders import list_dataset
from nextview.errors import DatasetError
from nextview.geometry.mesh import Mesh, load_mesh, make_mesh
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.simulation.simulated import SimulatedCamera
from nextview_lab.data.measures import find_measure, measure
from nextview_lab.data.rendering import Deform, RenderOptions, deformed, render
from nextview_lab.data.store import ViewStore, check
from nextview_lab.errors import MeasureError
from nextview_lab.thesis.measure import main as measure_with_meshes
from nextview_lab.thesis.measures import (
    DEPTH_BIN,
    MEASURES,
    base_avoidance,
    bits,
    depth_distribution,
    gradient_entropy,
    max_depth,
    silhouette_length,
    view_area,
    visible_normals,
)
from nextview_lab.thesis.surfaces import FaceCamera, Surface, view_of

SPHERE = ViewSphere.named("40")
TWELVE = ViewSphere.named("12")
DEPTH = [name for name, found in MEASURES.items() if found.needs == "depth"]
ROOT = Path(__file__).parents[2]
SAMPLES = ROOT / "samples"
SEEN_FROM_3 = (1 - 1 / 3) / 2
"""Share of a sphere that is seen from three radii."""


def mesh_of(found: trimesh.Trimesh) -> Mesh:
    return make_mesh(found.vertices, found.faces)


def surface_of(found: trimesh.Trimesh) -> Surface:
    return Surface(np.asarray(found.vertices), np.asarray(found.faces))


BALL = mesh_of(trimesh.creation.icosphere(4))
CUBE = mesh_of(trimesh.creation.box([1, 1, 1]))
SIDE = 2 / np.sqrt(3)
"""Of the cube in the sphere of radius 1."""
CORNER = look_at_origin(np.radians(30), np.radians(40), 3)
"""From where three sides of it are seen."""


def measured(name, mesh, pose=CORNER, size=224):
    return MEASURES[name](view_of(mesh, pose, size))


# Closed forms


def ball(size=224, distance=3.0):
    """Depth of the unit sphere, from the equation of a ray and a sphere."""
    focal = size / 2 * np.sqrt(distance**2 - 1)
    x = (np.arange(size) + 0.5 - size / 2) / focal
    r2 = x[:, None] ** 2 + x[None, :] ** 2
    root = distance**2 - (1 + r2) * (distance**2 - 1)
    return np.where(root > 0, (distance - np.sqrt(np.maximum(root, 0))) / (1 + r2), 0)


def test_a_ball_fills_the_circle_that_fits_the_image():
    depth = of_depth(ball())
    assert view_area(depth) == pytest.approx(np.pi / 4, rel=0.003)
    assert silhouette_length(depth) == pytest.approx(np.pi, rel=0.01)
    # to the tangent circle, which pixels just miss
    assert max_depth(depth) == pytest.approx((3 - 1 / 3) - 2, abs=0.06)


@pytest.mark.parametrize("degrees", [0, 10, 22.5, 30, 45, 60, 80])
def test_outline_of_a_turned_square(degrees):
    a = np.radians(degrees + np.array([45, 135, 225, 315]))
    depth = np.zeros((400, 400))
    depth[polygon(200 + 150 * np.sin(a), 200 + 150 * np.cos(a))] = 2.0
    assert silhouette_length(of_depth(depth)) == pytest.approx(
        4 * 150 * np.sqrt(2) / 400,
        rel=0.06,
    )
    assert view_area(of_depth(depth)) == pytest.approx(
        (150 * np.sqrt(2)) ** 2 / 400**2,
        rel=0.015,
    )


def test_outline_agrees_with_scikit_image_holes_and_borders_included():
    rng = np.random.default_rng(0)
    for _ in range(20):
        seen = np.zeros((100, 100), bool)
        for _ in range(6):
            seen[
                disk(rng.integers(0, 100, 2), rng.integers(5, 30), shape=seen.shape)
            ] ^= True
        expected = perimeter_crofton(np.pad(seen, 2), directions=4) / 100
        assert silhouette_length(of_depth(seen.astype(float))) == pytest.approx(
            expected,
            rel=1e-9,
        )


def test_depth_distribution_of_planes():
    facing = np.full((100, 100), 2.505)
    facing[:10] = 0  # background does not count
    assert depth_distribution(of_depth(facing)) == 0
    # one column in each of 100 bins
    slanted = np.broadcast_to(2 + (np.arange(100) + 0.5) * DEPTH_BIN, (100, 100))
    assert depth_distribution(of_depth(slanted)) == pytest.approx(1 - 1 / 100, abs=1e-3)
    two = np.where(np.arange(100) < 30, 2.505, 3.505) * np.ones((100, 1))
    # the chance that two pixels differ
    assert depth_distribution(of_depth(two)) == pytest.approx(2 * 0.3 * 0.7)


@pytest.mark.parametrize("name", DEPTH)
def test_an_empty_view_measures_nothing(name):
    assert MEASURES[name](of_depth(np.zeros((20, 20)))) == 0


@pytest.mark.parametrize("name", DEPTH)
@pytest.mark.parametrize("nothing", [np.nan, np.inf, -np.inf, -2.0, 65535.0])
def test_what_a_sensor_gives_for_nothing_is_no_object(name, nothing):
    depth = ball(64)
    sensed = np.where(depth > 0, depth, nothing)
    assert MEASURES[name](of_depth(sensed)) == MEASURES[name](of_depth(depth))
    assert MEASURES[name](of_depth(np.full((8, 8), nothing))) == 0
    assert np.isnan(sensed).any() == np.isnan(
        nothing
    )  # what was handed in is left alone


def test_a_ball():
    view = view_of(BALL, CORNER)
    # Pixels at the rim are few and show much: 4 % of the area seen is lost there.
    assert MEASURES["visible_area_ratio"](view) == pytest.approx(SEEN_FROM_3, rel=0.04)
    assert MEASURES["surface_visibility"](view) == pytest.approx(SEEN_FROM_3, rel=0.06)
    for name in ("mean_curvature", "gaussian_curvature"):  # 1 all over
        assert MEASURES[name](view) == pytest.approx(4 * np.pi * SEEN_FROM_3, rel=0.04)
    assert MEASURES["curvature_entropy"](view) < 0.1
    assert MEASURES["silhouette_entropy"](view) < 0.4  # of the pixels of a circle
    assert MEASURES["base_avoidance"](view) == 1


def test_a_cube():
    view = view_of(CUBE, CORNER)
    assert MEASURES["visible_area_ratio"](view) == pytest.approx(0.5, rel=0.01)
    assert MEASURES["surface_visibility"](view) == pytest.approx(0.5)
    # 12 edges that bend by a right angle, of which half the curvature lies on the three sides; 8
    # corners alike.
    assert MEASURES["mean_curvature"](view) == pytest.approx(
        12 * SIDE * (np.pi / 2) / 2 / 2,
        rel=0.01,
    )
    assert MEASURES["gaussian_curvature"](view) == pytest.approx(
        8 * (np.pi / 2) / 2,
        rel=0.02,
    )
    # six triangles, unequal
    assert MEASURES["viewpoint_entropy"](view) == pytest.approx(np.log2(6), abs=0.2)
    # three directions, unequal
    assert MEASURES["gradient_entropy"](view) == pytest.approx(np.log2(3), abs=0.2)


def test_one_side_of_a_cube():
    facing = look_at_origin(0, 0, 3)
    view = view_of(CUBE, facing)
    share = view.pixels[1] / view.pixels[1].sum()
    np.testing.assert_allclose(share, 0.5, atol=0.01)
    assert MEASURES["viewpoint_entropy"](view) == pytest.approx(1, abs=1e-3)
    assert MEASURES["gradient_entropy"](view) == pytest.approx(0, abs=0.01)
    assert MEASURES["visible_area_ratio"](view) == pytest.approx(1 / 6, rel=0.02)


def test_the_side_of_a_cylinder_bends_one_way_only():
    sections = 64
    height = 2.0
    surface = surface_of(trimesh.creation.cylinder(1, height, sections=sections))
    side = np.abs(surface.normals[:, 2]) < 0.5
    # Mean curvature 1/(2r) on the side, half of the bend of the rims besides.
    rims = 2 * (2 * sections * np.sin(np.pi / sections)) * (np.pi / 2) / 4
    along = sections * height * (2 * np.pi / sections) / 2
    assert surface.mean_of_faces[side].sum() == pytest.approx(along + rims, rel=1e-6)
    assert along == pytest.approx(2 * np.pi * height / 2)  # the integral of 1/2
    # all of it at the rims
    assert surface.gaussian_of_faces.sum() == pytest.approx(4 * np.pi, rel=1e-6)


def test_a_flat_square_does_not_bend():
    grid = trimesh.creation.box([1, 1, 1]).subdivide().subdivide()
    top = grid.submesh([np.flatnonzero(grid.face_normals[:, 2] > 0.5)], append=True)
    surface = surface_of(top)
    assert surface.mean_of_faces.sum() == pytest.approx(0, abs=1e-9)
    corners = np.isclose(np.abs(surface.deficits), np.pi / 2)
    assert (
        corners.sum() == 4
    )  # of the open square; along its edges and inside nothing turns
    assert np.abs(surface.deficits[~corners]).max() < 1e-9


def test_views_from_above_and_of_the_base():
    elevations = np.array([-60, -20, 0, 22.5, 45, 90])
    poses = [look_at_origin(np.radians(e), 0.3, 3) for e in elevations]
    values = [measured("above_preference", CUBE, pose, 64) for pose in poses]
    np.testing.assert_allclose(
        values,
        np.exp(-(((elevations - 22.5) / 45) ** 2) / 2),
        atol=1e-6,
    )
    avoided = [measured("base_avoidance", CUBE, pose, 64) for pose in poses]
    assert avoided[2:] == [1] * 4
    below = view_of(CUBE, look_at_origin(np.radians(-90), 0, 3))
    assert base_avoidance(below) == 0
    assert 0 < avoided[0] < avoided[1] < 1


def test_the_fused_descriptor_of_half_an_image():
    depth = np.zeros((10, 10))
    depth[:5] = 2.5
    # All at the nearest point: 1 over half of the image. Of F4's products, each row loses one
    # neighbour.
    variance = 1.0
    entropy = 1 / 8
    vollath = (5 * 9 - 5 * 8) / 50
    assert MEASURES["fused_descriptor"](of_depth(depth)) == pytest.approx(
        (variance + entropy + vollath) / 3
    )


def test_entropy_of_shares():
    assert bits(np.array([0.5, 0.25, 0.25, 0])) == 1.5
    assert bits(np.array([])) == 0


# The measure that no slant can raise


def plane(slant, azimuth=0.0, size=224, depth=3.0, half=0.9):
    """A square part of the image in which a plane is seen, turned away from the camera by an
    angle, degrees.
    """
    view = of_depth(np.zeros((size, size)))
    at = (np.arange(size) + 0.5 - size / 2) / view.intrinsics[0, 0]
    tilt = np.tan(np.radians(slant)) * np.array([np.cos(azimuth), np.sin(azimuth)])
    seen = np.maximum(np.abs(at[:, None]), np.abs(at[None])) < half * at.max()
    inverse = (1 - at[None] * tilt[0] - at[:, None] * tilt[1]) / depth
    return of_depth(np.where(seen, 1 / inverse, 0))


@pytest.mark.parametrize("azimuth", [0, 0.4, np.pi / 2, 4])
def test_a_slanted_plane_tells_no_more_than_a_frontal_one(azimuth):
    frontal = plane(0)
    for slant in (10, 18, 33, 45, 60):
        slanted = plane(slant, azimuth)
        assert np.ptp(visible_normals(slanted), axis=1).max() < 1e-4
        assert gradient_entropy(slanted) == pytest.approx(
            gradient_entropy(frontal),
            abs=0.1,
        )
        assert (
            MEASURES["depth_entropy"](slanted) > MEASURES["depth_entropy"](frontal) + 2
        )
    assert gradient_entropy(frontal) == pytest.approx(0, abs=1e-9)


def test_directions_of_a_ball():
    """Seen from far away its pixels are its normals, and those are spread by the cosine: log2(pi
    sqrt(e)) bits.
    """
    far = 20.0
    view = view_of(BALL, look_at_origin(0.3, 0.5, far), 448, far)
    own = np.log2(2 * np.pi * np.e * 0.1**2)  # of the blur
    assert gradient_entropy(view) == pytest.approx(
        np.log2(np.pi * np.sqrt(np.e)) - own,
        abs=0.15,
    )


# Independent implementations


@pytest.mark.parametrize(
    "solid",
    [
        trimesh.creation.icosphere(2),
        trimesh.creation.box([1, 2, 3]),
        trimesh.creation.torus(1, 0.3),
    ],
    ids=["ball", "box", "torus"],
)
def test_trimesh_agrees(solid):
    surface = surface_of(solid)
    np.testing.assert_allclose(surface.areas, solid.area_faces)
    np.testing.assert_allclose(surface.normals, solid.face_normals, atol=1e-9)
    np.testing.assert_allclose(surface.angles, solid.face_angles, atol=1e-7)
    place = np.zeros(len(solid.vertices), int)
    place[solid.faces.ravel()] = surface.corners.ravel()
    np.testing.assert_allclose(surface.deficits[place], solid.vertex_defects, atol=1e-6)
    # Trimesh's has the sign of the edge, convex or not.
    signed = np.where(solid.face_adjacency_convex, 1, -1) * solid.face_adjacency_angles
    lengths = np.linalg.norm(
        np.diff(solid.vertices[solid.face_adjacency_edges], axis=1)[:, 0],
        axis=1,
    )
    assert surface.mean_of_faces.sum() == pytest.approx(
        (np.abs(signed) * lengths).sum() / 2,
        rel=1e-4,
    )
    if solid.is_convex:
        assert surface.mean_of_faces.sum() == pytest.approx(
            solid.integral_mean_curvature,
            rel=1e-4,
        )


def test_face_ids_are_those_of_rays_cast_by_trimesh_geometry():
    """The point that depth and pose give lies on the face that the pixel is said to show."""
    mesh = load_mesh(SAMPLES / "chair.off")
    view = view_of(mesh, CORNER, 96)
    row, column = np.nonzero(view.depth)
    ids = view.face_ids[row, column]
    assert (ids >= 0).all()
    assert (view.face_ids[view.depth == 0] == -1).all()
    rays = (
        np.stack([column + 0.5, row + 0.5, np.ones(len(row))], 1)
        @ np.linalg.inv(view.intrinsics).T
    )
    points = (rays * view.depth[row, column, None]) @ CORNER[:3, :3].T + CORNER[:3, 3]
    barycentric = trimesh.triangles.points_to_barycentric(
        mesh.vertices[mesh.faces[ids]],
        points,
    )
    assert barycentric.min() > -1e-3
    triangle = trimesh.triangles.barycentric_to_points(
        mesh.vertices[mesh.faces[ids]],
        barycentric,
    )
    assert np.abs(triangle - points).max() < 1e-3


@pytest.mark.parametrize("gap", [0.001, 0.1])
# a pixel each: the wire stands in every column of four
@pytest.mark.parametrize("aside", [0, 0.012, 0.024, 0.036])
def test_a_wire_before_a_wall_is_seen_in_each_pixel_that_it_fills(gap, aside):
    """As wide as one pixel, so that the pixels on both sides of it show one face of the wall."""
    wall = np.array([[-0.6, -0.6, 0], [0.6, -0.6, 0], [0.6, 0.6, 0], [-0.6, 0.6, 0]])
    wire = wall * [0.012, 0.9, 0] + [aside, 0, gap]
    # they face x, where the camera is
    corners = np.concatenate([wall, wire])[:, [2, 0, 1]]
    mesh = Mesh(
        corners,
        np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]),
        1.0,
        "wire",
    )
    camera = SimulatedCamera(mesh, 224)
    for azimuth in (0, 0.5):
        pose = look_at_origin(0.2, azimuth, 3.0)
        seen = camera.observe(pose).depth
        row, column = np.nonzero(seen)
        ids = FaceCamera(mesh, 224).face_ids(pose, np.rint(seen * 1e4) / 1e4)[
            row,
            column,
        ]
        x = column + 0.5
        y = row + 0.5
        points = (
            np.stack([x, y, np.ones(len(x))], 1) @ np.linalg.inv(camera.intrinsics).T
        ) * seen[row, column, None]
        before = (points @ pose[:3, :3].T + pose[:3, 3])[:, 0] > gap / 2
        assert before.sum() > 50
        np.testing.assert_array_equal(ids >= 2, before)


@pytest.mark.parametrize("size", range(1, 12))
def test_every_pixel_of_the_smallest_images_shows_a_face(size):
    view = view_of(load_mesh(SAMPLES / "chair.off"), CORNER, size)
    np.testing.assert_array_equal(view.face_ids >= 0, view.depth > 0)
    assert np.isfinite(
        [measure(view_of(CUBE, CORNER, size)) for measure in MEASURES.values()]
    ).all()


# What they must not depend on


@pytest.mark.parametrize("name", MEASURES)
def test_nothing_depends_on_where_object_and_camera_are_together(name):
    """Turned about the vertical and moved; for those who do not know up and down, turned any
    way.
    """
    mesh = load_mesh(SAMPLES / "chair.off")
    still = measured(name, mesh, CORNER, 96)
    upright = name in ("above_preference", "base_avoidance")
    turn = (
        Rotation.from_euler("z", 77, degrees=True)
        if upright
        else Rotation.from_euler("xyz", [40, 110, 200])
    )
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = (
        turn.as_matrix(),
        (0, 0, 0) if upright else (0.3, -0.2, 0.1),
    )
    moved = Mesh(
        mesh.vertices @ move[:3, :3].T + move[:3, 3],
        mesh.faces,
        mesh.centre,
        mesh.radius,
    )
    # A few pixels at edges fall to the other side, on each processor others. The angles of a corner
    # change most by them.
    share = 0.1 if name == "gaussian_curvature" else 0.03
    assert measured(name, moved, move @ CORNER, 96) == pytest.approx(
        still,
        rel=share,
        abs=0.03,
    )


REMESHED = {
    "visible_area_ratio": 0.01,
    "surface_visibility": 0.2,
    "mean_curvature": 0.1,
    "gaussian_curvature": 0.2,
    "base_avoidance": 0.01,
}
"""How much a measure may differ, as a share of its value, when each face of a chair is cut into
four. A half hidden face has half of the curvature of its edges, and its parts more or less."""


@pytest.mark.parametrize("name", REMESHED)
def test_cutting_faces_changes_little(name):
    mesh = load_mesh(SAMPLES / "chair.off")
    fine = mesh_of(
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).subdivide()
    )
    for view in (9, 20, 35):
        before = measured(name, mesh, SPHERE.poses[view], 128)
        assert measured(name, fine, SPHERE.poses[view], 128) == pytest.approx(
            before,
            rel=REMESHED[name],
        )


# Meshes as files have them


def soup(mesh: Mesh, rng) -> Mesh:
    """The same triangles, each with corners of its own, turned either way, in any order."""
    faces = mesh.faces[rng.permutation(len(mesh.faces))]
    faces = np.where(rng.random((len(faces), 1)) < 0.5, faces, faces[:, ::-1])
    return Mesh(
        mesh.vertices[faces].reshape(-1, 3),
        np.arange(faces.size).reshape(-1, 3),
        mesh.centre,
        mesh.radius,
    )


@pytest.mark.parametrize("name", MEASURES)
def test_neither_shared_corners_nor_the_turn_of_faces_count(name):
    mesh = CUBE
    loose = soup(mesh, np.random.default_rng(0))
    assert measured(name, loose, CORNER, 96) == pytest.approx(
        measured(name, mesh, CORNER, 96),
        rel=1e-3,
        abs=1e-6,
    )


@pytest.mark.parametrize("name", MEASURES)
def test_broken_meshes_have_finite_measures(name):
    box = trimesh.creation.box([1, 1, 1])
    flat = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 0]], float)
    broken = {
        "open": (box.vertices, box.faces[:5]),
        "without area here and there": (
            flat,
            np.array([[0, 1, 2], [0, 1, 3], [1, 1, 3], [4, 2, 3]]),
        ),
        "three faces on one edge": (
            np.vstack([box.vertices, [[0, 0, 2]]]),
            np.vstack([box.faces, [[0, 1, 8]]]),
        ),
        "doubled": (
            np.vstack([box.vertices] * 2),
            np.vstack([box.faces, box.faces[:, ::-1] + 8]),
        ),
    }
    for vertices, faces in broken.values():
        value = measured(name, make_mesh(vertices, faces), CORNER, 48)
        assert np.isfinite(value)
        assert value >= 0


@pytest.mark.skipif("NEXTVIEW_DATA" not in os.environ, reason="needs the dataset")
def test_real_meshes_have_finite_measures():
    entries = list_dataset(Path(os.environ["NEXTVIEW_DATA"]) / "ModelNet10")
    for i in np.random.default_rng(0).choice(len(entries), 5, replace=False):
        mesh = load_mesh(entries[i].path)
        for pose in SPHERE.poses[[0, 21]]:
            view = view_of(mesh, pose, 112)
            values = {name: function(view) for name, function in MEASURES.items()}
            assert all(
                np.isfinite(value) and value >= 0 for value in values.values()
            ), (
                entries[i].path,
                values,
            )
            assert values["visible_area_ratio"] <= 1


# In a store


@pytest.fixture
def rendered(tmp_path):
    for name, mesh in {
        "ball": trimesh.creation.icosphere(4),
        "box": trimesh.creation.box([1, 2, 3]),
    }.items():
        (tmp_path / "meshes" / name).mkdir(parents=True)
        mesh.export(tmp_path / "meshes" / name / f"{name}.off")
    (tmp_path / "meshes/box/broken.off").write_text("OFF\n")
    list(render(tmp_path / "meshes", tmp_path / "views.zarr", TWELVE, 96, workers=0))
    return tmp_path / "views.zarr"


def test_all_measures_of_a_store_and_its_meshes(rendered):
    with pytest.raises(MeasureError, match="needs the meshes, not the depth alone"):
        next(measure(rendered, ["all"], workers=0))
    measure_with_meshes(rendered, rendered.parent / "meshes", workers=0)
    store = ViewStore.open(rendered)
    assert set(store.measures) == set(MEASURES)
    row = store.names.index("box")
    box = trimesh.creation.box([1, 2, 3])
    top = TWELVE.poses[0]
    own = MEASURES["visible_area_ratio"](
        view_of(make_mesh(box.vertices, box.faces), top, 96)
    )
    assert store.measure("visible_area_ratio")[row, 0] == pytest.approx(own, abs=1e-3)
    assert {problem for _, problem in check(rendered, workers=0)} == {None}


def test_a_deformed_store_is_measured_on_the_deformed_meshes(rendered):
    meshes = rendered.parent / "meshes"
    list(
        render(
            meshes,
            rendered.parent / "new.zarr",
            TWELVE,
            64,
            RenderOptions(3, Deform(0.8, True)),
            workers=0,
        )
    )
    measure_with_meshes(
        rendered.parent / "new.zarr",
        meshes,
        ("visible_area_ratio",),
        workers=0,
    )
    store = ViewStore.open(rendered.parent / "new.zarr")
    row = store.names.index("box")
    new = deformed(store, load_mesh(meshes / "box/box.off"), "box")
    seen = [view_of(new, pose, 64) for pose in TWELVE.poses]
    np.testing.assert_allclose(
        store.depth(row),
        [view.depth for view in seen],
        atol=1e-4,
    )
    own = [MEASURES["visible_area_ratio"](view) for view in seen]
    np.testing.assert_allclose(store.measure("visible_area_ratio")[row], own, atol=1e-3)
    before = [
        MEASURES["visible_area_ratio"](
            view_of(load_mesh(meshes / "box/box.off"), p, 64)
        )
        for p in TWELVE.poses
    ]
    assert np.abs(np.subtract(own, before)).max() > 0.02


def test_measures_take_the_meshes_that_were_rendered_and_no_others(rendered):
    meshes = rendered.parent / "meshes"
    file = meshes / "box/box.off"
    file.write_text(file.read_text() + "\n")
    with pytest.raises(
        DatasetError,
        match=r"box.off: is not the mesh that .*views.zarr was rendered from",
    ):
        measure_with_meshes(rendered, meshes, ("visible_area_ratio",), workers=0)
    file.unlink()
    with pytest.raises(DatasetError, match="holds no mesh called box"):
        measure_with_meshes(rendered, meshes, ("visible_area_ratio",), workers=0)


def test_they_are_fifteen_and_one_and_the_package_installs_them_by_name():
    project = tomllib.loads((ROOT / "lab/pyproject.toml").read_text())["project"]
    names = project["entry-points"]["nextview.measures"]
    assert len(MEASURES) == 16
    assert {"depth_entropy", *names} == set(MEASURES)
    for name, path in names.items():
        assert find_measure(path) is MEASURES[name]
