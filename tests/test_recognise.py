"""The command line as a user meets it, with the bundled models."""

import itertools
import json

import pytest
from factories import SAMPLE_FILES, run_python
from programs import main

import nextview
from nextview import ViewSphere
from nextview.policies.policy_card import bundled_policies
from nextview.recognition.model_card import BUNDLED_MODELS, bundled_cards


@pytest.fixture
def chair():
    return SAMPLE_FILES / "chair.off"


def test_json_holds_the_whole_episode(chair, capsys):
    main(f"recognise {chair} --json --start 3 --threshold 1 --max-views 4".split())
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


def test_several_objects_give_a_line_of_json_each_and_failures_are_named(chair, capsys):
    table = chair.with_name("table.off")
    with pytest.raises(SystemExit) as end:
        main(f"recognise {chair} no.off {table} --unit cm --json --start 3".split())
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


def test_every_bundled_policy_runs_live(chair, capsys):
    for name in bundled_policies():
        options = "--threshold 1 --max-views 3 --start 9 --json"
        main(f"recognise {chair} --policy {name} {options}".split())
        views = json.loads(capsys.readouterr().out)["views"]
        assert len({view["view"] for view in views}) == 3
        if name.endswith("local"):
            sphere = ViewSphere.named("40")
            for view in views[:-1]:
                assert view["next_view"] in sphere.windows[view["view"]]


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


def test_inference_never_imports_torch(chair):
    code = (
        f"main(['recognise', {str(chair)!r}, '--json']); assert not {{'torch', 'onnx'}} &"
        " {*sys.modules}"
    )
    assert (
        run_python(f"import sys; from nextview.cli.main import main; {code}").returncode
        == 0
    )
