"""The examples run, name what they see, and are short."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

import nextview

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def examples(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    yield
    for name in ("arm_over_table", "turntable", "simulated_sensor"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("sample", ["chair", "table"])
def test_an_arm_over_a_table(examples, sample):
    example = importlib.import_module("arm_over_table")
    arm = example.Arm(nextview.load_mesh(EXAMPLES.parent / f"samples/{sample}.off"), np.random.default_rng(1))
    result = example.recognise(arm)
    assert result.answer == sample
    assert result.confident
    assert arm.pose[2, 3] > example.CLEARANCE - 0.02


@pytest.mark.parametrize("sample", ["chair", "table"])
def test_a_turntable(examples, sample):
    example = importlib.import_module("turntable")
    mesh = nextview.load_mesh(EXAMPLES.parent / f"samples/{sample}.off")
    result = example.recognise(example.Turntable(mesh, np.random.default_rng(1)))
    assert result.answer == sample
    assert result.confident
    assert not any(view.warnings for view in result.views)


@pytest.mark.parametrize("name", ["arm_over_table", "turntable"])
def test_what_a_user_writes_is_short(name):
    text = (EXAMPLES / f"{name}.py").read_text()
    users = text[text.index("def recognise") : text.index("def main")]
    assert len(users.strip().splitlines()) < 60
