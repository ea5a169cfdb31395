"""Measures in a store: kept, resumed, of a user's own, and nothing left of those that fail."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from nextview.data.measures import measure
from nextview.data.store import ViewStore
from nextview.errors import DatasetError, MeasureError

OWN = """
from nextview.data.measures import Measure
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
    assert list(measure(store, ["own_measures:rows"], workers=0)) == [(k, 18) for k in range(19)]
    views = ViewStore.open(store)
    rows = (views.group["depth"][3] > 0).any(2)
    heights = [np.ptp(np.flatnonzero(row)) + 1 for row in rows]
    np.testing.assert_array_equal(views.measure("own_measures:rows")[3], heights)
    assert list(measure(store, ["own_measures:rows"], workers=0)) == [(18, 18)]
    assert len(list(measure(store, ["own_measures:rows"], workers=0, overwrite=True))) == 19
    assert list(measure(store, ["depth_entropy"], workers=0, overwrite=True))[-1] == (18, 18)
    np.testing.assert_array_equal(ViewStore.open(store).measure(), before)


def test_a_stopped_run_is_completed_by_the_next(store):
    steps = measure(store, ["own_measures:rows"], workers=0)
    next(steps), next(steps)
    steps.close()
    with pytest.raises(DatasetError, match=r"rows of .* is missing; nextview measure .* makes it"):
        ViewStore.open(store).measure("own_measures:rows")
    assert len(list(measure(store, ["own_measures:rows"], workers=0))) == 18
    assert ViewStore.open(store).held("measures/own_measures:rows").all()


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("own_measures:endless", "of chair.*, view 0, is not finite"),
        ("own_measures:leave", "measure own_measures:leave of chair.*: SystemExit"),
        ("own_measures:broken", "measure own_measures:broken of chair.*: AttributeError"),
        ("own_measures:constant", "is no function"),
        ("no_such_module:none", "cannot be imported .ModuleNotFoundError"),
        ("own_measures:pixels", "needs the meshes"),
        ("beauty", "no measure is called 'beauty'; there are depth_entropy"),
    ],
)
def test_nothing_is_left_of_a_measure_that_fails(store, name, problem):
    with pytest.raises(MeasureError, match=problem):
        list(measure(store, [name], workers=0))
    assert ViewStore.open(store).measures == ["depth_entropy"]
