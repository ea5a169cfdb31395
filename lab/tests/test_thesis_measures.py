"""Measures of a view against closed forms, trimesh and scikit-image; what they must not depend on;
meshes as files have them; the place of measures in the store.
"""

import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from lab_programs import main
from pipeline import of_depth
from scipy.spatial.transform import Rotation
from skimage.draw import disk
from skimage.measure import perimeter_crofton

from nextview.errors import DatasetError
from nextview.geometry.mesh import Mesh, load_mesh, make_mesh
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview_lab.data.measures import find_measure, measure
from nextview_lab.data.rendering import render
from nextview_lab.data.store import ViewStore
from nextview_lab.data.surfaces import mesh_views, view_of
from nextview_lab.errors import MeasureError
from nextview_lab.thesis.measures import (
    MEASURES,
    base_avoidance,
    gradient_entropy,
    max_depth,
    silhouette_length,
    view_area,
    visible_normals,
)

TWELVE = ViewSphere.named("12")
DEPTH = [name for name, found in MEASURES.items() if found.needs == "depth"]
ROOT = Path(__file__).parents[2]
SAMPLES = ROOT / "samples"
SEEN_FROM_3 = (1 - 1 / 3) / 2
"""Share of a sphere that is seen from three radii."""


def mesh_of(found: trimesh.Trimesh) -> Mesh:
    return make_mesh(found.vertices, found.faces)


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
            expected, rel=1e-9
        )


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
        12 * SIDE * (np.pi / 2) / 2 / 2, rel=0.01
    )
    assert MEASURES["gaussian_curvature"](view) == pytest.approx(
        8 * (np.pi / 2) / 2, rel=0.02
    )
    # six triangles, unequal
    assert MEASURES["viewpoint_entropy"](view) == pytest.approx(np.log2(6), abs=0.2)
    # three directions, unequal
    assert MEASURES["gradient_entropy"](view) == pytest.approx(np.log2(3), abs=0.2)


def test_views_from_above_and_of_the_base():
    elevations = np.array([-60, -20, 0, 22.5, 45, 90])
    poses = [look_at_origin(np.radians(e), 0.3, 3) for e in elevations]
    values = [measured("above_preference", CUBE, pose, 64) for pose in poses]
    np.testing.assert_allclose(
        values, np.exp(-(((elevations - 22.5) / 45) ** 2) / 2), atol=1e-6
    )
    avoided = [measured("base_avoidance", CUBE, pose, 64) for pose in poses]
    assert avoided[2:] == [1] * 4
    below = view_of(CUBE, look_at_origin(np.radians(-90), 0, 3))
    assert base_avoidance(below) == 0
    assert 0 < avoided[0] < avoided[1] < 1


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
            gradient_entropy(frontal), abs=0.1
        )
        assert (
            MEASURES["depth_entropy"](slanted) > MEASURES["depth_entropy"](frontal) + 2
        )
    assert gradient_entropy(frontal) == pytest.approx(0, abs=1e-9)


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
    move[:3, :3] = turn.as_matrix()
    move[:3, 3] = (0, 0, 0) if upright else (0.3, -0.2, 0.1)
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
        still, rel=share, abs=0.03
    )


# Meshes as files have them


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
    with pytest.raises(MeasureError):
        next(measure(rendered, ["all"], workers=0))
    meshes = str(rendered.parent / "meshes")
    main(["measure", str(rendered), "--meshes", meshes, "--workers", "0"])
    store = ViewStore.open(rendered)
    assert set(store.measures) == set(MEASURES)
    row = store.names.index("box")
    box = trimesh.creation.box([1, 2, 3])
    top = TWELVE.poses[0]
    own = MEASURES["visible_area_ratio"](
        view_of(make_mesh(box.vertices, box.faces), top, 96)
    )
    assert store.measure("visible_area_ratio")[row, 0] == pytest.approx(own, abs=1e-3)


def test_measures_take_the_meshes_that_were_rendered_and_no_others(rendered):
    meshes = rendered.parent / "meshes"
    file = meshes / "box/box.off"
    file.write_text(file.read_text() + "\n")
    views = mesh_views(ViewStore.open(rendered), meshes)
    with pytest.raises(DatasetError):
        list(measure(rendered, ("visible_area_ratio",), workers=0, views=views))
    file.unlink()
    with pytest.raises(DatasetError):
        mesh_views(ViewStore.open(rendered), meshes)


def test_they_are_fifteen_and_one_and_the_package_installs_them_by_name():
    project = tomllib.loads((ROOT / "lab/pyproject.toml").read_text())["project"]
    names = project["entry-points"]["nextview.measures"]
    assert len(MEASURES) == 16
    assert {"depth_entropy", *names} == set(MEASURES)
    for name, path in names.items():
        assert find_measure(path) is MEASURES[name]
