"""``nextview benchmark``: compare policies by replay."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from nextview.errors import EntryError


def benchmark(
    predictions: tyro.conf.Positional[Path],
    /,
    out: Path = Path("benchmark"),
    policies: tuple[str, ...] = (),
    models: str = "modelnet10",
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
    """Run every policy under every threshold from the same first views, and say which are better than the reference.

    Episodes, tables and tests are written; nextview report makes a page of them.

    Args:
        predictions: made by nextview predict.
        out: folder for the results; earlier results there are replaced, anything else is refused.
        policies: names, or MODULE:CLASS for your own; all that the predictions allow by default.
        models: a folder with models of your own: the policies learned for them take part, by their names.
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
    from functools import partial

    from nextview.benchmark.run import run_benchmark
    from nextview.cli.leaderboard_table import print_leaderboard
    from nextview.cli.live_leaderboard import LiveLeaderboard
    from nextview.cli.progress import console, track
    from nextview.models.collection import find_models

    own, live = find_models(models).policies, LiveLeaderboard()
    results = run_benchmark(
        predictions, out, policies, own, thresholds, risks, threshold_decay, uncalibrated, split, runs, max_views,
        reference, valley_classes, samples, seed, partial(track, above=live.table), live.add,
    )  # fmt: skip
    print_leaderboard(results)
    console.print(f"results in {out}", soft_wrap=True)
    if results.settings["failures"]:
        raise EntryError("\n".join(results.settings["failures"].values()))
