"""A task over predictions: what the models said of every view is looked up, nothing is rendered."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from nextview.arguments import of_kind
from nextview.data.predictions import Predictions
from nextview.envs.task import Rules, Split, Task
from nextview.errors import PredictionsError
from nextview.measures.map_names import in_order
from nextview.policies.gain import INPUTS


def replayed(
    predictions: str | Path | Predictions, split: Split | None = "train", balanced: bool = False, rules: Rules = Rules()
) -> Task:
    """The task of recognising the objects of one split.

    Args:
        predictions: a file, or what it holds. To learn from, they have to be of objects that the recogniser itself was
            not trained on (``nextview predict --held-out``): of others it is too sure, and an agent learns that one
            view is enough.
        split: "train" for objects to learn from, each shape once; "test" for those to judge by, which nothing may learn
            from; None for all, where the dataset has no splits.
        balanced: draw every class equally often.
        rules: see ``Rules``.

    Raises:
        PredictionsError: there are no objects of that split, or no such map or azimuth bins.
    """
    of_kind(predictions, str | Path | Predictions, "predictions are a file, or what it holds", PredictionsError)
    of_kind(split, str | None, "a split is a name", PredictionsError)
    p = predictions if isinstance(predictions, Predictions) else Predictions.load(predictions)
    p = p if split is None else p.of_split(split)
    p = p.deduplicate() if split == "train" else p
    lacking = [name for name in rules.maps if name not in p.maps]
    if lacking:
        known = ", ".join((*INPUTS, *in_order(p.maps)))
        raise PredictionsError(f"these predictions hold no map {lacking[0]!r}; inputs are some of {known}")
    if ("azimuth_bin" in rules.inputs or rules.frame == "object") and p.azimuth_bins is None:
        raise PredictionsError("these predictions hold no azimuth bins, which the inputs or the frame need")
    p = replace(p, maps={name: p.maps[name] for name in rules.maps})
    return Task(p.names, p.labels, p.classes, p.sphere, p.calibration, p.evidence, rules, balanced)
