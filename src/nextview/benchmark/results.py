"""The folder of results: every episode in Parquet, the tables in CSV, and all that is needed to run it again."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.benchmark.experiment import Grid
from nextview.benchmark.levels import COLUMNS
from nextview.benchmark.replay import Outcomes
from nextview.benchmark.summary import Tables
from nextview.data.predictions import Predictions
from nextview.errors import ResultsError
from nextview.outputs import changed_files, left_by_a_cut

KIND = "benchmark"
"""Of these results, in their manifest."""


@dataclass(frozen=True)
class Results:
    """What ``save`` wrote.

    Attributes:
        folder: where it lies.
        settings: how it was run.
        predictions: from which.
        tables: see ``summary.Tables``.
    """

    folder: Path
    settings: dict[str, Any]
    predictions: Predictions
    tables: Tables

    def episodes(self, policy: str, threshold: float | None) -> pd.DataFrame:
        """The episodes of one cell, one a row: run by run, in each the objects in the order of the predictions."""
        cell = [("policy", "==", policy)] + ([] if threshold is None else [("threshold", "==", threshold)])
        return pq.read_table(self.folder / "episodes.parquet", filters=cell).to_pandas()


def save(folder: Path, grid: Grid, tables: Tables, settings: dict[str, Any]) -> None:
    """Write results into a new folder, such as ``outputs.written_results`` makes."""
    _write_episodes(folder / "episodes.parquet", grid)
    for name, table in tables.named().items():
        table.to_csv(folder / f"{name}.csv", index=False)
    grid.specs.predictions.save(folder / "predictions.npz")
    (folder / "benchmark.json").write_text(json.dumps(settings, indent=1) + "\n")


@takes_paths("folder")
def load(folder: Path) -> Results:
    """Read a folder of results.

    Raises:
        ResultsError: it is none, or a part of it is missing or was changed.
    """
    changed = [name for name in changed_files(folder, KIND) if not name.endswith(".html")]
    if changed:
        raise ResultsError(f"{folder}: these benchmark results are damaged ({changed[0]} is not as it was written)")
    try:
        settings = json.loads((folder / "benchmark.json").read_text())
        tables = Tables(**{name: _table(folder, name) for name in Tables.__dataclass_fields__})
        if not (folder / "episodes.parquet").exists():
            raise FileNotFoundError
    except FileNotFoundError:
        left = left_by_a_cut(folder, KIND)
        if left is not None:
            raise ResultsError(
                f"{folder}: a run was killed while it put its results there; rename {left} to it"
            ) from None
        raise ResultsError(f"{folder}: holds no benchmark results; make some with nextview benchmark") from None
    except (ValueError, RecursionError) as error:
        raise ResultsError(f"{folder}: these benchmark results are damaged ({error})") from None
    return Results(folder, settings, Predictions.load(folder / "predictions.npz"), tables)


def _table(folder: Path, name: str) -> pd.DataFrame:
    """One of the tables; results that were made before there were worlds have no levels."""
    path = folder / f"{name}.csv"
    return pd.DataFrame(columns=COLUMNS) if name == "levels" and not path.exists() else pd.read_csv(path)


def _write_episodes(path: Path, grid: Grid) -> None:
    """One row an episode, one row group a cell."""
    p, runs = grid.specs.predictions, grid.runs
    names = pa.DictionaryArray.from_arrays(pa.array(grid.specs.objects, pa.int32()), pa.array(p.names))
    labels = pa.DictionaryArray.from_arrays(pa.array(grid.specs.labels, pa.int32()), pa.array(p.classes))
    run = pa.array(np.repeat(np.arange(runs, dtype=np.int32), len(p)))
    writer = None
    for policy, threshold, ends in grid.cells():
        fixed = grid.paths[policy].fixed
        table = pa.table(
            {
                "object": names,
                "label": labels,
                "run": run,
                "policy": _constant(policy, len(names)),
                "threshold": pa.array(np.full(len(names), np.nan if threshold is None else threshold)),
                "views": _lists(grid.paths[policy].views, ends.n_views),
                "stop": _stops(ends, fixed),
                "answer": pa.DictionaryArray.from_arrays(pa.array(ends.answer, pa.int32()), pa.array(p.classes)),
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


def _constant(text: str, n: int) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(np.zeros(n, np.int32)), pa.array([text]))


STOPS = ("views ran out", "confident", "fixed views")


def _stops(ends: Outcomes, fixed: bool) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(np.where(fixed, 2, ends.confident), pa.int32()), pa.array(STOPS))


def _lists(views: NDArray[np.int64], n_views: NDArray[np.int64]) -> pa.ListArray:
    """The first so many views of each row, as lists."""
    taken = np.arange(views.shape[1]) < n_views[:, None]
    offsets = np.concatenate([[0], np.cumsum(n_views)]).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(offsets), pa.array(views[taken].astype(np.int16)))
