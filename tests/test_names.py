"""Names of files, classes and objects may hold anything: they are shown as they are, and never
mean anything.
"""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
import trimesh
from factories import refused
from pipeline import benchmark, some_predictions
from programs import main

import nextview
from nextview.cli.episode_table import print_episode
from nextview.cli.exit_status import printable
from nextview.cli.look import print_scene
from nextview.data.folders import list_dataset
from nextview.data.samples import sample_mesh
from nextview.errors import DatasetError
from nextview.session.style import to_svg
from nextview_lab.benchmark.figures import confusion_matrix
from nextview_lab.benchmark.report import report

MATH = "$x^{$"
"""What matplotlib takes for a formula, and a broken one."""
COMMENT = "<!--<script>"
"""After which a browser takes the end of a script for a part of it."""


def texts(svg: str) -> list[str]:
    return [
        "".join(element.itertext())
        for element in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")
    ]


@pytest.mark.parametrize("name", [MATH, r"a\$b", "<b>&"])
def test_a_figure_shows_names_literally(name):
    shown = texts(to_svg(confusion_matrix(np.eye(2), [name, "chair"], f"of {name}")))
    assert shown.count(name) == 2  # on both axes
    assert shown.count(f"of {name}") == 1


def test_a_picture_of_an_episode(tmp_path):
    mesh = tmp_path / "meshes" / MATH / f"{MATH}.off"
    mesh.parent.mkdir(parents=True)
    trimesh.creation.box([1, 2, 3]).export(mesh)
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        main(
            [
                "recognise",
                str(mesh),
                "--max-views",
                "1",
                "--figure",
                str(tmp_path / "episode.svg"),
            ]
        )
    assert any(
        text.startswith(f"{MATH}.off: ")
        for text in texts((tmp_path / "episode.svg").read_text())
    )


CLASSES = (MATH, COMMENT, "</script>", "<b>[red]")


@pytest.fixture(scope="module")
def strange(tmp_path_factory):
    """Predictions of strange names, and a report of them."""
    folder = tmp_path_factory.mktemp("strange")
    p = some_predictions(24, seed=1)
    logits = np.concatenate([p.logits, p.logits[..., :1] - 9], -1)
    names = (f"{COMMENT}{MATH}", *p.names[1:])
    p = replace(
        p,
        logits=logits,
        classes=CLASSES,
        names=names,
        labels=np.arange(24) % 4,
        valley_classes={"lem": ()},
    )
    p.save(folder / "p.npz")
    benchmark(
        folder / "p.npz",
        folder / "out",
        thresholds=(0.8, 0.97),
        runs=2,
        samples=50,
    )
    report(folder / "out")
    return folder


def test_no_name_is_markup_in_a_report(strange):
    page = (strange / "out/report.html").read_text()
    assert "<script" not in page
    assert "</script>" not in page
    assert "<b>[red]" not in page
    assert "&lt;b&gt;[red]" in page


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("[red]desk :smile:.off", "[red]desk :smile:.off"),
        ("a\x1b[31mb\x07.off", r"a\x1b[31mb\x07.off"),
        (b"caf\xe9.off".decode("utf-8", "surrogateescape"), r"caf\udce9.off"),
    ],
)
def test_a_terminal_shows_names_literally(tmp_path, name, shown, capsys):
    assert printable(name) == shown
    trimesh.creation.box([1, 2, 3]).export(tmp_path / "box.off")
    (tmp_path / "box.off").rename(tmp_path / name)
    main(["recognise", str(tmp_path / name), "--max-views", "1"])
    assert f"Looking at {shown}" in capsys.readouterr().out
    (tmp_path / name).unlink()
    assert (
        refused(capsys, "recognise", tmp_path / name)
        == f"nextview: {tmp_path}/{shown}: no such file or folder"
    )


LONG_NAMES = ("phillips_screwdriver_no_2", "hexagon_flange_nut_m8", "b" * 36)


def of_name(number: int, name: str) -> SimpleNamespace:
    """What a table says of an object: all of its columns are as wide as they get."""
    return SimpleNamespace(
        number=number,
        name=name,
        confidence=0.987,
        confident=number % 2 == 1,
        size=np.array([0.1, 0.2, 0.3]),
        place=np.array([-0.123, -1.234, -0.345]),
        pose_uncertainty=SimpleNamespace(millimetres=12.3, degrees=123.4),
        pixels=dict.fromkeys("abcdefghijkl"),
        touches=(11, 12, 13),
        result=SimpleNamespace(beliefs={name: 0.987}, doubt=""),
    )


def test_a_table_of_a_scene_keeps_names_whole_in_80_columns(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    objects = [of_name(number, name) for number, name in enumerate(LONG_NAMES, 11)]
    scene = SimpleNamespace(objects=objects, frames=[None] * 4, remarks=())
    print_scene(scene, "table")
    shown = capsys.readouterr().out
    assert all(name in shown for name in LONG_NAMES)
    assert "…" not in shown
    assert "..." not in shown
    assert max(map(len, shown.splitlines())) <= 80


def test_a_table_of_views_keeps_names_whole_in_80_columns(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    camera = nextview.SimulatedCamera(sample_mesh("chair"))
    session = nextview.load(max_views=2, threshold=1).session()
    while not session.done:
        session.update(camera.observe(session.pose))
    names = tuple(f"{name}_of_the_living_room" for name in session.result.classes)
    result = replace(session.result, classes=names)
    print_episode(result, "chair", "gain")
    shown = capsys.readouterr().out
    table = shown.partition("view: number")[0]
    assert "chair_of_the_living_room\n" in re.sub(" +", "\n", table)
    assert "…" not in table
    assert "travel" not in table
    assert max(map(len, shown.splitlines())) <= 80

    print_episode(session.result, "chair", "gain")
    assert "travel" in capsys.readouterr().out.partition("view: number")[0]


@pytest.mark.parametrize(
    "name",
    ["a\nb", "a\x1b[1m", b"caf\xe9".decode("utf-8", "surrogateescape")],
)
def test_a_dataset_with_names_that_cannot_be_printed_is_refused(tmp_path, name):
    (tmp_path / name).mkdir()
    (tmp_path / name / "box.off").write_text("OFF\n")
    with pytest.raises(
        DatasetError,
        match=r"left out: \S+( b)?: its name cannot be printed; rename it",
    ):
        list_dataset(tmp_path)
