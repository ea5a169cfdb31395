"""What a folder teaches, wherever the result goes; sizes that give a wrong unit away; the
picture of all things.
"""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from factories import drawn_thing
from programs import main

import nextview.teaching.learn as teaching
from nextview import learn
from nextview.errors import DatasetError, UsageError
from nextview.recognition.model_card import read_card
from nextview.teaching.sizes import check_sizes
from nextview.teaching.thing_sources import find_things


@pytest.fixture
def quickly(monkeypatch):
    """Teaching without looking: what is remembered is drawn."""

    def drawn(path, name, how):
        assert path.is_file()
        return drawn_thing(name)

    monkeypatch.setattr(teaching, "teach", drawn)
    monkeypatch.setattr(teaching, "show", lambda *given: [])


def scans_in(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("OFF\n")
    return folder


def test_frames_meshes_and_classes_are_found_together(tmp_path):
    scans_in(
        tmp_path,
        "box.ply",
        "cups/a.ply",
        "cups/a.stl",
        "frames/frame-0.depth.png",
        "mine/learned.png",
        "b.dae",
    )
    found = find_things(tmp_path, tmp_path / "mine")
    assert [(thing.name, thing.label) for thing in found.things] == [
        ("box", "box"),
        ("a", "cups"),
        ("frames", "frames"),
    ]
    assert set(found.left_out) == {
        "cups/a.stl: the PLY file of the same model is taken",
        "mine: is where the result goes",
        "b.dae: of a format that is not read; export it as .off, .obj, .ply, .stl, .glb",
    }
    assert found.notes == (
        f"in {tmp_path}: 1 mesh, 1 mesh as CLASS/MESH, 1 folder of depth frames",
    )


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("sensor", "foo", "foo"),
        ("seed", -1, "-1"),
        ("unit", "km", "km"),
        ("up", "x", "x"),
        ("turntable", "left", "left"),
        ("workers", -1, "-1"),
        ("symmetry", ["can=z"], "nothing is called can"),
    ],
)
def test_a_value_that_makes_no_sense_is_refused_before_anything_is_taught(
    tmp_path, monkeypatch, option, value, said
):
    def teach(*arguments):
        raise AssertionError("a thing was taught")

    monkeypatch.setattr("nextview.teaching.learn.teach", teach)
    scans_in(tmp_path / "things", "box.ply", "tin.ply")
    with pytest.raises((UsageError, DatasetError), match=said):
        learn(
            tmp_path / "things",
            tmp_path / "mine",
            **({"unit": "m", "workers": 0} | {option: value}),
        )
    assert not (tmp_path / "mine").exists()


@pytest.mark.skipif(
    sys.platform != "linux", reason="names of files are bytes on Linux alone"
)
def test_a_file_that_cannot_be_taught_does_not_keep_the_others_from_it(
    tmp_path, quickly, capsys
):
    long = "n" * 251
    root = scans_in(tmp_path / "things", "box.ply", f"{long}.ply", "tin.ply")
    (root / "gone.ply").symlink_to("nowhere")
    (root / os.fsdecode(b"caf\xe9.ply")).write_text("OFF\n")
    main(
        ["learn", str(root), str(tmp_path / "mine"), *["--unit", "m", "--workers", "0"]]
    )
    assert set(read_card(tmp_path / "mine/memory.json").classes) >= {"box", "tin"}
    printed = " ".join("".join(capsys.readouterr()).split())
    assert "gone.ply: a link that leads nowhere" in printed
    assert r"caf\udce9.ply: its name cannot be printed; rename it" in printed


@pytest.mark.parametrize(
    ("radii", "unit_given", "said"),
    [
        (
            [71.0, 80, 65],
            "m",
            r"b\.ply: has a radius of 71 m if unit='m' is right.* unit='mm' \(7\.1 cm\)",
        ),
        ([71.0], "m", "unit='mm'"),
        ([0.0001, 0.00012], "mm", r"unit='m' \("),
        ([0.1, 0.12, 100.0], "m", r"c\.ply: is 833 times larger than most others"),
        ([0.1, 0.12, 0.0001], "m", "times smaller than most others"),
        ([0.1, 0.3], None, None),
        ([15.0, 3.0], "m", None),
    ],
)
def test_sizes_that_give_a_wrong_unit_away_are_asked_about(radii, unit_given, said):
    names = [Path(f"{name}.ply") for name in ("b", "a", "c")][: len(radii)]
    if said is None:
        return check_sizes(names, np.array(radii), unit_given)
    with pytest.raises(DatasetError, match=said) as raised:
        check_sizes(names, np.array(radii), unit_given)
    assert "any_size=True accepts it" in str(raised.value)
