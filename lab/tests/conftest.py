"""Fixtures of the laboratory: stores of views, predictions, results, archives.

What the tests of both packages share is in ``tests/shared_fixtures.py``.
"""

import sys
from functools import cache
from pathlib import Path

import kept_results
import numpy as np
import pipeline
import pytest
from bop_datasets import write_dataset
from frozen_archives import write_archive

from nextview_lab.benchmark import tables


@pytest.fixture(scope="session", autouse=True)
def kept_rests(shared):
    """Find the resting poses of each thing once in a run, as ``kept_things`` does."""
    folder = shared("kept", lambda folder: None)
    with pytest.MonkeyPatch.context() as patched:
        function = tables.resting_poses
        kept = kept_results.Kept(function, folder, kept_results.of_mesh)
        patched.setattr(tables, "resting_poses", kept)
        yield


@pytest.fixture(scope="session", autouse=True)
def kept_operators():
    """Read the operators that torch exports once in a process: that takes half of an export."""
    if "torch" not in sys.modules:  # no test file imports it
        yield
        return
    from torch.onnx._internal.exporter._registration import ONNXRegistry

    kept = staticmethod(cache(ONNXRegistry.from_torchlib))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(ONNXRegistry, "from_torchlib", kept)
        yield


@pytest.fixture(scope="session")
def bop(shared) -> Path:
    """A dataset of two images in the layout of BOP."""
    return shared("bop", write_dataset)


@pytest.fixture(scope="session")
def archive(shared) -> Path:
    """A frozen archive of two episodes."""
    return shared("archive", write_archive)


@pytest.fixture(scope="session")
def views(shared, furniture) -> Path:
    """A store of ``furniture``: 18 objects, 40 views, 32 pixels, with depth-entropy."""
    from nextview_lab.data.rendering import render

    def make(folder: Path) -> None:
        list(render(furniture, folder / "views.zarr", pipeline.SPHERE, 32, workers=0))

    return shared("views", make) / "views.zarr"


@pytest.fixture(scope="session")
def predictions(shared, views, models) -> Path:
    """The predictions of ``models`` for all of ``views``, train and test."""
    from nextview.recognition.model_card import read_card
    from nextview_lab.data.predicting import predict

    def make(folder: Path) -> None:
        recogniser, lem = (
            read_card(models / name) for name in ("tiny.json", "tiny-lem.json")
        )
        list(
            predict(
                views, folder / "predictions.npz", recogniser, {"lem": lem}, workers=0
            )
        )

    return shared("predictions", make) / "predictions.npz"


@pytest.fixture(scope="session")
def results(shared) -> Path:
    """A benchmark of ``some_predictions(40, seed=2)``: p.npz and the folder out.

    Two objects are conflicting.
    """
    pytest.importorskip("pandas")
    from dataclasses import replace

    def make(folder: Path) -> None:
        conflicting = np.isin(np.arange(40), (3, 8))
        replace(pipeline.some_predictions(40, seed=2), conflicting=conflicting).save(
            folder / "p.npz"
        )
        pipeline.benchmark(
            folder / "p.npz", folder / "out", thresholds=(0.7, 0.9), runs=3, samples=200
        )

    return shared("results", make)
