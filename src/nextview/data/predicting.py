"""Run the models over every view of a store, once; resumable by object."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.command_line import command_line
from nextview.data.lock import only_one, writing
from nextview.data.pool import WorkerDied, each
from nextview.data.predictions import Predictions
from nextview.data.splits import duplicate_groups
from nextview.data.store import ViewStore
from nextview.errors import DatasetError, PredictionsError
from nextview.models.inference import MAPS, MapNetwork, Recogniser
from nextview.models.model_card import BUNDLED, ModelCard
from nextview.models.network_input import from_store
from nextview.observation import enough_shows
from nextview.outputs import check_file, written_whole
from nextview.viewsphere import ViewSphere

RECIPE = "recipe.json"
"""In the folder of unfinished predictions: which these are."""


def conflicting_objects(store: ViewStore) -> NDArray[np.bool_]:
    """Objects that look exactly like one with another label, in any split of the store, (N,) bool."""
    group = duplicate_groups(store.measure())
    several = np.zeros((group.max() + 1, len(store.classes)), bool)
    several[group, store.labels] = True
    return (several.sum(1) > 1)[group] & store.done


@takes_paths("path", "out")
def predict(
    path: Path,
    out: Path,
    recognisers: Sequence[ModelCard],
    maps: dict[str, ModelCard],
    split: str | None = None,
    held_out: bool = False,
    size: bool = True,
    batch: int = 8,
    workers: int | None = None,
    scheduler: str | None = None,
) -> Iterator[tuple[int, int]]:
    """Write the predictions of a store's rendered objects.

    What is done is kept in a folder beside ``out`` until all is, so that a run that was killed goes on from there.

    Args:
        path: the view store.
        out: the .npz file to make.
        recognisers: cards; each object is judged by the first of them, or see ``held_out``.
        maps: card of the network for each map.
        split: only this split.
        held_out: let each object be judged by a recogniser from whose training it was held out, and leave out those
            that all were trained on.
        size: let the recogniser know how large the objects are, where store and card tell.
        batch: views a call of the networks.
        workers: processes; one for each core by default.
        scheduler: address of a dask.distributed scheduler whose workers see the same files, instead of processes here.

    Yields:
        Objects done so far, and how many there are.

    Raises:
        DatasetError: the store holds no such objects, or a class that the recogniser does not know, or another run is
            writing ``out``, or it cannot be written.
        PredictionsError: ``out`` is there and comes from another store or other models, or an object kills its process.
            Where it comes from the same, only what the cards say beside the networks (valley classes, sizes,
            calibration) and the place of the store are brought up to date. Or what lies in the folder beside it is not
            of such a run.
        ResultsError: ``out`` cannot be written.
    """
    check_file(out)
    store = ViewStore.open(path)
    chosen = np.flatnonzero(store.done & (True if split is None else store.splits == split))
    if len(chosen) == 0:
        raise DatasetError(f"{path}: holds no rendered object" + (f" of the split {split!r}" if split else ""))
    judge = judges(recognisers, [store.names[i] for i in chosen]) if held_out else np.zeros(len(chosen), np.int64)
    chosen, judge = chosen[judge >= 0], judge[judge >= 0]
    if len(chosen) == 0:
        raise DatasetError(f"{path}: holds no object that was held out from the training of one of these recognisers")
    recogniser = recognisers[0]
    classes = recogniser.classes
    unknown = sorted({store.classes[label] for label in store.labels[chosen]} - set(classes))
    if unknown:
        raise DatasetError(f"{path}: recogniser {recogniser.name} does not know the class {unknown[0]!r}")
    names = tuple(store.names[i] for i in chosen)
    models = {"recogniser": identity(recognisers), **{name: identity([card]) for name, card in maps.items()}}
    valleys = {name: card.valleys(classes) for name, card in maps.items()}
    calibration = recogniser.calibration
    own = [card for card in (*recognisers, *maps.values()) if card.path.parent != BUNDLED]
    commands = tuple(
        dict.fromkeys(
            (
                *store.commands,
                *(line for card in own for line in card.training.commands),
                _command(path, out, recognisers, maps, split, held_out, size),
            )
        )
    )
    entropy = store.measure()[chosen]  # differs where the views do
    of_size = sizes_say(store, chosen, recognisers, judge) if size else None
    if out.exists():
        there = Predictions.load(out)
        if (there.names, there.models) != (names, models) or not np.array_equal(there.depth_entropy, entropy):
            raise PredictionsError(f"{out}: was made from other objects or models; give another name or remove it")
        renewed = (valleys, calibration, str(path.resolve()), None if of_size is None else of_size.tobytes())
        size_there = None if there.of_size is None else there.of_size.tobytes()
        known = (there.valley_classes, there.calibration, there.store, size_there)
        if renewed != known:
            seen = there.by_shape()
            logits = seen.logits if of_size is None else seen.logits + of_size[:, None]
            fresh = replace(seen, logits=logits, of_size=of_size, valley_classes=valleys, calibration=calibration)
            with writing(out):
                replace(fresh, store=str(path.resolve())).save(out)
        yield len(names), len(names)
        return

    recipe = {"names": names, "models": models, "views": hashlib.sha256(entropy.tobytes()).hexdigest()}
    with only_one(out):
        n, v = len(chosen), len(store.sphere)
        windows = {name: shape for kind, card in maps.items() for name, shape in map_shapes(kind, card, store.sphere)}
        azimuth_bins = recogniser.azimuth_bins
        optional = {"azimuth_bins": (n, v, len(classes), azimuth_bins)} if azimuth_bins else {}
        maps_of = {f"map_{name}": (n, v, *shape) for name, shape in windows.items()}
        shapes = {"logits": (n, v, len(classes)), **optional, **maps_of}
        with writing(out):
            arrays = _begin(out.with_name(out.name + ".part"), recipe, shapes)
        # Logits are written last: an object counts as done when none of its logits is the NaN that the file began with.
        todo = np.flatnonzero(np.isnan(arrays["logits"]).any((1, 2)))
        total = n - len(todo)
        yield total, n
        paths = (
            tuple(card.path.with_suffix(".json").absolute() for card in recognisers),
            tuple((kind, card.path.with_suffix(".json").absolute()) for kind, card in maps.items()),
        )
        say = partial(_predict_object, path.absolute(), *paths, batch)
        row = {int(i): at for at, i in enumerate(chosen)}
        items = list(zip(chosen[todo].tolist(), judge[todo].tolist(), strict=True))
        for (i, _), found in each(say, items, workers, scheduler):
            if isinstance(found, WorkerDied):
                raise PredictionsError(f"{path}: object {store.names[i]} cannot be predicted: {found}")
            for name, values in found.items():
                arrays[name][row[i]] = values
            total += 1
            yield total, n

        seen_logits = np.array(arrays["logits"])
        predictions = Predictions(
            seen_logits if of_size is None else seen_logits + of_size[:, None],
            {name: np.array(arrays[f"map_{name}"]) for name in windows},
            entropy,
            names,
            np.array([classes.index(store.classes[label]) for label in store.labels[chosen]]),
            classes,
            store.splits[chosen],
            conflicting_objects(store)[chosen],
            store.sphere,
            models,
            valleys,
            calibration,
            np.array(arrays["azimuth_bins"]) if azimuth_bins else None,
            of_size,
            str(path.resolve()),
            commands,
        )
        with writing(out):
            predictions.save(out)
        _end(out.with_name(out.name + ".part"), shapes)


def _command(
    path: Path,
    out: Path,
    recognisers: Sequence[ModelCard],
    maps: dict[str, ModelCard],
    split: str | None,
    held_out: bool,
    size: bool,
) -> str:
    """The command that makes these predictions."""

    def place(card: ModelCard) -> str:
        return card.name if card.path.parent == BUNDLED else str(card.path.with_suffix(".json"))

    named = [name if place(card) == MAPS.get(name) else f"{name}={place(card)}" for name, card in maps.items()]
    judges = tuple(place(card) for card in recognisers)
    options = {"split": split, "held_out": held_out, "recogniser": judges, "by_shape": not size}
    line = command_line("predict", path, out, **options)
    return " ".join([line, "--maps", *map(shlex.quote, named)])


def sizes_say(
    store: ViewStore, chosen: NDArray[np.int64], recognisers: Sequence[ModelCard], judge: NDArray[np.int64]
) -> NDArray[np.float32] | None:
    """What the sizes of the chosen objects say of their class to the recognisers that judge them, (N, C) float32.

    None if no recogniser knows of sizes, or the store of none.
    """
    radii = store.radii[chosen]
    found = [card.size for card in recognisers]
    if np.isnan(radii).all() or all(evidence is None for evidence in found):
        return None
    found_evidence = np.zeros((len(chosen), len(recognisers[0].classes)), np.float32)
    for j, evidence in enumerate(found):
        if evidence is not None:
            found_evidence[judge == j] = evidence.logits(radii[judge == j])
    return found_evidence


def map_shapes(name: str, card: ModelCard, sphere: ViewSphere) -> list[tuple[str, tuple[int, int]]]:
    """Names and shapes of what a map network says of a view: its window and, if it knows it, its sphere."""
    window = (name, (sphere.rings, 3))
    return [window, (f"{name}-sphere", (sphere.rings, sphere.azimuths))] if card.output == "sphere" else [window]


def judges(recognisers: Sequence[ModelCard], names: Sequence[str]) -> NDArray[np.int64]:
    """Which recogniser judges each object: the first from whose training it was held out; -1 for none.

    Raises:
        DatasetError: one of them does not name what was held out, or they do not know the same classes.
    """
    for card in recognisers:
        if not card.held_out:
            raise DatasetError(f"recogniser {card.name} does not name the objects that were held out from its training")
        for what in ("classes", "azimuth_bins"):
            if getattr(card, what) != getattr(recognisers[0], what):
                raise DatasetError(f"recognisers {recognisers[0].name} and {card.name} do not know the same {what}")
    targets = [name.partition("@")[0] for name in names]  # in worlds; all of the name for others
    held_out = np.array([np.isin(names, card.held_out) | np.isin(targets, card.held_out) for card in recognisers])
    return np.where(held_out.any(0), held_out.argmax(0), -1)


def identity(cards: Sequence[ModelCard]) -> tuple[str, str]:
    """Name and SHA-256 of a model; of several together, their names and the hash of their hashes."""
    if len(cards) == 1:
        return cards[0].name, cards[0].sha256
    return "+".join(c.name for c in cards), hashlib.sha256("".join(c.sha256 for c in cards).encode()).hexdigest()


def _begin(part: Path, recipe: dict, shapes: dict[str, tuple[int, ...]]) -> dict[str, np.memmap]:
    """Open the files of a run that was cut off, or begin them full of NaN.

    Raises:
        PredictionsError: something else has the name of their folder.
    """
    recipe = json.loads(json.dumps(recipe))
    if not os.path.lexists(part):
        with written_whole(part) as begun:
            begun.mkdir()
            for name, shape in shapes.items():
                array = np.lib.format.open_memmap(begun / f"{name}.npy", "w+", np.float32, shape)
                _claim(begun / f"{name}.npy")
                array[:] = np.nan
            (begun / RECIPE).write_text(json.dumps(recipe))
    try:
        same = not part.is_symlink() and json.loads((part / RECIPE).read_bytes()) == recipe
    except (OSError, ValueError):
        same = False
    if not same:
        raise PredictionsError(
            f"{part}: is there and is not the unfinished work of this very run; remove it or give another name"
        )
    try:
        return {name: np.lib.format.open_memmap(part / f"{name}.npy", "r+") for name in shapes}
    except (OSError, ValueError) as error:
        raise PredictionsError(f"{part}: is damaged ({error}); remove it, and it is begun anew") from None


def _end(part: Path, names: Iterable[str]) -> None:
    """Remove the files of a run that is done, and their folder if nothing else is in it."""
    for file in [part / RECIPE, *(part / f"{name}.npy" for name in names)]:
        file.unlink()
    with suppress(OSError):
        part.rmdir()


def _claim(file: Path) -> None:
    """Have the disk set aside room for a file with holes: one that fills later would kill whoever writes through a map.

    Raises:
        OSError: there is not that much room.
    """
    if hasattr(os, "posix_fallocate"):
        with file.open("r+b") as whole:
            os.posix_fallocate(whole.fileno(), 0, file.stat().st_size)


@lru_cache(maxsize=1)
def _open(
    path: Path, recognisers: tuple[Path, ...], maps: tuple[tuple[str, Path], ...]
) -> tuple[ViewStore, list[Recogniser], dict[str, MapNetwork]]:
    """Each process has its own store and networks, and one thread: objects are what runs side by side."""
    networks = {name: MapNetwork(card, threads=1) for name, card in maps}
    return ViewStore.open(path), [Recogniser(card, threads=1) for card in recognisers], networks


def _predict_object(
    path: Path, recognisers: tuple[Path, ...], maps: tuple[tuple[str, Path], ...], batch: int, item: tuple[int, int]
) -> dict[str, NDArray[np.float32]]:
    """Maps, azimuth bins and logits of all views of one object, by the names of their files; the logits last.

    A view in which nothing is seen is no evidence: its logits are all the same.
    """
    i, judge = item
    store, names_it, networks = _open(path, recognisers, maps)
    recogniser = names_it[judge]
    specs = {recogniser.card.input} | {network.card.input for network in networks.values()}
    inputs = {spec: from_store(spec, store, i) for spec in specs}
    parts = [slice(start, start + batch) for start in range(0, len(store.sphere), batch)]
    found = {}
    for name, network in networks.items():
        found_evidence = [network.from_inputs(inputs[network.card.input][p]) for p in parts]
        for kind in found_evidence[0]:
            found[f"map_{name}{kind.removeprefix(network.card.kind)}"] = np.concatenate(
                [part[kind] for part in found_evidence]
            )
    answers = [recogniser.from_inputs(inputs[recogniser.card.input][p]) for p in parts]
    if all(found_evidence.azimuth_bins is not None for found_evidence in answers):
        found["azimuth_bins"] = np.concatenate([found_evidence.azimuth_bins for found_evidence in answers])
    found["logits"] = np.concatenate([found_evidence.logits for found_evidence in answers])
    nothing = np.array([not enough_shows(depth > 0) for depth in store.read("depth", i)])
    for name in ("azimuth_bins", "logits"):
        if name in found:
            found[name][nothing] = 0
    return found
