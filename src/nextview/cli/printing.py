"""What commands show of their results, beyond a sentence."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from nextview.cli.progress import Terminal
from nextview.errors import EntryError
from nextview.files import new_file

if TYPE_CHECKING:
    from nextview.benchmark.evaluation import Evaluation
    from nextview.benchmark.page import Number
    from nextview.benchmark.run import Results


def print_results(found: Results) -> None:
    """Print the leaderboard of a benchmark."""
    from nextview.cli.leaderboard_table import print_leaderboard

    print_leaderboard(found)
    if found.settings["failures"]:
        raise EntryError("\n".join(found.settings["failures"].values()))


def print_evaluation(found: Evaluation) -> None:
    """Print the scores of the recogniser and of each map."""
    console = Terminal()
    console.print(_recogniser_table(found))
    for name in found.maps["map"].unique():
        console.print(_map_table(found, name))
    for name, why in found.left_out.items():
        console.print(f"{name}: {why}")


def trained(runs: list[Path]) -> None:
    """Draw the log of each run that was trained as its curves.png."""
    from nextview.learning.loop import is_first
    from nextview.session.style import to_png
    from nextview.viewers.training_curves import read_log, training_curves

    for run in runs if is_first() else ():  # of the processes of a training on several devices, one draws
        with new_file(run / "curves.png", overwrite=True) as part:
            to_png(training_curves(read_log(run)), part)


def _recogniser_table(found: Evaluation) -> Table:
    """Accuracy of each class and of all, from one view and from all views fused."""
    from nextview.benchmark.page import numbers

    views = int(found.accuracy["n_views"].max())
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
        shown.add_row(heading, str(objects[label, measure]), *cells, end_section=label == labels[-1])
    published = right[1, "", "accuracy"].published
    if isfinite(published):
        shown.add_row("  published", "", f"{published:.3f}")
    return shown


def _map_table(found: Evaluation, name: str) -> Table:
    """Scores of a map over objects and classes, beside the published ones and the baselines."""
    from nextview.benchmark.page import numbers

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


def _cell(number: Number, digits: int) -> Text:
    """A number and its interval."""
    if not isfinite(number.value):
        return Text("-")
    interval = f" {number.low:.{digits}f}-{number.high:.{digits}f}" if number.high > number.low else ""
    return Text.assemble(f"{number.value:.{digits}f}", (interval, "dim"))
