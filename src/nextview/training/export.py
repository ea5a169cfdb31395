"""From finished training runs to a model that ships: an ONNX file and its card."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.command_line import command_line
from nextview.data.predictions import Predictions
from nextview.data.splits import deduplicate, split_training
from nextview.data.store import ViewStore
from nextview.errors import ModelError
from nextview.measures.map_names import CONFIDENCE, Good, map_name
from nextview.measures.registry import find_measure
from nextview.metrics import map_scores, recogniser_scores
from nextview.models.inference import MapNetwork, Recogniser
from nextview.models.model_card import ModelCard, Training, file_hash, write_card
from nextview.models.network_input import InputSpec, from_store
from nextview.training.architectures import map_network
from nextview.training.checkpoints import load_run
from nextview.training.inputs import load_inputs
from nextview.training.maps.map_targets import target_of
from nextview.training.onnx_export import ShippedMap, ShippedRecogniser, answer, export_onnx
from nextview.training.recipes import MapRecipe
from nextview.training.recogniser.members import member, member_networks
from nextview.training.runs import read_commands, read_recipe

Progress = Callable[[Iterator[int], int, str], None]
"""Exhausts an iterator of how much is done, of so much, and may show it under a heading."""


def silently(done: Iterator[int], total: int, what: str) -> None:
    """Show nothing."""
    for _ in done:
        pass


@dataclass(frozen=True)
class Exported:
    """A model that was exported.

    Attributes:
        card: NAME.json, beside NAME.onnx.
        difference: largest, between the answers of torch and of the ONNX file on real views.
    """

    card: Path
    difference: float


@takes_paths("store", "out", many=("runs",))
def export_recogniser(
    runs: Sequence[Path],
    store: Path,
    out: Path,
    bits: Literal[8, 16] = 16,
    name: str | None = None,
    note: str = "",
    progress: Progress = silently,
) -> Exported:
    """Export one recogniser, or several whose logits are averaged, with a card of the validation scores.

    The file gives the logits as the networks do; ``calibration.stages.fit_calibration`` finds how far to trust them.

    Args:
        runs: folders of finished training runs, or cards of exported recognisers (NAME.json).
        store: that they were trained on.
        out: folder for NAME.onnx and NAME.json.
        bits: that a weight takes in the file.
        name: what to call the model; by default recogniser-DATASET, after the meshes that the store was made from.
        note: what else the card should say.
        progress: of judging the validation views.

    Raises:
        ModelError: a run is not finished or of another store, they do not fit together, or the file's answers differ
            from the networks'; a card is written only when all is well.
    """
    views = ViewStore.open(store)
    name = name or f"recogniser-{views.dataset}"
    members = [member(source, views) for source in runs]
    spec = members[0].input
    if {one.input for one in members} != {spec}:
        raise ModelError(f"{runs[0]} and the others do not take the same: geometry or image, of one size")
    held_out = frozenset.intersection(*(one.validated | one.held for one in members))
    validated = frozenset.intersection(*(one.validated for one in members))
    validation = np.flatnonzero([each in validated for each in views.names])
    if len(validation) == 0:
        raise ModelError(f"{runs[0]} and the others have no validation object in common")
    training = np.flatnonzero(views.done & (views.splits != "test") & ~np.isin(views.names, list(held_out)))
    inputs = load_inputs(store, spec.size, spec.kind)
    sample = np.concatenate([inputs[i] for i in validation[:3]])
    networks = [network for one in members for network in member_networks(one, views, sample)]

    shipped = ShippedRecogniser(networks).eval()
    weights, card = out / f"{name}.onnx", out / f"{name}.json"
    export_onnx(shipped, inputs[validation[0], :2], "input", shipped.outputs, weights, bits)
    also = runs[1:]
    command = command_line("export recogniser", runs[0], store, out, also=tuple(also), bits=bits, name=name)
    model = ModelCard(
        name,
        "recogniser",
        spec,
        file_hash(weights),
        weights,
        network=" + ".join(network.name for network in networks),
        classes=tuple(views.classes),
        azimuth_bins=shipped.azimuth_bins,
        training=Training(
            f"{len(training)} objects of the training split, {len(views.sphere)} views each",
            tuple(asdict(recipe) for one in members for recipe in one.recipes),
        ),
        note=note,
        held_out=tuple(sorted(held_out)),
    ).made_by(*views.commands, *(line for one in members for line in one.commands), command)
    write_card(card, model)
    recogniser = Recogniser(card)
    sample = np.stack([inputs[i, 5] for i in validation[:: max(1, len(validation) // 8)][:8]])
    difference = float(np.abs(answer(shipped, sample) - recogniser.from_inputs(sample).logits).max())
    if not difference < 0.1:
        card.unlink()
        raise ModelError(f"{weights}: its logits differ from the network's by up to {difference:.2g}")
    judging = deduplicate(views, validation)
    logits = _of_each(lambda i: recogniser.from_inputs(inputs[i]).logits, judging, "validation views", progress)
    scores = {_validation(judging): recogniser_scores(logits, views.labels[judging])}
    write_card(card, replace(model, scores=scores, largest_difference_to_torch=round(difference, 4)))
    return Exported(card, difference)


@takes_paths("run", "store", "out", "predictions")
def export_map(
    run: Path,
    store: Path,
    out: Path,
    predictions: Path | None = None,
    measure: str | None = None,
    bits: Literal[8, 16] = 16,
    name: str | None = None,
    note: str = "",
    progress: Progress = silently,
) -> Exported:
    """Export a trained map network with a card of its validation scores.

    Args:
        run: folder of the finished training run.
        store: that it was trained on.
        out: folder for NAME.onnx and NAME.json.
        predictions: that a map of the confidence was trained on.
        measure: whose map it predicts, for runs that do not say so; by default as the run's recipe has it.
        bits: that a weight takes in the file.
        name: what to call the model; by default MAP-DATASET, after the meshes that the store was made from.
        note: what else the card should say.
        progress: of judging the validation views.

    Raises:
        ModelError: the run is not finished, or the file's answers differ from the network's.
    """
    views = ViewStore.open(store)
    sphere, recipe = views.sphere, read_recipe(run, MapRecipe)
    measure = measure or recipe.measure
    kind = map_name(measure)
    good: Good = "peak" if measure == CONFIDENCE else find_measure(measure).good
    name = name or f"{kind.replace(':', '-')}-{views.dataset}"
    predicted = None if predictions is None else Predictions.load(predictions)
    made = () if predicted is None else predicted.commands
    target = target_of(measure, views, predicted)
    parts = split_training(views, recipe.validation, recipe.seed)
    training, validation = (target.known(part) for part in parts)
    network = load_run(map_network(recipe, sphere), run)
    shipped = ShippedMap(network).eval()
    spec = InputSpec(recipe.input, 0 if recipe.input == "cloud" else recipe.size)
    sample = from_store(spec, views, int(validation[0]))[3:11]

    weights, card = out / f"{name}.onnx", out / f"{name}.json"
    export_onnx(shipped, sample, "seen", ["map", "sphere"] if shipped.whole else ["map"], weights, bits)
    options = {"predictions": predictions, "bits": bits, "name": name}
    command = command_line("export map", run, store, out, **options)
    model = ModelCard(
        name,
        kind,
        spec,
        file_hash(weights),
        weights,
        network="PointNet with both transforms" if spec.kind == "cloud" else f"ResNet-{recipe.depth}",
        measure=measure,
        good=good,
        output="sphere" if shipped.whole else "window",
        training=Training(
            f"{len(training)} objects of the training split, {len(sphere)} views each", (asdict(recipe),)
        ),
        note=note,
        held_out=tuple(views.names[i] for i in parts[1]),  # those without values too
    ).made_by(*views.commands, *made, *read_commands(run), command)
    write_card(card, model)
    predictor = MapNetwork(card)
    difference = float(np.abs(answer(shipped, sample) - predictor.from_inputs(sample)[kind]).max())
    if not difference < 0.02:
        card.unlink()
        raise ModelError(f"{weights}: its maps differ from the network's by up to {difference:.2g}")
    judging = deduplicate(views, validation)

    def one(i: int) -> NDArray[np.float32]:
        return predictor.from_inputs(from_store(spec, views, i))[kind]

    shape = (-1, sphere.rings, 3)
    maps = _of_each(one, judging, "validation maps", progress).reshape(shape)
    true = target.values[judging][:, sphere.windows].reshape(shape)
    scores = {_validation(judging): map_scores(maps, true)}
    write_card(card, replace(model, scores=scores, largest_difference_to_torch=round(difference, 4)))
    return Exported(card, difference)


def _validation(judging: NDArray[np.int64]) -> str:
    return f"validation ({len(judging)} objects of the training split)"


def _of_each(
    one: Callable[[int], NDArray[np.float32]], objects: NDArray[np.int64], what: str, progress: Progress
) -> NDArray[np.float32]:
    """Stack what ``one`` gives for each object."""
    found: list[NDArray[np.float32]] = []

    def done() -> Iterator[int]:
        for i in objects:
            found.append(one(int(i)))
            yield len(found)

    progress(done(), len(objects), what)
    return np.stack(found)
