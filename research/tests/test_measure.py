"""Measures of a depth image against closed forms and scikit-image, and the place of measures in
the store.
"""

import numpy as np
import pytest
import trimesh
from pipeline import of_depth
from skimage.draw import disk, polygon
from skimage.measure import perimeter_crofton

from nextview.errors import DatasetError
from nextview.geometry.mesh import load_mesh, make_mesh
from nextview.geometry.viewsphere import ViewSphere
from nextview_lab.data.measures import find_measure, measure
from nextview_lab.data.rendering import Deform, RenderOptions, deformed, render
from nextview_lab.data.store import ViewStore, check
from nextview_lab.errors import MeasureError
from research.area import view_area
from research.depth_spread import BIN, depth_distribution, max_depth
from research.measure import main as measure_with_meshes
from research.measures import MEASURES as ADDED
from research.mesh_view import view_of
from research.silhouette import silhouette_length

SPHERE = ViewSphere.named("12")
MEASURES = {"depth_entropy": find_measure("depth_entropy")} | ADDED


def ball(size=224, distance=3.0):
    """Depth of the unit sphere, from the equation of a ray and a sphere."""
    focal = size / 2 * np.sqrt(distance**2 - 1)
    x = (np.arange(size) + 0.5 - size / 2) / focal
    r2 = x[:, None] ** 2 + x[None, :] ** 2
    root = distance**2 - (1 + r2) * (distance**2 - 1)
    return np.where(root > 0, (distance - np.sqrt(np.maximum(root, 0))) / (1 + r2), 0)


DEPTH = [name for name, found in MEASURES.items() if found.needs == "depth"]


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
    slanted = np.broadcast_to(2 + (np.arange(100) + 0.5) * BIN, (100, 100))
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


@pytest.fixture
def views(tmp_path):
    for name, mesh in {
        "ball": trimesh.creation.icosphere(4),
        "box": trimesh.creation.box([1, 2, 3]),
    }.items():
        (tmp_path / "meshes" / name).mkdir(parents=True)
        mesh.export(tmp_path / "meshes" / name / f"{name}.off")
    (tmp_path / "meshes/box/broken.off").write_text("OFF\n")
    list(render(tmp_path / "meshes", tmp_path / "views.zarr", SPHERE, 96, workers=0))
    return tmp_path / "views.zarr"


def test_all_measures_of_a_store_and_its_meshes(views):
    with pytest.raises(MeasureError, match="needs the meshes, not the depth alone"):
        next(measure(views, ["all"], workers=0))
    measure_with_meshes(views, views.parent / "meshes", workers=0)
    store = ViewStore.open(views)
    assert set(store.measures) == set(MEASURES)
    row = store.names.index("box")
    box = trimesh.creation.box([1, 2, 3])
    top = SPHERE.poses[0]
    own = MEASURES["visible_area_ratio"](
        view_of(make_mesh(box.vertices, box.faces), top, 96)
    )
    assert store.measure("visible_area_ratio")[row, 0] == pytest.approx(own, abs=1e-3)
    assert {problem for _, problem in check(views, workers=0)} == {None}


def test_a_deformed_store_is_measured_on_the_deformed_meshes(views):
    meshes = views.parent / "meshes"
    list(
        render(
            meshes,
            views.parent / "new.zarr",
            SPHERE,
            64,
            RenderOptions(3, Deform(0.8, True)),
            workers=0,
        )
    )
    measure_with_meshes(
        views.parent / "new.zarr",
        meshes,
        ("visible_area_ratio",),
        workers=0,
    )
    store = ViewStore.open(views.parent / "new.zarr")
    row = store.names.index("box")
    new = deformed(store, load_mesh(meshes / "box/box.off"), "box")
    seen = [view_of(new, pose, 64) for pose in SPHERE.poses]
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
        for p in SPHERE.poses
    ]
    assert np.abs(np.subtract(own, before)).max() > 0.02


def test_a_measure_of_ones_own_is_kept_by_its_import_path(views, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine_to_measure.py").write_text(
        "def rows(view):\n    return view.near.shape[0]\ndef broken(view):\n    return"
        " view.nothing\ndef endless(view):\n    return float('inf')\nconstant = 3\ndef"
        " large(view):\n    return 1e300\ndef leave(view):\n    exit(0)\n"
    )
    list(measure(views, ["mine_to_measure:rows"], workers=0))
    assert 40 < ViewStore.open(views).measure("mine_to_measure:rows")[0].min() <= 96
    (tmp_path / "mine_to_leave.py").write_text("raise SystemExit(0)")
    for name, problem in {
        "mine_to_measure:large": "of b.*, view 0, is not finite",
        "mine_to_measure:leave": "measure mine_to_measure:leave of b.*: SystemExit",
        "mine_to_leave:none": "cannot be imported .SystemExit",
        "mine_to_measure:broken": "measure mine_to_measure:broken of b.*: AttributeError",
        "mine_to_measure:endless": "of b.*, view 0, is not finite",
        "mine_to_measure:constant": "is not a function",
        "mine_to_measure:none": "cannot be imported",
        "no_such_module:none": "cannot be imported .ModuleNotFoundError",
    }.items():
        with pytest.raises(MeasureError, match=problem):
            list(measure(views, [name], workers=0))


def test_measures_take_the_meshes_that_were_rendered_and_no_others(views):
    meshes = views.parent / "meshes"
    file = meshes / "box/box.off"
    file.write_text(file.read_text() + "\n")
    with pytest.raises(
        DatasetError,
        match=r"box.off: is not the mesh that .*views.zarr was rendered from",
    ):
        measure_with_meshes(views, meshes, ("visible_area_ratio",), workers=0)
    file.unlink()
    with pytest.raises(DatasetError, match="holds no mesh called box"):
        measure_with_meshes(views, meshes, ("visible_area_ratio",), workers=0)
