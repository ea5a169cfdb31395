"""Run the models over every view of a store, resumable by object."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from nextview.data.pool import counted
from nextview.errors import DAMAGED
from nextview.files import check_new, command, new_file, unfinished
from nextview.recognition.inference import MapNetwork, NetworkRecogniser
from nextview.recognition.model_card import BUNDLED_MODELS, ModelCard
from nextview.recognition.network_input import from_store
from nextview.sensing.observation import enough_shows
from nextview.types import Float32, Index
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.splits import some_objects
from nextview_lab.data.store import ViewStore, writing
from nextview_lab.errors import PredictionsError

VIEWS_PER_CALL = 8  # batch size of the networks
Cards = dict[str, ModelCard]  # of map networks, by name
Files = tuple[tuple[str, Path], ...]  # their paths


def predict(
    path: Path,
    out: Path,
    recogniser: ModelCard,
    maps: Cards,
    split: str | None = None,
    held_out: ModelCard | str | Path | None = None,
    size: bool = True,
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
) -> Iterator[tuple[int, int]]:
    """Predict all views of a store's objects and write the predictions.

    Finished parts are kept next to the output until it is complete, so an interrupted run resumes.

    Args:
        path: of the view store.
        out: .npz file to write.
        recogniser: card of the recogniser.
        maps: cards of the map networks by the names of their maps.
        split: name of the split; None for all objects.
        held_out: card, or its name or path, whose held-out objects are predicted; None for all.
        size: whether to use the size of the objects if store and card have it.
        workers: number of processes; None for one per core, 0 for this process.
        scheduler: address of a dask.distributed scheduler to use instead.
        overwrite: whether to replace an existing file.

    Yields:
        Number of finished objects, and the total.

    Raises:
        DatasetError: there are no such objects, the recogniser does not know a class, or an object
            kills its process.
        PredictionsError: the recogniser is a memory of taught things, or the maps of a network are
            of other views.
        ResultsError: the file exists or cannot be written.
    """
    path = Path(path)
    out = Path(out)
    check_new(out, overwrite)
    if recogniser.memory is not None:
        raise PredictionsError(
            f"{recogniser.card_path}: judges all views of a thing together; nextview-lab benchmark"
            " things compares policies on taught things"
        )
    store = ViewStore.open(path)
    unfit = sorted(set(maps) - set(fitting(maps, store)))
    if unfit:
        raise PredictionsError(
            f"{path}: the map {unfit[0]} of {maps[unfit[0]].name} is of other views than the"
            f" {len(store.sphere)} of the store; leave it out with --maps"
        )
    objects = some_objects(store, split, held_out)
    plan = _plan(store, objects, recogniser, maps)
    radii = store.radii[objects]
    of_size = None
    if size and recogniser.size is not None and not np.isnan(radii).all():
        of_size = recogniser.size.logits(radii).astype(np.float32)
    key = hashlib.sha256(
        repr((plan.names, plan.models)).encode() + plan.depth_entropy.tobytes()
    ).hexdigest()
    with writing(out), unfinished(out, key) as place:
        files = [place / f"{i}.npz" for i in objects]
        items = [
            item
            for item in zip(objects.tolist(), files, strict=True)
            if not item[1].exists()
        ]
        networks = tuple(
            (name, card.card_path.absolute()) for name, card in maps.items()
        )
        opened = store.path.absolute(), recogniser.card_path.absolute(), networks
        work = partial(_predict_object, opened)
        yield from counted(
            work,
            items,
            len(objects),
            lambda it: f"{path}: {store.names[it[0]]}",
            workers,
            scheduler,
        )

        arrays = _together(files)
        maps_found = {
            name.removeprefix("map/"): found
            for name, found in arrays.items()
            if name.startswith("map/")
        }
        logits = (
            arrays["logits"] if of_size is None else arrays["logits"] + of_size[:, None]
        )
        bins = arrays.get("azimuth_bins")
        replace(
            plan,
            logits=logits,
            of_size=of_size,
            azimuth_bins=bins,
            maps=maps_found,
        ).save(out, overwrite)


def fitting(maps: Cards, store: ViewStore) -> Cards:
    """Return the map networks whose maps are of the views of a store.

    Args:
        maps: cards of map networks by the names of their maps.
        store: the views.
    """
    return {
        name: card
        for name, card in maps.items()
        if MapNetwork(card.card_path, threads=1).fits(store.sphere)
    }


def _plan(
    store: ViewStore,
    objects: Index,
    recogniser: ModelCard,
    maps: Cards,
) -> Predictions:
    """Return predictions with the metadata of store and cards, and without network outputs."""
    own = [
        card
        for card in (recogniser, *maps.values())
        if card.path.parent != BUNDLED_MODELS
    ]
    made_by = [
        *store.commands,
        *(line for card in own for line in card.training.commands),
        command(),
    ]

    return replace(
        Predictions.of_objects_in(store, objects, recogniser.classes),
        models={
            name: (card.name, card.sha256)
            for name, card in ({"recogniser": recogniser} | maps).items()
        },
        valley_classes={
            name: card.valleys(recogniser.classes) for name, card in maps.items()
        },
        calibration=recogniser.calibration,
        commands=tuple(dict.fromkeys(made_by)),
    )


@lru_cache(maxsize=1)
def _open(
    store: Path,
    recogniser: Path,
    maps: Files,
) -> tuple[ViewStore, NetworkRecogniser, dict[str, MapNetwork]]:
    """Open store and networks in a process, with one thread each."""
    networks = {name: MapNetwork(card, threads=1) for name, card in maps}
    return ViewStore.open(store), NetworkRecogniser(recogniser, threads=1), networks


def _predict_object(files: tuple[Path, Path, Files], item: tuple[int, Path]) -> None:
    """Write the outputs for all views of an object, completely or not at all.

    They are zero for views without a visible object.
    """
    i, file = item
    store, recogniser, maps = _open(*files)
    specs = {recogniser.card.input} | {network.card.input for network in maps.values()}
    inputs = {spec: from_store(spec, store, i) for spec in specs}
    batches = [
        slice(start, start + VIEWS_PER_CALL)
        for start in range(0, len(store.sphere), VIEWS_PER_CALL)
    ]

    found: dict[str, Any] = {}
    for name, network in maps.items():
        answers = [
            network.from_inputs(inputs[network.card.input][batch]) for batch in batches
        ]
        for kind in answers[0]:
            values = np.concatenate([answer[kind] for answer in answers])
            found[f"map/{name}{kind.removeprefix(network.card.kind)}"] = values

    evidence = [
        recogniser.from_inputs(inputs[recogniser.card.input][batch])
        for batch in batches
    ]
    found["logits"] = np.concatenate([e.logits for e in evidence])
    bins = [e.azimuth_bins for e in evidence if e.azimuth_bins is not None]
    if bins:
        found["azimuth_bins"] = np.concatenate(bins)

    # views without a visible object carry no evidence
    nothing = np.array(
        [not enough_shows(depth > 0) for depth in store.read("depth", i)]
    )
    for name in {"azimuth_bins", "logits"} & found.keys():
        found[name][nothing] = 0

    with new_file(file) as part:
        np.savez(part, **found)


def _together(files: Sequence[Path]) -> dict[str, Float32]:
    """Join the arrays of all objects, (N, ...), from one file for each."""
    objects = []
    for file in files:
        try:
            with np.load(file, allow_pickle=False) as arrays:
                objects.append(dict(arrays))
        except DAMAGED as error:
            raise PredictionsError(
                f"{file}: is damaged ({error}); delete it and run again"
            ) from None
    return {name: np.stack([arrays[name] for arrays in objects]) for name in objects[0]}
