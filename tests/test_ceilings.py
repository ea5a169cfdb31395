"""The ceilings against plain enumeration of every walk."""

import runpy
from dataclasses import replace
from itertools import pairwise, permutations
from pathlib import Path

import numpy as np
import pytest
from test_predictions import some_predictions

from nextview.viewsphere import ViewSphere

CEILINGS = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "ceilings.py"))
SMALL = ViewSphere((0.0, 40.0), 4)


def small_predictions(n: int, seed: int = 0):
    """Objects that most single views are wrong about."""
    p, rng = some_predictions(n), np.random.default_rng(seed)
    logits = rng.normal(size=(n, 8, 3)).astype(np.float32)
    logits[np.arange(n), :, p.labels] -= 1.2
    return replace(p, logits=logits, maps={}, depth_entropy=p.depth_entropy[:, :8], sphere=SMALL)


@pytest.mark.parametrize("name", ["any_sets", "local_sets"])
def test_the_earliest_right_answer_is_that_of_trying_every_walk(name):
    p = small_predictions(12)
    found = CEILINGS["solvable"](p, CEILINGS[name])
    assert len(np.unique(found)) > 3
    for i in range(len(p)):
        for start in (0, 5):
            earliest = 6
            for n_views in range(5, 0, -1):
                for rest in permutations(np.delete(np.arange(8), start), n_views - 1):
                    walk = [start, *rest]
                    near = all(b in SMALL.window(a) for a, b in pairwise(walk))
                    if (name == "any_sets" or near) and p.logits[i, walk].sum(0).argmax() == p.labels[i]:
                        earliest = n_views
                        break
            assert found[i, start] == earliest


def test_the_page_says_what_the_predictions_say(tmp_path):
    p = small_predictions(30)
    p.save(tmp_path / "test.npz")
    replace(p, splits=np.array(["train"] * 30)).save(tmp_path / "train.npz")
    text = CEILINGS["section"](tmp_path / "test.npz", tmp_path / "train.npz", 1.0, samples=50)
    alone = (p.logits.argmax(2) == p.labels[:, None]).mean()
    rows = [line for line in text.splitlines() if line.startswith(("| random in", "| any views", "| learned path"))]
    for row in rows[:6]:
        assert float(row.split("|")[2].split()[0]) == pytest.approx(alone, abs=6e-4)
    fused = (p.logits.sum(1).argmax(1) == p.labels).mean()
    assert f"All 8 views fused: {fused:.3f}" in text
