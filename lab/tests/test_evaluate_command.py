"""``nextview-lab evaluate`` from a file of predictions to a folder, and what it refuses."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from lab_programs import main, refused
from pipeline import some_predictions

from nextview.files import sha256_of
from nextview.recognition.model_card import ModelCard, write_card
from nextview.recognition.network_input import InputSpec

TABLES = ("accuracy", "fusion", "confusion", "reliability", "maps")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """An evaluation of two maps."""
    folder = tmp_path_factory.mktemp("evaluate")
    p = some_predictions(30, seed=1)
    replace(p, maps=p.maps | {"lcm": p.maps["lem"][::-1]}).save(folder / "p.npz")
    main(["evaluate", str(folder / "p.npz"), str(folder / "out"), "--samples", "50"])
    return folder


def table(folder, name):
    with (folder / "out" / f"{name}.csv").open() as file:
        return list(csv.DictReader(file))


def test_the_folder_holds_tables_settings_and_a_page(made):
    files = {*(f"{name}.csv" for name in TABLES), "evaluate.json", "evaluate.html"}
    assert {path.name for path in (made / "out").iterdir()} == files
    assert (
        json.loads((made / "out" / "evaluate.json").read_text())["settings"]["objects"]
        == 30
    )
    assert all(len(table(made, name)) > 1 for name in TABLES)
    assert (made / "out" / "evaluate.html").read_text().count("data:image/svg+xml") == 4
    assert sorted(path.name for path in made.iterdir() if "part" in path.name) == []


def test_scores_are_noted_on_the_cards_of_the_models_that_made_the_predictions(
    tmp_path,
    capsys,
):
    p = some_predictions(30, seed=1)
    for kind, name in (("recogniser", "net"), ("lem", "map"), ("lem", "other")):
        (tmp_path / f"{name}.onnx").write_bytes(name.encode())
        weights = tmp_path / f"{name}.onnx"
        classes = ("a", "b", "c") if kind == "recogniser" else ()
        card = ModelCard(
            name,
            kind,
            InputSpec("geometry", 16),
            sha256_of(weights),
            weights,
            classes=classes,
        )
        write_card(
            tmp_path / f"{name}.json",
            msgspec.structs.replace(card, scores={"validation": 1}),
        )
    models = {"recogniser": "net", "lem": "map"}
    models = {
        kind: (name, sha256_of(tmp_path / f"{name}.onnx"))
        for kind, name in models.items()
    }
    replace(p, models=models, splits=np.full(30, "test")).save(tmp_path / "p.npz")
    cards = [str(tmp_path / "net.json"), str(tmp_path / "map.json")]
    main(
        [
            "evaluate",
            str(tmp_path / "p.npz"),
            str(tmp_path / "o"),
            "--samples",
            "50",
            "--cards",
            *cards,
        ]
    )
    net, lem = (json.loads(Path(card).read_text())["scores"] for card in cards)
    right = p.logits.argmax(2) == p.labels[:, None]
    assert net["test (30 objects)"]["single_view"]["instance"] == pytest.approx(
        right.mean(),
        abs=1e-4,
    )
    assert net["validation"] == 1
    assert lem["test (30 objects)"].keys() >= {"mse", "regret"}
    sized = replace(
        p,
        models=models,
        splits=np.full(30, "test"),
        of_size=np.zeros((30, 3), np.float32),
    )
    sized.save(tmp_path / "sized.npz")
    main(
        [
            "evaluate",
            str(tmp_path / "sized.npz"),
            str(tmp_path / "s"),
            "--samples",
            "50",
            "--cards",
            cards[0],
        ]
    )
    scores = json.loads(Path(cards[0]).read_text())["scores"]
    assert (
        scores["test (30 objects, of known size)"]
        == scores["test (30 objects)"]
        == net["test (30 objects)"]
    )
    assert capsys.readouterr().out.count("size not known") == 1
    assert (
        "size of the objects not known"
        in (tmp_path / "s" / "evaluate.html").read_text()
    )
    said = refused(
        capsys,
        "evaluate",
        tmp_path / "p.npz",
        tmp_path / "x",
        "--cards",
        tmp_path / "other.json",
    )
    assert "not made by model other" in said
