"""How long the benchmark's full grid takes by replay, how that grows, and what it would take with
the networks.

    python -m benchmarks.replay [--predictions test.npz] [--meshes table.off desk.off ...]

Each row of the growth table runs in a process of its own, so that its memory is its own peak too.
"""

from __future__ import annotations

import resource
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from nextview_lab.extras import require

require("benchmark")

import numpy as np
import tyro

from nextview.cli.exit_status import orderly_end
from nextview.geometry.viewsphere import ViewSphere
from nextview.recognition.belief import Calibration
from nextview_lab.benchmark.class_tables import summarise
from nextview_lab.benchmark.entries import default_entries
from nextview_lab.benchmark.replay import THESIS_THRESHOLDS, Grid, make_specs, run_grid
from nextview_lab.data.predictions import Predictions

TEN = ["random", "random-all", "furthest", "unidirectional", "lem", "lem-peak"]
TEN += ["oracle-valley", "true-lem", "true-lcm", "oracle-gain"]


def made_up(objects: int, azimuths: int = 8, classes: int = 10) -> Predictions:
    rng = np.random.default_rng(0)
    sphere = ViewSphere((0.0, 18.0, 36.0, 54.0, 72.0), azimuths)
    v = len(sphere)
    labels = np.arange(objects) % classes
    logits = (
        rng.normal(size=(objects, v, classes)) + 2 * np.eye(classes)[labels][:, None]
    )
    return Predictions(
        logits.astype(np.float32),
        {"lem": rng.random((objects, v, 5, 3)).astype(np.float32)},
        rng.random((objects, v)).astype(np.float32),
        tuple(f"object_{i}" for i in range(objects)),
        labels,
        tuple(f"class_{i}" for i in range(classes)),
        np.array(["test"] * objects),
        np.zeros(objects, bool),
        sphere,
        {},
        {"lem": ("class_0",)},
        Calibration(1.0, 0.8, bin_correlation=0.1),
        rng.normal(size=(objects, v, classes, 8)).astype(np.float32),
    )


def run(
    source: Path | tuple[int, int],
    names: list[str] | None,
    max_views: int = 5,
) -> tuple[float, float, float, int]:
    """Seconds to load and replay, seconds to summarise, peak memory in GB, episodes."""
    predictions = (
        Predictions.load(source) if isinstance(source, Path) else made_up(*source)
    )
    began = time.perf_counter()
    specs = make_specs(predictions, 10, 0)
    grid = Grid(specs, 10, THESIS_THRESHOLDS, max_views, 0)
    list(run_grid(grid, names or default_entries(specs)))
    replayed = time.perf_counter()
    summarise(grid, "random", 2000, np.random.default_rng(0))
    done = time.perf_counter()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return (
        replayed - began,
        done - replayed,
        memory,
        len(specs.objects) * len(list(grid.cells())),
    )


def with_networks(meshes: list[Path], n_views: int = 40) -> float:
    """Seconds a view with the simulated camera and the bundled networks, one view of a time, as
    live.
    """
    from nextview.geometry.mesh import load_mesh
    from nextview.session.system import load
    from nextview.simulation.simulated import SimulatedCamera

    models = load(policy="lem").models
    sphere = ViewSphere.named("40")
    cameras = [
        SimulatedCamera(load_mesh(path), 224, sphere.distance) for path in meshes
    ]
    models.evidence([cameras[0].observe(sphere.poses[0])])
    began = time.perf_counter()
    for camera in cameras:
        for pose in sphere.poses[:n_views]:
            models.evidence([camera.observe(pose)])
    return (time.perf_counter() - began) / (n_views * len(cameras))


def main(predictions: Path | None = None, meshes: list[Path] | None = None) -> None:
    """Print the tables.

    Args:
        predictions: of the full grid; made-up ones of 899 objects by default.
        meshes: to measure views that run the networks.
    """
    full = predictions or (899, 8)
    cases: list[tuple[str, tuple]] = [
        ("full grid: 10 policies", (full, TEN)),
        ("all entries", (full, None)),
        ("5 policies", (full, TEN[:5])),
        ("450 objects", ((450, 8), TEN)),
        ("899 objects", ((899, 8), TEN)),
        ("1,798 objects", ((1798, 8), TEN)),
        ("3,596 objects", ((3596, 8), TEN)),
        ("80 views on the sphere", ((899, 16), TEN)),
        ("160 views on the sphere", ((899, 32), TEN)),
        ("at most 10 views", (full, TEN, 10)),
        ("at most 20 views", (full, TEN, 20)),
    ]
    print(
        "| 10 starts, 5 thresholds | replay, s | tables, s | peak memory, GB | episodes |"
    )
    print("|---|---|---|---|---|")
    for what, case in cases:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            replayed, summarised, memory, episodes = pool.submit(run, *case).result()
        print(
            f"| {what} | {replayed:.2f} | {summarised:.2f} | {memory:.2f} | {episodes:,} |",
            flush=True,
        )
    if meshes:
        observation = with_networks(meshes)
        table = Predictions.load(full) if isinstance(full, Path) else made_up(*full)
        grid = Grid(make_specs(table, 10, 0), 10, THESIS_THRESHOLDS, 5, 0)
        list(run_grid(grid, TEN))
        n_views = sum(int(ends.n_views.sum()) for _, _, ends in grid.cells())
        print(
            f"\nWith the networks: {1000 * observation:.1f} ms a view over {len(meshes)} meshes;"
            f" {n_views:,} views"
        )
        print(f"would take {observation * n_views / 3600:.1f} hours.")


if __name__ == "__main__":
    with orderly_end("run it again"):
        tyro.cli(main)
