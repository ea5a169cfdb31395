"""A store knows when it is damaged or lacks a part, and a store of the first layout is still read."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
import zarr
from tiny_models import make_map_network, make_recogniser

from nextview.cli.main import main
from nextview.data.attributes import checksum
from nextview.data.checking import check
from nextview.data.correspond import correspond
from nextview.data.measuring import measure
from nextview.data.rendering import render
from nextview.data.store import DIGEST, PENDING, RENDERED, ViewStore
from nextview.errors import DatasetError
from nextview.measures.registry import MEASURES
from nextview.viewsphere import ViewSphere

DEPTH = [name for name, found in MEASURES.items() if found.needs == "depth"]
SPHERE = ViewSphere.named("12")


def boxes(folder: Path) -> Path:
    for name in ("a", "b", "c"):
        path = folder / "meshes/box" / f"{name}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box([1, 2, 1 + ord(name) % 5]).export(path)
    list(render(folder / "meshes", folder / "views.zarr", SPHERE, 48, workers=0))
    return folder / "views.zarr"


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Path:
    """Three boxes; no test changes them."""
    return boxes(tmp_path_factory.mktemp("rendered"))


@pytest.fixture
def views(rendered, tmp_path) -> Path:
    """A store of three boxes, and their meshes beside it, to be damaged."""
    shutil.copytree(rendered.parent, tmp_path, dirs_exist_ok=True)
    return tmp_path / "views.zarr"


def flip_a_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)


def chunk(views: Path, name: str, i: int) -> Path:
    place = views / name / "c" / str(i)
    return place if place.is_file() else next(p for p in place.rglob("*") if p.is_file())


def test_a_sound_store_is_found_sound(views):
    assert sorted(check(views, workers=0)) == [("a", None), ("b", None), ("c", None)]


def test_a_fresh_store_of_plates_seen_from_the_edge_is_sound(tmp_path):
    """Planes through a camera and a column of its pixels: rounding puts hits hundreds of radii away."""
    rng, sphere = np.random.default_rng(0), ViewSphere((0.0,), 4)
    depth, across = rng.uniform(2.4, 3.6, (90, 1)), rng.uniform(-0.6, 0.6, (90, 1))
    column = (np.repeat(rng.integers(16, 48, (30, 1)), 3, axis=0) + 0.5 - 32) / (32 * np.sqrt(8))
    plates = np.concatenate([depth, column * depth, across], 1) - [3, 0, 0]  # seen from x = -3: view 2
    vertices = np.concatenate([plates, np.repeat(np.concatenate([np.eye(3), -np.eye(3)]), 3, axis=0)])
    (tmp_path / "meshes/plate").mkdir(parents=True)
    trimesh.Trimesh(vertices, np.arange(len(vertices)).reshape(-1, 3), process=False).export(
        tmp_path / "meshes/plate/plate.off"
    )
    list(render(tmp_path / "meshes", tmp_path / "views.zarr", sphere, 64, workers=0))
    assert list(check(tmp_path / "views.zarr", workers=0)) == [("plate", None)]
    assert ViewStore.open(tmp_path / "views.zarr").depth(0).max() < 4.001


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


@pytest.mark.parametrize("name", [name for name in RENDERED if name != "status"])
@pytest.mark.parametrize("damage", ["flipped", "cut", "lost", "folder lost"])
def test_every_read_of_a_damaged_chunk_names_it(views, name, damage):
    store = ViewStore.open(views)
    store.note(unit="cm")
    file = chunk(views, name, 1)
    match damage:
        case "flipped":
            flip_a_byte(file)
        case "cut":
            file.write_bytes(file.read_bytes()[:-3])
        case "lost":
            file.unlink()
        case "folder lost" if name == "radius":
            return  # its chunks are files
        case "folder lost":
            shutil.rmtree(views / name / "c" / "1")
    reads = {
        "image": lambda: store.image(1),
        "depth": lambda: store.depth(1),
        "points": lambda: store.points(1),
        "measures/depth_entropy": store.measure,
        "radius": lambda: store.radii,
    }
    wrong = "is missing" if "lost" in damage else "cannot be read"
    for read in (reads[name], lambda: store.rows(name)):
        with pytest.raises(DatasetError, match=rf"{name} of b {wrong}.*; nextview .* makes it"):
            read()
    for other in (0, 2):
        assert store.read(name, other) is not None
    # The damage of an object that is not rendered hurts nobody.
    store.mark(1, PENDING)
    sound = [0, 2]
    assert np.isfinite(store.rows(name)[sound]).all()
    assert (store.rows(name)[sound] != 0).any()


def test_all_clouds_notice_a_missing_one(views):
    ViewStore.open(views).all_points()
    shutil.rmtree(views / "points" / "c" / "2")
    with pytest.raises(DatasetError, match="points of c is missing"):
        ViewStore.open(views).all_points()


def test_an_object_without_anything_is_damaged(views):
    """Blank arrays agree with each other."""
    for name in ("image", "depth", "points", "measures/depth_entropy"):
        shutil.rmtree(views / name / "c" / "1")
    assert [name for name, problem in check(views, workers=0) if problem] == ["b"]


def test_a_missing_chunk_ends_every_command_that_reads_it(views, capsys):
    shutil.rmtree(views / "depth" / "c" / "1")
    out = views.parent / "out.npz"
    recogniser, maps = make_recogniser(views.parent, ["box"]), make_map_network(views.parent, rings=1)
    for command in (
        ["predict", views, out, "--recogniser", recogniser, "--maps", f"lem={maps}", "--workers", 1],
        ["measure", views, "--measures", "max_depth", "--workers", 1],
        ["inspect", views, views.parent / "b.png", "--object", "b"],
    ):
        message = refused(capsys, *command)
        assert f"{views}: depth of b is missing; nextview check {views} --repair" in message
        assert "nextview render" in message
    assert not out.exists()
    with pytest.raises(SystemExit) as end:
        main(["check", str(views), "--workers", "1"])
    assert end.value.code == 2
    assert "b: depth is missing" in capsys.readouterr().err


def test_measure_makes_damaged_measures_anew(views):
    list(measure(views, workers=0))
    before = {name: ViewStore.open(views).measure(name) for name in DEPTH}
    shutil.rmtree(views / "measures/depth_entropy/c/0")
    flip_a_byte(chunk(views, "measures/max_depth", 2))
    assert list(measure(views, workers=0)) == [(1, 3), (2, 3), (3, 3)]
    for name, values in before.items():
        np.testing.assert_array_equal(ViewStore.open(views).measure(name), values)


def test_who_reads_a_store_while_it_is_rendered_is_told_nothing_of_lost_objects(views, monkeypatch, caplog):
    """Looks at the store whenever a chunk of it is written."""
    store = views.parent / "again.zarr"
    seen, write = [], zarr.Array.__setitem__

    def look(array, at, values):
        write(array, at, values)
        read = ViewStore.open(store)
        assert read.lost == {}
        seen.append((array.path, read.done.tolist()))

    monkeypatch.setattr(zarr.Array, "__setitem__", look)
    list(render(views.parent / "meshes", store, SPHERE, 48, workers=0))
    assert {path for path, _ in seen} == {*RENDERED, DIGEST}
    assert len({tuple(done) for _, done in seen}) == 4  # none, then one more each
    assert caplog.messages == []


def test_an_object_that_is_finished_while_others_are_read_is_not_missing(views, monkeypatch):
    """Between what is looked for first, which chunks there are, and the statuses."""
    away = views.parent / "away"
    chunks = [chunk(views, name, 1) for name in (*RENDERED, DIGEST)]
    for k, path in enumerate(chunks):
        path.rename(away.with_suffix(f".{k}"))
    scan = ViewStore.scan

    def late(store, name, objects):
        found = scan(store, name, objects)
        for k, path in enumerate(chunks):
            if not path.exists():
                away.with_suffix(f".{k}").rename(path)
        return found

    read = ViewStore.open(views)
    monkeypatch.setattr(ViewStore, "scan", late)
    points = read.all_points()
    monkeypatch.undo()
    np.testing.assert_array_equal(points, read.all_points())


@pytest.mark.parametrize("healer", ["check", "render"])
@pytest.mark.parametrize("damage", ["flipped", "lost"])
def test_a_damaged_status_costs_one_object_and_is_healed(views, capsys, caplog, damage, healer):
    flip_a_byte(chunk(views, "status", 1)) if damage == "flipped" else chunk(views, "status", 1).unlink()
    problem = "status is missing" if damage == "lost" else "status cannot be read"
    assert ViewStore.open(views).done.tolist() == [True, False, True]
    assert ViewStore.open(views).done.tolist() == [True, False, True]
    assert ["status of b is lost" in line for line in caplog.messages] == [True]
    found = dict(check(views, workers=0))
    assert found["b"].startswith(problem)
    assert (found["a"], found["c"]) == (None, None)
    main(["measure", str(views), "--workers", "1"])
    with pytest.raises(SystemExit) as end:
        main(["check", str(views), "--workers", "1"])
    assert end.value.code == 2
    message = " ".join(capsys.readouterr().err.split())
    assert f"b: {problem}" in message
    assert "2 objects are sound, 1 damaged, 0 not rendered yet" in message
    if healer == "check":
        list(check(views, repair=True, workers=0))
        assert ViewStore.open(views).lost == {}
        assert ViewStore.open(views).done.tolist() == [True, False, True]
    assert list(render(views.parent / "meshes", views, SPHERE, 48, workers=0)) == [("b", None)]
    assert dict(check(views, workers=0)) == {"a": None, "b": None, "c": None}


def test_wrong_values_with_a_right_checksum_are_found(views):
    store = ViewStore.open(views)
    store.group["points"][0] = store.group["points"][1]
    store.group["image"][2] = np.where(store.image(2) > 0, 0, 9)
    found = dict(check(views, workers=0))
    assert "points" in found["a"]
    assert "silhouette" in found["c"]
    assert found["b"] is None


def test_what_a_sensor_saw_of_a_wrong_object_frame_is_sound_and_its_damage_is_found(views):
    noisy = views.with_name("noisy.zarr")
    list(render(views.with_name("meshes"), noisy, SPHERE, sensor="setup:2", workers=0))
    assert [reason for _, reason in check(noisy, workers=0) if reason] == []
    flip_a_byte(chunk(noisy, "points", 1))
    found = [(name, reason) for name, reason in check(noisy, workers=0) if reason]
    assert [name for name, _ in found] == ["b"]


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
    assert store.measures == sorted(DEPTH)
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
    for command in (
        ["measure", views, "--measures", "max_depth"],
        ["inspect", views, views.parent / "b.png", "--object", "b"],
    ):
        message = refused(capsys, *command) if command[0] == "inspect" else refused(capsys, *command, "--workers", 1)
        assert "depth of b cannot be read" in message


@pytest.mark.parametrize("place", ["zarr.json", "depth/zarr.json"])
@pytest.mark.parametrize("content", ["", '{"zarr_format": 3, ', "{}"])
def test_damaged_attributes_are_one_sentence(views, capsys, place, content):
    (views / place).write_text(content)
    for command in (["check", views], ["measure", views], ["inspect", views, views.parent / "b.png", "--object", "b"]):
        message = refused(capsys, *command)
        assert str(views) in message
        expected = "not a view store" if content == "{}" else "zarr.json is damaged"
        assert (expected if place == "zarr.json" else "depth cannot be opened") in message


def test_arrays_of_another_length_are_refused(views):
    ViewStore.open(views).group["points"].resize((2, 12, 1024, 3))
    with pytest.raises(DatasetError, match=r"points is not one of \(3, 12, 1024, 3\) int16"):
        list(check(views, workers=0))


def test_what_is_no_store_is_refused(tmp_path, views):
    with pytest.raises(DatasetError, match="no view store"):
        list(check(tmp_path, workers=0))
    (views / "points" / "zarr.json").unlink()
    with pytest.raises(DatasetError, match="points is missing"):
        list(check(views, workers=0))


def test_a_store_from_before_checksums_and_digests_is_read_and_completed(views):
    store = ViewStore.open(views)
    before = {name: store.rows(name) for name in RENDERED}
    later = ("sha256", "failures", "checksum", "unit", "stretch", "turn", "seed")
    store.group.attrs.put({k: v for k, v in store.group.attrs.items() if k not in later})
    store.mark(1, PENDING)
    shutil.rmtree(views / "digest")
    old = ViewStore.open(views)
    assert (old.failures, old.duplicates) == ({}, [])
    assert np.isnan(old.radii).all()
    assert list(check(views, workers=0)) == [("a", None), ("c", None)]
    assert list(render(views.parent / "meshes", views, SPHERE, 48, workers=0)) == [("b", None)]
    for name, values in before.items():
        np.testing.assert_array_equal(ViewStore.open(views).rows(name), values)
    assert [ViewStore.open(views).has("digest", i) for i in range(3)] == [False, True, False]
    assert {problem for _, problem in check(views, workers=0)} == {None}


BAD = {
    "names": [None, [], ["a", "b"], ["a", "b", "b"], ["a", "b", 3], ["a", "b", ""], "abc"],
    "labels": [None, ["box", "box"], ["box", "box", 1], ["box", "box", ""], "box"],
    "splits": [None, ["", ""], ["", "", "validation"], [[], "", ""]],
    "elevations": [None, [], [np.nan], ["45"], [91.0], 45.0, [True]],
    "azimuths": [None, 0, 2, 10**400, 12.0, "12", True],
    "distance": [None, 1, 0.5, -3, np.inf, np.nan, "3"],
    "size": [None, 0, 10**400, -48, 48.5, "48"],
    "failures": [[], {"nobody": "reason"}, {"a": 3}],
    "seed": [-1, 0.5, "0"],
    "stretch": [np.nan, -2, "0"],
    "turn": [0, "no"],
    "sha256": [["0"], [0, 0, 0], "0"],
    "unit": ["parsec", 3, []],
    "dataset": [3],
    "commands": ["render", [3]],
    "checksum": [3, "0" * 64],
    "format": [None, 1, "2", [2]],
}


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in BAD.items() for value in values])
@pytest.mark.parametrize("checked", [True, False], ids=["with checksum", "without"])
def test_attributes_that_are_not_what_they_should_be_are_one_sentence(views, capsys, key, value, checked):
    file = views / "zarr.json"
    whole = json.loads(file.read_text())
    facts = whole["attributes"]
    facts[key] = value
    if value is None:
        del facts[key]
    if not checked:
        facts["checksum"] = checksum(facts)  # as if it had been written so
        if key == "checksum":
            return
    file.write_text(json.dumps(whole))
    for command in (["check", views], ["inspect", views, views.parent / "x.png"], ["measure", views]):
        message = refused(capsys, *command)
        assert str(views) in message
        assert key in message


def test_one_changed_letter_of_the_attributes_is_found_and_mended(views, capsys):
    file = views / "zarr.json"
    ViewStore.open(views).note(unit="cm")
    whole = file.read_bytes()
    meshes = views.parent / "meshes"
    for old, new in (
        (b'"c"', b'"d"'),
        (b'"box"', b'"bax"'),
        (b'"distance": 3.0', b'"distance": 3.5'),
        (b'"size": 48', b'"size": 24'),
        (b'"turn": false', b'"turn": true'),
        (b'"checksum": "', b'"checksum": "0'),
        (b'"failures": {}', b'"failures": []'),
        (b'"splits"', b'"splitz"'),
        (b'"unit": "cm"', b'"unit": "cn"'),
        (b'"format": 2', b'"format": 3'),
        (b'"labels": [', b'"labels": {'),
        (b'"node_type"', b'"node_typ\xe5"'),
        (b'"commands"', b'"commandz"'),
        (b'"dataset": "meshes"', b'"dataset": meshes"'),
        (b'"unit": "cm"', b'"unit": "m"'),
    ):
        assert old in whole
        file.write_bytes(whole.replace(old, new, 1))
        message = refused(capsys, "check", views)
        assert "not a view store of format 2" in message if b"format" in new else "zarr.json is damaged" in message
        with pytest.raises(DatasetError, match="format 2" if b"format" in new else "with these it cannot"):
            list(render(meshes, views, SPHERE, 47, workers=0))
        main(["render", str(meshes), str(views), "--sphere", "12", "--size", "48", "--workers", "1"])
        capsys.readouterr()
        mended, was = (json.loads(b)["attributes"] for b in (file.read_bytes(), whole))
        for later in ("commands", "checksum"):  # the command that mended it is noted too
            del mended[later], was[later]
        assert mended == was
        assert dict(check(views, workers=0)) == {"a": None, "b": None, "c": None}


@pytest.mark.parametrize("name", ["image", "depth", "points", "radius"])
def test_chunks_of_one_object_under_another_are_found(views, name):
    """Boxes of two sizes, one stretched copy: their checksums are right, and radii tell nothing else of a store."""
    first, second = chunk(views, name, 0), chunk(views, name, 1)
    kept = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(kept)
    found = dict(check(views, workers=0))
    assert found.pop("c") is None
    assert all(found.values())


def test_objects_that_changed_places_are_found(views):
    for array in (*RENDERED, "digest"):
        first, second = chunk(views, array, 0), chunk(views, array, 1)
        kept = first.read_bytes()
        first.write_bytes(second.read_bytes())
        second.write_bytes(kept)
    found = dict(check(views, workers=0))
    assert found["a"] == found["b"] == "image, depth, points, radius and name are not together what was rendered"


def test_a_store_without_its_root_is_named_with_the_way_to_go_on(views):
    (views / "zarr.json").unlink()
    for use in (ViewStore.open, lambda path: list(render(path.parent / "meshes", path, SPHERE, 48, workers=0))):
        with pytest.raises(DatasetError, match=r"^[^\n]*: its zarr\.json, .*is gone; copy it back, or move[^\n]*$"):
            use(views)


@pytest.mark.parametrize("place", [*(f"{name}/zarr.json" for name in (*RENDERED, "digest")), "measures/zarr.json"])
@pytest.mark.parametrize("damage", ["{", '{"zarr_format": 3}', None])
def test_arrays_that_cannot_be_opened_are_mended_and_keep_what_they_hold(views, capsys, place, damage):
    before = {name: ViewStore.open(views).rows(name) for name in RENDERED}
    file = views / place
    file.unlink() if damage is None else file.write_text(damage)
    if (place, damage) != ("digest/zarr.json", None):  # stores that were begun earlier have none
        message = refused(capsys, "check", views)
        remedy = "nextview measure" if place.startswith("measures/d") else f"nextview check {views} --repair"
        assert remedy in message
    main(["check", str(views), "--repair", "--workers", "1"])
    assert "3 objects are sound, 0 damaged, 0 not rendered yet" in " ".join(capsys.readouterr().err.split())
    for name, values in before.items():
        np.testing.assert_array_equal(ViewStore.open(views).rows(name), values)


@pytest.mark.parametrize("place", ["measures", "measures/depth_entropy", "measures/max_depth"])
def test_measure_mends_what_it_writes(views, place):
    list(measure(views, workers=0))
    before = {name: ViewStore.open(views).measure(name) for name in DEPTH}
    (views / place / "zarr.json").write_text("{")
    assert ViewStore.open(views).measures == sorted(DEPTH)
    list(measure(views, workers=0))
    for name, values in before.items():
        np.testing.assert_array_equal(ViewStore.open(views).measure(name), values)
    assert dict(check(views, workers=0)) == {"a": None, "b": None, "c": None}


def test_a_lost_array_is_made_and_filled_again(views, capsys):
    before = ViewStore.open(views).all_points()
    shutil.rmtree(views / "points")
    with pytest.raises(SystemExit):
        main(["check", str(views), "--repair", "--workers", "1"])
    assert "b: points is missing" in capsys.readouterr().err
    assert len(list(render(views.parent / "meshes", views, SPHERE, 48, workers=0))) == 3
    np.testing.assert_array_equal(ViewStore.open(views).all_points(), before)
