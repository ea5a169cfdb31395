"""The benchmark of classes: from predictions to a folder of results, and reading that folder."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from nextview.data.progress import TrackProgress, silently
from nextview.errors import ResultsError, UsageError
from nextview.files import check_new, command, sha256_of
from nextview.policies.registry import with_cards
from nextview.recognition.belief import PLAIN_SUM, Stopping
from nextview.recognition.map_names import LEM
from nextview.recognition.model_card import find_models
from nextview.recognition.own_stopping import own_stopping
from nextview_lab.benchmark.class_tables import (
    ClassResults,
    ClassTables,
    summarise,
)
from nextview_lab.benchmark.entries import check_entry, default_entries
from nextview_lab.benchmark.jobs import Settings
from nextview_lab.benchmark.replay import THESIS_THRESHOLDS, Grid, make_specs, run_grid
from nextview_lab.benchmark.results import RECORD, write_results
from nextview_lab.data.predictions import Predictions
from nextview_lab.errors import EntryError
from nextview_lab.extras import extras

with extras():
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq


@dataclass(frozen=True)
class ClassSettings(Settings):
    """Policies, thresholds and statistics.

    Attributes:
        policies: names of policies, or MODULE:CLASS for your own; by default all that the
            predictions allow.
        models: folder of your own models, whose learned policies can be used by name.
        thresholds: thresholds of the belief.
        risks: largest error rates; the thresholds that guarantee them, according to the
            recogniser's calibration, are added. With risks, thresholds are constant; otherwise they
            decrease with the views.
        views: further numbers of views after which the policies are compared, such as 1 2 3 5.
        stopping: stopping rule of your own, MODULE:NAME, called with each threshold.
        uncalibrated: use the plain sum of the logits, as published, instead of the calibration on
            the card.
        split: use only objects of this split; needed if the predictions contain several.
        runs: random first views of each object.
        max_views: largest number of views.
    """

    models: str = "modelnet10"
    thresholds: tuple[float, ...] = THESIS_THRESHOLDS
    risks: tuple[float, ...] = ()
    stopping: str | None = None
    uncalibrated: bool = False
    split: Literal["train", "test", "val"] | None = None
    runs: int = 10
    max_views: int = 5
    samples: int = 2000


def benchmark_classes(
    predictions: Path,
    out: Path,
    settings: ClassSettings = ClassSettings(),
    *,
    overwrite: bool = False,
    track: TrackProgress = silently,
) -> ClassResults:
    """Run all policies at all thresholds from the same first views, and compare them.

    It writes episodes, tables and significance tests; nextview-lab report makes an HTML page of
    them. If a policy fails, the settings of the results give the reason.

    Args:
        predictions: predictions of nextview-lab predict.
        out: folder for the results.
        overwrite: replace earlier results.

    Raises:
        UsageError, RiskError: settings are invalid, or a risk cannot be guaranteed.
        EntryError, PolicyError: a named policy cannot be made, or all policies fail.
    """
    check_new(out, overwrite, folder=True)
    grid, names, promised = _prepare(predictions, settings)
    track(run_grid(grid, names), len(names), "replaying policies")
    if not grid.paths:
        raise EntryError("; ".join(grid.failures.values()))

    rng = np.random.default_rng([settings.seed, 1])
    tables = summarise(
        grid,
        settings.reference,
        settings.samples,
        rng,
        sorted(set(settings.views)),
    )

    table = grid.specs.predictions
    made = asdict(settings) | {
        "command": command(),
        "predictions": predictions.name,
        "predictions_sha256": sha256_of(predictions),
        "models": table.models,
        "policies": names,
        "failures": grid.failures,
        "thresholds": grid.thresholds,
        "risks": {str(risk): threshold for risk, threshold in promised.items()},
        "calibration": [table.calibration.temperature, table.calibration.correlation],
        "threshold_decay": grid.threshold_decay,
        "valley_classes": [table.classes[i] for i in grid.specs.valley_classes(LEM)],
    }

    def more(part: Path) -> None:
        _write_episodes(part / "episodes.parquet", grid)
        table.save(part / "predictions.npz")

    write_results(out, tables, made, more, overwrite, withdraw=True)
    return load(out)


def _prepare(
    predictions: Path,
    s: ClassSettings,
) -> tuple[Grid, list[str], dict[float, float]]:
    """Return the grid, the entry names, and the threshold that guarantees each error rate."""
    if not s.thresholds:
        raise UsageError("at least one threshold is needed")
    if s.views and not 1 <= min(s.views) <= max(s.views) <= s.max_views:
        asked = " ".join(map(str, s.views))
        raise UsageError(
            f"policies take 1 to {s.max_views} views (--max-views), and --views asks for {asked}"
        )

    table = Predictions.load(predictions)
    if s.uncalibrated:
        table = replace(table, calibration=PLAIN_SUM)
    decay = 0.0 if s.risks else table.calibration.correlation
    for threshold in s.thresholds:
        Stopping(threshold, s.max_views, decay)  # raises an error for invalid settings
    if s.stopping and s.risks:
        raise UsageError(
            "error rates are promised for the package's own stopping rule, not for yours"
        )
    if s.stopping:
        own_stopping(s.stopping, s.thresholds[0], s.max_views)  # likewise
    promised = {
        risk: table.calibration.threshold(risk, s.max_views) for risk in s.risks
    }
    table = chosen_split(table, predictions, s.split)
    specs = make_specs(table, s.runs, s.seed)
    cards = find_models(s.models).policies
    names = [with_cards(name, cards) for name in s.policies] or [
        *default_entries(specs),
        *map(str, cards.values()),
    ]
    names = list(dict.fromkeys([*([s.reference] if s.policies else []), *names]))
    for name in names if s.policies else ():
        check_entry(name, specs)
    thresholds = tuple(sorted({*s.thresholds, *promised.values()}))

    return (
        Grid(specs, s.runs, thresholds, s.max_views, s.seed, decay, s.stopping),
        names,
        promised,
    )


def chosen_split(table: Predictions, path: Path, split: str | None) -> Predictions:
    """Select the objects of one split.

    Args:
        table: the predictions.
        path: of the predictions, for messages.
        split: name of the split; None if the predictions hold only one.

    Returns:
        The predictions of the split.

    Raises:
        UsageError: there are several splits and none is chosen.
    """
    if split:
        return table.of_split(split)
    if len(set(table.splits)) > 1:
        raise UsageError(
            f"{path}: holds training and test objects; choose one with --split"
        )
    return table


def load(folder: Path) -> ClassResults:
    """Read a folder of results."""
    folder = Path(folder)
    try:
        settings = json.loads((folder / RECORD).read_text())
        frames = {
            name: pd.read_csv(folder / f"{name}.csv") for name in ("measures", "tests")
        }
        tables = ClassTables(reference=settings["reference"], **frames)
        pq.read_schema(folder / "episodes.parquet")
    except (FileNotFoundError, NotADirectoryError):
        raise ResultsError(
            f"{folder}: holds no benchmark results; make some with nextview-lab benchmark classes"
        ) from None
    except (ValueError, RecursionError, pa.ArrowInvalid) as error:
        raise ResultsError(
            f"{folder}: these benchmark results are damaged ({error})"
        ) from None
    return ClassResults(
        folder,
        settings,
        Predictions.load(folder / "predictions.npz"),
        tables,
    )


STOPS = ("views ran out", "confident", "fixed views")


def _write_episodes(path: Path, grid: Grid) -> None:
    p = grid.specs.predictions
    n = len(grid.specs.objects)

    def words(codes: Any, names: tuple[str, ...]) -> pa.DictionaryArray:
        return pa.DictionaryArray.from_arrays(
            pa.array(codes, pa.int32()),
            pa.array(names),
        )

    names = words(grid.specs.objects, p.names)
    labels = words(grid.specs.labels, p.classes)
    run = pa.array(np.repeat(np.arange(grid.runs, dtype=np.int32), len(p)))
    writer = None
    for policy, threshold, ends in grid.cells():
        paths = grid.paths[policy]
        taken = ends.views[ends.views >= 0].astype(np.int16)
        begins = np.concatenate([[0], np.cumsum(ends.n_views)]).astype(np.int32)
        table = pa.table(
            {
                "object": names,
                "label": labels,
                "run": run,
                "policy": words(np.zeros(n), (policy,)),
                "threshold": pa.array(
                    np.full(n, np.nan if threshold is None else threshold)
                ),
                "views": pa.ListArray.from_arrays(pa.array(begins), pa.array(taken)),
                "stop": words(np.where(paths.fixed, 2, ends.confident), STOPS),
                "answer": words(ends.answer, p.classes),
                "confidence": pa.array(ends.confidence),
                "n_views": pa.array(ends.n_views, pa.int32()),
                "travel": pa.array(ends.travel),
                "arc": pa.array(ends.arc),
            }
        )
        writer = writer or pq.ParquetWriter(path, table.schema, compression="zstd")
        writer.write_table(table)
    if writer is not None:
        writer.close()
