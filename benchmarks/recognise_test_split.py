"""Recognise every mesh of a test split live (camera, networks, policy), with each policy, from the same first views.

    python benchmarks/recognise_test_split.py DATASET/ModelNet10 [--runs 1] [--limit N]

Prints for each policy: accuracy over objects (95 % bootstrap interval over objects) and over classes, looks, travel.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from nextview import SimulatedCamera, Stopping, ViewSphere, load_mesh, load_models, make_policy, recognise
from nextview.cli.progress import track
from nextview.data.folders import Entry, list_dataset

POLICIES = ("random", "random-all", "furthest", "unidirectional", "lem", "lcm-peak", "fixed-sequence-near", "gain")


@dataclass(frozen=True)
class Settings:
    """What is run.

    Attributes:
        dataset: folder in ModelNet's layout.
        runs: first views for each object.
        threshold: stop at this belief.
        max_views: or after so many views.
        limit: only so many objects, spread over the split; all by default.
        seed: decides the first views and what the policies draw.
    """

    dataset: tyro.conf.Positional[Path]
    runs: int = 1
    threshold: float = 0.97
    max_views: int = 5
    limit: int | None = None
    seed: int = 0


def begin() -> None:
    global models, sphere
    models, sphere = load_models(("lem", "lcm"), threads=1), ViewSphere.named("40")


def run_object(entry: Entry, starts: np.ndarray, settings: Settings) -> np.ndarray:
    """(policies, runs, [right, looks, travel in cells, travel in radians, seconds])"""
    camera = SimulatedCamera(load_mesh(entry.path))
    found = np.zeros((len(POLICIES), len(starts), 5))
    for p, name in enumerate(POLICIES):
        policy = make_policy(name, sphere, models.valley_classes("lem"), models.classes)
        for r, start in enumerate(starts):
            begun = time.perf_counter()
            rng = np.random.default_rng([settings.seed, int(start), r])
            stopping = Stopping(settings.threshold, settings.max_views, models.recogniser.calibration.correlation)
            result = recognise(camera, models, policy, sphere, int(start), stopping, rng)
            seconds = time.perf_counter() - begun
            last = result.n_views[-1]
            found[p, r] = result.answer == entry.label, len(result.n_views), last.travel, last.arc, seconds
    return found


def main(settings: Settings) -> None:
    entries = [e for e in list_dataset(settings.dataset) if e.split == "test"]
    if settings.limit:
        entries = entries[:: max(1, len(entries) // settings.limit)]
    rng = np.random.default_rng(settings.seed)
    starts = rng.integers(40, size=(len(entries), settings.runs))
    results: list[np.ndarray] = []
    with ProcessPoolExecutor(mp_context=get_context("spawn"), initializer=begin) as pool:

        def done():
            for found in pool.map(run_object, entries, starts, [settings] * len(entries)):
                results.append(found)
                yield len(results)

        track(done(), len(entries), "recognising")
    found = np.stack(results)  # (objects, policies, runs, 5)
    labels = np.array([e.label for e in entries])
    draws = rng.integers(len(entries), size=(2000, len(entries)))
    table = Table(
        "policy", "accuracy", "95 %", "class mean", "n_views", "travel, cells", "travel, rad", "ms an episode",
        title=f"{len(entries)} test objects x {settings.runs} first views, threshold {settings.threshold}, "
        f"at most {settings.max_views} views",
    )  # fmt: skip
    for p, name in enumerate(POLICIES):
        right = found[:, p, :, 0].mean(1)
        low, high = np.percentile(right[draws].mean(1), [2.5, 97.5])
        class_mean = np.mean([right[labels == c].mean() for c in np.unique(labels)])
        n_views, travel, arc, seconds = found[:, p, :, 1:].mean((0, 1))
        table.add_row(
            name, f"{right.mean():.4f}", f"{low:.3f} .. {high:.3f}", f"{class_mean:.4f}", f"{n_views:.2f}",
            f"{travel:.2f}", f"{arc:.2f}", f"{1000 * seconds:.0f}",
        )  # fmt: skip
    Console(width=120).print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
