"""``nextview fit``: what is fitted to predictions, in seconds and without torch."""

from __future__ import annotations

from pathlib import Path

import tyro

from nextview.errors import DatasetError, PredictionsError, UsageError


def fit_calibration(
    predictions: tyro.conf.Positional[Path],
    card: tyro.conf.Positional[Path],
    /,
    validation: float | None = None,
    split_seed: int = 0,
    delta: float = 0.1,
    seed: int = 0,
) -> None:
    """Calibrate a recogniser: how far to trust the sum of several views, and which error rates can be promised.

    Both go into its card; nextview predict takes them into predictions made before, without predicting again. How large
    the objects are is left aside.

    Args:
        predictions: of the training split (nextview predict --held-out, or --split train).
        card: of the recogniser; "calibration" is written into it. Those objects are taken that it calls unseen.
        validation: take this part of every class instead, as training kept it out of the whole split; 1 for
            out-of-fold predictions. A card that names no unseen objects needs it.
        split_seed: the recogniser's seed, which decided that part.
        delta: how often a promised error rate may not hold.
        seed: decides the walks over which is fitted.
    """
    from dataclasses import replace

    import numpy as np

    from nextview.belief import PLAIN_SUM
    from nextview.calibration.fitting_set import FittingSet, fitting_set, held_out_by
    from nextview.calibration.temperature import fit_risk, fit_temperature, loss
    from nextview.cli.progress import console
    from nextview.data.predictions import Predictions
    from nextview.models.model_card import read_card, write_card

    if not 0 < delta < 1:
        raise UsageError(f"delta is a probability between 0 and 1, not {delta}")
    model, table = read_card(card), Predictions.load(predictions).by_shape()
    if validation != 1 and table.models["recogniser"][1] != model.sha256:
        raise PredictionsError(f"{predictions}: comes from another recogniser than {card}")
    if validation is None:
        data = FittingSet.of_all(table).of(held_out_by(model, table))
        if len(data) == 0:
            raise PredictionsError(f"{predictions}: holds no object that {card} calls unseen; see --validation")
    else:
        data = fitting_set(table, validation, split_seed)
    walks = 1 + 8000 // len(data)  # few objects are walked over more often
    calibration = fit_temperature(data, np.random.default_rng([seed, 0]), walks=walks)
    risk = fit_risk(data, calibration, np.random.default_rng([seed, 1]), delta, walks=walks)
    calibration = replace(calibration, risk=risk)
    notes = {"fitted_to": f"{len(data)} objects of the training split, classes weighted evenly"}
    write_card(card, model.facts | {"calibration": calibration.facts() | notes})
    before, after = (loss(data, c, np.random.default_rng([seed, 2]), walks=walks) for c in (PLAIN_SUM, calibration))
    console.print(
        f"{len(data)} objects: temperature of one view {calibration.temperature}, correlation of two views "
        f"{calibration.correlation}; negative log-likelihood over 1 to 5 views {before:.3f} before, {after:.3f} after"
    )


def fit_size(
    store: tyro.conf.Positional[Path],
    predictions: tyro.conf.Positional[Path],
    card: tyro.conf.Positional[Path],
    /,
) -> None:
    """Tell a recogniser how large the objects of each class are, for stores and cameras that know it.

    It goes into its card; nextview predict takes it into predictions made before, without predicting again.

    Args:
        store: view store that knows the unit of its meshes (nextview render --unit); its training objects teach, except
            those in the predictions.
        predictions: of training objects that the recogniser has not seen (nextview predict --held-out); they decide how
            much the size counts beside the shape.
        card: of the recogniser; "size" is written into it.
    """
    import numpy as np

    from nextview.calibration.fitting_set import FittingSet
    from nextview.calibration.size_density import densities, fit_weight
    from nextview.cli.progress import console
    from nextview.data.predictions import Predictions
    from nextview.data.store import ViewStore
    from nextview.models.model_card import read_card, write_card

    model, views, predicted = read_card(card), ViewStore.open(store), Predictions.load(predictions)
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
    found, before, after = fit_weight(data, radii[judged], log_density)
    notes = {"learned_from": f"{len(taught)} objects of the training split", "weighed_on": f"{len(data)} others"}
    write_card(card, model.facts | {"size": found.facts() | notes})
    console.print(
        f"sizes of {len(taught)} objects; by {len(data)} others, weight beside the logits {found.weight:.2f}; negative "
        f"log-likelihood of single views {before:.3f} by shape alone, {after:.3f} with the size"
    )


def fit_valleys(
    predictions: tyro.conf.Positional[Path],
    card: tyro.conf.Positional[Path],
    /,
) -> None:
    """Choose the classes for which the valley of a predicted map is the better view than its peak.

    They go into the map network's card; nextview predict takes them into predictions made before, without predicting
    again.

    Args:
        predictions: of the training split; those of objects are taken that the map network was not trained on. Let
            neither be the recogniser (nextview predict --held-out).
        card: of the map network; "valley_classes" is written into it.
    """
    from nextview.calibration.fitting_set import FittingSet, held_out_by
    from nextview.calibration.valleys import valley_gains
    from nextview.cli.progress import console
    from nextview.data.predictions import Predictions
    from nextview.models.model_card import read_card, write_card

    model, table = read_card(card), Predictions.load(predictions)
    if model.kind not in table.maps or table.models[model.kind] != (model.name, model.sha256):
        raise PredictionsError(f"{predictions}: holds no maps by {card}")
    kept = held_out_by(model, table)
    data = FittingSet.of_all(table).of(kept)
    if len(kept) == 0:
        raise PredictionsError(f"{predictions}: holds no object of which {card} says that it was not trained on it")
    gains = valley_gains(data.sphere, data.logits, table.maps[model.kind][kept], data.labels)
    notes = {
        "valley_classes": [table.classes[c] for c, gain in gains.items() if gain > 0],
        "valley_gain": {table.classes[c]: round(gain, 4) for c, gain in gains.items()},
        "valley_fitted_to": f"{len(kept)} objects of the training split, judged by {table.models['recogniser'][0]}",
    }
    write_card(card, model.facts | notes)
    console.print(f"{len(kept)} objects: the valley is better for {', '.join(notes['valley_classes']) or 'no class'}")


def fit_policies(
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    validation: float = 0.1,
    split_seed: int = 0,
    length: int = 7,
    n_views: int = 5,
    shrinkage: float = 20.0,
    travel_weight: float = 0.01,
    seed: int = 0,
) -> None:
    """Learn the policies that follow a table: fixed sequence, fixed ring, class table.

    Each in three variants: over the whole sphere (NAME), in the local window (NAME-local), and over the whole sphere at
    a travel weight (NAME-near; a ring has none).

    Args:
        predictions: of the training split (nextview predict --split train).
        out: folder for NAME.json; run one with --policy OUT/NAME.json.
        validation: part of every class that the recogniser was not trained on; 1 for out-of-fold predictions.
        split_seed: the recogniser's seed, which decided which.
        length: moves of the fixed sequence.
        n_views: over which the ring and the class table are chosen.
        shrinkage: objects by whose weight the gains of one believed class are drawn towards those of all.
        travel_weight: of one cell of travel for NAME-near, in units of the logarithm of the belief in the true class.
        seed: decides the walks behind the class table.
    """
    import numpy as np

    from nextview.belief import PLAIN_SUM
    from nextview.calibration.fitting_set import fitting_set
    from nextview.calibration.policy_tables import fit_class_table, fit_ring, fit_sequence
    from nextview.calibration.temperature import fit_temperature
    from nextview.cli.progress import console
    from nextview.data.predictions import Predictions
    from nextview.models.model_card import file_hash
    from nextview.policies.policy_card import write_policy

    if length < 1 or n_views < 2 or shrinkage < 0 or travel_weight < 0:
        raise UsageError("length has to be at least 1, looks at least 2, shrinkage and travel weight not negative")
    table = Predictions.load(predictions)
    data = fitting_set(table, validation, split_seed)
    calibration, sphere = table.calibration, data.sphere
    if calibration == PLAIN_SUM:  # its recogniser was not calibrated when these were made
        calibration = fit_temperature(data, np.random.default_rng([seed, 0]), walks=1 + 8000 // len(data))
    values = fit_class_table(data, n_views, shrinkage, calibration, np.random.default_rng(seed))
    travel = sphere.travel[:: sphere.azimuths]  # from each ring to each cell
    learned = {}
    for suffix, anywhere, paid in (("", True, 0.0), ("-local", False, 0.0), ("-near", True, travel_weight)):
        moves = fit_sequence(data, anywhere, length, calibration, paid)
        learned[f"fixed-sequence{suffix}"] = (anywhere, paid, {"moves": moves.tolist()})
        learned[f"class-table{suffix}"] = (anywhere, paid, {"values": np.round(values - paid * travel, 5).tolist()})
        if not paid:
            ring, steps = fit_ring(data, anywhere, n_views, calibration)
            learned[f"fixed-ring{suffix}"] = (anywhere, paid, {"ring": ring, "steps": steps})
    out.mkdir(parents=True, exist_ok=True)
    for name, (anywhere, paid, content) in learned.items():
        facts = {
            "kind": "-".join(name.split("-")[:2]),
            "anywhere": anywhere,
            "elevations": sphere.elevations,
            "azimuths": sphere.azimuths,
            "classes": data.classes,
            "learned_from": f"{len(data)} objects of the training split, classes weighted evenly",
            "predictions": {"sha256": file_hash(predictions), "models": table.models},
            "calibration": [calibration.temperature, calibration.correlation],
            "settings": {
                "length": length,
                "n_views": n_views,
                "shrinkage": shrinkage,
                "travel_weight": paid,
                "seed": seed,
            },
            "table": content,
        }
        write_policy(out / f"{name}.json", facts)
    console.print(f"{len(learned)} policies, learned from {len(data)} objects, are in {out}")
