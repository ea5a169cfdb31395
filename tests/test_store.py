"""A store knows when it is damaged, and a store of the first layout is still read."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from nextview.data.check import check
from nextview.data.folders import DatasetError
from nextview.data.measure import measure
from nextview.data.render import render
from nextview.data.store import ViewStore
from nextview.viewsphere import ViewSphere

SPHERE = ViewSphere.named("12")


@pytest.fixture
def views(tmp_path) -> Path:
    for name in ("a", "b", "c"):
        path = tmp_path / "meshes/box" / f"{name}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box([1, 2, 1 + ord(name) % 5]).export(path)
    list(render(tmp_path / "meshes", tmp_path / "views.zarr", SPHERE, 48, workers=0))
    return tmp_path / "views.zarr"


def flip_a_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)


def chunk(views: Path, name: str, i: int) -> Path:
    return next(p for p in (views / name / "c" / str(i)).rglob("*") if p.is_file())


def test_a_sound_store_is_found_sound(views):
    assert sorted(check(views, workers=0)) == [("a", None), ("b", None), ("c", None)]


def test_other_measures_are_checked_where_they_are_made(views):
    next(steps := measure(views, ["max_depth"], workers=0))
    next(steps)
    steps.close()
    assert {problem for _, problem in check(views, workers=0)} == {None}
    list(measure(views, ["max_depth"], workers=0))
    ViewStore.open(views).group["measures/max_depth"][1, 3] = 0.1
    assert dict(check(views, workers=0))["b"] == "max_depth is not that of the depth"


@pytest.mark.parametrize("name", ["image", "depth", "points", "measures/depth_entropy"])
@pytest.mark.parametrize("damage", ["flipped", "lost", "emptied"])
def test_damage_is_found_and_repaired_by_rendering(views, name, damage):
    before = {n: ViewStore.open(views).group[n][:] for n in ("image", "depth", "points", "measures/depth_entropy")}
    file = chunk(views, name, 1)
    match damage:
        case "flipped":
            flip_a_byte(file)
        case "lost":
            file.unlink()
        case "emptied":
            file.write_bytes(b"")
    found = dict(check(views, repair=True, workers=0))
    assert [n for n, problem in found.items() if problem] == ["b"]
    assert ViewStore.open(views).done.tolist() == [True, False, True]
    assert list(render(views.parent / "meshes", views, SPHERE, 48, workers=0)) == [("b", None)]
    for n, values in before.items():
        np.testing.assert_array_equal(ViewStore.open(views).group[n][:], values)


def test_wrong_values_with_a_right_checksum_are_found(views):
    store = ViewStore.open(views)
    store.group["points"][0] = store.group["points"][1]
    store.group["image"][2] = np.where(store.image(2) > 0, 0, 9)
    found = dict(check(views, workers=0))
    assert "points" in found["a"]
    assert "silhouette" in found["c"]
    assert found["b"] is None


def test_what_is_no_store_is_refused(tmp_path, views):
    with pytest.raises(DatasetError, match="no view store"):
        list(check(tmp_path, workers=0))
    (views / "points" / "zarr.json").unlink()
    with pytest.raises(DatasetError, match="points is missing"):
        list(check(views, workers=0))


def test_a_store_without_hashes_and_failures_is_still_read(views):
    store = ViewStore.open(views)
    kept = {k: v for k, v in store.group.attrs.items() if k not in ("sha256", "failures")}
    store.group.attrs.put(kept)
    old = ViewStore.open(views)
    assert (old.failures, old.twins) == ({}, [])
    assert list(render(views.parent / "meshes", views, SPHERE, 48, workers=0)) == []
