"""View measures against closed forms and scikit-image, and their place in the store."""

import numpy as np
import pytest
import trimesh
from skimage.draw import disk, polygon
from skimage.measure import perimeter_crofton

from nextview.data.measuring import measure
from nextview.data.rendering import render
from nextview.data.store import DEPTH_UNIT, ViewStore
from nextview.errors import DatasetError
from nextview.measures.depth_spread import BIN, depth_distribution, max_depth
from nextview.measures.registry import MEASURES
from nextview.measures.silhouette import silhouette_area, silhouette_length
from nextview.viewsphere import ViewSphere

SPHERE = ViewSphere.named("12")


def ball(size=224, distance=3.0):
    """Depth of the unit sphere, from the equation of a ray and a sphere."""
    focal = size / 2 * np.sqrt(distance**2 - 1)
    x = (np.arange(size) + 0.5 - size / 2) / focal
    r2 = x[:, None] ** 2 + x[None, :] ** 2
    root = distance**2 - (1 + r2) * (distance**2 - 1)
    return np.where(root > 0, (distance - np.sqrt(np.maximum(root, 0))) / (1 + r2), 0)


def test_a_ball_fills_the_circle_that_fits_the_image():
    depth = ball()
    assert silhouette_area(depth) == pytest.approx(np.pi / 4, rel=0.003)
    assert silhouette_length(depth) == pytest.approx(np.pi, rel=0.01)
    assert max_depth(depth) == pytest.approx((3 - 1 / 3) - 2, abs=0.06)  # to the tangent circle, which pixels just miss


@pytest.mark.parametrize("degrees", [0, 10, 22.5, 30, 45, 60, 80])
def test_outline_of_a_turned_square(degrees):
    a = np.radians(degrees + np.array([45, 135, 225, 315]))
    depth = np.zeros((400, 400))
    depth[polygon(200 + 150 * np.sin(a), 200 + 150 * np.cos(a))] = 2.0
    assert silhouette_length(depth) == pytest.approx(4 * 150 * np.sqrt(2) / 400, rel=0.06)
    assert silhouette_area(depth) == pytest.approx((150 * np.sqrt(2)) ** 2 / 400**2, rel=0.015)


def test_outline_agrees_with_scikit_image_holes_and_borders_included():
    rng = np.random.default_rng(0)
    for _ in range(20):
        seen = np.zeros((100, 100), bool)
        for _ in range(6):
            seen[disk(rng.integers(0, 100, 2), rng.integers(5, 30), shape=seen.shape)] ^= True
        expected = perimeter_crofton(np.pad(seen, 2), directions=4) / 100
        assert silhouette_length(seen.astype(float)) == pytest.approx(expected, rel=1e-9)


def test_depth_distribution_of_planes():
    facing = np.full((100, 100), 2.505)
    facing[:10] = 0  # background does not count
    assert depth_distribution(facing) == 0
    slanted = np.broadcast_to(2 + (np.arange(100) + 0.5) * BIN, (100, 100))  # one column in each of 100 bins
    assert depth_distribution(slanted) == pytest.approx(1 - 1 / 100, abs=1e-3)
    two = np.where(np.arange(100) < 30, 2.505, 3.505) * np.ones((100, 1))
    assert depth_distribution(two) == pytest.approx(2 * 0.3 * 0.7)  # the chance that two pixels differ


@pytest.mark.parametrize("name", MEASURES)
def test_an_empty_view_measures_nothing(name):
    assert MEASURES[name](np.zeros((20, 20))) == 0


@pytest.mark.parametrize("name", MEASURES)
@pytest.mark.parametrize("nothing", [np.nan, np.inf, -np.inf, -2.0, 65535.0])
def test_what_a_sensor_gives_for_nothing_is_no_object(name, nothing):
    depth = ball(64)
    sensed = np.where(depth > 0, depth, nothing)
    assert MEASURES[name](sensed) == MEASURES[name](depth)
    assert MEASURES[name](np.full((8, 8), nothing)) == 0
    assert np.isnan(sensed).any() == np.isnan(nothing)  # what was handed in is left alone


@pytest.fixture
def views(tmp_path):
    for name, mesh in {"ball": trimesh.creation.icosphere(4), "box": trimesh.creation.box([1, 2, 3])}.items():
        (tmp_path / "meshes" / name).mkdir(parents=True)
        mesh.export(tmp_path / "meshes" / name / f"{name}.off")
    (tmp_path / "meshes/box/broken.off").write_text("OFF\n")
    list(render(tmp_path / "meshes", tmp_path / "views.zarr", SPHERE, 96, workers=0))
    return tmp_path / "views.zarr"


def test_measures_are_kept_in_the_store_and_not_made_twice(views):
    before = ViewStore.open(views).measure()
    assert list(measure(views, workers=0)) == [(0, 2), (1, 2), (2, 2)]
    store = ViewStore.open(views)
    row = store.names.index("ball")
    for name, function in MEASURES.items():
        depth = store.group["depth"][row] * DEPTH_UNIT
        np.testing.assert_allclose(store.measure(name)[row], [function(d) for d in depth], rtol=1e-6)
        np.testing.assert_allclose(store.measure(name)[row], function(ball(96)), rtol=0.1)  # its rim is steep
    np.testing.assert_array_equal(store.measure(), before)
    assert np.isnan(store.measure("max_depth")[store.names.index("broken")]).all()
    assert list(measure(views, workers=0)) == [(2, 2)]


def test_a_stopped_run_is_completed_by_the_next(views):
    steps = measure(views, ["silhouette_area"], workers=0)
    next(steps), next(steps)
    steps.close()
    with pytest.raises(DatasetError, match=r"silhouette_area of b.* is missing; nextview measure .* makes it"):
        ViewStore.open(views).measure("silhouette_area")  # half of it is of no use
    steps = measure(views, ["silhouette_area"], workers=1)
    assert list(steps) == [(1, 2), (2, 2)]
    assert np.isfinite(ViewStore.open(views).measure("silhouette_area")).all(1).sum() == 2


def test_unknown_measures_are_refused(views):
    with pytest.raises(DatasetError, match=r"no measure is called 'beauty'; there are depth_entropy"):
        next(measure(views, ["beauty"]))
