"""The script of the frozen archive: it goes on after a stop, and is the same on each processor."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from nextview_lab.benchmark.frozen import FrozenArchive
from nextview_lab.benchmark.submit import SubmitOptions, submit
from nextview_lab.studies.staged_things import (
    FOCAL,
    IMAGE,
    STEPS_PER_METRE,
    STEREO_BASE,
    as_measured,
)

ROOT = Path(__file__).parents[2]
OPTIONS = "--places alone --things 2 --draws 1 --grid 1 3 --seed 3"
SURROUNDINGS = {**os.environ, "OMP_NUM_THREADS": "1"}


def make(scans, out):
    return subprocess.run(
        [
            sys.executable,
            "-m",
            "nextview_lab.studies.frozen",
            scans,
            out,
            *OPTIONS.split(),
        ],
        cwd=ROOT,
        env=SURROUNDINGS,
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
    assert len(run.episodes) == 2


def test_the_noise_of_a_wall_is_that_of_its_disparities():
    rng = np.random.default_rng(0)
    depth = as_measured(np.full(IMAGE, 0.6), rng) / STEPS_PER_METRE

    seen = depth[:, 100:]
    assert (seen > 0).mean() > 0.999
    assert abs(np.median(seen) - 0.6) < 0.001
    # Gaussian noise, steps of 1/16 pixel, and steps of the image
    per_pixel = 0.6**2 / (FOCAL * STEREO_BASE)
    disparity = per_pixel**2 * (0.08**2 + 1 / (12 * 16**2))
    expected = np.sqrt(disparity + 1 / (12 * STEPS_PER_METRE**2))
    assert seen.std() == pytest.approx(expected, rel=0.05)
