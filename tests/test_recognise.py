"""The command line as a user meets it, with the bundled models."""

import itertools
import json
import os
import subprocess
import sys

import pytest
from matplotlib.image import imread
from pipeline import write_off

import nextview
from nextview import ViewSphere
from nextview.cli.main import main
from nextview.data.samples import sample_mesh
from nextview.errors import ModelError
from nextview.policies.policy_card import bundled_policies
from nextview.recognition.inference import MapNetwork, Recogniser
from nextview.recognition.model_card import BUNDLED, RECOGNISER, bundled_cards

DATA = os.environ.get("NEXTVIEW_DATA")


@pytest.fixture(scope="module")
def chair(tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "chair.off"
    write_off(path, sample_mesh("chair"))
    return path


def test_json_holds_the_whole_episode(chair, capsys):
    main(["recognise", str(chair), "--json", "--start", "3", "--threshold", "1", "--max-views", "4"])
    episode = json.loads(capsys.readouterr().out)
    views = episode["views"]
    assert next(view["view"] for view in views) == 3
    assert len(views) == len({view["view"] for view in views}) == 4
    assert [view["next_view"] for view in views] == [view["view"] for view in views[1:]] + [None]
    for view in views:
        assert sum(view["belief"].values()) == pytest.approx(1, abs=1e-4)
        assert view["azimuth_bin"]["belief"] > 0.5
    assert (
        len({(view["azimuth"] - view["azimuth_bin"]["degrees"]) % 360 for view in views}) == 1
    )  # the chair stands still
    assert views[0]["belief"] == views[0]["alone"]
    sphere = ViewSphere.named("40")
    legs = [sphere.travel[a["view"], b["view"]] for a, b in itertools.pairwise(views)]
    assert views[-1]["travel_cells"] == pytest.approx(sum(legs), abs=1e-5)


def test_same_seed_same_episode(chair, capsys):
    for policy in ("random", "lem"):
        runs = []
        for _ in range(2):
            main(["recognise", str(chair), "--policy", policy, "--threshold", "1", "--seed", "7", "--json"])
            runs.append(capsys.readouterr().out)
        assert runs[0] == runs[1]


def test_a_risk_stops_at_the_threshold_that_the_recogniser_promises(chair, capsys):
    main(["recognise", str(chair), "--risk", "0.1", "--start", "3", "--json"])
    by_risk = capsys.readouterr().out
    result = nextview.load(risk=0.1).recognise(chair, start=3)
    found = json.loads(by_risk)
    assert [view["view"] for view in found["views"]] == [view.index for view in result.views]
    assert found["confidence"] == pytest.approx(result.confidence, abs=1e-6)
    for arguments in (["--risk", "0.000001"], ["--risk", "2"], ["--risk", "0.1", "--max-views", "40"]):
        with pytest.raises(SystemExit) as end:
            main(["recognise", str(chair), *arguments])
        assert end.value.code == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_every_bundled_policy_runs_live(chair, capsys):
    for name in bundled_policies():
        arguments = ["--policy", name, "--threshold", "1", "--max-views", "3", "--start", "9", "--json"]
        main(["recognise", str(chair), *arguments])
        views = json.loads(capsys.readouterr().out)["views"]
        assert len({view["view"] for view in views}) == 3
        if name.endswith("local"):
            sphere = ViewSphere.named("40")
            for view in views[:-1]:
                assert view["next_view"] in sphere.windows[view["view"]]
    with pytest.raises(SystemExit) as end:
        main(["recognise", str(chair), "--policy", "clairvoyant"])
    assert end.value.code == 2


def test_table_and_figure(chair, tmp_path, capsys):
    figure = tmp_path / "out.png"
    main(["recognise", str(chair), "--figure", str(figure), "--start", "5"])
    assert "chair" in capsys.readouterr().out
    picture = imread(figure)
    assert picture.shape[0] > 400
    assert picture[..., :3].std() > 0.05


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["missing.off"], "no such file"),
        (["chair.off", "--start", "40"], "0 to 39"),
        (["chair.off", "--threshold", "1.5"], "between 0 and 1"),
        (["chair.off", "--max-views", "0"], "at least one view"),
        (["chair.off", "--figure", "."], "is a folder"),
        (["chair.off", "--figure", "chair"], "ends in .png or .pdf or .svg"),
        (["chair.off", "--figure", "chair.off"], "exists"),
    ],
)
def test_mistakes_end_in_one_sentence(chair, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(chair.parent)
    with pytest.raises(SystemExit) as stop:
        main(["recognise", *arguments])
    assert stop.value.code == 2
    message = capsys.readouterr().err.strip()
    assert words in message
    assert len(message.splitlines()) == 1


def test_bundled_models_are_what_their_cards_say():
    cards = bundled_cards()
    assert {card.kind for card in cards.values()} >= {"recogniser", "lem"}
    assert {path.suffix for path in BUNDLED.iterdir()} <= {".onnx", ".json", ".safetensors"}  # nothing that is pickled
    assert sum(card.path.stat().st_size for card in cards.values()) < 60e6
    for card in cards.values():
        training = card.training
        assert training.data
        assert training.commands
        assert training.recipes
        judged = [of.split(" (")[0] for of in card.scores]
        assert judged == (["validation", "test", "test"] if card.size else ["validation", "test"])


def copy_model(folder, change):
    for suffix in (".onnx", ".json"):
        source = (BUNDLED / RECOGNISER).with_suffix(suffix)
        (folder / source.name).write_bytes(change(source.read_bytes()) if suffix == ".onnx" else source.read_bytes())
    return folder / f"{RECOGNISER}.json"


@pytest.mark.parametrize("change", [lambda b: b[: len(b) // 2], lambda b: b"\x80\x04" + b, lambda b: b""])
def test_damaged_weights_are_refused(tmp_path, change):
    with pytest.raises(ModelError, match="SHA-256"):
        Recogniser(copy_model(tmp_path, change))


def test_wrong_models_are_refused(tmp_path):
    with pytest.raises(ModelError, match="not a recogniser"):
        Recogniser("lem-modelnet10")
    with pytest.raises(ModelError, match="not a map network"):
        MapNetwork(RECOGNISER)
    with pytest.raises(ModelError, match="no bundled model"):
        Recogniser("resnet999")
    (tmp_path / "foreign.json").write_text("[1, 2]")
    with pytest.raises(ModelError, match="not a model card"):
        Recogniser(tmp_path / "foreign.json")


def test_inference_never_imports_torch(chair):
    code = (
        "import sys; from nextview.cli.main import main; "
        f"main(['recognise', {str(chair)!r}, '--json']); assert 'torch' not in sys.modules"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0
