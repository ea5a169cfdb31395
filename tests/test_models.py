"""Models of a card and an ONNX file: what is written is read again, what does not fit is refused
in one sentence.
"""

import numpy as np
import onnx
import pytest
from factories import change_card, make_map_network, make_recogniser
from msgspec.structs import replace
from onnx import TensorProto, helper, numpy_helper

from nextview.errors import ModelError
from nextview.files import sha256_of
from nextview.geometry.camera import pinhole
from nextview.geometry.viewsphere import ViewSphere
from nextview.recognition.inference import MapNetwork, NetworkRecogniser
from nextview.recognition.model_card import bundled_cards, read_card, write_card
from nextview.sensing.observation import Observation

CLASSES = [f"class{k}" for k in range(10)]


def test_cards_are_read_as_they_were_written(tmp_path):
    (tmp_path / "card.onnx").touch()
    (tmp_path / "card.safetensors").touch()
    for card in bundled_cards().values():
        write_card(tmp_path / "card.json", card)
        assert read_card(tmp_path / "card.json") == replace(
            card, path=tmp_path / f"card{card.path.suffix}"
        )


def test_a_card_of_other_classes_or_inputs_than_its_network_is_refused_when_that_is_opened(
    tmp_path,
):
    card = make_recogniser(tmp_path, CLASSES, azimuth_bins=8)
    for values in (
        {"classes": CLASSES[:9]},
        {"azimuth_bins": 4},
        {"input": {"kind": "geometry", "size": 32}},
        {"input": {"kind": "image", "size": 16}},
    ):
        before = card.read_text()
        change_card(card, **values)
        with pytest.raises(ModelError):
            NetworkRecogniser(card)
        card.write_text(before)
    lem = make_map_network(tmp_path)
    change_card(lem, good="valley")
    assert MapNetwork(lem).card.valleys(("a", "b")) == ("a", "b")
    change_card(lem, valley_gain={"a": -0.1, "b": 0.1}, valley_classes=["b"])
    assert MapNetwork(lem).card.valleys(("a", "b")) == ("b",)
    change_card(lem, output="sphere")
    with pytest.raises(ModelError):
        MapNetwork(lem)


SEEN = Observation(
    np.pad(np.full((16, 16), 2.5, np.float32), 8),
    ViewSphere.named("40").poses[3],
    pinhole(32, 3.5),
)


def constant(model: onnx.ModelProto, name: str) -> onnx.TensorProto:
    return next(each for each in model.graph.initializer if each.name == name)


def weights_elsewhere(where: str):
    """Weights in another file, as ONNX allows."""

    def change(model: onnx.ModelProto) -> None:
        weights = constant(model, "weights")
        weights.ClearField("raw_data")
        weights.data_location = TensorProto.EXTERNAL
        weights.external_data.add(key="location", value=where)

    return change


def another_input(model: onnx.ModelProto) -> None:
    model.graph.input[0].name = model.graph.node[0].input[0] = "other"


def two_inputs(model: onnx.ModelProto) -> None:
    model.graph.input.append(
        helper.make_tensor_value_info("more", TensorProto.UINT8, ["batch", 4, 16, 16])
    )


def one_answer(model: onnx.ModelProto) -> None:
    """Of the first view alone, however many there are."""
    model.graph.node[-1].output[0] = "all"
    model.graph.initializer.extend(
        numpy_helper.from_array(np.array([k]), f"at{k}") for k in (0, 1)
    )
    model.graph.node.append(
        helper.make_node("Slice", ["all", "at0", "at1"], ["logits"])
    )


def no_numbers(model: onnx.ModelProto) -> None:
    constant(model, "weights").CopyFrom(
        numpy_helper.from_array(np.full((4, 3), np.nan, np.float32), "weights")
    )


@pytest.mark.parametrize(
    "change",
    [
        weights_elsewhere("../weights.bin"),
        weights_elsewhere("/dev/zero"),
        another_input,
        two_inputs,
        one_answer,
        no_numbers,
    ],
)
def test_a_file_that_contradicts_its_card_is_rejected(tmp_path, monkeypatch, change):
    monkeypatch.chdir(tmp_path)  # ONNX Runtime would find weights here
    (tmp_path / "models").mkdir()
    for folder in (tmp_path, tmp_path / "models"):
        (folder / "weights.bin").write_bytes(np.ones(12, np.float32).tobytes())
    card = make_recogniser(tmp_path / "models", ["a", "b", "c"])
    assert NetworkRecogniser(card, 1)([SEEN, SEEN]).logits.shape == (2, 3)
    file = card.with_suffix(".onnx")
    model = onnx.load(file)
    change(model)
    file.write_bytes(model.SerializeToString())
    with pytest.raises(ModelError):
        NetworkRecogniser(card, 1)
    change_card(card, sha256=sha256_of(file))
    with pytest.raises(ModelError) as refused:
        NetworkRecogniser(card, 1)([SEEN, SEEN])
    assert "\n" not in str(refused.value)
