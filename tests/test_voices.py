"""The benchmark of averaged recognisers, on predictions whose answers are known."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from test_predictions import some_predictions

SCRIPT = Path(__file__).parent.parent / "benchmarks" / "voices.py"


def voices(*entries):
    return subprocess.run([sys.executable, str(SCRIPT), *map(str, entries)], capture_output=True, text=True)


def test_two_that_err_elsewhere_are_better_together(tmp_path):
    rng, p = np.random.default_rng(0), some_predictions(60)
    p = replace(p, splits=np.array(["train"] * 60))
    truth = 2.0 * np.eye(3)[p.labels][:, None]
    paths = []
    for k in range(2):  # an error of its own for each object, which more views do not take away
        logits = truth + 2.5 * rng.normal(size=(60, 1, 3)) + 0.3 * rng.normal(size=(60, 40, 3))
        paths.append(tmp_path / f"{k}.npz")
        replace(p, logits=logits.astype(np.float32)).save(paths[-1])
    done = voices(paths[0], f"{paths[0]}+{paths[0]}", f"{paths[0]}+{paths[1]}")
    assert done.returncode == 0, done.stderr
    alone, twice, both = ([cell.strip() for cell in line.split("|")[2:-1]] for line in done.stdout.splitlines()[2:])
    assert twice[:4] == alone[:4]
    assert twice[4].startswith("+0.000 (+0.000 to +0.000)")
    assert float(both[2]) > float(alone[2]) + 0.05
    assert float(both[4].split()[0]) > 0.05
    low, high = (float(x) for x in both[4].split("(")[1].rstrip(")").split(" to "))
    assert low < float(both[4].split()[0]) < high


def test_others_objects_and_the_test_split_are_refused(tmp_path):
    p = some_predictions(6)
    p.save(tmp_path / "test.npz")
    train = replace(p, splits=np.array(["train"] * 6))
    train.save(tmp_path / "a.npz")
    replace(train, names=tuple("abcdef")).save(tmp_path / "b.npz")
    for entry, sentence in (("a.npz+b.npz", "not of the same objects"), ("test.npz", "test split")):
        done = voices("+".join(str(tmp_path / part) for part in entry.split("+")))
        assert done.returncode != 0
        assert done.stderr.startswith("voices.py: ")
        assert sentence in done.stderr
        assert done.stderr.count("\n") == 1
