"""``nextview evaluate``: how good a recogniser and its map networks are, from predictions."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from nextview.errors import UsageError

if TYPE_CHECKING:
    from rich.table import Table

    from nextview.benchmark.evaluation import Evaluation
    from nextview.report.elements import Number


def evaluate(
    predictions: tyro.conf.Positional[Path],
    /,
    out: Path = Path("evaluation"),
    split: Literal["train", "test"] | None = None,
    deduplicate: bool = False,
    cards: tuple[str, ...] = (),
    samples: int = 2000,
    seed: int = 0,
) -> None:
    """Judge recogniser and maps on every view: accuracy, confusions, calibration, map scores, beside the published.

    Args:
        predictions: made by nextview predict.
        out: folder for numbers, tables, figures and evaluate.html; an earlier evaluation there is replaced, anything
            else is refused.
        split: take only the objects of this one; needed where the predictions hold several.
        deduplicate: of objects with the same label that look the same from every view, copies of one mesh, judge
            only the first; the published numbers count them all.
        cards: of the models that made the predictions; their scores are noted on these.
        samples: of the bootstrap.
        seed: decides the bootstrap, the orders of views and the examples.
    """
    from dataclasses import replace

    from rich.console import Console

    from nextview.cli.extra import needs_extra
    from nextview.cli.progress import track
    from nextview.data.predictions import Predictions
    from nextview.models.model_card import file_hash, find_card, write_card
    from nextview.outputs import check_folder, written_results

    with needs_extra("benchmark"):
        from nextview.benchmark import evaluation as judge
        from nextview.report import evaluation_page as evaluation
    import numpy as np

    check_folder(out, evaluation.KIND)
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
        noted[card.path] = replace(card, scores={**card.scores, of: judge.scores_for_card(card, table)})
    with written_results(out, evaluation.KIND) as part:
        found = judge.evaluate(table, samples, np.random.default_rng([seed, 0]))
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
        figures = evaluation.all_figures(found, table, np.random.default_rng([seed, 1]))
        track(evaluation.save(part, found, table, settings, figures), len(figures) + 1, "writing figures")
    for path, card in noted.items():
        write_card(path.with_suffix(".json"), card)
    console = Console()
    console.print(_recogniser(found, len(table.sphere)))
    for name in found.maps["map"].unique():
        console.print(_map(found, name))
    for name, why in found.left_out.items():
        console.print(f"{name}: {why}", highlight=False, markup=False)
    console.print(f"numbers, figures and {evaluation.PAGE} in {out}", highlight=False, markup=False)


def _recogniser(found: Evaluation, views: int) -> Table:
    """Accuracy of each class and of all."""
    from rich.markup import escape
    from rich.table import Table

    from nextview.report.elements import numbers

    shown = Table("share of right answers", "objects", "one view", f"all {views} views")
    right = numbers(found.accuracy, "n_views", "label", "measure")
    objects = found.accuracy.groupby(["label", "measure"])["objects"].first()
    labels = [label for label in found.accuracy["label"].unique() if label]
    lines = [(label.replace("_", " "), label, "accuracy") for label in labels]
    lines += [("mean of classes", "", "class_accuracy"), ("mean of objects", "", "accuracy")]
    lines += [("  without duplicates", "", "clean_accuracy")]
    if "shape_accuracy" in set(found.accuracy["measure"]):
        lines += [("  size not known", "", "shape_accuracy")]
    for heading, label, measure in lines:
        cells = (_cell(right[n_views, label, measure], 3) for n_views in (1, views))
        shown.add_row(escape(heading), str(objects[label, measure]), *cells, end_section=label == labels[-1])
    published = right[1, "", "accuracy"].published
    if isfinite(published):
        shown.add_row("  published", "", f"{published:.3f}")
    return shown


def _map(found: Evaluation, name: str) -> Table:
    """Scores of a map over objects and classes, beside the published ones and the baselines."""
    from rich.table import Table

    from nextview.report.elements import numbers

    measures = {"mse": "MSE", "d0": "d = 0", "d_le_1": "d <= 1", "d_lt_2": "d < 2", "regret": "regret"}
    scores = numbers(found.maps[(found.maps["map"] == name) & (found.maps["label"] == "")], "by", "measure")
    baselines = [by for by in found.maps["by"].unique() if by != "network"]
    printed = any(isfinite(score.published) for score in scores.values())
    caption = "published: squared error over objects, peaks over classes (table 4)" if printed else None
    shown = Table(name.upper(), "mean of objects", "of classes", "published", *baselines, caption=caption)
    shown.columns[1].no_wrap = True
    for measure, heading in measures.items():
        digits = 4 if measure == "mse" else 3
        over_objects, over_classes = scores["network", measure], scores["network", f"class_{measure}"]
        published = over_objects.published if measure == "mse" else over_classes.published
        rest = [over_classes.value, published, *(scores[by, measure].value for by in baselines)]
        cells = (f"{value:.{digits}f}" if isfinite(value) else "-" for value in rest)
        shown.add_row(heading, _cell(over_objects, digits), *cells)
    return shown


def _cell(number: Number, digits: int) -> str:
    """A number and its interval."""
    if not isfinite(number.value):
        return "-"
    interval = f" {number.low:.{digits}f}-{number.high:.{digits}f}" if number.high > number.low else ""
    return f"{number.value:.{digits}f}[dim]{interval}[/]"
