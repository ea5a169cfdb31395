"""Datasets of BOP: the file of results, and what users do wrong."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from bop_datasets import IDS, VIEWS
from lab_programs import main, refused


@pytest.fixture
def own(bop, tmp_path) -> Path:
    """A copy of the dataset that a test may damage."""
    return Path(shutil.copytree(bop, tmp_path / "bop"))


def read_results(path: Path) -> list[dict]:
    """The lines of a file of results, as bop_toolkit's inout.load_bop_results takes them apart."""
    lines = path.read_text().splitlines()
    assert lines[0] == "scene_id,im_id,obj_id,score,R,t,time"
    results = []
    for line in lines[1:]:
        parts = line.split(",")
        assert len(parts) == 7
        results.append(
            {
                "scene_id": int(parts[0]),
                "im_id": int(parts[1]),
                "obj_id": int(parts[2]),
                "score": float(parts[3]),
                "R": np.array(list(map(float, parts[4].split())), float).reshape(3, 3),
                "t": np.array(list(map(float, parts[5].split())), float).reshape(3),
                "time": float(parts[6]),
            }
        )
    return results


def true_of(dataset: Path, image: int, number: int) -> tuple[np.ndarray, np.ndarray]:
    objects = json.loads((dataset / "test/000001/scene_gt.json").read_text())
    (one,) = [one for one in objects[str(image)] if one["obj_id"] == number]
    return np.reshape(one["cam_R_m2c"], (3, 3)), np.array(one["cam_t_m2c"])


def surface_error(dataset: Path, line: dict) -> float:
    """Largest distance of a vertex from its place, mm, modulo the symmetries."""
    image, number = line["im_id"], line["obj_id"]
    info = json.loads((dataset / "models/models_info.json").read_text())[str(number)]
    vertices = trimesh.load(dataset / f"models/obj_{number:06d}.ply").vertices
    rotation, shift = true_of(dataset, image, number)
    found = vertices @ line["R"].T + line["t"]
    surface = []
    for flat in (np.eye(4).ravel(), *info.get("symmetries_discrete", [])):
        turn = np.reshape(flat, (4, 4))
        there = (vertices @ turn[:3, :3].T + turn[:3, 3]) @ rotation.T + shift
        surface.append(np.sqrt(((found - there) ** 2).sum(1)).max())
    return min(surface)


def test_each_model_has_a_line_with_its_pose_in_the_camera(bop, tmp_path, capsys):
    out = tmp_path / "nextview_tiny-test.csv"
    main(["bop", str(bop), str(out), "--models", "ycb", "--ids", *IDS])
    said = capsys.readouterr()

    lines = read_results(out)
    there = [(line["scene_id"], line["im_id"], line["obj_id"]) for line in lines]
    assert sorted(there) == [(1, image, n) for image, _ in VIEWS for n in (2, 14)]
    for line in lines:
        assert 0.5 < line["score"] <= 1
        np.testing.assert_allclose(line["R"] @ line["R"].T, np.eye(3), atol=1e-6)
        assert np.linalg.det(line["R"]) > 0
    # the search misses the pose of one of two mugs
    assert sorted(surface_error(bop, line) for line in lines)[2] < 10
    for image, _ in VIEWS:  # bop_toolkit refuses an image with several times
        (seconds,) = {line["time"] for line in lines if line["im_id"] == image}
        assert seconds > 0

    assert "4 poses in 2 images" in said.out
    assert "banana: is no model of the dataset, found 2 times" in said.err
    assert f"wrote {out}" in said.err
    assert not list(tmp_path.glob(".*"))


def test_models_that_the_memory_does_not_know_are_named(own, tmp_path, capsys):
    out = tmp_path / "out.csv"
    one = ["--models", "ycb", "--ids", "mug=14", "--frames", "1"]
    main(["bop", str(own), str(out), *one])
    said = capsys.readouterr()
    assert "does not know the models 2, so they are never found" in said.err
    assert "cracker_box: is no model of the dataset, found 1 time" in said.err
    assert {line["obj_id"] for line in read_results(out)} == {14}


# What users do wrong


def removed(*names):
    return lambda folder: [(folder / name).unlink() for name in names]


def moved_away(name):
    return lambda folder: shutil.rmtree(folder / name)


SCENE = "test/000001"
MISTAKES = {
    "no models": (moved_away("models"), (), "has no models"),
    "another split": (None, ("--split", "val"), "--split names one of test"),
    "no depth at all": (
        removed(f"{SCENE}/depth/000003.png", f"{SCENE}/depth/000007.png"),
        (),
        "no image can be looked at",
    ),
    "an unknown model": (None, ("--ids", "mug=99"), "has no model 99; it has 2, 14"),
    "an unknown thing": (None, ("--ids", "mag=14"), "knows nothing called mag"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_told_in_one_sentence(mistake, own, tmp_path, capsys):
    damage, options, said = MISTAKES[mistake]
    if damage is not None:
        damage(own)
    out = tmp_path / "out.csv"
    options = options if "--ids" in options else (*options, "--ids", *IDS)
    found = refused(capsys, "bop", own, out, "--models", "ycb", *options)
    assert said in found
    assert not out.exists()
    assert not list(tmp_path.glob(".*"))
