"""Evaluate the models behind predictions, and write a folder of tables and an HTML page."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from msgspec.structs import replace

from nextview.errors import ModelError
from nextview.files import check_new, new_folder, only_one, sha256_of
from nextview.recognition.model_card import find_card, read_card, write_card
from nextview_lab.benchmark import figures as draw
from nextview_lab.benchmark.classes import chosen_split
from nextview_lab.benchmark.evaluation import Evaluation, evaluate, scores_for_card
from nextview_lab.benchmark.page import numbers, origin, picture, render
from nextview_lab.benchmark.published import published_recognisers
from nextview_lab.data.predictions import Predictions


@dataclass(frozen=True)
class EvaluationSettings:
    """Predictions to evaluate, and statistics.

    Attributes:
        split: use only objects of this split; needed if the predictions contain several.
        deduplicate: evaluate only the first of identical meshes with the same label; the published
            numbers include all of them.
        cards: cards of the models that made the predictions; the scores are written into them.
        samples: number of bootstrap samples.
        seed: seed of the bootstrap and of the orders of views.
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
) -> Evaluation:
    """Evaluate a recogniser and its maps on every view, and compare with published scores.

    Args:
        predictions: predictions of nextview-lab predict.
        out: folder for tables (.csv), settings and evaluate.html.
        overwrite: replace an earlier evaluation.

    Raises:
        UsageError: the predictions contain several splits, and none is selected.
        ResultsError: there is nothing to evaluate, or a card belongs to another model.
    """
    check_new(out, overwrite, folder=True)
    p = chosen_split(Predictions.load(predictions), predictions, settings.split)
    p = p.deduplicate() if settings.deduplicate else p
    noted = {}

    for name in settings.cards:
        card = find_card(name)
        what = "shapes" if settings.deduplicate else "objects"
        if p.of_size is not None:
            what += ", of known size"
        scores = {
            f"{settings.split or p.splits[0] or 'all'} ({len(p)} {what})": scores_for_card(
                card,
                p,
            )
        }
        noted[card.card_path] = card.sha256, scores
    made = asdict(settings) | {
        "predictions": predictions.name,
        "predictions_sha256": sha256_of(predictions),
    }
    made |= {"models": p.models, "objects": len(p)}
    found = evaluate(p, settings.samples, np.random.default_rng([settings.seed, 0]))

    with new_folder(out, overwrite, last="evaluate.json", withdraw=True) as part:
        for name, frame in found.tables().items():
            frame.to_csv(part / f"{name}.csv", index=False)
        (part / "evaluate.json").write_text(
            json.dumps({"settings": made, "left_out": found.left_out}, indent=1) + "\n"
        )
        (part / "evaluate.html").write_text(page(found, p, made), encoding="utf-8")
    for path, (sha256, scores) in noted.items():
        with only_one(path):
            card = read_card(path)  # it may have changed
            if card.sha256 != sha256:
                raise ModelError(
                    f"{path}: became the card of another model while this ran, and is left as it is"
                )
            write_card(path, replace(card, scores={**card.scores, **scores}))

    return found


def page(e: Evaluation, p: Predictions, settings: dict[str, Any]) -> str:
    """Return the page of an evaluation.

    Args:
        e: the evaluation.
        p: the predictions.
        settings: of the evaluation.

    Returns:
        HTML.
    """
    v = len(p.sphere)
    curve = e.fusion.set_index("n_views")
    c = p.calibration
    counts = e.accuracy.query(
        "n_views == 1 and measure == 'accuracy' and label != ''"
    ).set_index("label")["objects"]

    made = {
        **origin(p, settings),
        "calibration": (
            f"temperature {c.temperature:.3g} for one view, correlation {c.correlation:.3g} between"
            " views"
        ),
        "bootstrap": f"{settings['samples']} samples of objects; seed {settings['seed']}",
        "calibration error": "15 bins of equal width (Guo et al. 2017)",
    }

    return render(
        "evaluate.html",
        p=p,
        found=numbers(e.accuracy, "n_views", "label", "measure"),
        counts=counts.to_dict(),
        published=published_recognisers(p.classes, v),
        errors=curve["calibration_error"],
        fused_views=", ".join(
            f"{k}: {curve.accuracy[k]:.3f}"
            for k in (1, 2, 5, 10, v)
            if k in curve.index
        ),
        maps={
            kind: numbers(rows, "by", "label", "measure")
            for kind, rows in e.maps.groupby("map", sort=False)
        },
        baselines=[by for by in e.maps["by"].unique() if by != "network"],
        figures={
            "confusion_one_view": picture(draw.confusion_matrix(e, 1, p.classes)),
            "confusion_all_views": picture(
                draw.confusion_matrix(e, len(p.sphere), p.classes)
            ),
        },
        left_out=e.left_out,
        made=made,
    )
