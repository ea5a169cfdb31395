"""Cards of models and policies: what is written is read again, and what makes no sense is refused in one sentence."""

import json
import shlex
from pathlib import Path

import pytest
from tiny_models import make_map_network, make_recogniser

from nextview.command_line import command_line
from nextview.errors import ModelError, PolicyError
from nextview.models.inference import MapNetwork, Recogniser
from nextview.models.model_card import ModelCard, bundled_cards, read_card, write_card
from nextview.policies.policy_card import bundled_policies, read_policy, read_policy_card, write_policy_card
from nextview.training.recipes import MapRecipe
from nextview.viewsphere import ViewSphere

CLASSES = [f"class{k}" for k in range(10)]


def test_the_bundled_cards_are_written_as_they_are_read(tmp_path):
    for card in bundled_cards().values():
        write_card(tmp_path / "card.json", card)
        written = json.loads((tmp_path / "card.json").read_text())
        before = json.loads(card.path.with_suffix(".json").read_text())
        if before["schema"] == 1:  # the name of a map told its measure
            measures = {"lem": "depth_entropy", "lcm": "confidence"}
            own = {} if card.is_recogniser else {"measure": measures[card.kind], "good": "peak"}
            assert written == before | {"schema": 2} | own
            before = written
        assert written == before
        assert ModelCard.from_dict(written, card.path).to_dict() == written
    for path in bundled_policies().values():
        write_policy_card(tmp_path / "card.json", read_policy_card(path))
        assert (tmp_path / "card.json").read_bytes() == path.read_bytes()


def change(path, **values):
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"schema": 3}, "of schema 3, and this version of nextview reads schema 1 and 2"),
        ({"schema": None}, "of schema None"),
        ({"schema": True}, "of schema True"),
        ({"name": 7}, "'name' of the card is not a string"),
        ({"name": ""}, "a model has a name"),
        ({"sha256": "0" * 63}, "not a SHA-256"),
        ({"sha256": "G" * 64}, "not a SHA-256"),
        ({"classes": ["a", "a"]}, "not a list of different strings"),
        ({"classes": []}, "a recogniser has classes"),
        ({"classes": "abc"}, "not a list of"),
        ({"azimuth_bins": -1}, "not a whole number"),
        ({"azimuth_bins": True}, "not a whole number"),
        ({"azimuth_bins": 10**400}, "not a whole number"),
        ({"input": {"kind": "sound", "size": 16}}, "a network takes geometry"),
        ({"input": {"kind": "geometry", "size": 0}}, "a network takes geometry"),
        ({"input": "geometry"}, "the input is not a JSON object"),
        ({"calibration": {"temperature": 1e999, "correlation": 0}}, "not a finite number"),
        ({"calibration": {"temperature": 1, "correlation": 0, "extra": 0}}, "says 'extra'"),
        ({"held_out": [1]}, "not a list of"),
        ({"scores": {"test": float("inf")}}, "not a finite number|not finite"),
        ({"training": {"commands": "nextview"}}, "not a list of strings"),
        ({"colour": "red"}, "says 'colour', which this version of nextview does not know"),
    ],
)
def test_a_card_that_makes_no_sense_is_refused_in_one_sentence(tmp_path, values, sentence):
    card = make_recogniser(tmp_path, CLASSES)
    read_card(card)
    change(card, **values)
    with pytest.raises(ModelError, match=rf"^[^\n]*tiny\.json: not a model card \([^\n]*({sentence})[^\n]*$"):
        read_card(card)


@pytest.mark.parametrize(
    ("changes", "sentence"), [({"inputs": []}, "not nothing"), ({"classes": 150_000_000}, "the table is of 150000000")]
)
def test_a_gain_policy_without_inputs_or_of_other_classes_is_refused_in_one_sentence(tmp_path, changes, sentence):
    bundled = bundled_policies()["gain"]
    (tmp_path / "gain.onnx").symlink_to(bundled.with_suffix(".onnx"))
    values = json.loads(bundled.read_text())
    (tmp_path / "gain.json").write_text(json.dumps(values | {"table": values["table"] | changes}))
    with pytest.raises(PolicyError, match=rf"^[^\n]*gain\.json: not a policy card \([^\n]*{sentence}[^\n]*$"):
        read_policy(tmp_path / "gain.json", ViewSphere.named("40"))


NO_CARDS = [b"[" * 10**6, b"\xff\xfe{}", b"", b"[]", b'{"schema": 1', b'{"schema": 1' + b"0" * 9999]


@pytest.mark.parametrize("content", NO_CARDS)
def test_a_file_that_is_no_card_is_refused_in_one_sentence(tmp_path, content):
    path = tmp_path / "card.json"
    path.write_bytes(content)
    for read, error in ((read_card, ModelError), (read_policy_card, PolicyError)):
        with pytest.raises(error, match=r"^[^\n]*card\.json: not a (model|policy) card[^\n]*$"):
            read(path)


def test_a_card_of_other_classes_or_inputs_than_its_network_is_refused_when_that_is_opened(tmp_path):
    card = make_recogniser(tmp_path, CLASSES, azimuth_bins=8)
    Recogniser(card)
    for values, sentence in (
        ({"classes": CLASSES[:9]}, r"tiny\.onnx: has logits \(batch, 10\) .*, not \(batch, 9\)"),
        ({"azimuth_bins": 4}, r"has sides \(batch, 10, 8\)"),
        ({"input": {"kind": "geometry", "size": 32}}, r"has input \(batch, 4, 16, 16\)"),
        ({"input": {"kind": "image", "size": 16}}, r"has input \(batch, 4, 16, 16\)"),
    ):
        before = card.read_text()
        change(card, **values)
        with pytest.raises(ModelError, match=sentence):
            Recogniser(card)
        card.write_text(before)
    lem = make_map_network(tmp_path)
    MapNetwork(lem)
    change(lem, schema=2)
    with pytest.raises(ModelError, match="'measure'"):
        MapNetwork(lem)
    change(lem, measure="depth_entropy", good="hill")
    with pytest.raises(ModelError, match="'good'"):
        MapNetwork(lem)
    change(lem, good="valley")
    assert MapNetwork(lem).card.valleys(("a", "b")) == ("a", "b")
    change(lem, valley_gain={"a": -0.1, "b": 0.1}, valley_classes=["b"])
    assert MapNetwork(lem).card.valleys(("a", "b")) == ("b",)
    change(lem, output="sphere")
    with pytest.raises(ModelError, match="gives no sphere"):
        MapNetwork(lem)


def test_commands_are_what_a_shell_reads_as_the_same_words():
    several = (1, "two 2")
    line = command_line("fit size", Path("a b.zarr"), flag=True, off=False, none=None, several=several, n_views=0)
    words = ["nextview", "fit", "size", "a b.zarr", "--flag", "--several", "1", "two 2", "--n-views", "0"]
    assert shlex.split(line) == words
    line = command_line("train lem", "out", recipe=MapRecipe(mirror=False, reach=1))
    assert line == "nextview train lem out --reach 1 --no-mirror"
