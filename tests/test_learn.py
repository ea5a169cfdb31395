"""Teaching things: what a folder holds, what is remembered, added and forgotten, and what
recognises them then.
"""

import shutil

import numpy as np
import pytest
import trimesh
from factories import SimulatedTable, TableCamera, poses_around, refused, write_off

import nextview
from nextview.data.samples import sample_mesh
from nextview.errors import DatasetError, UsageError
from nextview.geometry.mesh import load_mesh, make_mesh
from nextview.recognition.model_card import read_card
from nextview.simulation.sensor import SENSORS
from nextview.teaching.learn import learn
from nextview.things.memory import open_memory

THINGS = ("chair", "monitor", "table")


def test_taught_things_are_recognised_through_a_sensor(taught, scans):
    system = nextview.load(models=taught)
    assert system.policy_name == "discriminate"
    assert system.classes == THINGS
    for name in THINGS:
        result = system.recognise(
            scans / f"{name}.off", unit="m", sensor="wrist", seed=1
        )
        assert (result.answer, result.confident) == (name, True)
        np.testing.assert_allclose(result.views[-1].belief.sum(), 1)


def test_adding_leaves_what_is_known_as_it_was_and_removing_takes_it_away(
    tmp_path, taught, scans, capsys
):
    more, models = tmp_path / "more", tmp_path / "models"
    more.mkdir()
    shutil.copytree(taught, models)
    slab = make_mesh(
        sample_mesh("table").vertices * (1, 0.2, 1), sample_mesh("table").faces
    )
    write_off(more / "bench.off", slab)
    before = open_memory(taught / "memory.json")[1]
    learn(more, models, unit="m", upright=True, add=True, workers=0)
    card = read_card(models / "memory.json")
    assert card.classes == ("bench", *THINGS)
    np.testing.assert_array_equal(
        open_memory(card.card_path)[1].pictures[1:], before.pictures
    )
    learn(models, models, remove=("bench",))
    card = read_card(models / "memory.json")
    assert card.classes == THINGS
    after = open_memory(card.card_path)[1]
    np.testing.assert_array_equal(after.surfaces.places, before.surfaces.places)
    np.testing.assert_array_equal(after.surfaces.boxes, before.surfaces.boxes)
    alone = learn(models, models, remove=THINGS[1:]).notes[0]
    assert f"every object is {THINGS[0]} or unknown" in alone
    with pytest.raises(UsageError):
        learn(models, models, remove=("mug",))
    with pytest.raises(UsageError):
        learn(scans, models, unit="m", add=True)
    assert "already knows things; --add adds others, --overwrite" in refused(
        capsys, "learn", str(scans), str(models)
    )


def test_meshes_without_a_unit_are_refused_at_once_with_the_units_they_may_have(
    tmp_path,
):
    (tmp_path / "scans").mkdir()
    trimesh.creation.box((60, 60, 80)).export(tmp_path / "scans/tile.ply")
    with pytest.raises(UsageError, match=r"unit='mm' \(8 cm\)"):
        learn(tmp_path / "scans", tmp_path / "mine", workers=0)
    with pytest.raises(DatasetError, match=r"radius of 58.3 m if unit='m' is right"):
        learn(tmp_path / "scans", tmp_path / "mine", unit="m", track=pytest.fail)
    (tmp_path / "scans/tile.ply").write_text("no mesh")
    with pytest.raises(UsageError, match="unit='foot'"):
        learn(tmp_path / "scans", tmp_path / "mine", workers=0)
    assert not (tmp_path / "mine").exists()


def test_a_run_that_was_stopped_goes_on_and_gives_the_same(
    tmp_path, knobs, knobs_memory, taught_afresh
):
    def stopping(done, total, what):
        for count in done:
            if count == 2:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learn(
            knobs, tmp_path / "mine", unit="m", upright=True, workers=0, track=stopping
        )
    assert not (tmp_path / "mine").exists()
    counts = []
    learn(
        knobs,
        tmp_path / "mine",
        unit="m",
        upright=True,
        workers=0,
        track=lambda done, total, what: counts.extend(done),
    )
    assert counts[0] == 2  # what was finished is not looked at again
    assert (
        read_card(tmp_path / "mine/memory.json").sha256
        == read_card(knobs_memory / "memory.json").sha256
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine"]


def test_what_lies_too_flat_for_depth_is_told_when_it_is_taught(tmp_path):
    scans = tmp_path / "scans"
    scans.mkdir()
    sizes = {"card": (85.6, 54, 0.8), "tile": (60, 60, 20)}
    for name, sides in sizes.items():
        trimesh.creation.box(sides).export(scans / f"{name}.ply")
    found = learn(scans, tmp_path / "mine", unit="mm", workers=0)
    told = [note for note in found.notes if "where it lies flat" in note]
    assert len(told) == 1
    assert told[0].startswith("card: it is 0.8 mm high where it lies flat")
    assert told[0] in str(found)

    # What the note says is what a table shows: nothing stands there.
    system = nextview.load(tmp_path / "mine", threads=1)
    lies = np.eye(3)[None]
    for name, count in (("card", 0), ("tile", 1)):
        mesh = load_mesh(scans / f"{name}.ply", unit="mm")
        rng = np.random.default_rng(1)
        table = SimulatedTable.draw([mesh], rng, resting=lambda mesh: lies)
        camera = TableCamera(table, SENSORS["wrist"], rng)
        pose = poses_around(np.zeros(1), np.radians(50), 0.5, np.zeros(3))[0]
        scene = nextview.Scene(system)
        scene.update(camera.frame(pose))
        assert len(scene.objects) == count
