"""The judge of single things in another world: its camera, its physics, and one thing alone."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from nextview_lab.studies.staged_things import (
    CAMERA_MATRIX,
    FOCAL,
    IMAGE,
    STEREO_BASE,
    Actor,
    alone,
    as_measured,
    at_rest,
    stable_ups,
)

ROOT = Path(__file__).parents[2]
SCANS = Path(os.environ.get("NEXTVIEW_DATA", ".")) / "YCB"
NAME = "mustard_bottle"
with_scans = pytest.mark.skipif(
    not (SCANS / f"{NAME}.ply").exists(),
    reason="NEXTVIEW_DATA has no YCB scans",
)


def test_the_noise_of_a_wall_is_that_of_its_disparities():
    rng = np.random.default_rng(0)
    depth = as_measured(np.full(IMAGE, 0.6), rng) / 1000

    seen = depth[:, 100:]
    assert (seen > 0).mean() > 0.999
    assert abs(np.median(seen) - 0.6) < 0.001
    # Gaussian noise, steps of 1/16 pixel, and steps of a millimetre
    per_pixel = 0.6**2 / (FOCAL * STEREO_BASE)
    expected = np.sqrt(
        per_pixel**2 * (0.08**2 + 1 / (12 * 16**2)) + 0.001**2 / 12,
    )
    assert seen.std() == pytest.approx(expected, rel=0.05)


def test_the_second_camera_does_not_see_what_is_left_of_a_near_thing():
    depth = np.full(IMAGE, 1.0)
    depth[100:400, 300:400] = 0.5
    seen = as_measured(depth, np.random.default_rng(1))

    # by how much the near thing is displaced more than the wall, pixels
    shadow = FOCAL * STEREO_BASE * (1 / 0.5 - 1 / 1.0)
    holes = (seen[150:350, 200:300] == 0).sum(1)
    assert np.median(holes) == pytest.approx(shadow, abs=3)
    assert (seen[150:350, 405:] > 0).all()


def test_a_floor_is_not_seen_at_grazing_angles():
    rows = np.arange(IMAGE[0]) - CAMERA_MATRIX[1, 2]
    for degrees, share in ((5, 0.02), (40, 0.98)):
        slope = np.tan(np.radians(degrees)) + rows / FOCAL
        depth = np.repeat(0.1 / np.maximum(slope, 0.02)[:, None], IMAGE[1], 1)
        seen = as_measured(depth, np.random.default_rng(2))[235:245, 300:]
        assert ((seen > 0).mean() > share) == (degrees == 40)


@with_scans
def test_a_bottle_comes_to_rest_on_a_side_of_its_hull():
    actor = Actor(str(SCANS), NAME, 0)
    for seed in range(3):
        staging = alone(actor, np.random.default_rng(seed))
        scene = at_rest(staging)
        assert scene is not None
        assert staging.stays(*scene)

        turn = scene[1].body("thing").xmat.reshape(3, 3)
        points = actor.scan.vertices @ turn.T + scene[1].body("thing").xpos
        assert abs(points[:, 2].min()) < 0.003
        ups, _ = stable_ups(actor.scan)
        assert (ups @ turn[2]).max() > np.cos(np.radians(12))


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
