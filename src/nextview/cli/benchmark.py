"""``nextview benchmark``: compare policies by replay."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from nextview.errors import EntryError, UsageError


def benchmark(
    predictions: tyro.conf.Positional[Path],
    /,
    out: Path = Path("benchmark"),
    policies: tuple[str, ...] = (),
    thresholds: tuple[float, ...] = (0.85, 0.9, 0.95, 0.97, 0.99),
    risks: tuple[float, ...] = (),
    threshold_decay: float | None = None,
    uncalibrated: bool = False,
    split: Literal["train", "test"] | None = None,
    runs: int = 10,
    max_views: int = 5,
    reference: str = "random",
    valley_classes: tuple[str, ...] | None = None,
    samples: int = 2000,
    seed: int = 0,
) -> None:
    """Run every policy under every threshold from the same first views, and write episodes, tables and tests.

    Args:
        predictions: made by nextview predict.
        out: folder for the results; earlier results there are replaced, anything else is refused.
        policies: names, or MODULE:CLASS for your own; all that the predictions allow by default.
        thresholds: of the belief.
        risks: error rates; the thresholds that promise them, by the recogniser's calibration, are run too.
        threshold_decay: how fast a threshold comes down with the views; by default with the recogniser's correlation,
            as in nextview recognise, or not at all with --risks, which are promised for thresholds that stay.
        uncalibrated: believe the plain sum of the logits, as published, whatever the recogniser's card says.
        split: take only the objects of this one; needed where the predictions hold several.
        runs: random first views of each object.
        max_views: views at most.
        reference: the policy that the others are compared with.
        valley_classes: classes whose map valley is the better view; those of the map network's card by default.
        samples: of the bootstrap.
        seed: decides first views, random policies and the bootstrap.
    """
    import sys
    import time
    from dataclasses import replace

    from nextview.belief import PLAIN_SUM, Stopping
    from nextview.benchmark.entries import default_entries
    from nextview.benchmark.experiment import Grid, run_grid
    from nextview.benchmark.replay import make_specs
    from nextview.cli.extra import needs_extra
    from nextview.cli.progress import console, track
    from nextview.data.predictions import Predictions
    from nextview.models.model_card import file_hash
    from nextview.outputs import check_folder, written_results

    with needs_extra("benchmark"):
        from nextview.benchmark.results import KIND, save
        from nextview.benchmark.summary import summarise
    import numpy as np

    began = time.perf_counter()
    check_folder(out, KIND)
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
    sys.path.insert(0, str(Path.cwd()))  # where a user's own policy lies
    names = list(dict.fromkeys([*([reference] if policies else []), *(policies or default_entries(specs))]))
    grid = Grid(specs, runs, tuple(sorted({*thresholds, *promised.values()})), max_views, seed, threshold_decay)
    with written_results(out, KIND) as part:
        track(run_grid(grid, names), len(names), "replaying policies")
        if not grid.paths:
            raise EntryError("\n".join(grid.failures.values()))
        tables = summarise(grid, reference, samples, np.random.default_rng([seed, 1]))
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
            "valley_classes": [table.classes[i] for i in specs.valley_classes],
            "samples": samples,
            "seed": seed,
        }
        save(part, grid, tables, settings)
    episodes = runs * len(table) * len(list(grid.cells()))
    console.print(f"{episodes:,} episodes in {time.perf_counter() - began:.1f} s; results in {out}")
    if grid.failures:
        raise EntryError("\n".join(grid.failures.values()))
