"""The fuzzer notices all that can go wrong, and a few seconds of it find nothing."""

import os
import subprocess
import sys
import time
import warnings
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from nextview.errors import MeshError

FUZZ = Path(__file__).parents[1] / "benchmarks" / "fuzz.py"
sys.path.append(str(FUZZ.parent))

import fuzz  # noqa: E402


def make(folder):
    (folder / "a.txt").write_text("sound")


def damage(rng, sound, case):
    (case / "a.txt").write_text("damaged")
    return case / "a.txt"


def reads(path):
    pass


def refuses(path):
    if path.read_text() == "damaged":
        raise MeshError(f"{path}: is damaged")


def refuses_at_length(path):
    if path.read_text() == "damaged":
        raise MeshError("damaged,\nvery much so")


def raises(path):
    if path.read_text() == "damaged":
        raise KeyError("a bug")


def warns(path):
    if path.read_text() == "damaged":
        warnings.warn("strange", RuntimeWarning, stacklevel=1)


def prints(path):
    if path.read_text() == "damaged":
        os.write(2, b"noise\n")


def tells(path):
    if path.read_text() == "damaged":
        os.write(2, b"nextview: one object counts as not rendered\n")


def takes_memory(path):
    if path.read_text() == "damaged":
        np.empty(2 * fuzz.MEMORY, np.uint8)


def dies(path):
    if path.read_text() == "damaged":
        os.abort()


def computes_for_ever(path):
    while path.read_text() == "damaged":
        pass


EXPECTED = {
    reads: "loaded", tells: "loaded", refuses: "refused", refuses_at_length: "error", raises: "error", warns: "error",
    prints: "error", takes_memory: "error", dies: "crash", computes_for_ever: "hang",
}  # fmt: skip


def test_each_kind_of_failure_is_noticed():
    kinds = {take.__name__: fuzz.Kind(make, damage, take) for take in EXPECTED}
    began = time.monotonic()
    counts, failures = fuzz.fuzz(kinds, 0, 0, patience=1)
    assert {name: [*count] for name, count in counts.items()} == {
        take.__name__: [outcome] for take, outcome in EXPECTED.items()
    }
    assert len(failures) == sum(outcome in fuzz.BAD for outcome in EXPECTED.values())
    assert time.monotonic() - began < 60
    for name, part in (("raises", "KeyError: 'a bug'"), ("prints", "noise"), ("dies", "status -6")):
        assert any(text.startswith(f"--case '{name}' 0: ") and part in text for text in failures)


@pytest.mark.parametrize("kind", fuzz.KINDS)
def test_the_same_case_has_the_same_damage_and_others_differ(tmp_path, kind):
    chosen = {kind: fuzz.KINDS[kind]}
    sound = tmp_path / "sound"
    sound.mkdir()
    fuzz.make_sound(chosen, sound, None)

    def damaged(number):
        case = tmp_path / f"case{len(list(tmp_path.iterdir()))}"
        case.mkdir()
        rng = np.random.default_rng([0, number])
        chosen[kind].damage(rng, sorted((sound / kind).glob(chosen[kind].inputs)), case)
        return {str(p.relative_to(case)): p.read_bytes() for p in case.rglob("*") if p.is_file() and not p.is_symlink()}

    made = [damaged(number) for number in range(20)]
    assert [damaged(number) for number in range(20)] == made
    assert sum(a != b for a, b in pairwise(made)) > 15


def test_a_few_cases_of_each_kind_find_nothing():
    done = subprocess.run([sys.executable, FUZZ, "--count", "4", "--seed", "0"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    lines = {line[:12].strip(): [int(n) for n in line[12:].split()] for line in done.stdout.splitlines()[1:] if line}
    assert lines.keys() == fuzz.KINDS.keys()
    assert all(sum(counts[:2]) >= 4 and counts[2:] == [0, 0, 0] for counts in lines.values())
