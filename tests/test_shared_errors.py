"""What several recognisers get wrong alike."""

import runpy
from pathlib import Path

import numpy as np

ALIKE = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "shared_errors.py"))["duplicate_groups"]


def test_errors_are_shared_only_where_all_are_wrong():
    labels = np.array([0, 1, 2, 0])
    answers = np.array([[0, 2, 1, 1], [1, 2, 0, 0], [2, 2, 1, 2]])
    wrong, same = ALIKE(answers, labels)
    assert wrong.tolist() == [False, True, True, False]  # one recogniser knows the first, another the last
    assert same.tolist() == [False, True, False, False]  # of the third they say different things
