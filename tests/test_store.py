"""A store knows when it is damaged or lacks a part, and a store of the first layout is still read."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from nextview.cli.main import main
from nextview.data.checking import check
from nextview.data.correspond import correspond
from nextview.data.measuring import measure
from nextview.data.rendering import render
from nextview.data.store import RENDERED, ViewStore
from nextview.errors import DatasetError
from nextview.measures.registry import MEASURES
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


def test_correspondence_is_checked_where_it_is_made(views):
    steps = correspond(views, workers=0)
    next(steps), next(steps)
    steps.close()
    assert {problem for _, problem in check(views, workers=0)} == {None}
    list(correspond(views, workers=0))
    assert {problem for _, problem in check(views, workers=0)} == {None}
    share = ViewStore.open(views).group["correspondence"]
    share[1, 2, 5] = share[1, 2, 5] + 0.01
    flip_a_byte(chunk(views, "correspondence", 2))
    found = dict(check(views, workers=0))
    assert found["a"] is None
    assert found["b"] == "correspondence is not that of points and depth"
    assert found["c"].startswith("correspondence cannot be read")


def refused(capsys, *arguments) -> str:
    """The sentence with which a command ends, with status 2, below its bar."""
    with pytest.raises(SystemExit) as end:
        main([str(a) for a in arguments])
    assert end.value.code == 2
    *before, message = capsys.readouterr().err.strip().splitlines()
    assert all("/3 " in line for line in before)
    assert message.startswith("nextview: ")
    return message


@pytest.mark.parametrize("name", RENDERED)
def test_check_and_render_say_which_array_is_missing(views, capsys, name):
    shutil.rmtree(views / name)
    for command in (["check", views], ["render", views.parent / "meshes", views, "--sphere", "12", "--size", "48"]):
        assert f"the array {name} is missing" in refused(capsys, *command, "--workers", 1)


def test_measure_needs_the_depth_alone(views, capsys):
    before = ViewStore.open(views).measure()
    for name in ("image", "points", "measures"):
        shutil.rmtree(views / name)
    main(["measure", str(views), "--workers", "1"])
    store = ViewStore.open(views)
    assert store.measures == sorted(MEASURES)
    np.testing.assert_array_equal(store.measure(), before)
    capsys.readouterr()
    shutil.rmtree(views / "depth")
    shutil.rmtree(views / "measures" / "max_depth")
    assert "the array depth is missing" in refused(capsys, "measure", views)
    assert "max_depth" not in ViewStore.open(views).measures
    assert "the array depth is missing" in refused(capsys, "correspond", views, views.parent / "share")


def test_inspect_draws_what_is_there(views, capsys):
    picture = views.parent / "picture.png"
    shutil.rmtree(views / "measures")
    main(["inspect", str(views), str(picture)])
    assert "measures/depth_entropy" in capsys.readouterr().err
    main(["inspect", str(views), str(picture), "--object", "b"])
    shutil.rmtree(views / "image")
    main(["inspect", str(views), str(picture)])
    message = " ".join(capsys.readouterr().err.split())
    assert "arrays that are missing image, measures/depth_entropy" in message
    assert "per view depth" in message
    assert "the array image is missing" in refused(capsys, "inspect", views, picture, "--object", "b")
    shutil.rmtree(views / "status")
    assert "the array status is missing" in refused(capsys, "inspect", views, picture)


def test_a_damaged_object_is_named(views, capsys):
    flip_a_byte(chunk(views, "depth", 1))
    for command in (["measure", views, "max_depth"], ["inspect", views, views.parent / "b.png", "--object", "b"]):
        message = refused(capsys, *command) if command[0] == "inspect" else refused(capsys, *command, "--workers", 1)
        assert "depth of b cannot be read" in message


@pytest.mark.parametrize("place", ["zarr.json", "depth/zarr.json"])
@pytest.mark.parametrize("content", ["", '{"zarr_format": 3, ', "{}"])
def test_damaged_attributes_are_one_sentence(views, capsys, place, content):
    (views / place).write_text(content)
    for command in (["check", views], ["measure", views], ["inspect", views, views.parent / "b.png", "--object", "b"]):
        message = refused(capsys, *command)
        assert str(views) in message
        expected = "not a view store" if content == "{}" else "zarr.json cannot be read"
        assert (expected if place == "zarr.json" else "depth cannot be opened") in message


def test_arrays_of_another_length_are_refused(views):
    ViewStore.open(views).group["points"].resize((2, 12, 1024, 3))
    with pytest.raises(DatasetError, match="points is of 2 objects, not 3"):
        list(check(views, workers=0))


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
    assert (old.failures, old.duplicates) == ({}, [])
    assert list(render(views.parent / "meshes", views, SPHERE, 48, workers=0)) == []
