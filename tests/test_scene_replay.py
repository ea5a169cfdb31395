"""Predictions of cluttered scenes in replay, and what benchmarks/scenes.py judges of them."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pipeline import some_predictions

from nextview.benchmark import statistics
from nextview.benchmark.published import ACCURACY, comparable_classes, read_table
from nextview.benchmark.replay import make_specs, replay
from nextview.benchmark.summary import target_weights
from nextview.data.predictions import Predictions
from nextview.data.store import ViewStore
from nextview.errors import DatasetError
from nextview.recognition.belief import Calibration

TEN = tuple(read_table(ACCURACY[10]))
SCRIPT = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "scenes.py"))


@pytest.fixture(scope="module")
def predictions(cluttered_views) -> Predictions:
    """Of six scenes and ten classes; what hardly shows says nothing, and what shows in part counts in part."""
    opened, rng = ViewStore.open(cluttered_views), np.random.default_rng(0)
    shows = opened.measure("visible_share") > 0.3

    logits = np.where(shows[..., None], 2 * rng.normal(size=(len(opened), 40, 10)), 0).astype(np.float32)
    return replace(
        some_predictions(len(opened)), logits=logits, classes=TEN, names=tuple(opened.names), valley_classes={},
        depth_entropy=opened.measure(), store=str(cluttered_views), calibration=Calibration(1.0, 0.3),
        maps={},
    )  # fmt: skip


def test_scenes_without_their_store_are_not_taken_for_single_objects(predictions, tmp_path):
    lost = replace(predictions, store=str(tmp_path / "lost.zarr"))
    with pytest.raises(DatasetError, match=r"of scenes, and there is no view store at .*lost.zarr any more"):
        make_specs(lost, 1, 0)
    with pytest.raises(DatasetError, match="are of scenes, and name no view store; predict again"):
        make_specs(replace(predictions, store=""), 1, 0)
    alone = replace(lost, names=tuple(f"thing_{i}" for i in range(len(lost))))
    assert make_specs(alone, 1, 0).scenes is None


def test_nothing_published_stands_beside_scenes(predictions):
    assert comparable_classes(predictions) == ()
    alone = replace(predictions, names=tuple(f"thing_{i}" for i in range(len(predictions))))
    assert comparable_classes(alone) == TEN


def test_scenes_around_one_target_are_drawn_together():
    names = ("a@light-0", "b@light-0", "a@heavy-0", "c@heavy-0", "a@heavy-1")
    weights = target_weights(names, 200, np.random.default_rng(0))
    for same in (2, 4):
        np.testing.assert_array_equal(weights[:, 0], weights[:, same])
    np.testing.assert_array_equal(weights[:, [0, 1, 3]].sum(1), 3)  # as many targets as there are
    plain = statistics.resample(5, 200, np.random.default_rng(0))
    np.testing.assert_array_equal(target_weights(tuple("abcde"), 200, np.random.default_rng(0)), plain)


def test_what_the_script_judges_is_what_replay_believes(predictions):
    specs = make_specs(predictions, 4, 0)
    path = replay("random-all", specs, 4, 0)
    assert (path.views >= 0).all()
    found = SCRIPT["Believed"].of(predictions, specs.objects, path.views)
    np.testing.assert_allclose(found.confidence, path.confidences, rtol=1e-6)
    sure = found.confidence > 0.11  # else all classes are alike
    np.testing.assert_array_equal(found.right[sure], (path.answers == specs.labels[:, None])[sure])
    np.testing.assert_allclose(found.loss[found.right], -np.log(found.confidence[found.right]), rtol=1e-6)
    assert (found.loss[~found.right] >= np.log(2)).all()
