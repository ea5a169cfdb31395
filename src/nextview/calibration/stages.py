"""What is fitted to predictions or stored views, from files to a file: without torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.belief import PLAIN_SUM, Calibration
from nextview.calibration.fitting_set import FittingSet, fitting_set, held_out_by, load_sensed
from nextview.calibration.novelty_score import fit_novelty
from nextview.calibration.novelty_views import Known, MadeUp, features_of, known_features, made_up_features
from nextview.calibration.outliers import FAMILIES
from nextview.calibration.policy_tables import fit_class_table, fit_ring, fit_sequence
from nextview.calibration.size_density import densities, fit_weight
from nextview.calibration.temperature import fit_risk, fit_temperature, loss
from nextview.calibration.valleys import valley_gains
from nextview.calibration.visibility_weight import visibility_losses
from nextview.command_line import command_line
from nextview.data.folders import list_dataset
from nextview.data.predictions import Predictions
from nextview.data.splits import deduplicated
from nextview.data.store import ViewStore
from nextview.data.world_sight import worlds_of
from nextview.errors import DatasetError, ModelError, PredictionsError, UsageError
from nextview.models.model_card import file_hash, read_card, write_card
from nextview.models.size_evidence import SizeEvidence
from nextview.novelty import novelty_path
from nextview.policies.base import Scope
from nextview.policies.policy_card import LearnedFrom, PolicyCard, write_policy_card
from nextview.tracking import Track, silently


@dataclass(frozen=True)
class FittedCalibration:
    """What ``fit_calibration`` found.

    Attributes:
        calibration: written into the card.
        objects: fitted to.
        before, after: mean negative log-likelihood over 1 to 5 views, by the plain sum and by the calibration.
    """

    calibration: Calibration
    objects: int
    before: float
    after: float


@takes_paths("predictions", "card", many=("sensed",))
def fit_calibration(
    predictions: Path,
    card: Path,
    validation: float | None = None,
    split_seed: int = 0,
    delta: float = 0.1,
    seed: int = 0,
    sensed: Sequence[Path] = (),
) -> FittedCalibration:
    """Calibrate a recogniser: how far to trust the sum of several views, and which error rates can be promised.

    How large the objects are is left aside.

    Args:
        predictions: of the training split.
        card: of the recogniser; is written anew. Those objects are taken that it calls held out.
        validation: take this part of every class instead, as training kept it out of the whole split; 1 for
            out-of-fold predictions.
        split_seed: the recogniser's seed, which decided that part.
        delta: how often a promised error rate may not hold.
        seed: of the walks over which is fitted.
        sensed: predictions of the same objects through sensors, fitted to as well.

    Raises:
        UsageError, ModelError, PredictionsError: what was given makes no sense, or does not fit together.
    """
    if not 0 < delta < 1:
        raise UsageError(f"delta is a probability between 0 and 1, not {delta}")
    model, table = read_card(card), Predictions.load(predictions).by_shape()
    if not model.is_recogniser:
        raise ModelError(f"{card}: is a {model.kind}, not a recogniser")
    if validation != 1 and table.models["recogniser"][1] != model.sha256:
        raise PredictionsError(f"{predictions}: comes from another recogniser than {card}")
    if validation is None:
        FittingSet.of_all(table)  # refuses the test split
        kept = held_out_by(model, table)
        if len(kept) == 0:
            raise PredictionsError(f"{predictions}: holds no object that {card} calls held out; see --validation")
        table = table.of_objects(kept)
        data = FittingSet.joined([FittingSet.of_all(part) for part in (table, *load_sensed(sensed, table))])
    elif sensed:
        raise UsageError("predictions through sensors are of the objects that the card calls held out: no --validation")
    else:
        data = fitting_set(table, validation, split_seed)
    walks = 1 + 8000 // len(data)  # few objects are walked over more often
    calibration = fit_temperature(data, np.random.default_rng([seed, 0]), walks=walks)
    risk = fit_risk(data, calibration, np.random.default_rng([seed, 1]), delta, walks=walks)
    calibration = replace(calibration, risk=risk, visibility=model.calibration.visibility)
    command = command_line(
        "fit calibration", predictions, card,
        validation=validation, split_seed=split_seed, delta=delta, seed=seed, sensed=tuple(sensed),
    )  # fmt: skip
    about = _objects(len(data) // (1 + len(sensed))) + ", clean and through sensors" * bool(sensed)
    fitted_to = {**model.fitted_to, "calibration": about}
    model = replace(model, calibration=calibration, fitted_to=fitted_to)
    write_card(card, model.made_by(*table.commands, command))
    before, after = (loss(data, c, np.random.default_rng([seed, 2]), walks=walks) for c in (PLAIN_SUM, calibration))
    return FittedCalibration(calibration, len(data), before, after)


@dataclass(frozen=True)
class FittedVisibility:
    """What ``fit_visibility`` found.

    Attributes:
        power: written into the card's calibration.
        worlds: fitted to.
        losses: mean negative log-likelihood over 1 to 5 views at each power that was tried.
    """

    power: float
    worlds: int
    losses: dict[float, float]


@takes_paths("predictions", "card")
def fit_visibility(predictions: Path, card: Path, seed: int = 0) -> FittedVisibility:
    """Learn from worlds how much a view counts that shows only a share of the object.

    Args:
        predictions: of worlds of the training split; their store has to be there.
        card: of the recogniser, which is calibrated already; is written anew. Those worlds are taken around objects
            that it calls held out.
        seed: of the walks over which is fitted.

    Raises:
        ModelError, PredictionsError, DatasetError: what was given does not fit together.
    """
    model, table = read_card(card), Predictions.load(predictions).by_shape()
    if not model.is_recogniser or table.models["recogniser"][1] != model.sha256:
        raise PredictionsError(f"{predictions}: comes from another recogniser than {card}")
    FittingSet.of_all(table)  # refuses the test split
    kept = np.flatnonzero(np.isin([name.partition("@")[0] for name in table.names], model.held_out))
    if len(kept) == 0:
        raise PredictionsError(f"{predictions}: holds no world around an object that {card} calls held out")
    table = table.of_objects(kept)
    worlds = worlds_of(table)
    if worlds is None:
        raise PredictionsError(f"{predictions}: is of no worlds, or their store is gone")
    losses = visibility_losses(FittingSet.of_all(table), worlds, model.calibration, np.random.default_rng(seed))
    power = min(losses, key=lambda power: losses[power])
    command = command_line("fit visibility", predictions, card, seed=seed)
    fitted_to = {**model.fitted_to, "visibility": f"{len(table)} worlds around objects held out of its training"}
    model = replace(model, calibration=replace(model.calibration, visibility=power), fitted_to=fitted_to)
    write_card(card, model.made_by(*table.commands, command))
    return FittedVisibility(power, len(table), losses)


@dataclass(frozen=True)
class FittedSize:
    """What ``fit_size`` found.

    Attributes:
        size: written into the card.
        objects: whose sizes were learned.
        weighed_on: so many others.
        before, after: mean negative log-likelihood of single views, by shape alone and with the size.
    """

    size: SizeEvidence
    objects: int
    weighed_on: int
    before: float
    after: float


@takes_paths("store", "predictions", "card")
def fit_size(store: Path, predictions: Path, card: Path) -> FittedSize:
    """Tell a recogniser how large the objects of each class are, for stores and cameras that know it.

    Args:
        store: view store that knows the unit of its meshes; its training objects teach, except those in the
            predictions.
        predictions: of training objects that the recogniser has not seen; they decide how much the size counts.
        card: of the recogniser; is written anew.

    Raises:
        DatasetError, ModelError, PredictionsError: what was given does not fit together.
    """
    model, views, predicted = read_card(card), ViewStore.open(store), Predictions.load(predictions)
    if not model.is_recogniser:
        raise ModelError(f"{card}: is a {model.kind}, not a recogniser")
    table = predicted.deduplicate().by_shape()
    radii, labels = views.radii, views.labels
    if np.isnan(radii[views.done]).any():
        raise DatasetError(f"{store}: does not know the unit of its meshes; tell it with nextview render --unit")
    row = {name: i for i, name in enumerate(views.names)}
    strangers = [name for name in predicted.names if name not in row]
    if strangers:
        raise PredictionsError(f"{predictions}: holds {strangers[0]!r}, which {store} does not")
    if table.models["recogniser"][1] != model.sha256:
        raise PredictionsError(f"{predictions}: comes from another recogniser than {card}")
    data, judged = FittingSet.of_all(table), [row[name] for name in table.names]
    of_training = views.done & (views.splits == "train") & np.isin(views.group.attrs["labels"], table.classes)
    taught = np.setdiff1d(np.flatnonzero(of_training), [row[name] for name in predicted.names])
    classes = np.array([table.classes.index(name) if name in table.classes else -1 for name in views.classes])
    log_density = densities(radii[taught], classes[labels[taught]], len(table.classes))
    size, before, after = fit_weight(data, radii[judged], log_density)
    about = f"{len(taught)} objects of the training split, weighed on {len(data)} others"
    model = replace(model, size=size, fitted_to={**model.fitted_to, "size": about})
    command = command_line("fit size", store, predictions, card)
    write_card(card, model.made_by(*views.commands, *table.commands, command))
    return FittedSize(size, len(taught), len(data), before, after)


@dataclass(frozen=True)
class FittedUnknown:
    """What ``fit_unknown`` found.

    Attributes:
        objects: known, that the recogniser learned.
        made_up: objects that were made up.
        held_out: known objects that it did not learn, to which the false-alarm rate was calibrated.
    """

    objects: int
    made_up: int
    held_out: int


LEARNED_VIEWS, MADE_UP_VIEWS, HELD_OUT_VIEWS = 3, 4, 12
"""Views of each object to which a novelty score is fitted."""


@takes_paths("store", "meshes", "card", many=("sensed",))
def fit_unknown(
    store: Path,
    meshes: Path,
    card: Path,
    made_up: int = 1700,
    seed: int = 0,
    sensed: tuple[Path, Path] | None = None,
    workers: int | None = None,
    progress: Track = silently,
) -> FittedUnknown:
    """Teach a recogniser to tell objects of no class that it knows.

    Nothing is learned from the test split. The objects that the card calls held out calibrate the false-alarm rate.

    Args:
        store: view store of the recogniser's training objects.
        meshes: folder of their meshes, from which objects of no class are made up.
        card: of the recogniser; is written anew, and NAME.novelty.safetensors beside it.
        made_up: so many objects.
        seed: of all that is drawn.
        sensed: stores of objects that it learned and of some that it holds out, seen through sensors: both count
            as known as well, and every second made-up object is seen through the mix of sensors.
        workers: processes; one for each core by default.
        progress: of rendering and of running the recogniser.

    Raises:
        UsageError, DatasetError, ModelError: what was given makes no sense, or does not fit together.
    """
    if made_up < 1:
        raise UsageError(f"at least one object has to be made up, not {made_up}")
    model, views = read_card(card), ViewStore.open(store)
    if not model.is_recogniser:
        raise ModelError(f"{card}: is a {model.kind}, not a recogniser")
    known = np.array([name in model.classes for name in views.classes])[views.labels]
    usable = np.flatnonzero(views.done & (views.splits != "test") & known)
    kept_out = np.isin(np.array(views.names)[usable], model.held_out)
    learned, held_out = usable[~kept_out], usable[kept_out]
    if len(learned) == 0 or len(held_out) == 0:
        raise DatasetError(f"{store}: holds no object that {card} was trained on, or none that it calls held out")
    held_out = held_out[deduplicated(views.labels[held_out], views.measure()[held_out])]
    entries = [e for e in list_dataset(meshes) if e.split != "test" and e.name not in model.held_out]
    if not entries:
        raise DatasetError(f"{meshes}: holds no mesh of which an object could be made up")
    rng, places = np.random.default_rng(seed), (str(store.absolute()), str(card.absolute()))
    classes = np.array([model.classes.index(name) if name in model.classes else -1 for name in views.classes])

    def drawn(of: ViewStore, rows: NDArray[np.int64], wanted: int) -> list[Known]:
        path, views = str(of.path.absolute()), len(of.sphere)
        return [(path, places[1], int(i), tuple(rng.permutation(views).tolist()), wanted) for i in rows]

    of_learned = drawn(views, learned, LEARNED_VIEWS)
    of_held_out = drawn(views, held_out, HELD_OUT_VIEWS)
    labels, held_out_labels = (classes[views.labels[rows]] for rows in (learned, held_out))
    if sensed is not None:
        (first, at, there), (second, held_at, held_there) = (
            _rows(path, [views.names[i] for i in rows]) for path, rows in zip(sensed, (learned, held_out), strict=True)
        )
        of_learned += drawn(first, at, LEARNED_VIEWS)
        of_held_out += drawn(second, held_at, HELD_OUT_VIEWS)
        labels = np.concatenate([labels, labels[there]])
        held_out_labels = np.concatenate([held_out_labels, held_out_labels[held_there]])
    of_made_up: list[MadeUp] = []
    for k, at in enumerate(rng.integers(len(entries), size=(made_up, 2))):
        one, other = (str(entries[j].path.absolute()) for j in at)
        family, chosen = FAMILIES[k % len(FAMILIES)], tuple(rng.permutation(len(views.sphere))[:MADE_UP_VIEWS].tolist())
        sensor = "mix" if sensed and (k // len(FAMILIES)) % 2 else None
        of_made_up.append((*places, family, one, other, chosen, k + seed * made_up, sensor))
    strange = features_of(made_up_features, of_made_up, workers, progress, "made-up objects")
    if not any(map(len, strange)):
        raise DatasetError(f"{meshes}: no object could be made up of its meshes")
    ordinary = features_of(known_features, of_learned, workers, progress, "objects that it learned")
    calibrating = features_of(known_features, of_held_out, workers, progress, "held-out objects")
    enough = [k for k, rows in enumerate(calibrating) if len(rows) == HELD_OUT_VIEWS]
    found = fit_novelty(
        np.concatenate([rows for rows in ordinary if len(rows)]),
        labels.repeat([len(rows) for rows in ordinary]),
        np.concatenate([rows for rows in strange if len(rows)]),
        np.stack([calibrating[k] for k in enough]),
        held_out_labels[enough],
        rng,
    )
    number = sum(len(rows) > 0 for rows in strange)
    # Killed between the two files, this leaves a card that knows of no score, and not one of another score's hash.
    write_card(card, replace(model, novelty_sha256=""))
    sha256 = found.save(novelty_path(model.path))
    about = (
        f"{len(learned)} objects of the training split and {number} made-up ones, calibrated on {len(held_out)} others"
        + ", clean and through sensors" * (sensed is not None)
    )
    model = replace(model, novelty_sha256=sha256, fitted_to={**model.fitted_to, "novelty": about})
    command = command_line("fit unknown", store, meshes, card, made_up=made_up, seed=seed, sensed=sensed)
    write_card(card, model.made_by(*views.commands, command))
    return FittedUnknown(len(learned), number, len(held_out))


def _rows(path: Path, names: list[str]) -> tuple[ViewStore, NDArray[np.int64], NDArray[np.int64]]:
    """A store, where it holds those of some objects that it holds, and which ones these are.

    Raises:
        DatasetError: it holds none.
    """
    store = ViewStore.open(path)
    done = store.done
    row = {name: i for i, name in enumerate(store.names) if done[i]}
    there = np.array([k for k, name in enumerate(names) if name in row], np.int64)
    if len(there) == 0:
        raise DatasetError(f"{path}: holds none of {len(names)} objects, {names[0]} among them")
    return store, np.array([row[names[k]] for k in there]), there


@dataclass(frozen=True)
class FittedValleys:
    """What ``fit_valleys`` found.

    Attributes:
        classes: for which the valley is the better view.
        gains: by how much, in belief in the true class, by class.
        objects: fitted to.
    """

    classes: tuple[str, ...]
    gains: dict[str, float]
    objects: int


@takes_paths("predictions", "card")
def fit_valleys(predictions: Path, card: Path) -> FittedValleys:
    """Choose the classes for which the valley of a predicted map is the better view than its peak.

    Args:
        predictions: of the training split; those of objects are taken that the map network was not trained on. Let
            neither be the recogniser.
        card: of the map network; is written anew.

    Raises:
        ModelError, PredictionsError: what was given does not fit together.
    """
    model, table = read_card(card), Predictions.load(predictions)
    if model.kind not in table.maps or table.models[model.kind] != (model.name, model.sha256):
        raise PredictionsError(f"{predictions}: holds no maps by {card}")
    kept = held_out_by(model, table)
    data = FittingSet.of_all(table).of(kept)
    if len(kept) == 0:
        raise PredictionsError(f"{predictions}: holds no object of which {card} says that it was not trained on it")
    found = valley_gains(data.sphere, data.logits, table.maps[model.kind][kept], data.labels)
    classes = tuple(table.classes[c] for c, gain in found.items() if gain > 0)
    gains = {table.classes[c]: round(gain, 4) for c, gain in found.items()}
    about = f"{len(kept)} objects of the training split, judged by {table.models['recogniser'][0]}"
    fitted_to = {**model.fitted_to, "valleys": about}
    model = replace(model, valley_classes=classes, valley_gain=gains, fitted_to=fitted_to)
    write_card(card, model.made_by(*table.commands, command_line("fit valleys", predictions, card)))
    return FittedValleys(classes, gains, len(kept))


@dataclass(frozen=True)
class FittedPolicies:
    """What ``fit_policies`` made.

    Attributes:
        cards: of the policies.
        objects: that they were learned from.
    """

    cards: tuple[Path, ...]
    objects: int


@takes_paths("predictions", "out")
def fit_policies(
    predictions: Path,
    out: Path,
    validation: float = 0.1,
    split_seed: int = 0,
    length: int = 7,
    n_views: int = 5,
    shrinkage: float = 20.0,
    travel_weight: float = 0.01,
    seed: int = 0,
) -> FittedPolicies:
    """Learn the policies that follow a table: fixed sequence, fixed ring, class table.

    Each in three variants: over the whole sphere (NAME), in the local window (NAME-local), and over the whole sphere at
    a travel weight (NAME-near; a ring has none).

    Args:
        predictions: of the training split.
        out: folder for NAME.json.
        validation: part of every class that the recogniser was not trained on; 1 for out-of-fold predictions.
        split_seed: the recogniser's seed, which decided which.
        length: moves of the fixed sequence.
        n_views: over which the ring and the class table are chosen.
        shrinkage: objects by whose weight the gains of one believed class are drawn towards those of all.
        travel_weight: of one cell of travel for NAME-near, in units of the logarithm of the belief in the true class.
        seed: of the walks behind the class table.

    Raises:
        UsageError, PredictionsError: what was given makes no sense, or nothing can be fitted to it.
    """
    if length < 1 or n_views < 2 or shrinkage < 0 or travel_weight < 0:
        raise UsageError("length has to be at least 1, views at least 2, shrinkage and travel weight not negative")
    table = Predictions.load(predictions)
    data = fitting_set(table, validation, split_seed)
    calibration, sphere = table.calibration, data.sphere
    if calibration == PLAIN_SUM:  # its recogniser was not calibrated when these were made
        calibration = fit_temperature(data, np.random.default_rng([seed, 0]), walks=1 + 8000 // len(data))
    values = fit_class_table(data, n_views, shrinkage, calibration, np.random.default_rng(seed))
    travel = sphere.travel[:: sphere.azimuths]  # from each ring to each cell
    command = command_line(
        "fit policies",
        predictions,
        out,
        validation=validation,
        split_seed=split_seed,
        length=length,
        n_views=n_views,
        shrinkage=shrinkage,
        travel_weight=travel_weight,
        seed=seed,
    )
    settings = {"length": length, "n_views": n_views, "shrinkage": shrinkage, "seed": seed}
    variants: tuple[tuple[str, Scope, float], ...] = (
        ("", "global", 0.0),
        ("-local", "local", 0.0),
        ("-near", "global", travel_weight),
    )
    learned = {}
    for suffix, scope, paid in variants:
        about = PolicyCard(
            "",
            scope,
            sphere.elevations,
            sphere.azimuths,
            data.classes,
            {},
            _objects(len(data)),
            (LearnedFrom(file_hash(predictions), table.models),),
            ((calibration.temperature, calibration.correlation),),
            settings | {"travel_weight": paid},
            (*table.commands, command),
        )
        moves = fit_sequence(data, scope, length, calibration, paid)
        paying = np.round(values - paid * travel, 5)
        learned[f"fixed-sequence{suffix}"] = replace(about, kind="fixed-sequence", table={"moves": moves.tolist()})
        learned[f"class-table{suffix}"] = replace(about, kind="class-table", table={"values": paying.tolist()})
        if not paid:
            ring, steps = fit_ring(data, scope, n_views, calibration)
            learned[f"fixed-ring{suffix}"] = replace(about, kind="fixed-ring", table={"ring": ring, "steps": steps})
    for name, card in learned.items():
        write_policy_card(out / f"{name}.json", card)
    return FittedPolicies(tuple(out / f"{name}.json" for name in learned), len(data))


def _objects(n: int) -> str:
    return f"{n} objects of the training split, classes weighted evenly"
