"""The command line as a user meets it, with the bundled models."""

import itertools
import json
import os
import shutil
import warnings

import numpy as np
import pytest
from factories import SAMPLE_FILES, refused, run_python
from fontTools.fontBuilder import FontBuilder
from fontTools.pens.ttGlyphPen import TTGlyphPen
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.font_manager import fontManager
from matplotlib.text import Text
from programs import main

import nextview
from nextview import ViewSphere
from nextview.errors import ModelError, NextviewError, ResultsError, UsageError
from nextview.policies.policy_card import bundled_policies
from nextview.recognition.inference import MapNetwork, NetworkRecogniser
from nextview.recognition.model_card import BUNDLED_MODELS, RECOGNISER, bundled_cards
from nextview.session import fonts
from nextview.session.style import PlainFigure


@pytest.fixture
def chair():
    return SAMPLE_FILES / "chair.off"


def test_json_holds_the_whole_episode(chair, capsys):
    main(
        [
            "recognise",
            str(chair),
            "--json",
            "--start",
            "3",
            "--threshold",
            "1",
            "--max-views",
            "4",
        ]
    )
    views = json.loads(capsys.readouterr().out)["views"]
    assert next(view["view"] for view in views) == 3
    assert len(views) == len({view["view"] for view in views}) == 4
    assert [view["next_view"] for view in views] == [
        view["view"] for view in views[1:]
    ] + [None]
    for view in views:
        assert sum(view["belief"].values()) == pytest.approx(1, abs=1e-4)
        assert view["azimuth_bin"]["belief"] > 0.5
    # it stands still
    assert (
        len(
            {(view["azimuth"] - view["azimuth_bin"]["degrees"]) % 360 for view in views}
        )
        == 1
    )
    assert views[0]["belief"] == views[0]["alone"]
    sphere = ViewSphere.named("40")
    legs = [sphere.travel[a["view"], b["view"]] for a, b in itertools.pairwise(views)]
    assert views[-1]["travel_cells"] == pytest.approx(sum(legs), abs=1e-5)


def test_several_objects_give_a_line_of_json_each_and_failures_are_named(
    chair,
    capsys,
):
    table = chair.with_name("table.off")
    with pytest.raises(SystemExit) as end:
        main(
            [
                "recognise",
                str(chair),
                "no.off",
                str(table),
                "--unit",
                "cm",
                "--json",
                "--start",
                "3",
            ]
        )
    out, err = capsys.readouterr()
    assert end.value.code == 2
    assert "no.off" in err
    assert "1 of 3 were left out" in err
    found = [json.loads(line) for line in out.splitlines()]
    assert [(one["name"], one["answer"]) for one in found] == [
        ("chair.off", "chair"),
        ("table.off", "table"),
    ]
    for one, path in zip(found, (chair, table), strict=True):
        assert (one["radius"], one["unit"]) == (
            pytest.approx(nextview.load_mesh(path, unit="cm").metres),
            "m",
        )
        assert one["beliefs"] == one["views"][-1]["belief"]
        assert (one["unknown"], one["warnings"]) == (False, [])


def test_a_rule_of_ones_own_shows_no_threshold_that_it_does_not_have(
    chair,
    tmp_path,
    monkeypatch,
    capsys,
):
    rule = "def second(seen, threshold):\n    return seen.n_views >= 2 + 0 * seen.highest\n"
    (tmp_path / "own_rule.py").write_text(rule)
    monkeypatch.chdir(tmp_path)
    command = ["recognise", str(chair), "--stopping", "own_rule:second", "--start", "3"]
    main([*command, "--figure", "episode.svg"])
    shown = capsys.readouterr().out
    assert "stops at" not in shown
    assert "2 views" in shown
    assert "enough: inf" not in (tmp_path / "episode.svg").read_text()
    main([*command, "--json"])
    assert [
        view["threshold"] for view in json.loads(capsys.readouterr().out)["views"]
    ] == [
        None,
        None,
    ]


@pytest.mark.parametrize("wrong", [{"models": 3}, {"policy": 3}, {"risk": "low"}])
def test_an_invalid_name_is_rejected(wrong):
    with pytest.raises(UsageError, match=r"(name or path|a number), not"):
        nextview.load(**wrong)


def test_every_bundled_policy_runs_live(chair, capsys):
    for name in bundled_policies():
        arguments = [
            "--policy",
            name,
            "--threshold",
            "1",
            "--max-views",
            "3",
            "--start",
            "9",
            "--json",
        ]
        main(["recognise", str(chair), *arguments])
        views = json.loads(capsys.readouterr().out)["views"]
        assert len({view["view"] for view in views}) == 3
        if name.endswith("local"):
            sphere = ViewSphere.named("40")
            for view in views[:-1]:
                assert view["next_view"] in sphere.windows[view["view"]]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["missing.off"], "no such file"),
        (["nowhere"], "nowhere: no such file"),
        (["nowhere", "--point", "0", "0", "0"], "nowhere: no such file or folder"),
        (["scans/mug", "--unit", "m"], "scans/mug: no such file or folder"),
        (["chair.off", "--start", "40"], "0 to 39"),
        (["chair.off", "--policy", "clairvoyant"], "no policy is called"),
        (["chair.off", "--risk", "0.000001"], "cannot promise"),
        (["chair.off", "--policy", "gian"], "did you mean 'gain'?"),
        (["chair.off", "--policy", "discriminate"], "is for taught things"),
        (
            ["chair.off", "--policy", "true-depth_entropy"],
            "runs only in nextview-lab benchmark",
        ),
        (["chair.off", "--figure", "chair"], "ends in .png or .pdf or .svg"),
        (["."], "is a folder of meshes, not of captured views; recognise one of them"),
    ],
)
def test_mistakes_end_in_one_sentence(chair, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(chair.parent)
    assert words in refused(capsys, "recognise", *arguments)


def test_bundled_models_agree_with_their_cards():
    cards = bundled_cards()
    assert {card.kind for card in cards.values()} >= {"recogniser", "lem"}
    # nothing that is pickled
    assert {path.suffix for path in BUNDLED_MODELS.iterdir()} <= {
        ".onnx",
        ".json",
        ".safetensors",
    }
    assert sum(card.path.stat().st_size for card in cards.values()) < 90e6
    for card in cards.values():
        training = card.training
        assert training.data
        assert training.commands
        if card.kind == "features" or card.memory is not None:
            continue
        assert training.recipes
        judged = [of.split(" (")[0] for of in card.scores]
        assert judged == (
            ["validation", "test", "test"] if card.size else ["validation", "test"]
        )


def test_wrong_models_are_refused():
    with pytest.raises(ModelError, match="not a recogniser"):
        NetworkRecogniser("lem-modelnet10")
    with pytest.raises(ModelError, match="not a map network"):
        MapNetwork(RECOGNISER)


def test_inference_never_imports_torch(chair):
    code = (
        f"main(['recognise', {str(chair)!r}, '--json']); assert not {{'torch', 'onnx'}} &"
        " {*sys.modules}"
    )
    assert (
        run_python(f"import sys; from nextview.cli.main import main; {code}").returncode
        == 0
    )


def test_the_figure_explains_its_colours_and_angles():
    figure = nextview.recognise(SAMPLE_FILES / "table.off", start=33).plot()
    texts = [text.get_text() for text in figure.findobj(Text)]
    assert {"low", "high"} <= set(texts)
    assert any(text.endswith("up, 45° around") for text in texts)


# Names in any script, and terminals of any encoding


@pytest.mark.parametrize(
    "encoding",
    ["ascii", "cp1252", "latin-1", "utf-8", "ascii:strict"],
)
def test_an_output_of_any_encoding_shows_everything(encoding, tmp_path):
    mesh = tmp_path / "椅子ü.off"
    shutil.copy(SAMPLE_FILES / "chair.off", mesh)
    code = (
        f"from nextview.cli.main import main; main(['recognise', {str(mesh)!r}, '--max-views',"
        " '1'])"
    )
    done = run_python(
        code,
        env=os.environ | {"PYTHONIOENCODING": encoding},
        encoding=encoding.partition(":")[0],
    )
    assert done.returncode == 0, done.stderr
    name = "椅子" if encoding == "utf-8" else "\\u6905\\u5b50"
    assert name in done.stdout
    assert "chair" in done.stdout


CHARACTER = "椅"


@pytest.fixture
def with_font(tmp_path):
    """A font that draws one Chinese character, a filled square, among the installed ones."""
    path = tmp_path / "chinese.ttf"
    pen = TTGlyphPen(None)
    pen.moveTo((0, 0))
    for corner in ((0, 900), (900, 900), (900, 0)):
        pen.lineTo(corner)
    pen.closePath()
    empty = TTGlyphPen(None).glyph()
    font = FontBuilder(1000, isTTF=True)
    font.setupGlyphOrder([".notdef", "square"])
    font.setupCharacterMap({ord(CHARACTER): "square"})
    font.setupGlyf({".notdef": empty, "square": pen.glyph()})
    font.setupHorizontalMetrics({".notdef": (1000, 0), "square": (1000, 0)})
    font.setupHorizontalHeader(ascent=900, descent=-100)
    font.setupNameTable({"familyName": "Test Chinese", "styleName": "Regular"})
    font.setupOS2(sTypoAscender=900, usWinAscent=900, usWinDescent=100)
    font.setupPost()
    font.save(path)
    known = list(fontManager.ttflist)
    fontManager.addfont(path)
    fonts._fonts_for.cache_clear()
    yield
    fontManager.ttflist[:] = known
    fonts._fonts_for.cache_clear()


def drawn(text):
    """A figure with one text, as pixels, and the text after it was drawn."""
    figure = PlainFigure((2, 1))
    FigureCanvasAgg(figure)
    shown = figure.text(0.1, 0.4, text, fontsize=30)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba()), shown


def test_a_figure_takes_a_font_that_has_the_name(with_font, caplog):
    pixels, text = drawn(CHARACTER)
    assert text.get_fontfamily()[-1] == "Test Chinese"
    assert text.get_text() == CHARACTER
    assert not caplog.records
    dark = pixels[..., 0] < 100
    # the square of that font, and no empty box
    assert dark[np.ix_(dark.any(1), dark.any(0))].mean() > 0.9


def test_a_name_that_no_font_has_is_written_as_codes_and_one_line_says_so(caplog):
    unassigned = "\U000e0fff"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, text = drawn(f"a chair {unassigned}{unassigned}")
    assert text.get_text() == "a chair \\U000e0fff\\U000e0fff"
    (record,) = caplog.records
    assert "fonts-noto-cjk" in record.getMessage()
    assert "\n" not in record.getMessage()


def test_plain_names_look_at_no_other_font(caplog, monkeypatch):
    monkeypatch.setattr(fonts, "_fonts_for", None)
    _, text = drawn("night stand, 45° um $2")
    assert text.get_text() == "night stand, 45° um $2"
    assert not caplog.records


# Names


@pytest.mark.parametrize("name", ["", "  "])
def test_an_empty_name_is_refused(name):
    with pytest.raises(UsageError, match="empty name"):
        nextview.recognise(name)


@pytest.mark.parametrize("end", ["", ".off", ".ply"])
def test_a_name_that_is_too_long_for_the_system_is_no_file(end):
    with pytest.raises(NextviewError) as found:
        nextview.recognise(5000 * "a" + end)
    assert len(str(found.value)) < 6000
    assert "\n" not in str(found.value)


def test_a_plot_is_written_as_every_output_is(chair, tmp_path):
    result = nextview.recognise(chair, start=3)
    target = tmp_path / "kept.png"
    target.write_bytes(b"kept")
    (tmp_path / "link.png").symlink_to(target)
    (tmp_path / "folder.png").mkdir()
    for name in ("link.png", "folder.png"):
        with pytest.raises(ResultsError, match=name):
            result.plot(tmp_path / name)
    for name in ("episode", "episode.docx"):
        with pytest.raises(UsageError, match="a figure is written as"):
            result.plot(tmp_path / name)
    assert target.read_bytes() == b"kept"
    for _ in range(2):  # the second one replaces the first
        result.plot(str(tmp_path / "episode.png"))
    assert (tmp_path / "episode.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(tmp_path.iterdir())) == 4
