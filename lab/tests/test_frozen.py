"""The script of the frozen archive: it goes on after a stop, and is the same on each processor."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mujoco")

from nextview_lab.benchmark.frozen import FrozenArchive
from nextview_lab.benchmark.submit import SubmitOptions, submit

ROOT = Path(__file__).parents[2]
OPTIONS = "--places alone --things 2 --draws 1 --grid 1 3 --seed 3"
SURROUNDINGS = {**os.environ, "OMP_NUM_THREADS": "1"}
# what OpenBLAS, NumPy and the C library do on a processor without AVX2
OLD_PROCESSOR = {
    "OPENBLAS_CORETYPE": "Prescott",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2,-FMA4",
}
LAST_BITS = """
import numpy as np
from math import exp
numbers = np.random.default_rng(0).random((60, 60))
print(np.linalg.svd(numbers)[2].tobytes().hex(), np.exp(numbers).tobytes().hex())
print([exp(number) for number in numbers.flat])
"""


def make(scans, out, options=OPTIONS, **surroundings):
    return subprocess.run(
        [
            sys.executable,
            "-m",
            "nextview_lab.studies.frozen",
            scans,
            out,
            *options.split(),
        ],
        cwd=ROOT,
        env=SURROUNDINGS | surroundings,
        capture_output=True,
        text=True,
    )


def content(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_the_same_seed_gives_the_same_bytes_after_a_stop_too(household, tmp_path):
    out = tmp_path / "first/tiny-1.0"
    made = make(household, out)
    assert made.returncode == 0, made.stderr
    archive = FrozenArchive(out)
    assert archive.sha256 in made.stdout
    assert archive.manifest.name == "tiny-1.0"
    assert len(archive.numbers) == 2
    assert len(archive.things) == 10
    whole = content(out)
    assert sum(path.suffix == ".png" for path in whole) == 12

    again = make(household, out)
    assert again.returncode == 2
    assert "is whole" in again.stderr

    # what a run leaves that is stopped in the second episode
    (out / "manifest.json").unlink()
    (out / "truth/0001.json").unlink()
    (out / "episodes/0001").rename(out / "episodes/0001.partial")
    assert "was begun with other options" in make(household, out, "--seed 4").stderr
    before = (out / "episodes/0000/000.png").stat().st_mtime_ns
    assert make(household, out).returncode == 0
    assert content(out) == whole
    assert (out / "episodes/0000/000.png").stat().st_mtime_ns == before

    run = submit(out, tmp_path / "out.json", SubmitOptions("fixed"))
    assert run.whole


def last_bits(**surroundings):
    ended = subprocess.run(
        [sys.executable, "-c", LAST_BITS],
        env=SURROUNDINGS | surroundings,
        capture_output=True,
        text=True,
        check=True,
    )
    return ended.stdout


def test_another_processor_makes_the_same_archive(household, tmp_path):
    one = last_bits()
    if last_bits(**OLD_PROCESSOR) == one:
        pytest.skip("the libraries do here what they do on an old processor")

    options = "--places leaning --things 1 --draws 1 --grid 1 1 --seed 11"
    sums = []
    for number, surroundings in enumerate(({}, OLD_PROCESSOR)):
        out = tmp_path / f"{number}/tiny-1.0"
        made = make(household, out, options, **surroundings)
        assert made.returncode == 0, made.stderr
        sums.append(FrozenArchive(out).sha256)
    assert sums[0] == sums[1]
