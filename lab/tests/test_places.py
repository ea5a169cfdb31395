"""The judge of single things in another world: its camera, its physics, and one thing alone."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from nextview_lab.studies.staged_things import FOCAL, IMAGE, STEREO_BASE, as_measured

ROOT = Path(__file__).parents[2]
SCANS = Path(os.environ.get("NEXTVIEW_DATA", ".")) / "YCB"
NAME = "mustard_bottle"
with_scans = pytest.mark.skipif(
    not (SCANS / f"{NAME}.ply").exists(), reason="NEXTVIEW_DATA has no YCB scans"
)


def test_the_noise_of_a_wall_is_that_of_its_disparities():
    rng = np.random.default_rng(0)
    depth = as_measured(np.full(IMAGE, 0.6), rng) / 1000

    seen = depth[:, 100:]
    assert (seen > 0).mean() > 0.999
    assert abs(np.median(seen) - 0.6) < 0.001
    # Gaussian noise, steps of 1/16 pixel, and steps of a millimetre
    per_pixel = 0.6**2 / (FOCAL * STEREO_BASE)
    expected = np.sqrt(per_pixel**2 * (0.08**2 + 1 / (12 * 16**2)) + 0.001**2 / 12)
    assert seen.std() == pytest.approx(expected, rel=0.05)


@with_scans
def test_a_thing_alone_is_staged_and_recognised(tmp_path):
    surroundings = {**os.environ, "OMP_NUM_THREADS": "1"}
    scans = tmp_path / "scans"
    scans.mkdir()
    (scans / f"{NAME}.ply").symlink_to(SCANS / f"{NAME}.ply")
    command = [
        sys.executable,
        "-m",
        "nextview_lab.studies.places",
        scans,
        tmp_path / "out.jsonl",
    ]
    for _ in range(2):  # the second run finds all done
        ended = subprocess.run(
            [*command, "--places", "alone"],
            cwd=ROOT,
            env=surroundings,
            capture_output=True,
            text=True,
            check=True,
        )
    assert not ended.stderr
    assert "| alone | 1 of 1 | 1 of 1, 1.00" in ended.stdout
    (line,) = (tmp_path / "out.jsonl").read_text().splitlines()
    views = json.loads(line)["views"]
    assert [view["answer"] for view in views] == [NAME] * 3
    assert all(view["off_mm"][0] < 8 for view in views)
