"""Export finished runs as an ONNX file with half-precision weights, and a card."""

import logging
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from nextview.data.progress import TrackProgress, silently
from nextview.errors import ModelError, UsageError
from nextview.files import check_new, command, new_file, new_folder, sha256_of
from nextview.recognition.inference import (
    BINS_OUTPUT,
    FEATURES_OUTPUT,
    MapNetwork,
    NetworkRecogniser,
)
from nextview.recognition.map_names import CONFIDENCE, Good, map_name
from nextview.recognition.model_card import ModelCard, Training, write_card
from nextview.recognition.network_input import InputSpec, from_store
from nextview.types import Float32, Index
from nextview_lab.data.measures import find_measure
from nextview_lab.data.metrics import map_scores, recogniser_scores
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.progress import collected
from nextview_lab.data.splits import deduplicate
from nextview_lab.data.store import ViewStore
from nextview_lab.extras import extras
from nextview_lab.training.architectures import (
    map_network,
    recogniser_network,
)
from nextview_lab.training.inputs import load_inputs
from nextview_lab.training.map_training import target_of
from nextview_lab.training.recipes import MapRecipe, RecogniserRecipe
from nextview_lab.training.runs import load_run, read_recipe, read_run

with extras():
    import onnx
    import torch
    from onnx import TensorProto, helper, numpy_helper
    from torch import Tensor, nn

OPSET = 18
SMALL_WEIGHT = 2**17


class ShippedRecogniser(nn.Module):
    """The exported recogniser: from input bytes to mean logits and all features."""

    def __init__(self, networks: Sequence[nn.Module]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)
        bins = {network.azimuths for network in networks}
        self.azimuth_bins = bins.pop() if len(bins) == 1 else 0
        self.outputs = ["logits", FEATURES_OUTPUT]
        if self.azimuth_bins:
            self.outputs.append(BINS_OUTPUT)

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        x = x.float() / 255
        features = [network.features(x) for network in self.networks]
        outputs = [
            network.answers(seen)
            for network, seen in zip(self.networks, features, strict=True)
        ]

        logits = torch.stack([each[0] for each in outputs]).mean(0)
        joined = torch.cat(features, 1)
        if not self.azimuth_bins:
            return logits, joined
        return (
            logits,
            joined,
            torch.stack([each[1] for each in outputs]).mean(0).log_softmax(2),
        )


class ShippedMap(nn.Module):
    """The exported map network: the map of the window and, if available, of the sphere."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.whole = network.shape[1] > 3
        self.outputs = ["map", "sphere"] if self.whole else ["map"]

    def forward(self, seen: Tensor) -> tuple[Tensor, ...]:
        if seen.dtype == torch.uint8:
            seen = seen.float() / 255
        outputs = self.network(seen)[0]
        return (outputs[..., [-1, 0, 1]], outputs) if self.whole else (outputs,)


def export_onnx(
    net: nn.Module,
    example: NDArray,
    inputs: str,
    outputs: list[str],
    path: Path,
    bits: int = 16,
    sides: int | None = None,
) -> None:
    """Write a network as ONNX with any batch size.

    Weights may be stored in fewer bits; the arithmetic is in single precision.

    Args:
        net: the network.
        example: of its input, (B, ...).
        inputs: name of the input.
        outputs: names of the outputs.
        path: of the file.
        bits: of each weight: 8, 16 or 32.
        sides: the last two dimensions of the input may be any multiple of this number; None for
            those of the example.
    """
    free = {0: torch.export.Dim("batch")}
    if sides is not None:
        free |= {
            axis: sides * torch.export.Dim(name)
            for axis, name in ((2, "rows"), (3, "columns"))
        }
    # suppress a warning that torchvision is not installed
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            net.eval(),
            (torch.from_numpy(example),),
            dynamo=True,
            input_names=[inputs],
            output_names=outputs,
            dynamic_shapes=(free,),
            opset_version=OPSET,
            verbose=False,
        )
    model = program.model_proto
    if bits < 32:
        _shrink(model.graph, bits)
    # Remove source lines and stack traces that the exporter adds.
    graph = model.graph
    for part in (
        model,
        graph,
        *graph.node,
        *graph.value_info,
        *graph.input,
        *graph.output,
        *graph.initializer,
    ):
        del part.metadata_props[:]
        part.doc_string = ""
    onnx.checker.check_model(model, full_check=True)
    with new_file(path) as part:
        onnx.save(model, part)


def _shrink(graph: onnx.GraphProto, bits: int) -> None:
    """Store large float32 weights in 16 or 8 bits and convert them back where they are used."""
    nodes = []
    scales = []
    for weight in graph.initializer:
        if weight.data_type != TensorProto.FLOAT or np.prod(weight.dims) < 1024:
            continue

        name = weight.name
        values = numpy_helper.to_array(weight)
        small = f"{name}_small"

        if bits == 16 or values.size < SMALL_WEIGHT:
            weight.CopyFrom(numpy_helper.from_array(values.astype(np.float16), small))
            nodes.append(
                helper.make_node("Cast", [small], [name], to=TensorProto.FLOAT)
            )
            continue

        scale = np.abs(values).max(tuple(range(1, values.ndim)), keepdims=True) / 127
        scale[scale == 0] = 1
        weight.CopyFrom(
            numpy_helper.from_array(np.rint(values / scale).astype(np.int8), small)
        )
        scales.append(
            numpy_helper.from_array(scale.astype(np.float32), f"{name}_scale")
        )
        nodes.append(
            helper.make_node("Cast", [small], [f"{name}_steps"], to=TensorProto.FLOAT)
        )
        nodes.append(
            helper.make_node("Mul", [f"{name}_steps", f"{name}_scale"], [name])
        )

    nodes += list(graph.node)
    graph.initializer.extend(scales)
    del graph.node[:]
    graph.node.extend(nodes)


@dataclass(frozen=True)
class Exported:
    """An exported model.

    Attributes:
        card: path of its card.
        difference: largest difference between the outputs of torch and of ONNX on real views.
    """

    card: Path
    difference: float


@dataclass(frozen=True)
class _Candidate:
    """A network to be exported, and the data that verify its file.

    Attributes:
        sample: views on which file and network are compared.
        judging: validation objects.
        seen: returns the views of an object as network input.
        scores: of the answers for these objects, (N, V, ...).
    """

    card: ModelCard
    network: ShippedRecogniser | ShippedMap
    sample: NDArray
    judging: Index
    seen: Callable[[int], NDArray]
    scores: Callable[[Float32], dict[str, Any]]

    def answers(self, card: Path) -> Callable[[NDArray], Float32]:
        """Return a function from views to the outputs of the file."""
        if self.card.is_recogniser:
            recogniser = NetworkRecogniser(card)
            return lambda seen: recogniser.from_inputs(seen).logits
        network = MapNetwork(card)
        return lambda seen: network.from_inputs(seen)[self.card.kind]


def export_recogniser(
    run: Path,
    store: Path,
    out: Path,
    ensemble: tuple[Path, ...] = (),
    bits: Literal[8, 16] = 16,
    name: str | None = None,
    note: str = "",
    overwrite: bool = False,
    track: TrackProgress = silently,
) -> Exported:
    """Export a trained recogniser to ONNX with a card of its validation scores.

    Calibrate it afterwards with nextview-lab fit calibration.

    Args:
        run: folder of a run of nextview-lab train recogniser.
        store: view store on which it was trained.
        out: folder for NAME.onnx and NAME.json.
        ensemble: further runs with the same store and input, whose logits are averaged with those
            of RUN.
        bits: bits per weight in the file.
        name: name of the model; by default recogniser-DATASET, after the mesh folder of the store.
        note: text to add to the card.
        overwrite: replace an existing model.

    Raises:
        ModelError: a run is not finished or used another store, runs are not compatible, or the
            outputs of the file differ.
        ResultsError: the model exists.
    """
    folders = run, *ensemble
    views = ViewStore.open(store)
    name = name or f"recogniser-{views.dataset}"
    check_new_model(out, name, overwrite)
    runs = [read_run(each) for each in folders]
    recipes = [read_recipe(each, RecogniserRecipe) for each in folders]

    if len({(recipe.input, recipe.size) for recipe in recipes}) > 1:
        raise ModelError(
            f"{folders[0]} and the others do not take the same: geometry or image, of one size"
        )
    spec = InputSpec(recipes[0].input, recipes[0].size)

    held_out = frozenset.intersection(*(frozenset(each.held_out) for each in runs))
    validation = np.flatnonzero(np.isin(views.names, list(held_out)))
    if len(validation) == 0:
        raise ModelError(
            f"{folders[0]} and the others have no validation object of {store} in common"
        )

    networks = []
    for each, recipe in zip(folders, recipes, strict=True):
        azimuths = views.sphere.azimuths if recipe.azimuth_bins_weight else 0
        network = recogniser_network(recipe, len(views.classes), azimuths)
        networks.append(load_run(network, each))
    shipped = ShippedRecogniser(networks).eval()

    card = ModelCard(
        name,
        "recogniser",
        spec,
        "",
        network=" + ".join(network.name for network in networks),
        classes=tuple(views.classes),
        azimuth_bins=shipped.azimuth_bins,
        training=_training(views, held_out, recipes),
        note=note,
        held_out=tuple(sorted(held_out)),
    ).made_by(
        *views.commands,
        *(line for each in runs for line in each.commands),
        command(),
    )

    inputs = load_inputs(store, spec.size, spec.kind)
    judging = deduplicate(views, validation)
    sample = np.stack(
        [inputs[i, 5] for i in validation[:: max(1, len(validation) // 8)][:8]]
    )
    scores = partial(recogniser_scores, labels=views.labels[judging])
    made = _Candidate(card, shipped, sample, judging, lambda i: inputs[i], scores)
    return _export(made, out, bits, track)


def export_map(
    run: Path,
    store: Path,
    out: Path,
    predictions: Path | None = None,
    bits: Literal[8, 16] = 16,
    name: str | None = None,
    note: str = "",
    overwrite: bool = False,
    track: TrackProgress = silently,
) -> Exported:
    """Export a trained map network to ONNX with a card of its validation scores.

    Args:
        run: folder of a run of nextview-lab train map.
        store: view store on which it was trained.
        out: folder for NAME.onnx and NAME.json.
        predictions: for a map of the confidence: predictions on which it was trained.
        bits: bits per weight in the file.
        name: name of the model; by default MEASURE-DATASET, after the mesh folder of the store.
        note: text to add to the card.
        overwrite: replace an existing model.
    """
    views = ViewStore.open(store)
    recipe = read_recipe(run, MapRecipe)
    noted = read_run(run)
    kind = map_name(recipe.measure)
    name = name or f"{kind.replace(':', '-')}-{views.dataset}"
    check_new_model(out, name, overwrite)
    shape = (-1, views.sphere.rings, 3)
    good: Good = (
        "peak" if recipe.measure == CONFIDENCE else find_measure(recipe.measure).good
    )

    values, there = target_of(
        recipe.measure,
        views,
        None if predictions is None else Predictions.load(predictions),
    )

    validation = np.flatnonzero(
        views.done
        & there
        & (views.splits == "train")
        & np.isin(views.names, noted.held_out)
    )
    if len(validation) == 0:
        raise ModelError(f"{run}: was not trained on {store}")

    shipped = ShippedMap(load_run(map_network(recipe, views.sphere), run)).eval()
    spec = InputSpec(recipe.input, 0 if recipe.input == "cloud" else recipe.size)
    card = ModelCard(
        name,
        kind,
        spec,
        "",
        network=(
            "PointNet with both transforms"
            if spec.kind == "cloud"
            else f"ResNet-{recipe.layers}"
        ),
        measure=recipe.measure,
        good=good,
        output="sphere" if shipped.whole else "window",
        training=_training(views, noted.held_out, [recipe], there),
        note=note,
        held_out=noted.held_out,
    ).made_by(*noted.commands, command())

    judging = deduplicate(views, validation)
    true = values[judging][:, views.sphere.windows].reshape(shape)
    seen = partial(from_store, spec, views)
    sample = seen(int(validation[0]))[3:11]
    made = _Candidate(
        card,
        shipped,
        sample,
        judging,
        seen,
        lambda maps: map_scores(maps.reshape(shape), true),
    )
    return _export(made, out, bits, track)


def _training(
    views: ViewStore,
    held_out: Iterable[str],
    recipes: Sequence[Any],
    usable: Any = True,
) -> Training:
    learned = (
        views.done
        & usable
        & (views.splits == "train")
        & ~np.isin(views.names, list(held_out))
    )
    about = (
        f"{learned.sum()} objects of the training split, {len(views.sphere)} views each"
    )
    return Training(about, tuple(asdict(recipe) for recipe in recipes))


def check_new_model(out: Path, name: str, overwrite: bool) -> None:
    """Refuse, before any work is done, a model that exists or cannot be written.

    Args:
        out: folder of the model.
        name: of the model.
        overwrite: whether a model that exists may be replaced.

    Raises:
        UsageError: the name is a path.
        ResultsError: the model exists, or cannot be written.
    """
    if Path(name).name != name:
        raise UsageError(f"--name is the name of a model, not a path: {name}")
    for suffix in (".json", ".onnx"):
        check_new(out / f"{name}{suffix}", overwrite)


def _export(
    candidate: _Candidate,
    out: Path,
    bits: int,
    track: TrackProgress,
) -> Exported:
    """Write ONNX file and card if the file agrees with the network; both or neither."""
    name = candidate.card.name
    sample = candidate.sample
    with new_folder(out, overwrite=True, last=f"{name}.json") as folder:
        part = folder / f"{name}.json"
        weights = folder / f"{name}.onnx"
        example = np.resize(sample, (2, *sample.shape[1:]))
        limit, end = (0.1, "input") if candidate.card.is_recogniser else (0.02, "seen")
        export_onnx(
            candidate.network,
            example,
            end,
            candidate.network.outputs,
            weights,
            bits,
        )
        card = replace(candidate.card, sha256=sha256_of(weights))
        write_card(part, card)
        answers = candidate.answers(part)
        with torch.no_grad():
            expected = candidate.network(torch.from_numpy(sample))[0].numpy()
        difference = float(np.abs(expected - answers(sample)).max())
        if not difference < limit:
            raise ModelError(
                f"{name}: its answers differ from the network's by up to {difference:.2g}; not"
                " written"
            )
        judging = candidate.judging
        judged = (answers(candidate.seen(int(i))) for i in judging)
        rows = collected(judged, len(judging), "validation objects", track)
        scores = {
            f"validation ({len(rows)} objects of the training split)": candidate.scores(
                np.stack(rows)
            )
        }
        write_card(
            part,
            replace(
                card,
                scores=scores,
                largest_difference_to_torch=round(difference, 4),
            ),
        )
    return Exported(out / part.name, difference)
