"""The stage from predictions to an evaluation of the models that made them: a folder, and scores on their cards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from nextview.arguments import takes_paths
from nextview.benchmark.evaluation import Evaluation, evaluate, scores_for_card
from nextview.data.predictions import Predictions
from nextview.errors import UsageError
from nextview.models.model_card import file_hash, find_card, write_card
from nextview.outputs import check_folder, written_results
from nextview.report.evaluation_page import KIND, all_figures, save
from nextview.tracking import Track, silently


@takes_paths("predictions", "out")
def write_evaluation(
    predictions: Path,
    out: Path,
    *,
    split: str | None = None,
    deduplicate: bool = False,
    cards: Sequence[str | Path] = (),
    samples: int = 2000,
    seed: int = 0,
    track: Track = silently,
) -> Evaluation:
    """Judge the recogniser and the maps behind some predictions on every view.

    Args:
        predictions: the file.
        out: folder for numbers, tables, figures and evaluate.html; an earlier evaluation there is replaced.
        split: take only the objects of this one; needed where the predictions hold several.
        deduplicate: judge one object of each shape and label.
        cards: names or paths of the models that made the predictions, on which their scores are noted.
        samples: of the bootstrap.
        seed: decides the bootstrap, the orders of views and the examples.
        track: follows the writing of the figures.

    Raises:
        UsageError: the predictions hold several splits, and none is chosen.
        PredictionsError: they cannot be used.
        ModelError: there is no such card.
        ResultsError: there is nothing to judge, a card's model did not make them, or ``out`` must not be replaced.
    """
    check_folder(out, KIND)
    table = Predictions.load(predictions)
    if split:
        table = table.of_split(split)
    elif len(set(table.splits)) > 1:
        raise UsageError(f"{predictions}: holds training and test objects; choose with --split which are judged")
    if deduplicate:
        table = table.deduplicate()
    noted = {}
    for name in cards:
        card = find_card(name)
        known = "" if table.of_size is None else ", of known size"
        things = "shapes" if deduplicate else "objects"
        of = f"{split or table.splits[0] or 'all'} ({len(table)} {things}{known})"
        noted[card.path] = replace(card, scores={**card.scores, of: scores_for_card(card, table)})
    settings = {
        "predictions": predictions.name,
        "predictions_sha256": file_hash(predictions),
        "models": table.models,
        "split": split,
        "deduplicate": deduplicate,
        "objects": len(table),
        "samples": samples,
        "seed": seed,
    }
    with written_results(out, KIND) as part:
        found = evaluate(table, samples, np.random.default_rng([seed, 0]))
        figures = all_figures(found, table, np.random.default_rng([seed, 1]))
        track(save(part, found, table, settings, figures), len(figures) + 1, "writing figures")
    for path, card in noted.items():
        write_card(path.with_suffix(".json"), card)
    return found
