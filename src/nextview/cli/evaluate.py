"""``nextview evaluate``: how good a recogniser and its map networks are, from predictions."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro


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
    from nextview.cli.progress import track
    from nextview.cli.terminal import Terminal
    from nextview.report import terminal
    from nextview.report.evaluation_page import PAGE
    from nextview.report.evaluation_stage import write_evaluation

    found = write_evaluation(
        predictions, out, split=split, deduplicate=deduplicate, cards=cards, samples=samples, seed=seed, track=track
    )
    console = Terminal()
    console.print(terminal.recogniser_table(found))
    for name in found.maps["map"].unique():
        console.print(terminal.map_table(found, name))
    for name, why in found.left_out.items():
        console.print(f"{name}: {why}", highlight=False)
    console.print(f"numbers, figures and {PAGE} in {out}", highlight=False)
