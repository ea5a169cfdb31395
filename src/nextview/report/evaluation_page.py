"""An evaluation as a folder: all numbers, the tables, the figures, and one self-contained HTML page."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nextview.benchmark.evaluation import Evaluation
from nextview.benchmark.published import comparable_classes, published_recognisers
from nextview.data.predictions import Predictions
from nextview.measures.map_names import CONFIDENCE, measure_of
from nextview.report import evaluation_figures as drawn
from nextview.report.elements import (
    NONE,
    Card,
    Cell,
    Number,
    Picture,
    Table,
    cell,
    label,
    numbers,
    percent,
    picture,
    render,
)
from nextview.report.style import to_png

PAGE = "evaluate.html"
KIND = "evaluation"
"""Of these results, in their manifest."""


def save(
    folder: Path, e: Evaluation, p: Predictions, settings: dict[str, Any], figures: dict[str, Figure]
) -> Iterator[int]:
    """Write results.json, a CSV of each table, a PNG of each figure and evaluate.html.

    Args:
        folder: a new one, such as ``outputs.written_results`` makes.
        e: the numbers.
        p: from which.
        settings: how they were made.
        figures: of ``all_figures``.

    Yields:
        How many figures are written; the page counts as one.
    """
    for name, frame in e.tables().items():
        frame.to_csv(folder / f"{name}.csv", index=False)
    records = {name: _records(frame) for name, frame in e.tables().items()}
    results = {"settings": settings, "left_out": e.left_out, **records}
    (folder / "results.json").write_text(json.dumps(results, indent=1, allow_nan=False) + "\n")
    for done, (name, figure) in enumerate(figures.items()):
        to_png(figure, folder / f"{name}.png")
        yield done + 1
    (folder / PAGE).write_text(page(e, p, settings, figures), encoding="utf-8")
    yield len(figures) + 1


def _records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """One mapping a row; what is not there is left out."""
    rows = frame.astype(object).to_dict("records")
    return [{str(k): v for k, v in row.items() if v is not None and v == v} for row in rows]


def all_figures(e: Evaluation, p: Predictions, rng: np.random.Generator) -> dict[str, Figure]:
    """Every figure by the name of its file; the generator draws the examples."""
    figures = {
        "fusion": drawn.fusion_curve(e),
        "class_accuracy": drawn.class_accuracies(e),
        "reliability": drawn.reliability(e),
        "confidence": drawn.confidence_curve(e),
        "confusion_one_view": drawn.confusion(e, 1, p.classes),
        "confusion_all_views": drawn.confusion(e, len(p.sphere), p.classes),
    }
    for name in e.maps["map"].unique():
        for measure in ("mse", "d0", "d_le_1", "regret"):
            figures[f"{name}_{measure}"] = drawn.map_classes(e, name, measure)
        figures[f"{name}_examples"] = drawn.example_maps(p, name, rng)
    return figures


def page(e: Evaluation, p: Predictions, settings: dict[str, Any], figures: dict[str, Figure]) -> str:
    """The whole page as text."""
    v, found = len(p.sphere), _accuracies(e)
    name = p.models["recogniser"][0] if "recogniser" in p.models else "the recogniser"
    twice = int(p.conflicting.sum())
    error = e.fusion.set_index("n_views")["calibration_error"]
    return render(
        "evaluate.html",
        title=f"Evaluation of {name}",
        headline=f"{name}: {percent(found[1, '', 'accuracy'].value)} of single views right, "
        f"{percent(found[v, '', 'accuracy'].value)} of objects with all {v} views fused",
        facts=f"{len(p):,} objects of {len(set(p.labels.tolist()))} classes, {v} views each"
        + (f"; {twice} of them are the very mesh of another object with another label." if twice else "."),
        numbers=_cards(e, v),
        recogniser=_recogniser(p, e, figures),
        accuracy=_accuracy_table(e, p),
        published=_published_table(e, p),
        confusions=_confusions(p, figures),
        errors=", ".join(f"{error[k]:.3f} after {k}" for k in _compared(e)),
        calibration=_calibration(e, figures),
        maps=[_map(e, kind, figures) for kind in e.maps["map"].unique()],
        left_out=e.left_out,
        made=_facts(p, settings),
    )


def _cards(e: Evaluation, v: int) -> list[Card]:
    found = _accuracies(e)
    error = e.fusion.set_index("n_views")["calibration_error"]
    cards = [
        _share_card(heading, found[n, "", "accuracy"], f"classes {percent(found[n, '', 'class_accuracy'].value)}")
        for n, heading in ((1, "one view"), (v, f"all {v} views fused"))
    ]
    cards.append(Card("calibration error", f"{error[1]:.3f}", f"one view; {error[v]:.3f} with all {v} fused"))
    for kind in e.maps["map"].unique():
        scores = _scores(e, kind)
        near, loss = scores["network", "", "d_le_1"], scores["network", "", "mse"]
        cards.append(_share_card(f"{kind.upper()}: peak within one cell", near, f"MSE {loss.value:.4f}"))
    return cards


def _share_card(title: str, number: Number, small: str) -> Card:
    return Card(title, percent(number.value), f"{100 * number.low:.1f} {NONE} {percent(number.high)}; {small}")


def _accuracies(e: Evaluation) -> dict[tuple, Number]:
    return numbers(e.accuracy, "n_views", "label", "measure")


def _scores(e: Evaluation, name: str) -> dict[tuple, Number]:
    return numbers(e.maps[e.maps["map"] == name], "by", "label", "measure")


def _compared(e: Evaluation) -> list[int]:
    """Numbers of views whose confidence is compared with accuracy."""
    return list(dict.fromkeys(e.reliability["n_views"].tolist()))


def _accuracy_table(e: Evaluation, p: Predictions) -> Table:
    found, v = _accuracies(e), len(p.sphere)
    columns = [(n_views, measure) for n_views in (1, v) for measure in ("accuracy", "clean_accuracy")]
    rows: list[list[Cell | str]] = []
    counts = np.bincount(p.labels, minlength=len(p.classes))
    for of_class in e.accuracy.query("label != ''")["label"].unique():
        cells = (cell(found[n_views, of_class, measure]) for n_views, measure in columns)
        rows.append([label(of_class), str(counts[p.classes.index(of_class)]), *cells])
    for heading, before in (("mean of classes", "class_"), ("mean of objects", "")):
        cells = (cell(found[n_views, "", before + measure]) for n_views, measure in columns)
        rows.append([heading, f"{len(p):,}", *cells])
        if p.of_size is not None:
            one, fused = (cell(found[n_views, "", f"{before}shape_accuracy"]) for n_views in (1, v))
            rows.append([Cell(heading, ("size of the objects not known",)), f"{len(p):,}", one, "", fused, ""])
    head = ["class", "objects", "one view", "without duplicates", f"all {v} views fused", "without duplicates"]
    return Table(head, rows, "Share of right answers. Small print: 95\u00a0% intervals.")


def _published_table(e: Evaluation, p: Predictions) -> Table | None:
    """Beside the published recognisers; None if there are none for these objects."""
    published = published_recognisers(comparable_classes(p), len(p.sphere))
    if not published:
        return None
    ours = _accuracies(e)[1, "", "accuracy"]
    listed: list[list[Cell | str]] = [[p.models["recogniser"][0], "", cell(Number(*ours[:3]))]]
    listed += [[f"{network}, published", str(batch), f"{accuracy:.4f}"] for network, batch, accuracy in published]
    caption = f"Accuracy from one of {len(p.sphere)} views beside the published recognisers (table 6), over objects."
    return Table(["network", "batch size", "one view"], listed, caption)


def _recogniser(p: Predictions, e: Evaluation, figures: dict[str, Figure]) -> list[Picture]:
    curve = e.fusion.set_index("n_views")["accuracy"]
    shown = ", ".join(f"{k}: {curve[k]:.3f}" for k in (1, 2, 5, 10, len(p.sphere)) if k in curve.index)
    return [
        picture(
            figures["fusion"],
            f"Accuracy against the number of random views fused. {shown}.",
            "Logits of random views summed: accuracy against their number. Each object's views come in one random "
            "order and all its rotations, so every view counts alike at every number.",
        ),
        picture(
            figures["class_accuracy"],
            "Accuracy of each class from one view and from all; the table has the numbers.",
            "Accuracy by class.",
        ),
    ]


def _confusions(p: Predictions, figures: dict[str, Figure]) -> list[Picture]:
    caption = "Percent of each true class, as figure 12 of the thesis."
    return [
        picture(figures["confusion_one_view"], "Confusion matrix of single views.", caption),
        picture(figures["confusion_all_views"], f"Confusion matrix of all {len(p.sphere)} views fused.", caption),
    ]


def _calibration(e: Evaluation, figures: dict[str, Figure]) -> list[Picture]:
    curve = e.fusion.set_index("n_views")
    shown = ", ".join(f"{curve.calibration_error[k]:.3f} after {k}" for k in _compared(e))
    return [
        picture(
            figures["reliability"],
            f"Share of right answers against confidence. Calibration error: {shown}.",
            "Reliability after one random view and more. Bins of fewer than 20 answers are left out.",
        ),
        picture(
            figures["confidence"],
            "Mean confidence and accuracy against the number of random views fused. "
            + ", ".join(f"{k}: {curve.confidence[k]:.3f} and {curve.accuracy[k]:.3f}" for k in _compared(e))
            + ".",
            "Mean confidence against accuracy. Views of one object make alike mistakes: a sum of logits takes them "
            "for independent and grows too sure.",
        ),
    ]


def _truth(name: str) -> str:
    """What a map tells."""
    measure = measure_of(name)
    if measure == CONFIDENCE:
        return "the recogniser's confidence in the neighbouring views, 0 where it is wrong"
    called = measure.replace("_", " ").replace("depth entropy", "depth-entropy")
    return f"the {called} of the neighbouring views, scaled to 0 .. 1 over the object's views"


def _map(e: Evaluation, name: str, figures: dict[str, Figure]) -> dict[str, Any]:
    scores = _scores(e, name)
    measures = list(drawn.MEASURES)
    head = ["", *(words[0].upper() + words[1:] for words in drawn.MEASURES.values())]

    def row(heading: Cell | str, by: str, of_class: str = "", before: str = "") -> list[Cell | str]:
        cells = (cell(scores.get((by, of_class, before + m)), 4 if m == "mse" else 3) for m in measures)
        return [heading, *cells]

    rows = [row("mean of objects", "network"), row("mean of classes", "network", before="class_")]
    for by in e.maps["by"].unique():
        if by != "network":
            rows.append(row(Cell(by, ("mean of objects",)), by))
            rows.append(row(Cell(by, ("mean of classes",)), by, before="class_"))
    classes = [name for name in e.maps[e.maps["map"] == name]["label"].unique() if name]
    return {
        "name": name,
        "truth": _truth(name),
        "scores": Table(head, rows, "The predicted maps and the baselines. Small print: 95\u00a0% intervals."),
        "figures": [
            picture(
                figures[f"{name}_{measure}"],
                f"{drawn.MEASURES[measure]} by class; the table has the numbers.",
                f"{drawn.MEASURES[measure].capitalize()}, by class.",
            )
            for measure in ("mse", "d0", "d_le_1", "regret")
        ],
        "by_class": Table(head, [row(label(c), "network", c) for c in classes], "By class, as table 7 of the thesis."),
        "examples": picture(
            figures[f"{name}_examples"],
            "True and predicted maps side by side, five objects of each class from the best to the worst.",
            "Examples, as figures 25 to 28: one random view of each object was drawn, and those shown stand at equal "
            "steps of its squared error.",
            broad=True,
        ),
    }


def _calibration_fact(p: Predictions) -> str:
    """How the sums of logits became confidences."""
    c = p.calibration
    if (c.temperature, c.correlation) == (1, 0):
        return "none: the softmax of the sum of the logits as it stands"
    return f"temperature {c.temperature:.3g} for one view, correlation {c.correlation:.3g} between views"


def _facts(p: Predictions, settings: dict[str, Any]) -> dict[str, str]:
    splits = zip(*np.unique(p.splits, return_counts=True), strict=True)
    conflicting = [name for name, twice in zip(p.names, p.conflicting, strict=True) if twice]
    return {
        "predictions": f"{settings['predictions']}, SHA-256 {settings['predictions_sha256']}",
        **{f"model: {kind}": f"{name}, SHA-256 {sha}" for kind, (name, sha) in p.models.items()},
        "splits": ", ".join(f"{n} {name or 'unnamed'}" for name, n in splits),
        "the same mesh under another label": ", ".join(conflicting) or "none",
        "calibration": _calibration_fact(p),
        "bootstrap": f"{settings['samples']} samples of objects; seed {settings['seed']}",
        "calibration error": "15 bins of equal width (Guo et al. 2017)",
    }
