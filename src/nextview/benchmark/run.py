"""The benchmark, from predictions to a folder of results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from nextview.arguments import takes_paths
from nextview.belief import PLAIN_SUM, Stopping
from nextview.benchmark import results
from nextview.benchmark.entries import default_entries
from nextview.benchmark.experiment import THRESHOLDS, Grid, run_grid
from nextview.benchmark.replay import make_specs
from nextview.benchmark.summary import summarise
from nextview.data.predictions import Predictions
from nextview.errors import EntryError, UsageError
from nextview.measures.map_names import LEM
from nextview.models.model_card import file_hash
from nextview.outputs import check_folder, written_results
from nextview.policies.registry import with_cards

Track = Callable[[Iterable[int], int, str], object]
"""Exhausts counts of what is done, given the last count and what is being done."""


def _unseen(done: Iterable[int], total: int, what: str) -> None:
    for _ in done:
        pass


@takes_paths("predictions", "out")
def run_benchmark(
    predictions: Path,
    out: Path,
    policies: Sequence[str] = (),
    own: Mapping[str, Path] | None = None,
    thresholds: Sequence[float] = THRESHOLDS,
    risks: Sequence[float] = (),
    threshold_decay: float | None = None,
    uncalibrated: bool = False,
    split: str | None = None,
    runs: int = 10,
    max_views: int = 5,
    reference: str = "random",
    valley_classes: Sequence[str] | None = None,
    samples: int = 2000,
    seed: int = 0,
    track: Track = _unseen,
    through: Callable[[Grid, str], object] = lambda grid, name: None,
) -> results.Results:
    """Run every policy under every threshold from the same first views, and write episodes, tables and tests.

    An entry that fails takes nothing from the others; why it did stands in the settings of the results.

    Args:
        predictions: made by ``data.predicting.predict``.
        out: folder for the results; earlier results there are replaced.
        policies: see ``entries``; all that the predictions allow by default. The reference is run in any case.
        own: cards of policies that take part too, or are meant where ``policies`` names them.
        thresholds: of the belief.
        risks: error rates; the thresholds that promise them, by the recogniser's calibration, are run too.
        threshold_decay: how fast a threshold comes down with the views, see ``Stopping``; by default with the
            recogniser's correlation, or not at all with ``risks``, which are promised for thresholds that stay.
        uncalibrated: believe the plain sum of the logits, as published.
        split: take only the objects of this one; needed where the predictions hold several.
        runs: random first views of each object.
        max_views: views at most.
        reference: the policy that the others are compared with.
        valley_classes: classes whose map valley is the better view; those of each map's card by default.
        samples: of the bootstrap.
        seed: decides first views, random policies and the bootstrap.
        track: shows how far it is; by default nothing is shown.
        through: is called with all that was run and the name of each policy that has just come through.

    Raises:
        UsageError: settings that make no sense.
        PredictionsError: the predictions cannot be used.
        RiskError: the recogniser's calibration does not promise such an error rate.
        EntryError: not one policy came to its end.
        ResultsError: ``out`` cannot be written.
    """
    check_folder(out, results.KIND)
    if not thresholds:
        raise UsageError("at least one threshold is needed")
    table = Predictions.load(predictions)
    if uncalibrated:
        table = replace(table, calibration=PLAIN_SUM)
    if threshold_decay is None:
        threshold_decay = 0.0 if risks else table.calibration.correlation
    for threshold in thresholds:
        Stopping(threshold, max_views, threshold_decay)  # says what is wrong with it
    if risks and threshold_decay:
        raise UsageError("error rates are promised for thresholds without a threshold decay")
    promised = {risk: table.calibration.threshold(risk, max_views) for risk in risks}
    if split:
        table = table.of_split(split)
    elif len(set(table.splits)) > 1:
        raise UsageError(f"{predictions}: holds training and test objects; choose with --split which are compared")
    unknown = [name for name in valley_classes or () if name not in table.classes]
    if unknown:
        raise UsageError(f"{predictions}: knows no class {unknown[0]!r}; there are {', '.join(table.classes)}")
    valleys = None if valley_classes is None else tuple(map(table.classes.index, valley_classes))
    specs = make_specs(table, runs, seed, valleys)
    own = own or {}
    wanted = [with_cards(name, own) for name in policies] or [*default_entries(specs), *map(str, own.values())]
    names = list(dict.fromkeys([*([reference] if policies else []), *wanted]))
    grid = Grid(specs, runs, tuple(sorted({*thresholds, *promised.values()})), max_views, seed, threshold_decay)
    with written_results(out, results.KIND) as part:
        track(run_grid(grid, names, through), len(names), "replaying policies")
        if not grid.paths:
            raise EntryError("\n".join(grid.failures.values()))
        tables = summarise(grid, reference, samples, np.random.default_rng([seed, 1]), promised)
        settings = {
            "predictions": predictions.name,
            "predictions_sha256": file_hash(predictions),
            "models": table.models,
            "policies": names,
            "failures": grid.failures,
            "split": split,
            "reference": reference,
            "thresholds": grid.thresholds,
            "risks": {str(risk): threshold for risk, threshold in promised.items()},
            "calibration": [table.calibration.temperature, table.calibration.correlation],
            "threshold_decay": threshold_decay,
            "runs": runs,
            "max_views": max_views,
            "valley_classes": [table.classes[i] for i in specs.valley_classes(LEM)],
            "samples": samples,
            "seed": seed,
        }
        results.save(part, grid, tables, settings)
    return results.load(out)
