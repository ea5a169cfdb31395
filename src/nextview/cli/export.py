"""``nextview export``: from a training run to an ONNX model with its card."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from nextview.errors import ModelError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from nextview.training.targets import Target


SEEN = {
    "geometry": "4 channels from a depth image and its pose: facing, up, height, nearness; uint8, 0 = background",
    "image": "the shaded image, grey; uint8, 0 = background",
    "cloud": "1,024 visible points, upright, camera at azimuth zero, scaled to [0, 1] by their own extent",
}
"""What a network sees, in words."""


def export_recogniser(
    run: tyro.conf.Positional[Path],
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    also: tuple[Path, ...] = (),
    bits: Literal[8, 16] = 16,
    name: str = "recogniser-modelnet10",
    commands: tuple[str, ...] = (),
    note: str = "",
) -> None:
    """Export a trained recogniser: ONNX, calibrated on validation views, with a card of its validation scores.

    Args:
        run: folder made by nextview train recogniser; or the card of an exported recogniser (NAME.json).
        store: the store that it was trained on.
        out: folder for NAME.onnx and NAME.json.
        also: further runs or cards, of the same store and input; the logits of all are averaged.
        bits: that a weight takes in the file.
        name: what to call the model.
        commands: the commands that made the run, for the card.
        note: what else the card should say.
    """
    from dataclasses import asdict

    import numpy as np

    from nextview.cli.progress import console
    from nextview.data.splits import deduplicate
    from nextview.data.store import ViewStore
    from nextview.metrics import recogniser_scores
    from nextview.models.inference import Recogniser
    from nextview.models.model_card import write_card
    from nextview.training.inputs import load_inputs
    from nextview.training.members import member, member_networks
    from nextview.training.onnx_export import CalibratedRecogniser, answer, export_onnx, fit_temperature

    views = ViewStore.open(store)
    members = [member(source, views) for source in (run, *also)]
    size, sees = members[0].size, members[0].sees
    if {(one.size, one.sees) for one in members} != {(size, sees)}:
        raise ModelError(f"{run} and the others do not see the same: geometry or image, of one size")
    unseen = frozenset.intersection(*(one.validated | one.held for one in members))
    validated = frozenset.intersection(*(one.validated for one in members))
    validation = np.flatnonzero([name in validated for name in views.names])
    if len(validation) == 0:
        raise ModelError(f"{run} and the others have no validation object in common")
    training = np.flatnonzero(views.done & (views.splits != "test") & ~np.isin(views.names, list(unseen)))
    inputs = load_inputs(store, size, sees)
    sample = np.concatenate([inputs[i] for i in validation[:3]])
    networks = [network for one in members for network in member_networks(one, views, sample)]

    out.mkdir(parents=True, exist_ok=True)
    weights, card = out / f"{name}.onnx", out / f"{name}.json"
    facts: dict[str, Any] = {
        "name": name,
        "kind": "recogniser",
        "network": " + ".join(network.name for network in networks),
        "input": SEEN[sees],
        "sees": sees,
        "input_size": size,
        "classes": views.classes,
        "temperature": 1.0,
    }
    example = inputs[validation[0], :2]
    uncalibrated = CalibratedRecogniser(networks, 1.0)
    if uncalibrated.azimuth_bins:
        facts["azimuth_bins"] = uncalibrated.azimuth_bins
    export_onnx(uncalibrated, example, "input", uncalibrated.outputs, weights, bits)
    write_card(card, facts)
    plain, judging = Recogniser(card), deduplicate(views, validation)
    raw = _tracked(lambda i: plain.from_inputs(inputs[i]).logits, judging, "validation views")
    labels = views.labels[judging]
    temperature = fit_temperature(raw.reshape(-1, raw.shape[2]), np.repeat(labels, raw.shape[1]))

    shipped = CalibratedRecogniser(networks, temperature).eval()
    export_onnx(shipped, example, "input", shipped.outputs, weights, bits)
    write_card(card, facts)
    sample = np.stack([inputs[i, 5] for i in validation[:: max(1, len(validation) // 8)][:8]])
    difference = float(np.abs(answer(shipped, sample) - Recogniser(card).from_inputs(sample).logits).max())
    console.print(f"largest difference between torch and ONNX logits on real views: {difference:.2g}")
    if not difference < 0.1:
        raise ModelError(f"{weights}: its logits differ from the network's by up to {difference:.2g}")
    facts |= {
        "temperature": round(temperature, 4),
        "training": {
            "data": f"{len(training)} objects of the training split, {len(views.sphere)} views each",
            "recipes": [asdict(recipe) for one in members for recipe in one.recipes],
            "commands": [*(command for one in members for command in one.commands), *commands],
        },
        "scores": {f"validation ({len(judging)} objects of the training split)": recogniser_scores(raw, labels)},
        "largest_difference_to_torch": round(difference, 4),
        "note": note,
        "unseen": sorted(unseen),
    }
    write_card(card, facts)


def export_lem(
    run: tyro.conf.Positional[Path],
    store: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    bits: Literal[8, 16] = 16,
    name: str = "lem-modelnet10",
    commands: tuple[str, ...] = (),
    note: str = "",
) -> None:
    """Export a trained LEM: ONNX, with a card of its validation scores.

    Args:
        run: folder made by nextview train lem.
        store: the store that it was trained on.
        out: folder for NAME.onnx and NAME.json.
        bits: that a weight takes in the file.
        name: what to call the model.
        commands: the commands that made the run, for the card.
        note: what else the card should say.
    """
    from nextview.data.store import ViewStore
    from nextview.training.targets import entropy_target

    target = entropy_target(ViewStore.open(store))
    what = "depth-entropy, 0 .. 1 over the object's views"
    _export_map("lem", what, target, run, store, out, bits, name, commands, note)


def export_lcm(
    run: tyro.conf.Positional[Path],
    store: tyro.conf.Positional[Path],
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    bits: Literal[8, 16] = 16,
    name: str = "lcm-modelnet10",
    commands: tuple[str, ...] = (),
    note: str = "",
) -> None:
    """Export a trained LCM: ONNX, with a card of its validation scores.

    Args:
        run: folder made by nextview train lcm.
        store: the store that it was trained on.
        predictions: those that it was trained on.
        out: folder for NAME.onnx and NAME.json.
        bits: that a weight takes in the file.
        name: what to call the model.
        commands: the commands that made the run, for the card.
        note: what else the card should say.
    """
    from nextview.data.predictions import Predictions
    from nextview.data.store import ViewStore
    from nextview.training.targets import confidence_target

    target = confidence_target(ViewStore.open(store), Predictions.load(predictions))
    what = "the recogniser's confidence where it is right, else 0"
    _export_map("lcm", what, target, run, store, out, bits, name, commands, note)


def _export_map(
    kind: str,
    what: str,
    target: Target,
    run: Path,
    store: Path,
    out: Path,
    bits: int,
    name: str,
    commands: tuple[str, ...],
    note: str,
) -> None:
    import json

    import numpy as np

    from nextview.cli.progress import console
    from nextview.data.input_views import input_views
    from nextview.data.splits import deduplicate, split_training
    from nextview.data.store import ViewStore
    from nextview.metrics import map_scores
    from nextview.models.inference import MapNetwork
    from nextview.models.model_card import write_card
    from nextview.training.architectures import map_network
    from nextview.training.checkpoints import load_run
    from nextview.training.onnx_export import ShippedMap, answer, export_onnx
    from nextview.training.recipes import MapRecipe
    from nextview.training.runs import read_recipe

    recipe = read_recipe(run, MapRecipe)
    views = ViewStore.open(store)
    sphere = views.sphere
    parts = split_training(views, recipe.validation, recipe.seed)
    training, validation = map(target.known, parts)
    network = load_run(map_network(recipe, sphere), run)
    shipped = ShippedMap(network).eval()

    out.mkdir(parents=True, exist_ok=True)
    weights, card = out / f"{name}.onnx", out / f"{name}.json"
    size = recipe.size if recipe.input != "cloud" else 0
    sample = input_views(views, int(validation[0]), recipe.input, size)[3:11]
    export_onnx(shipped, sample, "seen", ["map", "sphere"] if shipped.whole else ["map"], weights, bits)
    facts: dict[str, Any] = {
        "name": name,
        "kind": kind,
        "network": f"ResNet-{recipe.depth}" if size else "PointNet with both transforms",
        "input": SEEN[recipe.input],
        "sees": recipe.input,
        "input_size": size,
        "output": f"{what}, of {sphere.rings} rings x azimuth -1, 0, +1"
        + f"; and of {sphere.rings} x {sphere.azimuths}, once round from the view" * shipped.whole,
        "around": recipe.around,
    }
    write_card(card, facts)
    predictor = MapNetwork(card)
    difference = float(np.abs(answer(shipped, sample) - predictor.from_inputs(sample)[kind]).max())
    console.print(f"largest difference between torch and ONNX maps on real views: {difference:.2g}")
    if not difference < 0.02:
        raise ModelError(f"{weights}: its maps differ from the network's by up to {difference:.2g}")

    def one(i: int) -> NDArray:
        return predictor.from_inputs(input_views(views, i, *predictor.sees))[kind]

    judging = deduplicate(views, validation)
    maps = _tracked(one, judging, "validation maps")
    shape = (-1, sphere.rings, 3)
    true = target.values[judging][:, sphere.windows]
    facts |= {
        "training": {
            "data": f"{len(training)} objects of the training split, {len(sphere)} views each",
            "recipe": json.loads((run / "recipe.json").read_text()),
            "commands": list(commands),
        },
        "scores": {
            f"validation ({len(judging)} objects of the training split)": map_scores(
                maps.reshape(shape), true.reshape(shape)
            ),
        },
        "largest_difference_to_torch": round(difference, 4),
        "note": note,
        "unseen": [views.names[i] for i in parts[1]],  # those without values too
    }
    write_card(card, facts)


def _tracked(one: Callable[[int], NDArray], objects: NDArray, what: str) -> NDArray:
    """Stack what ``one`` gives for each object, behind a progress bar."""
    import numpy as np

    from nextview.cli.progress import track

    found: list[NDArray] = []

    def done() -> Iterator[int]:
        for i in objects:
            found.append(one(int(i)))
            yield len(found)

    track(done(), len(objects), what)
    return np.stack(found)
