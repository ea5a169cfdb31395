"""From finished training runs to a model that ships: an ONNX file with half-precision weights, and its card."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnx
import torch
from msgspec.structs import replace
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from nextview.data.measures import find_measure
from nextview.data.metrics import map_scores, recogniser_scores
from nextview.data.predictions import Predictions
from nextview.data.progress import Track, silently
from nextview.data.splits import deduplicate
from nextview.data.store import ViewStore
from nextview.errors import ModelError, UsageError
from nextview.files import check_new, command, new_file, new_folder, sha256_of
from nextview.learning.architectures import LiteNet, ResNet, map_network, recogniser_network
from nextview.learning.inputs import load_inputs
from nextview.learning.map_training import target_of
from nextview.learning.recipes import MapRecipe, RecogniserRecipe
from nextview.learning.runs import load_run, read_recipe, read_run
from nextview.recognition.inference import BINS_OUTPUT, FEATURES_OUTPUT, MapNetwork, Recogniser
from nextview.recognition.map_names import CONFIDENCE, Good, map_name
from nextview.recognition.model_card import ModelCard, Training, write_card
from nextview.recognition.network_input import InputSpec, from_store

OPSET = 18
SMALL = 2**17


class ShippedRecogniser(nn.Module):
    """The recogniser as it ships: raw input bytes in; the mean logits out, and the features of all networks."""

    def __init__(self, networks: Sequence[nn.Module]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)
        bins = {getattr(network, "azimuths", 0) for network in networks}
        self.azimuth_bins = bins.pop() if len(bins) == 1 else 0

    @property
    def outputs(self) -> list[str]:
        """Names of what it gives."""
        return ["logits", FEATURES_OUTPUT] + [BINS_OUTPUT] * bool(self.azimuth_bins)

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        x = x.float() / 255
        features = [network.features(x) for network in self.networks]
        outputs = [network.answers(seen) for network, seen in zip(self.networks, features, strict=True)]
        logits, joined = torch.stack([each[0] for each in outputs]).mean(0), torch.cat(features, 1)
        if not self.azimuth_bins:
            return logits, joined
        return logits, joined, torch.stack([each[1] for each in outputs]).mean(0).log_softmax(2)


class ShippedMap(nn.Module):
    """A map network as it ships: the map of the window, and that of the sphere, (B, rings, azimuths), if it has it."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network, self.whole = network, network.shape[1] > 3

    def forward(self, seen: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        if seen.dtype == torch.uint8:
            seen = seen.float() / 255
        outputs = self.network(seen)[0]
        return (outputs[..., [-1, 0, 1]], outputs) if self.whole else outputs


def answer(network: nn.Module, inputs: NDArray) -> NDArray[np.float32]:
    """The first output of a network in torch for inputs (B, ...)."""
    with torch.no_grad():
        outputs = network.eval()(torch.from_numpy(inputs))
    return (outputs[0] if isinstance(outputs, tuple) else outputs).numpy()


def export_onnx(
    network: nn.Module, example: NDArray, inputs: str, outputs: list[str], path: Path, bits: int = 16
) -> None:
    """Write a network as ONNX: any batch size, weights in fewer bits, arithmetic in single precision."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns that torchvision is not installed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            network.eval(),
            (torch.from_numpy(example),),
            dynamo=True,
            input_names=[inputs],
            output_names=outputs,
            dynamic_shapes=({0: torch.export.Dim("batch")},),
            opset_version=OPSET,
            verbose=False,
        )
    model = _without_traces(_shrunk(program.model_proto, bits))
    onnx.checker.check_model(model, full_check=True)
    with new_file(path) as part:
        onnx.save(model, part)


def _without_traces(model: onnx.ModelProto) -> onnx.ModelProto:
    """Without the source lines and stack traces of the machine, which the exporter notes."""
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.value_info, *graph.input, *graph.output, *graph.initializer):
        del part.metadata_props[:]
        part.doc_string = ""
    return model


def _shrunk(model: onnx.ModelProto, bits: int) -> onnx.ModelProto:
    """Store large float32 weights in 16 or 8 bits and widen them where they are used."""
    if bits == 32:
        return model
    nodes, scales = [], []
    for weight in model.graph.initializer:
        if weight.data_type != TensorProto.FLOAT or np.prod(weight.dims) < 1024:
            continue
        name, values = weight.name, numpy_helper.to_array(weight)
        small = f"{name}_small"
        if bits == 16 or values.size < SMALL:
            weight.CopyFrom(numpy_helper.from_array(values.astype(np.float16), small))
            nodes.append(helper.make_node("Cast", [small], [name], to=TensorProto.FLOAT))
            continue
        scale = np.abs(values).max(tuple(range(1, values.ndim)), keepdims=True) / 127
        scale[scale == 0] = 1
        weight.CopyFrom(numpy_helper.from_array(np.rint(values / scale).astype(np.int8), small))
        scales.append(numpy_helper.from_array(scale.astype(np.float32), f"{name}_scale"))
        nodes.append(helper.make_node("Cast", [small], [f"{name}_steps"], to=TensorProto.FLOAT))
        nodes.append(helper.make_node("Mul", [f"{name}_steps", f"{name}_scale"], [name]))
    nodes += list(model.graph.node)
    model.graph.initializer.extend(scales)
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    return model


@dataclass(frozen=True)
class Exported:
    """A model that was exported."""

    card: Path
    difference: float


def export_recogniser(
    run: Path,
    store: Path,
    out: Path,
    also: tuple[Path, ...] = (),
    bits: Literal[8, 16] = 16,
    name: str | None = None,
    note: str = "",
    overwrite: bool = False,
    track: Track = silently,
) -> Exported:
    """Export a trained recogniser: ONNX, with a card of its validation scores. Calibrate it with nextview fit.

    Args:
        run: folder made by nextview train recogniser.
        store: that it was trained on.
        out: folder for NAME.onnx and NAME.json.
        also: further runs on the same store and input; the logits of all are averaged.
        bits: that a weight takes in the file.
        name: of the model; by default recogniser-DATASET, after the mesh folder of the store.
        note: what else the card should say.
        overwrite: replace a model of this name.
        track: follows the validation views.

    Raises:
        ModelError: a run is not finished or of another store, they do not fit together, or the file's answers differ
            from the networks'; nothing is written then.
        ResultsError: the model exists.
    """
    views, folders = ViewStore.open(store), (run, *also)
    runs, recipes = [read_run(each) for each in folders], [read_recipe(each, RecogniserRecipe) for each in folders]
    spec = InputSpec(recipes[0].input, recipes[0].size)
    if {(recipe.input, recipe.size) for recipe in recipes} != {(spec.kind, spec.size)}:
        raise ModelError(f"{run} and the others do not take the same: geometry or image, of one size")
    held_out = frozenset.intersection(*(frozenset(each.held_out) for each in runs))
    validated = frozenset.intersection(*(frozenset(each.validation) for each in runs))
    validation = np.flatnonzero(np.isin(views.names, list(validated)))
    if len(validation) == 0:
        raise ModelError(f"{run} and the others have no validation object of {store} in common")
    training = np.flatnonzero(views.done & (views.splits == "train") & ~np.isin(views.names, list(held_out)))
    inputs = load_inputs(store, spec.size, spec.kind)
    networks = [run_network(each, recipe, views) for each, recipe in zip(folders, recipes, strict=True)]
    shipped = ShippedRecogniser(networks).eval()
    model = ModelCard(
        name or f"recogniser-{views.dataset}",
        "recogniser",
        spec,
        "",
        Path(),
        network=" + ".join(network.name for network in networks),
        classes=tuple(views.classes),
        azimuth_bins=shipped.azimuth_bins,
        training=Training(
            f"{len(training)} objects of the training split, {len(views.sphere)} views each",
            tuple(asdict(recipe) for recipe in recipes),
        ),
        note=note,
        held_out=tuple(sorted(held_out)),
    ).made_by(*views.commands, *(line for each in runs for line in each.commands), command())
    with _written(out, model, overwrite) as (part, finish):
        export_onnx(shipped, inputs[validation[0], :2], "input", shipped.outputs, part.with_suffix(".onnx"), bits)
        finish({}, 0.0)
        recogniser = Recogniser(part)
        sample = np.stack([inputs[i, 5] for i in validation[:: max(1, len(validation) // 8)][:8]])
        difference = float(np.abs(answer(shipped, sample) - recogniser.from_inputs(sample).logits).max())
        if not difference < 0.1:
            raise ModelError(
                f"{part.stem}: its logits differ from the network's by up to {difference:.2g}; not written"
            )
        judging = deduplicate(views, validation)
        logits = _of_each(lambda i: recogniser.from_inputs(inputs[i]).logits, judging, "validation views", track)
        finish({_validation(judging): recogniser_scores(logits, views.labels[judging])}, difference)
    return Exported(out / part.name, difference)


def run_network(run: Path, recipe: RecogniserRecipe, views: ViewStore) -> ResNet | LiteNet:
    """The recogniser of a finished run, in evaluation mode."""
    azimuths = views.sphere.azimuths if recipe.azimuth_bins_weight else 0
    return load_run(recogniser_network(recipe, len(views.classes), azimuths), run)


def export_map(
    run: Path,
    store: Path,
    out: Path,
    predictions: Path | None = None,
    bits: Literal[8, 16] = 16,
    name: str | None = None,
    note: str = "",
    overwrite: bool = False,
    track: Track = silently,
) -> Exported:
    """Export a trained map network: ONNX, with a card of its validation scores.

    Args:
        run: folder made by nextview train map.
        store: that it was trained on.
        out: folder for NAME.onnx and NAME.json.
        predictions: that a map of the confidence was trained on.
        bits: that a weight takes in the file.
        name: of the model; by default MEASURE-DATASET, after the mesh folder of the store.
        note: what else the card should say.
        overwrite: replace a model of this name.
        track: follows the validation maps.

    Raises:
        ModelError: the run is not finished, or the file's answers differ from the network's; nothing is written then.
        ResultsError: the model exists.
    """
    views, recipe, noted = ViewStore.open(store), read_recipe(run, MapRecipe), read_run(run)
    sphere, kind = views.sphere, map_name(recipe.measure)
    good: Good = "peak" if recipe.measure == CONFIDENCE else find_measure(recipe.measure).good
    values, there = target_of(recipe.measure, views, None if predictions is None else Predictions.load(predictions))
    held_out = np.isin(views.names, noted.held_out)
    training, validation = (
        np.flatnonzero(views.done & there & (views.splits == "train") & part) for part in (~held_out, held_out)
    )
    if len(validation) == 0:
        raise ModelError(f"{run}: was not trained on {store}")
    shipped = ShippedMap(load_run(map_network(recipe, sphere), run)).eval()
    spec = InputSpec(recipe.input, 0 if recipe.input == "cloud" else recipe.size)
    sample = from_store(spec, views, int(validation[0]))[3:11]
    model = ModelCard(
        name or f"{kind.replace(':', '-')}-{views.dataset}",
        kind,
        spec,
        "",
        Path(),
        network="PointNet with both transforms" if spec.kind == "cloud" else f"ResNet-{recipe.depth}",
        measure=recipe.measure,
        good=good,
        output="sphere" if shipped.whole else "window",
        training=Training(
            f"{len(training)} objects of the training split, {len(sphere)} views each", (asdict(recipe),)
        ),
        note=note,
        held_out=noted.held_out,
    ).made_by(*noted.commands, command())
    with _written(out, model, overwrite) as (part, finish):
        outputs = ["map", "sphere"] if shipped.whole else ["map"]
        export_onnx(shipped, sample, "seen", outputs, part.with_suffix(".onnx"), bits)
        finish({}, 0.0)
        predictor = MapNetwork(part)
        difference = float(np.abs(answer(shipped, sample) - predictor.from_inputs(sample)[kind]).max())
        if not difference < 0.02:
            raise ModelError(f"{part.stem}: its maps differ from the network's by up to {difference:.2g}; not written")
        judging, shape = deduplicate(views, validation), (-1, sphere.rings, 3)
        maps = _of_each(
            lambda i: predictor.from_inputs(from_store(spec, views, i))[kind], judging, "validation maps", track
        )
        true = values[judging][:, sphere.windows].reshape(shape)
        finish({_validation(judging): map_scores(maps.reshape(shape), true)}, difference)
    return Exported(out / part.name, difference)


@contextmanager
def _written(
    out: Path, model: ModelCard, overwrite: bool
) -> Iterator[tuple[Path, Callable[[dict[str, Any], float], None]]]:
    """A temporary path for a card, and the function that writes it beside its ONNX file; both appear at the end."""
    if Path(model.name).name != model.name:
        raise UsageError(f"--name is the name of a model, not a path: {model.name}")
    for suffix in (".json", ".onnx"):
        check_new(out / f"{model.name}{suffix}", overwrite)
    with new_folder(out, overwrite=True) as folder:
        part = folder / f"{model.name}.json"

        def finish(scores: dict[str, Any], difference: float) -> None:
            sha256 = sha256_of(part.with_suffix(".onnx"))
            write_card(
                part, replace(model, sha256=sha256, scores=scores, largest_difference_to_torch=round(difference, 4))
            )

        yield part, finish


def _validation(judging: NDArray[np.int64]) -> str:
    return f"validation ({len(judging)} objects of the training split)"


def _of_each(
    function: Callable[[int], NDArray[np.float32]], objects: NDArray[np.int64], what: str, track: Track
) -> NDArray[np.float32]:
    """Stack what a function gives for each object."""
    rows: list[NDArray[np.float32]] = []

    def done() -> Iterator[int]:
        for i in objects:
            rows.append(function(int(i)))
            yield len(rows)

    track(done(), len(objects), what)
    return np.stack(rows)
