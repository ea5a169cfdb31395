"""Run the models over every view of a store, once; resumable by object."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.data.folders import DatasetError
from nextview.data.predictions import Predictions, PredictionsError
from nextview.data.store import ViewStore
from nextview.models.card import Card
from nextview.models.cloud_input import cloud_input
from nextview.models.geometry_input import geometry_input
from nextview.models.networks import MapNetwork, Recogniser


def conflicting_objects(store: ViewStore) -> NDArray[np.bool_]:
    """Objects that look exactly like one with another label, in any split of the store, (N,) bool.

    Byte-identical meshes have identical depth-entropies from all views, and different ones hardly ever do.
    """
    _, twin = np.unique(store.measure(), axis=0, return_inverse=True)
    several = np.zeros((twin.max() + 1, len(store.classes)), bool)
    several[twin, store.labels] = True
    return (several.sum(1) > 1)[twin] & store.done


def predict(
    path: Path,
    out: Path,
    recogniser: Card,
    maps: dict[str, Card],
    split: str | None = None,
    batch: int = 8,
    workers: int | None = None,
) -> Iterator[tuple[int, int]]:
    """Write the predictions of a store's rendered objects.

    What is done is kept in a folder beside ``out`` until all is, so that a run that was killed goes on from there.

    Args:
        path: the view store.
        out: the .npz file to make.
        recogniser: card of the recogniser.
        maps: card of the network for each map.
        split: only this split.
        batch: views a call of the networks.
        workers: processes; one for each core by default.

    Yields:
        Objects done so far, and how many there are.

    Raises:
        DatasetError: the store holds no such objects, or a class that the recogniser does not know.
        PredictionsError: ``out`` is there and comes from another store or from other models.
    """
    store = ViewStore.open(path)
    chosen = np.flatnonzero(store.done & (True if split is None else store.splits == split))
    if len(chosen) == 0:
        raise DatasetError(f"{path}: holds no rendered object" + (f" of the split {split!r}" if split else ""))
    classes = tuple(recogniser.facts["classes"])
    unknown = sorted({store.classes[label] for label in store.labels[chosen]} - set(classes))
    if unknown:
        raise DatasetError(f"{path}: recogniser {recogniser.name} does not know the class {unknown[0]!r}")
    names = tuple(store.names[i] for i in chosen)
    models = {kind: (card.name, card.sha256) for kind, card in {"recogniser": recogniser, **maps}.items()}
    if out.exists():
        there = Predictions.load(out)
        if (there.names, there.models) != (names, models):
            raise PredictionsError(f"{out}: was made from other objects or models; give another name or remove it")
        yield len(names), len(names)
        return

    n, v, rings = len(chosen), len(store.sphere), store.sphere.rings
    shapes = {"logits": (n, v, len(classes)), **{f"map_{name}": (n, v, rings, 3) for name in maps}}
    arrays = _begin(out.with_name(out.name + ".part"), {"names": names, "models": models}, shapes)
    # Logits are written last: an object counts as done when none of its logits is the NaN that the file began with.
    todo = np.flatnonzero(np.isnan(arrays["logits"]).any((1, 2)))
    total = n - len(todo)
    yield total, n
    with ProcessPoolExecutor(
        workers or os.cpu_count(), get_context("spawn"), _open, (path, recogniser, maps, batch)
    ) as pool:
        try:
            jobs = {pool.submit(_predict_object, int(chosen[row])): row for row in todo}
            for job in as_completed(jobs):
                for name, values in job.result().items():
                    arrays[name][jobs[job]] = values
                total += 1
                yield total, n
        finally:
            pool.shutdown(cancel_futures=True)

    Predictions(
        np.array(arrays["logits"]),
        {name: np.array(arrays[f"map_{name}"]) for name in maps},
        store.measure()[chosen],
        names,
        np.array([classes.index(store.classes[label]) for label in store.labels[chosen]]),
        classes,
        store.splits[chosen],
        conflicting_objects(store)[chosen],
        store.sphere,
        models,
        {name: tuple(card.facts.get("valley_classes", ())) for name, card in maps.items()},
    ).save(out)
    shutil.rmtree(out.with_name(out.name + ".part"))


def _begin(part: Path, recipe: dict, shapes: dict[str, tuple[int, ...]]) -> dict[str, np.memmap]:
    """Open the files of a run that was cut off, or begin them full of NaN: logits before maps, recipe last."""
    recipe = json.loads(json.dumps(recipe))
    note = part / "recipe.json"
    if note.exists() and json.loads(note.read_text()) == recipe:
        return {name: np.lib.format.open_memmap(part / f"{name}.npy", "r+") for name in shapes}
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    arrays = {}
    for name, shape in shapes.items():
        arrays[name] = np.lib.format.open_memmap(part / f"{name}.npy", "w+", np.float32, shape)
        arrays[name][:] = np.nan
    note.write_text(json.dumps(recipe))
    return arrays


_store: ViewStore
_recogniser: Recogniser
_maps: dict[str, MapNetwork]
_batch: int


def _open(path: Path, recogniser: Card, maps: dict[str, Card], batch: int) -> None:
    """Each process has its own store and networks, and one thread: objects are what runs side by side."""
    global _store, _recogniser, _maps, _batch
    _store, _batch = ViewStore.open(path), batch
    _recogniser = Recogniser(recogniser.path.with_suffix(".json"), threads=1)
    _maps = {name: MapNetwork(card.path.with_suffix(".json"), threads=1) for name, card in maps.items()}


def _predict_object(i: int) -> dict[str, NDArray[np.float32]]:
    """Maps and logits of all views of one object, by the names of their files; the logits last."""
    poses, intrinsics = _store.sphere.poses, _store.intrinsics
    depth, points = _store.depth(i), _store.points(i)
    # One view at a time stays in the processor's cache.
    inputs = np.concatenate(
        [geometry_input(depth[v : v + 1], poses[v : v + 1], intrinsics, _recogniser.size) for v in range(len(poses))]
    )
    clouds = cloud_input(points, poses)
    parts = [slice(start, start + _batch) for start in range(0, len(poses), _batch)]
    found = {f"map_{name}": np.concatenate([net.from_clouds(clouds[p]) for p in parts]) for name, net in _maps.items()}
    return {**found, "logits": np.concatenate([_recogniser.from_inputs(inputs[p])[0] for p in parts])}
