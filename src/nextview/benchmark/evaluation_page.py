"""The stage that judges the models behind some predictions: a folder of numbers, figures and one HTML page."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from msgspec.structs import replace

from nextview.benchmark import figures as draw
from nextview.benchmark import page as html
from nextview.benchmark.evaluation import Evaluation, evaluate, scores_for_card
from nextview.benchmark.page import Cell, Number, Part, Row, Section, Table, cell, numbers, percent, words
from nextview.benchmark.published import comparable_classes, published_recognisers
from nextview.benchmark.report import origin
from nextview.benchmark.run import chosen_split
from nextview.data.predictions import Predictions
from nextview.data.progress import Track, silently
from nextview.files import check_new, new_folder, sha256_of
from nextview.recognition.map_names import measure_of
from nextview.recognition.model_card import find_card, write_card
from nextview.session.style import to_png

PAGE = "evaluate.html"
MAPS = (
    "Of equal cells the first counts as the peak. The regret is the highest true value less the true one at the "
    "predicted peak. The baselines are made from the true maps of these very objects: one map for all views, and one "
    "for each class and view. The published peaks are means over classes, the published loss is over objects."
)
TRUST = "Views of one object make alike mistakes: a sum of logits takes them for independent and grows too sure."
EXAMPLES = (
    "One random view of each object was drawn, and those shown stand at equal steps of its squared error. The true map "
    "is left, the predicted one right; rows are rings, the lowest below; dark is 0, yellow 1."
)
MEASURES = {
    "mse": "mean squared error",
    "d0": "peak exact (d = 0)",
    "d_le_1": "peak within one cell (d ≤ 1)",
    "d_lt_2": "peak within a diagonal (d < 2)",
    "regret": "regret",
}
"""The scores of maps in words."""


@dataclass(frozen=True)
class EvaluationSettings:
    """What is judged.

    Attributes:
        split: take only the objects of this one; needed where the predictions hold several.
        deduplicate: of objects with the same label that look the same from every view, copies of one mesh, judge
            only the first; the published numbers count them all.
        cards: of the models that made the predictions; their scores are noted on these.
        samples: of the bootstrap.
        seed: decides the bootstrap, the orders of views and the examples.
    """

    split: Literal["train", "test", "val"] | None = None
    deduplicate: bool = False
    cards: tuple[str, ...] = ()
    samples: int = 2000
    seed: int = 0


def write_evaluation(
    predictions: Path,
    out: Path,
    settings: EvaluationSettings = EvaluationSettings(),
    *,
    overwrite: bool = False,
    track: Track = silently,
) -> Evaluation:
    """Judge recogniser and maps on every view: accuracy, confusions, calibration, map scores, beside the published.

    Args:
        predictions: made by nextview predict.
        out: folder for numbers, tables, figures and evaluate.html.
        settings: what is judged.
        overwrite: replace the files of an earlier evaluation.
        track: follows the writing of the figures.

    Raises:
        UsageError: the predictions hold several splits, and none is chosen.
        ResultsError: there is nothing to judge, or a card's model did not make them.
    """
    check_new(out, overwrite, folder=True)
    p = chosen_split(Predictions.load(predictions), predictions, settings.split)
    p = p.deduplicate() if settings.deduplicate else p
    noted = {}
    for name in settings.cards:
        card = find_card(name)
        what = f"{'shapes' if settings.deduplicate else 'objects'}{'' if p.of_size is None else ', of known size'}"
        scores = {f"{settings.split or p.splits[0] or 'all'} ({len(p)} {what})": scores_for_card(card, p)}
        noted[card.path] = replace(card, scores={**card.scores, **scores})
    made = asdict(settings) | {
        "predictions": predictions.name,
        "predictions_sha256": sha256_of(predictions),
        "models": p.models,
        "objects": len(p),
    }
    found = evaluate(p, settings.samples, np.random.default_rng([settings.seed, 0]))
    figures = all_figures(found, p, np.random.default_rng([settings.seed, 1]))
    records = {name: _records(frame) for name, frame in found.tables().items()}
    results = {"settings": made, "left_out": found.left_out, **records}
    with new_folder(out, overwrite) as part:
        for name, frame in found.tables().items():
            frame.to_csv(part / f"{name}.csv", index=False)
        (part / "results.json").write_text(json.dumps(results, indent=1, allow_nan=False) + "\n")
        track(_draw(figures, part), len(figures), "writing figures")
        (part / PAGE).write_text(page(found, p, made, figures), encoding="utf-8")
    for path, card in noted.items():
        write_card(path.with_suffix(".json"), card)
    return found


def _draw(figures: dict[str, Figure], folder: Path) -> Iterator[int]:
    for done, (name, figure) in enumerate(figures.items(), 1):
        to_png(figure, folder / f"{name}.png")
        yield done


def _records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    rows = frame.astype(object).to_dict("records")
    return [{str(k): v for k, v in row.items() if v is not None and v == v} for row in rows]


def all_figures(e: Evaluation, p: Predictions, rng: np.random.Generator) -> dict[str, Figure]:
    """Every figure by the name of its file; the generator draws the examples."""
    figures = {
        "fusion": draw.fusion_curve(e),
        "reliability": draw.evaluated_reliability(e),
        "confusion_one_view": draw.evaluated_confusion(e, 1, p.classes),
        "confusion_all_views": draw.evaluated_confusion(e, len(p.sphere), p.classes),
    }
    return figures | {f"{name}_examples": draw.example_maps(p, name, rng) for name in e.maps["map"].unique()}


def page(e: Evaluation, p: Predictions, settings: dict[str, Any], figures: dict[str, Figure]) -> str:
    """The whole page as text."""
    v, found, curve = len(p.sphere), numbers(e.accuracy, "n_views", "label", "measure"), e.fusion.set_index("n_views")
    name = p.models["recogniser"][0] if "recogniser" in p.models else "the recogniser"
    twice = int(p.conflicting.sum())
    one, fused = (percent(found[n, "", "accuracy"].value) for n in (1, v))
    title = f"{name}: {one} of single views right, {fused} of objects with all {v} views fused"
    lead = f"{len(p):,} objects of {len(set(p.labels.tolist()))} classes, {v} views each"
    lead += f"; {twice} of them are the very mesh of another object with another label." if twice else "."
    intervals = "All intervals are 95\u00a0% bootstrap intervals over objects: views of one object are not independent."
    errors = ", ".join(f"{curve.calibration_error[k]:.3f} after {k}" for k in e.reliability["n_views"].unique())
    at = ", ".join(f"{k}: {curve.accuracy[k]:.3f}" for k in (1, 2, 5, 10, v) if k in curve.index)
    right = html.picture(figures["fusion"], f"Accuracy by the number of random views fused. {at}.", TRUST)
    matrices = {"confusion_one_view": "one view", "confusion_all_views": f"all {v} views fused"}
    confused = [
        html.picture(figures[name], f"Confusion matrix of {what}.", "Percent of each true class, as figure 12.")
        for name, what in matrices.items()
    ]
    alt = f"Share of right answers against confidence. Calibration error: {errors}."
    bins = f"Reliability; expected calibration error over views: {errors}. Bins of fewer than 20 answers are left out."
    sections: list[Section] = [
        ("recogniser", "How often it is right", [[right], *_accuracy_tables(e, p)]),
        ("confusion", "Which classes it confuses", [confused]),
        ("calibration", "Is the confidence worth its name?", [[html.picture(figures["reliability"], alt, bins)]]),
        *(_map(e, kind, figures) for kind in e.maps["map"].unique()),
        ("left-out", "Left out", [e.left_out] if e.left_out else []),
        ("made", "How this was made", [_facts(p, settings)]),
    ]
    return html.render(title, [(lead, "lead"), (intervals, "")], _cards(e, v), sections)


def _cards(e: Evaluation, v: int) -> list[html.Card]:
    found, error = (
        numbers(e.accuracy, "n_views", "label", "measure"),
        e.fusion.set_index("n_views")["calibration_error"],
    )
    cards = []
    for n, heading in ((1, "one view"), (v, f"all {v} views fused")):
        number, classes = found[n, "", "accuracy"], percent(found[n, "", "class_accuracy"].value)
        cards.append((heading, percent(number.value), f"{html.between(number)}; classes {classes}"))
    cards.append(("calibration error", f"{error[1]:.3f}", f"one view; {error[v]:.3f} with all {v} fused"))
    for kind in e.maps["map"].unique():
        scores = _scores(e, kind)
        near, loss = scores["network", "", "d_le_1"], scores["network", "", "mse"]
        small = f"{html.between(near)}; MSE {loss.value:.4f}"
        cards.append((f"{kind.upper()}: peak within one cell", percent(near.value), small))
    return cards


def _scores(e: Evaluation, name: str) -> dict[tuple, Number]:
    return numbers(e.maps[e.maps["map"] == name], "by", "label", "measure")


def _accuracy_tables(e: Evaluation, p: Predictions) -> list[Part]:
    """By class, and beside the published recognisers, if there are any for these objects."""
    found, v = numbers(e.accuracy, "n_views", "label", "measure"), len(p.sphere)
    columns = [(n_views, measure) for n_views in (1, v) for measure in ("accuracy", "clean_accuracy")]
    rows: list[Row] = []
    counts = np.bincount(p.labels, minlength=len(p.classes))
    for of_class in e.accuracy.query("label != ''")["label"].unique():
        cells = (cell(found[n_views, of_class, measure]) for n_views, measure in columns)
        rows.append([words(of_class), str(counts[p.classes.index(of_class)]), *cells])
    for heading, before in (("mean of classes", "class_"), ("mean of objects", "")):
        cells = (cell(found[n_views, "", before + measure]) for n_views, measure in columns)
        rows.append([heading, f"{len(p):,}", *cells])
        if p.of_size is not None:
            one, fused = (cell(found[n_views, "", f"{before}shape_accuracy"]) for n_views in (1, v))
            rows.append([Cell(heading, ("size of the objects not known",)), f"{len(p):,}", one, "", fused, ""])
    head = ["class", "objects", "one view", "without duplicates", f"all {v} views fused", "without duplicates"]
    clean = "Without duplicates leaves out the objects whose very mesh also stands in the data under another label."
    parts: list[Part] = [clean, Table(head, rows, "Share of right answers. Small print: 95\u00a0% intervals.")]
    published = published_recognisers(comparable_classes(p), v)
    if published:
        listed: list[Row] = [[p.models["recogniser"][0], "", cell(Number(*found[1, "", "accuracy"][:3]))]]
        listed += [[f"{network}, published", str(batch), f"{accuracy:.4f}"] for network, batch, accuracy in published]
        caption = f"Accuracy from one of {v} views beside the published recognisers (table 6), over objects."
        parts.append(Table(["network", "batch size", "one view"], listed, caption))
    return parts


def _map(e: Evaluation, name: str, figures: dict[str, Figure]) -> Section:
    scores = _scores(e, name)
    head = ["", *(text[0].upper() + text[1:] for text in MEASURES.values())]

    def row(heading: Cell | str, by: str, of_class: str = "", before: str = "") -> Row:
        cells = (cell(scores.get((by, of_class, before + m)), 4 if m == "mse" else 3) for m in MEASURES)
        return [heading, *cells]

    rows = [row("mean of objects", "network"), row("mean of classes", "network", before="class_")]
    for by in e.maps["by"].unique():
        if by != "network":
            rows.append(row(Cell(by, ("mean of objects",)), by))
            rows.append(row(Cell(by, ("mean of classes",)), by, before="class_"))
    classes = [label for label in e.maps[e.maps["map"] == name]["label"].unique() if label]
    alt = "True and predicted maps side by side, five objects of each class from the best to the worst."
    parts: list[Part] = [
        f"True is the {words(measure_of(name))} of the neighbouring views. {MAPS}",
        Table(head, rows, "The predicted maps and the baselines. Small print: 95\u00a0% intervals."),
        Table(head, [row(words(c), "network", c) for c in classes], "By class, as table 7 of the thesis."),
        [html.picture(figures[f"{name}_examples"], alt, EXAMPLES, broad=True)],
    ]
    return name, f"The {name.upper()}", parts


def _facts(p: Predictions, settings: dict[str, Any]) -> dict[str, str]:
    c = p.calibration
    calibration = f"temperature {c.temperature:.3g} for one view, correlation {c.correlation:.3g} between views"
    return {
        **origin(p, settings),
        "calibration": calibration,
        "bootstrap": f"{settings['samples']} samples of objects; seed {settings['seed']}",
        "calibration error": "15 bins of equal width (Guo et al. 2017)",
    }
