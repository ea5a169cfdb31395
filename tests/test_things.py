"""The benchmark of taught things: its ceiling against brute force, and its table from meshes on."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pipeline import show_taught, some_predictions
from scipy.special import log_softmax

from nextview.benchmark.replay import make_specs, replay, replay_policy
from nextview.data.predictions import Predictions
from nextview.data.rendering import rotations
from nextview.data.store import ViewStore
from nextview.errors import UsageError
from nextview.recognition.belief import Stopping

THINGS = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "things.py"))


def ceiling(draws, specs):
    p, n = specs.predictions, len(draws[0])
    evidence = p.log_evidence.reshape(len(draws), n, 40, -1)
    policy = THINGS["FairCeiling"](
        p.sphere,
        evidence,
        p.labels[:n],
        specs.objects,
        3,
        p.calibration,
    )
    return replay_policy(
        "ceiling",
        policy,
        specs,
        Stopping(1.0, 3),
        np.random.default_rng(0),
    ).views


def noisy(*seeds: int) -> list[Predictions]:
    """The same objects with other logits."""
    first = some_predictions(seed=seeds[0])
    return [replace(first, logits=some_predictions(seed=seed).logits) for seed in seeds]


def test_where_the_noise_is_the_same_again_the_fair_ceiling_is_foresight():
    draws = noisy(3, 3)
    specs = make_specs(THINGS["together"](draws), 4, 0)
    np.testing.assert_array_equal(
        ceiling(draws, specs),
        replay("oracle-gain-all", specs, 3, 0).views,
    )


def test_the_fair_ceiling_goes_by_the_mean_of_the_other_draws():
    draws = noisy(3, 4, 5)
    specs = make_specs(THINGS["together"](draws), 2, 0)
    for (first, second, _), episode in zip(
        ceiling(draws, specs),
        specs.objects,
        strict=True,
    ):
        draw, thing = divmod(episode, 6)
        others = [k for k in range(3) if k != draw]
        seen = draws[draw].logits[thing, first].astype(float)
        worth = sum(
            log_softmax(seen + draws[k].logits[thing], axis=1)[:, thing % 3]
            for k in others
        )
        worth[first] = -np.inf
        assert second == worth.argmax()


def test_things_are_compared_from_meshes_on_under_the_same_azimuth_and_other_noise(
    tmp_path,
    scans,
    taught,
    shown,
):
    show_taught(scans, taught, tmp_path, "--noise-seed", "1")
    both = (shown, tmp_path)
    first, again = (ViewStore.open(folder / "views.zarr") for folder in both)
    tables = [folder / "predictions.npz" for folder in both]
    np.testing.assert_array_equal(rotations(first), rotations(again))
    assert not np.array_equal(first.depth(0), again.depth(0))
    THINGS["main"](
        taught / "memory.json",
        tmp_path / "out",
        tuple(tables),
        runs=3,
        views=(1, 2),
    )
    found = pd.read_csv(tmp_path / "out" / "things.csv").set_index(
        ["things", "policy", "n_views"]
    )
    draws = [Predictions.load(path) for path in tables]
    specs = make_specs(THINGS["together"](draws), 3, 0)
    one = replay("random-all", specs, 1, 0).answers[:, 0] == specs.labels
    row = found.loc["all", "discriminate", 1]
    assert row["accuracy"] == pytest.approx(one.mean())
    assert np.isnan(row["p"])  # the first view is the same for all
    ours = {"discriminate", "foresight", "fair ceiling"}
    assert set(found.index.get_level_values("policy")) == {*THINGS["RIVALS"], *ours}
    assert "the confusable half" in (tmp_path / "out" / "things.md").read_text()
    with pytest.raises(UsageError, match="other things"):
        THINGS["together"]([draws[0], draws[1].of_objects(np.array([0, 1]))])
