"""Depth-entropy against closed forms and scikit-image; measures in a store: kept, resumed, of a
user's own.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest
from skimage.measure import shannon_entropy

from nextview.errors import DatasetError
from nextview_lab.data.measures import QUANTUM, confidence_maps, depth_entropy, measure
from nextview_lab.data.store import ViewStore
from nextview_lab.errors import MeasureError

OWN = """
from nextview_lab.data.measures import Measure
def rows(view):
    return view.near.shape[0]
def upright(view):
    faces, pixels = view.pixels
    return float(pixels.sum())
pixels = Measure(upright, needs="mesh")
def broken(view):
    return view.nothing
def later(view):
    return 1.0 if view.depths.mean() < 3 else view.nothing
def endless(view):
    return float("inf")
def leave(view):
    exit(0)
constant = 3
"""


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_scikit_image_agrees_on_the_quantised_image(dtype):
    rng = np.random.default_rng(0)
    for _ in range(20):
        depth = (
            rng.uniform(2, 4, (60, 60)).round(rng.choice([1, 2, 3, 9])).astype(dtype)
        )
        depth[rng.random(depth.shape) < rng.random()] = 0
        levels = np.floor(depth.astype(np.float64) / QUANTUM + 0.5)
        assert depth_entropy(depth) == pytest.approx(
            shannon_entropy(levels, base=2), abs=1e-9
        )


def test_confidence_where_right_and_zero_where_wrong():
    half, three_quarters = np.log([1, 1]), np.log([1, 3])
    logits = np.array(
        [
            [three_quarters, half],
            [three_quarters, -three_quarters],
            [half, three_quarters],
        ]
    )
    maps = confidence_maps(logits, np.array([1, 0, 0]))
    # a tie counts for the lower index, so the second view of the first object is wrong and the
    # first of the last right
    np.testing.assert_allclose(maps, [[0.75, 0], [0, 0.75], [0.5, 0]], rtol=1e-6)
    assert maps.dtype == np.float32


@pytest.fixture
def store(views, tmp_path, monkeypatch) -> Path:
    """A copy of the shared store beside a module of measures."""
    shutil.copytree(views, tmp_path / "views.zarr")
    (tmp_path / "own_measures.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path / "views.zarr"


def test_measures_are_kept_and_not_made_twice(store):
    before = ViewStore.open(store).measure()
    assert list(measure(store, ["own_measures:rows"], workers=0)) == [
        (k, 18) for k in range(19)
    ]
    views = ViewStore.open(store)
    rows = (views.group["depth"][3] > 0).any(2)
    heights = [np.ptp(np.flatnonzero(row)) + 1 for row in rows]
    np.testing.assert_array_equal(views.measure("own_measures:rows")[3], heights)
    assert list(measure(store, ["own_measures:rows"], workers=0)) == [(18, 18)]
    assert (
        len(list(measure(store, ["own_measures:rows"], workers=0, overwrite=True)))
        == 19
    )
    assert list(measure(store, ["depth_entropy"], workers=0, overwrite=True))[-1] == (
        18,
        18,
    )
    np.testing.assert_array_equal(ViewStore.open(store).measure(), before)


def test_a_stopped_run_is_completed_by_the_next(store):
    steps = measure(store, ["own_measures:rows"], workers=0)
    next(steps), next(steps)
    steps.close()
    with pytest.raises(DatasetError):
        ViewStore.open(store).measure("own_measures:rows")
    assert len(list(measure(store, ["own_measures:rows"], workers=0))) == 18
    assert ViewStore.open(store).held("measures/own_measures:rows").all()


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("own_measures:endless", "of chair.*, view 0, is not finite"),
        ("own_measures:leave", "measure own_measures:leave of chair.*: SystemExit"),
        (
            "own_measures:broken",
            "measure own_measures:broken of chair.*: AttributeError",
        ),
        ("own_measures:constant", "is not a function"),
        ("no_such_module:none", "cannot be imported .ModuleNotFoundError"),
        ("own_measures:pixels", "needs the meshes"),
        ("beauty", "no measure is called 'beauty'; there are depth_entropy"),
    ],
)
def test_nothing_is_left_of_a_measure_that_fails(store, name, problem):
    with pytest.raises(MeasureError, match=problem):
        list(measure(store, [name], workers=0))
    assert ViewStore.open(store).measures == ["depth_entropy"]
