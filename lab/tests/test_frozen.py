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

    # what a run leaves that is stopped in the second episode
    (out / "manifest.json").unlink()
    (out / "truth/0001.json").unlink()
    (out / "episodes/0001").rename(out / "episodes/0001.partial")
    before = (out / "episodes/0000/000.png").stat().st_mtime_ns
    assert make(household, out).returncode == 0
    assert content(out) == whole
    assert (out / "episodes/0000/000.png").stat().st_mtime_ns == before

    run = submit(out, tmp_path / "out.json", SubmitOptions("fixed"))
    assert run.whole
