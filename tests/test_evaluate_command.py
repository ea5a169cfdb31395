"""``nextview evaluate`` from a file of predictions to a folder, and what it refuses."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_predictions import some_predictions
from test_report import Page

from nextview.cli.main import main
from nextview.models.model_card import ModelCard, file_hash, write_card
from nextview.models.network_input import InputSpec

TABLES = ("accuracy", "fusion", "confusion", "reliability", "maps")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """An evaluation of two maps, of objects one of which has a name that would break careless HTML."""
    folder = tmp_path_factory.mktemp("evaluate")
    p = some_predictions(30, seed=1)
    names = ("<script>alert(1)</script>&", *p.names[1:])
    replace(p, names=names, maps=p.maps | {"lcm": p.maps["lem"][::-1]}).save(folder / "p.npz")
    main(["evaluate", str(folder / "p.npz"), "--out", str(folder / "out"), "--samples", "50"])
    return folder


def refused(capsys, *arguments):
    """The sentence with which a command is refused."""
    with pytest.raises(SystemExit) as stopped:
        main(["evaluate", *map(str, arguments)])
    assert stopped.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    return printed.err


def test_the_folder_holds_numbers_tables_figures_and_a_page(made):
    out = made / "out"
    pictures = sorted(path.stem for path in out.glob("*.png"))
    assert {"confusion_one_view", "confusion_all_views", "fusion", "reliability", "lem_examples", "lcm_examples"} < {
        *pictures
    }
    for name in pictures:
        with Image.open(out / f"{name}.png") as picture:
            assert np.ptp(np.asarray(picture.convert("L"))) > 100  # something is drawn
    results = json.loads((out / "results.json").read_text())
    assert results["settings"]["objects"] == 30
    for name in TABLES:
        with (out / f"{name}.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == len(results[name]) > 1
        for row, same in zip(rows, results[name], strict=True):
            assert {k for k, value in row.items() if value != ""} - {"label"} == same.keys() - {"label"}
            assert all(float(row[k]) == value for k, value in same.items() if isinstance(value, float))
    assert sorted(path.name for path in made.iterdir() if "part" in path.name) == []


def test_the_page_is_whole_and_needs_nothing_from_outside(made):
    text = (made / "out" / "evaluate.html").read_text()
    page = Page(text)
    assert page.open == []
    assert len(page.ids) == len(set(page.ids))
    assert all(link.startswith(("#", "data:")) for link in page.links)
    assert all(link[1:] in page.ids for link in page.links if link.startswith("#"))
    assert not re.search(r"@import|url\(|https?://(?!www\.w3\.org)", text)
    assert len(page.images) == len(list((made / "out").glob("*.png")))
    assert all(len(image["alt"]) > 10 for image in page.images)


def test_the_page_shows_the_numbers_of_the_results(made):
    results = json.loads((made / "out" / "results.json").read_text())
    text = (made / "out" / "evaluate.html").read_text()
    of = {(row["n_views"], row["label"], row["measure"]): row["value"] for row in results["accuracy"]}
    cells = re.findall(r"<td>([\d.]+)", re.search(r'<tr><th scope="row">pillar</th>.*?</tr>', text)[0])
    assert cells == [
        "10",
        *(f"{of[n_views, 'pillar', m]:.3f}" for n_views in (1, 40) for m in ("accuracy", "clean_accuracy")),
    ]
    mse = next(row["value"] for row in results["maps"] if (row["map"], row["label"]) == ("lem", "box"))
    section = text[text.index('id="lem"') : text.index('id="lcm"')]
    assert f"<td>{mse:.4f}" in re.search(r'<tr><th scope="row">box</th>.*?</tr>', section)[0]


def test_the_same_seed_gives_the_same_bytes(made):
    again = made / "again"
    main(["evaluate", str(made / "p.npz"), "--out", str(again), "--samples", "50"])
    for name in ("accuracy.csv", "fusion.csv", "lem_examples.png", "evaluate.html"):
        assert (made / "out" / name).read_bytes() == (again / name).read_bytes()


def test_the_terminal_tells_the_numbers_of_another_seed(made, capsys):
    main(["evaluate", str(made / "p.npz"), "--out", str(made / "told"), "--samples", "50", "--seed", "1"])
    printed = capsys.readouterr().out
    results = json.loads((made / "told" / "results.json").read_text())
    for row in results["accuracy"]:
        if row["measure"] == "class_accuracy" or row["label"] == "ball":
            assert f"{row['value']:.3f}" in printed
    assert "LEM" in printed
    assert "LCM" in printed
    for name in ("fusion.csv", "lem_examples.png"):
        assert (made / "out" / name).read_bytes() != (made / "told" / name).read_bytes()


def test_other_spheres_and_no_maps(tmp_path, capsys):
    p = some_predictions(6)
    p = replace(p, maps={}, logits=p.logits[:, :12], depth_entropy=p.depth_entropy[:, :12],
                sphere=type(p.sphere).named("12"))  # fmt: skip
    p.save(tmp_path / "p.npz")
    main(["evaluate", str(tmp_path / "p.npz"), "--out", str(tmp_path / "out"), "--samples", "20"])
    assert "maps: these predictions hold none" in capsys.readouterr().out
    text = (tmp_path / "out" / "evaluate.html").read_text()
    assert "all 12 views" in text
    assert "these predictions hold none" in text
    ring = replace(p, maps={"lem": np.random.default_rng(0).random((6, 12, 1, 3)).astype(np.float32)})
    ring.save(tmp_path / "ring.npz")
    main(["evaluate", str(tmp_path / "ring.npz"), "--out", str(tmp_path / "out"), "--samples", "20"])
    assert (tmp_path / "out" / "lem_examples.png").exists()


def test_copies_of_a_shape_are_judged_once_where_that_is_asked_for(tmp_path):
    p = some_predictions(6)
    rows = np.array([0, 1, 2, 3, 4, 0])
    replace(p, depth_entropy=p.depth_entropy[rows], labels=p.labels[rows]).save(tmp_path / "p.npz")
    for more, objects in (([], 6), (["--deduplicate"], 5)):
        main(["evaluate", str(tmp_path / "p.npz"), "--out", str(tmp_path / "out"), "--samples", "5", *more])
        settings = json.loads((tmp_path / "out" / "results.json").read_text())["settings"]
        assert settings["objects"] == objects
        assert settings["deduplicate"] == bool(more)


def test_one_object_is_enough(tmp_path):
    some_predictions(1).save(tmp_path / "p.npz")
    main(["evaluate", str(tmp_path / "p.npz"), "--out", str(tmp_path / "out"), "--samples", "5"])
    assert json.loads((tmp_path / "out" / "results.json").read_text())["settings"]["objects"] == 1


def test_many_classes(tmp_path):
    rng, n = np.random.default_rng(0), 40
    p = some_predictions(n)
    p = replace(p, logits=rng.normal(size=(n, 40, n)).astype(np.float32), labels=np.arange(n),
                classes=tuple(f"class_{i}" for i in range(n)))  # fmt: skip
    p.save(tmp_path / "p.npz")
    main(["evaluate", str(tmp_path / "p.npz"), "--out", str(tmp_path / "out"), "--samples", "5"])
    assert (tmp_path / "out" / "lem_examples.png").exists()


def test_splits_are_never_mixed(tmp_path, capsys):
    p = some_predictions(6)
    replace(p, splits=np.array(["train", "test"] * 3)).save(tmp_path / "p.npz")
    assert "choose with --split" in refused(capsys, tmp_path / "p.npz", "--out", tmp_path / "out")
    main(["evaluate", str(tmp_path / "p.npz"), "--out", str(tmp_path / "out"), "--split", "test", "--samples", "5"])
    assert json.loads((tmp_path / "out" / "results.json").read_text())["settings"]["objects"] == 3


@pytest.mark.parametrize(
    ("change", "printed"),
    [
        ({"logits": np.full((6, 40, 3), np.nan, np.float32)}, "not a finite number"),
        ({"logits": np.zeros((6, 40, 2), np.float32)}, "shape"),
        ({"names": np.array([], str)}, "no objects"),
        ({"classes": np.array(["ball"]), "logits": np.zeros((6, 40, 1), np.float32), "labels": np.zeros(6, int)},
         "one class only, ball"),
    ],
)  # fmt: skip
def test_bad_predictions_are_refused_in_a_sentence(tmp_path, capsys, change, printed):
    path = tmp_path / "p.npz"
    some_predictions(6).save(path)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files} | change
    np.savez(path, **arrays)
    assert printed in refused(capsys, path, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_is_not_ours_is_left_alone(tmp_path, capsys):
    some_predictions(6).save(tmp_path / "p.npz")
    out = tmp_path / "thesis"
    out.mkdir()
    (out / "results.json").write_text("years of work")
    assert "holds no evaluation results" in refused(capsys, tmp_path / "p.npz", "--out", out)
    assert (out / "results.json").read_text() == "years of work"
    (tmp_path / "bad.npz").write_bytes(b"not an archive")
    assert "not a predictions file" in refused(capsys, tmp_path / "bad.npz", "--out", tmp_path / "out")
    assert "no such file" in refused(capsys, tmp_path / "none.npz", "--out", tmp_path / "out")


def test_a_folder_that_cannot_be_made_is_refused(tmp_path, capsys):
    some_predictions(6).save(tmp_path / "p.npz")
    with pytest.raises(SystemExit):  # a file is in the way
        main(["evaluate", str(tmp_path / "p.npz"), "--out", str(tmp_path / "p.npz" / "out"), "--samples", "5"])
    assert "cannot be written" in capsys.readouterr().err


def test_scores_are_noted_on_the_cards_of_the_models_that_made_the_predictions(tmp_path, capsys):
    p = some_predictions(30, seed=1)
    for kind, name in (("recogniser", "net"), ("lem", "map"), ("lem", "other")):
        (tmp_path / f"{name}.onnx").write_bytes(name.encode())
        weights = tmp_path / f"{name}.onnx"
        classes = ("a", "b", "c") if kind == "recogniser" else ()
        card = ModelCard(name, kind, InputSpec("geometry", 16), file_hash(weights), weights, classes=classes)
        write_card(tmp_path / f"{name}.json", replace(card, scores={"validation": 1}))
    models = {"recogniser": "net", "lem": "map"}
    models = {kind: (name, file_hash(tmp_path / f"{name}.onnx")) for kind, name in models.items()}
    replace(p, models=models, splits=np.full(30, "test")).save(tmp_path / "p.npz")
    cards = [str(tmp_path / "net.json"), str(tmp_path / "map.json")]
    main(["evaluate", str(tmp_path / "p.npz"), "--out", str(tmp_path / "o"), "--samples", "50", "--cards", *cards])
    net, lem = (json.loads(Path(card).read_text())["scores"] for card in cards)
    right = p.logits.argmax(2) == p.labels[:, None]
    assert net["test (30 objects)"]["single_view"]["instance"] == pytest.approx(right.mean(), abs=1e-4)
    assert net["validation"] == 1
    assert lem["test (30 objects)"].keys() >= {"mse", "regret"}
    sized = replace(p, models=models, splits=np.full(30, "test"), of_size=np.zeros((30, 3), np.float32))
    sized.save(tmp_path / "sized.npz")
    main(
        ["evaluate", str(tmp_path / "sized.npz"), "--out", str(tmp_path / "o"), "--samples", "50", "--cards", cards[0]]
    )
    scores = json.loads(Path(cards[0]).read_text())["scores"]
    assert scores["test (30 objects, of known size)"] == scores["test (30 objects)"] == net["test (30 objects)"]
    assert capsys.readouterr().out.count("size not known") == 1
    assert "size of the objects not known" in (tmp_path / "o" / "evaluate.html").read_text()
    assert "not made by model other" in refused(capsys, tmp_path / "p.npz", "--cards", tmp_path / "other.json")
