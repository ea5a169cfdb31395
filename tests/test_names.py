"""Names of files, classes and objects may hold anything: they are shown as they are, and never mean anything."""

import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser

import matplotlib
import numpy as np
import pytest
import trimesh
from test_predictions import some_predictions
from test_report import browse

from nextview.cli.benchmark import benchmark
from nextview.cli.ending import printable
from nextview.cli.main import main
from nextview.cli.report import report
from nextview.cli.terminal import Terminal
from nextview.data.folders import list_dataset
from nextview.data.rendering import render
from nextview.data.store import ViewStore
from nextview.errors import DatasetError
from nextview.report.diagrams import confusion_matrix
from nextview.report.store_figures import correspondence_figure, object_figure, store_figure
from nextview.report.style import to_svg
from nextview.viewsphere import ViewSphere

MATH = "$x^{$"
"""What matplotlib takes for a formula, and a broken one."""
COMMENT = "<!--<script>"
"""After which a browser takes the end of a script for a part of it."""


def texts(svg: str) -> list[str]:
    return ["".join(element.itertext()) for element in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]


@pytest.mark.parametrize("name", [MATH, "a$b$c", r"a\$b", "<b>&", "5 %"])
def test_a_figure_shows_a_name_as_it_is(name):
    shown = texts(to_svg(confusion_matrix(np.eye(2), [name, "chair"], f"of {name}")))
    assert shown.count(name) == 2  # on both axes
    assert shown.count(f"of {name}") == 1


@pytest.mark.filterwarnings("ignore:Glyph")
def test_a_control_character_leaves_a_figure_sound():
    assert "\ufffd[31mred" in texts(to_svg(confusion_matrix(np.eye(2), ["\x1b[31mred", "chair"], "")))


def test_pictures_of_a_store_and_of_an_episode(tmp_path):
    mesh = tmp_path / "meshes" / MATH / f"{MATH}.off"
    mesh.parent.mkdir(parents=True)
    trimesh.creation.box([1, 2, 3]).export(mesh)
    list(render(tmp_path / "meshes", tmp_path / f"{MATH}.zarr", ViewSphere.named("12"), 16, workers=0))
    store = ViewStore.open(tmp_path / f"{MATH}.zarr")
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        assert f"{MATH}  ·  {MATH}" in texts(to_svg(object_figure(store, 0)))
        assert {f"{MATH}.zarr", MATH} <= {*texts(to_svg(store_figure(store)))}
        assert MATH in texts(to_svg(correspondence_figure(np.eye(12), store.sphere, MATH)))
        main(["recognise", str(mesh), "--max-views", "1", "--figure", str(tmp_path / "episode.svg")])
    assert any(text.startswith(f"{MATH}.off: ") for text in texts((tmp_path / "episode.svg").read_text()))


class Scripts(HTMLParser):
    """The contents of the scripts of a page, as a browser takes them apart."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.inside = False
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.inside = tag == "script"
        self.found += [""] * self.inside

    def handle_endtag(self, tag):
        self.inside = False

    def handle_data(self, data):
        if self.inside:
            self.found[-1] += data


CLASSES = (MATH, COMMENT, "</script>", "<b>[red]")


@pytest.fixture(scope="module")
def strange(tmp_path_factory):
    """Predictions of strange names, and a report of them."""
    folder = tmp_path_factory.mktemp("strange")
    p = some_predictions(24, seed=1)
    logits = np.concatenate([p.logits, p.logits[..., :1] - 9], -1)
    names = (f"{COMMENT}{MATH}", *p.names[1:])
    p = replace(p, logits=logits, classes=CLASSES, names=names, labels=np.arange(24) % 4, valley_classes={"lem": ()})
    p.save(folder / "p.npz")
    benchmark(folder / "p.npz", out=folder / "out", thresholds=(0.8, 0.97), runs=2, samples=50)
    report(folder / "out")
    return folder


def test_no_name_ends_the_script_of_a_report(strange):
    data, script = Scripts((strange / "out/report.html").read_text()).found
    assert json.loads(data)["classes"] == list(CLASSES)
    assert "<" not in data  # in HTML, nothing but this can end a script or hide its end
    assert "getElementById" in script


def test_the_viewer_of_a_report_of_strange_names_runs_in_a_browser(strange):
    page = browse(strange / "out/report.html", "#scene=0&step=0")
    assert re.search(r'id="verdict"[^>]*>[^<]+<', page)


def test_an_evaluation_of_strange_names(strange, tmp_path, capsys):
    main(["evaluate", str(strange / "p.npz"), "--out", str(tmp_path / "e"), "--samples", "20"])
    printed = capsys.readouterr().out
    assert "<b>[red]" in printed
    assert MATH in printed


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("desk[old].off", "desk[old].off"),
        ("[red]desk :smile:.off", "[red]desk :smile:.off"),
        ("a\x1b[31mb\x07.off", r"a\x1b[31mb\x07.off"),
        ("a\rb\u202ec\x9b.off", r"a\rb\u202ec\x9b.off"),
        (b"caf\xe9.off".decode("utf-8", "surrogateescape"), r"caf\udce9.off"),
    ],
)
def test_a_terminal_gets_a_name_as_it_is(tmp_path, name, shown, capsys):
    assert printable(name) == shown
    trimesh.creation.box([1, 2, 3]).export(tmp_path / "box.off")
    (tmp_path / "box.off").rename(tmp_path / name)
    main(["recognise", str(tmp_path / name), "--max-views", "1"])
    assert f"Looking at {shown}" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["recognise", str(tmp_path / name), "--max-views", "0"])
    (tmp_path / name).unlink()
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main(["recognise", str(tmp_path / name)])
    assert capsys.readouterr().err == f"nextview: {tmp_path}/{shown}: there is no such file\n"


def test_a_terminal_prints_lines_of_all_kinds(capsys):
    from rich.table import Table

    table = Table("a\x1bb", title="t\x1b[1m", caption="[c]")
    table.add_row("[bold]\x07\n:smile:")
    Terminal().print("x\x1b[0m [y]", table)
    printed = capsys.readouterr().out
    assert all(part in printed for part in (r"x\x1b[0m [y]", r"a\x1bb", r"t\x1b[1m", "[c]", r"[bold]\x07", ":smile:"))
    assert not re.search(r"[\x00-\x09\x0b-\x1f]", printed)


@pytest.mark.parametrize("name", ["a\nb", "a\x1b[1m", b"caf\xe9".decode("utf-8", "surrogateescape")])
def test_a_dataset_with_names_that_cannot_be_printed_is_refused(tmp_path, name):
    (tmp_path / name).mkdir()
    (tmp_path / name / "box.off").write_text("OFF\n")
    with pytest.raises(DatasetError, match="its name holds what cannot be printed; rename it"):
        list_dataset(tmp_path)
