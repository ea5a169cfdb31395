"""Run the models over every view of a store, once; resumable by object."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from nextview.data.pool import WorkerDied, each
from nextview.data.predictions import Predictions
from nextview.data.splits import duplicate_groups
from nextview.data.store import ViewStore, writing
from nextview.errors import DatasetError, PredictionsError
from nextview.files import check_new, command
from nextview.geometry.observation import enough_shows
from nextview.recognition.inference import MapNetwork, Recogniser
from nextview.recognition.model_card import BUNDLED, ModelCard
from nextview.recognition.network_input import from_store

BATCH = 8
"""Views a call of the networks."""


def predict(
    path: Path,
    out: Path,
    recognisers: Sequence[ModelCard],
    maps: dict[str, ModelCard],
    split: str | None = None,
    held_out: bool = False,
    size: bool = True,
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
) -> Iterator[tuple[int, int]]:
    """Write the predictions of a store's rendered objects.

    What is done is kept in a folder beside ``out``, so that a run that was killed goes on from there. Where ``out``
    holds the same objects and models, only what their cards say beside the networks is brought up to date.

    Args:
        path: the view store.
        out: the .npz file to make.
        recognisers: cards; each object is judged by the first of them, or see ``held_out``.
        maps: card of the network for each map.
        split: only this split.
        held_out: judge each object by a recogniser from whose training it was held out; leave out those without.
        size: let the recogniser know how large the objects are, where store and card tell.
        workers: processes; one for each core by default; 0 to work in this one.
        scheduler: address of a dask.distributed scheduler whose workers see the same files, to use instead.
        overwrite: replace predictions of other objects or models.

    Yields:
        Objects done so far, and how many there are.

    Raises:
        DatasetError: the store holds no such objects, or a class that the recogniser does not know.
        PredictionsError: ``out`` comes from another store or other models, or an object kills its process.
        ResultsError: ``out`` cannot be written.
    """
    path, out = Path(path), Path(out)
    check_new(out, overwrite=True)
    plan = _Plan.of(ViewStore.open(path), recognisers, maps, split, held_out, size)
    with writing(out):
        if out.exists() and not overwrite:
            there = Predictions.load(out)
            if (there.names, there.models) != (plan.names, plan.models) or not np.array_equal(
                there.depth_entropy, plan.depth_entropy
            ):
                raise PredictionsError(f"{out}: holds other objects or models; give another name, or --overwrite")
            arrays: dict[str, Any] = {f"map_{name}": values for name, values in there.maps.items()}
            arrays |= {"logits": there.by_shape().logits, "azimuth_bins": there.azimuth_bins}
            renewed = replace(plan.predictions(arrays), commands=there.commands)
            if _from_cards(renewed) != _from_cards(there):
                renewed.save(out, overwrite=True)
            yield len(plan.names), len(plan.names)
            return
        part = out.with_name(f".{out.name}.part")
        group = _begin(part, plan)
        done = ~np.isnan(group["logits"][:]).any((1, 2))  # they are written last
        finished, total = int(done.sum()), len(done)
        yield finished, total
        row = {int(i): at for at, i in enumerate(plan.objects)}
        items = list(zip(plan.objects[~done].tolist(), plan.judge[~done].tolist(), strict=True))
        for (i, _), found in each(partial(_predict_object, plan.networks), items, workers, scheduler):
            if isinstance(found, WorkerDied):
                raise PredictionsError(f"{path}: object {plan.store.names[i]} cannot be predicted: {found}")
            for name, values in found.items():
                group[name][row[i]] = values
            finished += 1
            yield finished, total
        plan.predictions({name: group[name][:] for name in plan.shapes}).save(out, overwrite)
        shutil.rmtree(part)


@dataclass(frozen=True)
class _Networks:
    """Where the processes find the store and the networks."""

    store: Path
    recognisers: tuple[Path, ...]
    maps: tuple[tuple[str, Path], ...]


@dataclass(frozen=True)
class _Plan:
    """What is to be predicted: which objects (rows of the store), each judged by which recogniser (index)."""

    store: ViewStore
    recognisers: tuple[ModelCard, ...]
    maps: dict[str, ModelCard]
    objects: NDArray[np.int64]
    judge: NDArray[np.int64]
    depth_entropy: NDArray[np.float32]
    of_size: NDArray[np.float32] | None

    @classmethod
    def of(
        cls,
        store: ViewStore,
        recognisers: Sequence[ModelCard],
        maps: dict[str, ModelCard],
        split: str | None,
        held_out: bool,
        size: bool,
    ) -> _Plan:
        objects = np.flatnonzero(store.done & (True if split is None else store.splits == split))
        if len(objects) == 0:
            raise DatasetError(
                f"{store.path}: holds no rendered object" + (f" of the split {split!r}" if split else "")
            )
        judge = np.zeros(len(objects), np.int64)
        if held_out:
            judge = judges(recognisers, [store.names[i] for i in objects])
            objects, judge = objects[judge >= 0], judge[judge >= 0]
        if len(objects) == 0:
            raise DatasetError(f"{store.path}: holds no object that was held out from the training of the recognisers")
        unknown = sorted({store.classes[label] for label in store.labels[objects]} - set(recognisers[0].classes))
        if unknown:
            raise DatasetError(f"{store.path}: recogniser {recognisers[0].name} does not know the class {unknown[0]!r}")
        sizes = _size_logits(store, objects, recognisers, judge) if size else None
        return cls(store, tuple(recognisers), maps, objects, judge, store.measure()[objects], sizes)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.store.names[i] for i in self.objects)

    @property
    def models(self) -> dict[str, tuple[str, str]]:
        return {"recogniser": identity(self.recognisers), **{name: identity([c]) for name, c in self.maps.items()}}

    @property
    def networks(self) -> _Networks:
        def place(card: ModelCard) -> Path:
            return card.path.with_suffix(".json").absolute()

        maps = tuple((name, place(card)) for name, card in self.maps.items())
        return _Networks(self.store.path.absolute(), tuple(map(place, self.recognisers)), maps)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape for one object of what the networks say, by the names of the arrays."""
        v, rings, azimuths = len(self.store.sphere), self.store.sphere.rings, self.store.sphere.azimuths
        classes, bins = len(self.recognisers[0].classes), self.recognisers[0].azimuth_bins
        shapes: dict[str, tuple[int, ...]] = {"logits": (v, classes)}
        if bins:
            shapes["azimuth_bins"] = (v, classes, bins)
        for name, card in self.maps.items():
            shapes[f"map_{name}"] = (v, rings, 3)
            if card.output == "sphere":
                shapes[f"map_{name}-sphere"] = (v, rings, azimuths)
        return shapes

    def predictions(self, arrays: dict[str, Any]) -> Predictions:
        """What the networks say, by the names of ``shapes``, with what store and cards say."""
        store, classes = self.store, self.recognisers[0].classes
        own = [card for card in (*self.recognisers, *self.maps.values()) if card.path.parent != BUNDLED]
        made_by = [*store.commands, *(line for card in own for line in card.training.commands), command()]
        logits = arrays["logits"]
        return Predictions(
            logits if self.of_size is None else logits + self.of_size[:, None],
            {name.removeprefix("map_"): values for name, values in arrays.items() if name.startswith("map_")},
            self.depth_entropy,
            self.names,
            np.array([classes.index(store.classes[label]) for label in store.labels[self.objects]]),
            classes,
            store.splits[self.objects],
            conflicting_objects(store)[self.objects],
            store.sphere,
            self.models,
            {name: card.valleys(classes) for name, card in self.maps.items()},
            self.recognisers[0].calibration,
            arrays.get("azimuth_bins"),
            self.of_size,
            str(store.path.resolve()),
            tuple(dict.fromkeys(made_by)),
        )


def _begin(part: Path, plan: _Plan) -> zarr.Group:
    """The arrays of a run that was cut off, or new ones full of NaN, one chunk an object."""
    views = hashlib.sha256(plan.depth_entropy.tobytes()).hexdigest()
    recipe = json.loads(json.dumps({"names": plan.names, "models": plan.models, "views": views}))
    if (part / "zarr.json").exists():
        with suppress(Exception):  # zarr and its codecs raise whatever a damaged file makes them raise
            group = zarr.open_group(part, mode="r+")
            whole = all(group[name][:].shape == (len(plan.objects), *shape) for name, shape in plan.shapes.items())
            if whole and group.attrs.asdict() == recipe:
                return group
        shutil.rmtree(part)
    group = zarr.open_group(part, mode="w-", attributes=recipe)
    for name, shape in plan.shapes.items():
        whole_shape = (len(plan.objects), *shape)
        group.create_array(name, shape=whole_shape, chunks=(1, *shape), dtype="float32", fill_value=np.nan)
    return group


def _from_cards(p: Predictions) -> tuple[Any, ...]:
    """What predictions have from elsewhere than the networks."""
    return p.valley_classes, p.calibration, p.store, None if p.of_size is None else p.of_size.tobytes()


def conflicting_objects(store: ViewStore) -> NDArray[np.bool_]:
    """Objects that look exactly like one with another label, in any split of the store, (N,) bool."""
    group = duplicate_groups(store.measure())
    several = np.zeros((group.max() + 1, len(store.classes)), bool)
    several[group, store.labels] = True
    return (several.sum(1) > 1)[group] & store.done


def _size_logits(
    store: ViewStore, objects: NDArray[np.int64], recognisers: Sequence[ModelCard], judge: NDArray[np.int64]
) -> NDArray[np.float32] | None:
    """Logits by the size of the objects, (N, C) float32; None if no recogniser knows of sizes, or the store of none."""
    radii = store.radii[objects]
    if np.isnan(radii).all() or all(card.size is None for card in recognisers):
        return None
    logits = np.zeros((len(objects), len(recognisers[0].classes)), np.float32)
    for j, card in enumerate(recognisers):
        if card.size is not None:
            logits[judge == j] = card.size.logits(radii[judge == j])
    return logits


def judges(recognisers: Sequence[ModelCard], names: Sequence[str]) -> NDArray[np.int64]:
    """Which recogniser judges each object: the first from whose training it was held out; -1 for none."""
    for card in recognisers:
        if not card.held_out:
            raise DatasetError(f"recogniser {card.name} does not name the objects that were held out from its training")
        for what in ("classes", "azimuth_bins"):
            if getattr(card, what) != getattr(recognisers[0], what):
                raise DatasetError(f"recognisers {recognisers[0].name} and {card.name} do not know the same {what}")
    targets = [name.partition("@")[0] for name in names]  # in scenes; all of the name for others
    held_out = np.array([np.isin(names, card.held_out) | np.isin(targets, card.held_out) for card in recognisers])
    return np.where(held_out.any(0), held_out.argmax(0), -1)


def identity(cards: Sequence[ModelCard]) -> tuple[str, str]:
    """Name and SHA-256 of a model; of several together, their names and the hash of their hashes."""
    if len(cards) == 1:
        return cards[0].name, cards[0].sha256
    return "+".join(c.name for c in cards), hashlib.sha256("".join(c.sha256 for c in cards).encode()).hexdigest()


@lru_cache(maxsize=1)
def _open(networks: _Networks) -> tuple[ViewStore, list[Recogniser], dict[str, MapNetwork]]:
    """Each process has its own store and networks, and one thread: objects are what runs side by side."""
    maps = {name: MapNetwork(card, threads=1) for name, card in networks.maps}
    return ViewStore.open(networks.store), [Recogniser(card, threads=1) for card in networks.recognisers], maps


def _predict_object(networks: _Networks, item: tuple[int, int]) -> dict[str, NDArray[np.float32]]:
    """Maps, azimuth bins and logits of all views of one object, by the names of their arrays; the logits last.

    A view in which nothing is seen is no evidence: its logits are all the same.
    """
    i, judge = item
    store, recognisers, maps = _open(networks)
    recogniser = recognisers[judge]
    specs = {recogniser.card.input} | {network.card.input for network in maps.values()}
    inputs = {spec: from_store(spec, store, i) for spec in specs}
    parts = [slice(start, start + BATCH) for start in range(0, len(store.sphere), BATCH)]
    found = {}
    for name, network in maps.items():
        answers = [network.from_inputs(inputs[network.card.input][p]) for p in parts]
        for kind in answers[0]:
            values = np.concatenate([answer[kind] for answer in answers])
            found[f"map_{name}{kind.removeprefix(network.card.kind)}"] = values
    evidence = [recogniser.from_inputs(inputs[recogniser.card.input][p]) for p in parts]
    if all(e.azimuth_bins is not None for e in evidence):
        found["azimuth_bins"] = np.concatenate([e.azimuth_bins for e in evidence])
    found["logits"] = np.concatenate([e.logits for e in evidence])
    nothing = np.array([not enough_shows(depth > 0) for depth in store.read("depth", i)])
    for name in {"azimuth_bins", "logits"} & found.keys():
        found[name][nothing] = 0
    return found
