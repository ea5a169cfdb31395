"""Datasets of BOP: the file of results, the errors of poses, and what users do wrong."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from bop_datasets import IDS, NUMBERS, VIEWS
from lab_programs import main, refused
from PIL import Image
from scipy.spatial.transform import Rotation

from nextview_lab.benchmark.bop import BopOptions, look_for_models
from nextview_lab.benchmark.bop_dataset import BopModelInfo, ContinuousSymmetry
from nextview_lab.benchmark.pose_recall import (
    hits_of,
    matched,
    mspd,
    mssd,
    symmetries_of,
)

HOW = BopOptions(models="ycb", ids=IDS)


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


def errors_of(dataset: Path, line: dict) -> tuple[float, float]:
    """MSSD, mm, and MSPD, pixels, of a line: vertices, and symmetries one by one."""
    image, number = line["im_id"], line["obj_id"]
    info = json.loads((dataset / "models/models_info.json").read_text())[str(number)]
    cameras = json.loads((dataset / "test/000001/scene_camera.json").read_text())
    fx, _, cx, _, fy, cy, *_ = cameras[str(image)]["cam_K"]
    vertices = trimesh.load(dataset / f"models/obj_{number:06d}.ply").vertices
    rotation, shift = true_of(dataset, image, number)
    found = vertices @ line["R"].T + line["t"]
    surface, projection = [], []
    for flat in (np.eye(4).ravel(), *info.get("symmetries_discrete", [])):
        turn = np.reshape(flat, (4, 4))
        turned = vertices @ turn[:3, :3].T + turn[:3, 3]
        there = turned @ rotation.T + shift
        surface.append(np.sqrt(((found - there) ** 2).sum(1)).max())
        pixels = [
            np.stack([fx * x / z + cx, fy * y / z + cy], 1)
            for x, y, z in (found.T, there.T)
        ]
        projection.append(np.sqrt(((pixels[0] - pixels[1]) ** 2).sum(1)).max())
    return min(surface), min(projection)


def surface_error(dataset: Path, line: dict) -> float:
    return errors_of(dataset, line)[0]


def recall_of(dataset: Path, lines: list[dict], number: int) -> list[str]:
    """What is to be printed of a model that is once in each image."""
    info = json.loads((dataset / "models/models_info.json").read_text())[str(number)]
    with Image.open(dataset / f"test/000001/depth/{VIEWS[0][0]:06d}.png") as image:
        width = image.width
    errors = [errors_of(dataset, line) for line in lines if line["obj_id"] == number]
    parts = [k / 20 * info["diameter"] for k in range(1, 11)]
    pixels = [5 * k * width / 640 for k in range(1, 11)]
    shares = [
        np.mean([[error[which] < limit for limit in limits] for error in errors])
        for which, limits in enumerate((parts, pixels))
    ]
    return [f"{share:.3f}" for share in (*shares, np.mean(shares))]


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
        assert surface_error(bop, line) < 10
    for image, _ in VIEWS:  # bop_toolkit refuses an image with several times
        (seconds,) = {line["time"] for line in lines if line["im_id"] == image}
        assert seconds > 0

    assert "4 poses in 2 images" in said.out
    rows = [row.split() for row in said.out.splitlines() if row.strip()]
    for number in NUMBERS.values():
        assert [str(number), "2", *recall_of(bop, lines, number)] in rows
    assert "VSD and the official figures are bop_toolkit's" in said.out
    assert "banana: is no model of the dataset, found 2 times" in said.err
    assert f"wrote {out}" in said.err
    assert not list(tmp_path.glob(".*"))


def test_an_interrupted_run_goes_on(own, tmp_path):
    out = tmp_path / "out.csv"

    def stopped(done, total, what):
        next(iter(done))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        look_for_models(own, out, HOW, track=stopped)
    assert not out.exists()

    (own / f"test/000001/depth/{VIEWS[0][0]:06d}.png").unlink()
    run = look_for_models(own, out, HOW)
    assert run.left_out == {}
    assert {line["im_id"] for line in read_results(out)} == {3, 7}
    assert not list(tmp_path.glob(".*"))


def test_without_the_truth_nothing_is_compared(own, tmp_path, capsys):
    (own / "test/000001/scene_gt.json").unlink()
    out = tmp_path / "out.csv"
    one = ["--models", "ycb", "--ids", *IDS, "--frames", "1"]
    main(["bop", str(own), str(out), *one])
    said = capsys.readouterr()
    assert "evaluate with bop_toolkit" in said.err
    assert "MSSD" not in said.out
    assert len(read_results(out)) == 2


def test_models_that_the_memory_does_not_know_are_named(own, tmp_path, capsys):
    out = tmp_path / "out.csv"
    one = ["--models", "ycb", "--ids", "mug=14", "--frames", "1"]
    main(["bop", str(own), str(out), *one])
    said = capsys.readouterr()
    assert "does not know the models 2, so they are never found" in said.err
    assert "cracker_box: is no model of the dataset, found 1 time" in said.err
    assert {line["obj_id"] for line in read_results(out)} == {14}
    (row,) = [row for row in said.out.splitlines() if row.split()[:1] == ["2"]]
    assert row.split() == ["2", "1", "0.000", "0.000", "0.000"]


def test_what_is_hidden_counts_neither_way(own, tmp_path):
    shares = [{"visib_fract": 0.05}, {"visib_fract": 0.9}]
    info = {image: shares for image, _ in VIEWS}
    (own / "test/000001/scene_gt_info.json").write_text(json.dumps(info))
    hidden = json.loads((own / "test/000001/scene_gt.json").read_text())["3"][0]
    hits = look_for_models(own, tmp_path / "out.csv", HOW).hits
    assert hits[hidden["obj_id"]].objects == 0
    assert [one.objects for one in hits.values()].count(2) == 1


# What users do wrong


def removed(*names):
    return lambda folder: [(folder / name).unlink() for name in names]


def put(name, text):
    return lambda folder: (folder / name).write_text(text)


def moved_away(name):
    return lambda folder: shutil.rmtree(folder / name)


INFO = "models/models_info.json"
TARGETS = "test_targets_bop19.json"
SCENE = "test/000001"
MISTAKES = {
    "no models": (moved_away("models"), (), "has no models"),
    "no axis": (
        put(
            INFO,
            '{"2": {"diameter": 1, "symmetries_continuous": [{"axis": [0, 0, 0]}]}}',
        ),
        (),
        "not 0, 0, 0",
    ),
    "no targets": (removed(TARGETS), (), "bop19.json: no such file"),
    "another split": (None, ("--split", "val"), "--split names one of test"),
    "no cameras": (
        removed(f"{SCENE}/scene_camera.json"),
        (),
        "scene_camera.json: no such file",
    ),
    "no depth at all": (
        removed(f"{SCENE}/depth/000003.png", f"{SCENE}/depth/000007.png"),
        (),
        "no image can be looked at",
    ),
    "an unknown model": (None, ("--ids", "mug=99"), "has no model 99; it has 2, 14"),
    "an unknown thing": (None, ("--ids", "mag=14"), "knows nothing called mag"),
    "no number": (None, ("--ids", "mug"), "NAME=NUMBER"),
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


# Errors of poses, against what is computed by hand

BOX = np.array(
    [[x, y, z] for x in (-30, 30) for y in (-20, 20) for z in (0, 50)], float
)
AHEAD = np.eye(4)
AHEAD[:3, 3] = (40, -25, 800)
CAMERA = np.array([[600, 0, 320], [0, 600, 240], [0, 0, 1]], float)
NONE = np.eye(4)[None]


def shifted(pose, *shift) -> np.ndarray:
    moved = pose.copy()
    moved[:3, 3] += shift
    return moved


def turned(degrees, axis=(0, 0, 1), about=(0, 0, 0)) -> np.ndarray:
    turn = np.eye(4)
    rotation = Rotation.from_rotvec(degrees * np.array(axis), degrees=True)
    turn[:3, :3] = rotation.as_matrix()
    turn[:3, 3] = np.array(about) - rotation.apply(about)
    return turn


def test_a_shift_has_its_length_as_mssd():
    assert mssd(AHEAD, AHEAD, BOX, NONE) == 0
    assert mssd(shifted(AHEAD, 3, 0, 4), AHEAD, BOX, NONE) == pytest.approx(5)


def test_a_turn_moves_the_farthest_vertex_along_its_chord():
    chord = 2 * np.hypot(30, 20) * np.sin(np.radians(30) / 2)
    assert mssd(AHEAD @ turned(30), AHEAD, BOX, NONE) == pytest.approx(chord)


def test_a_shift_across_the_view_has_its_pixels_as_mspd():
    """6 mm at the nearest vertex, 800 mm away, by a focal length of 600 pixels."""
    found = mspd(shifted(AHEAD, 6, 0, 0), AHEAD, BOX, NONE, CAMERA)
    assert found == pytest.approx(6 * 600 / 800)
    behind = shifted(AHEAD, 0, 0, -900)
    assert mspd(behind, AHEAD, BOX, NONE, CAMERA) == float("inf")


def test_a_turn_of_a_symmetry_is_no_error():
    info = BopModelInfo(100.0, [turned(180).ravel().tolist()])
    symmetries = symmetries_of(info)
    assert len(symmetries) == 2
    half = AHEAD @ turned(180)
    assert mssd(half, AHEAD, BOX, symmetries) == pytest.approx(0, abs=1e-9)
    assert mspd(half, AHEAD, BOX, symmetries, CAMERA) == pytest.approx(0, abs=1e-9)
    assert mssd(half, AHEAD, BOX, NONE) == pytest.approx(2 * np.hypot(30, 20))


def test_a_turn_by_any_angle_is_no_error_but_for_the_steps():
    """Half a step, 0.01 rad, of the farthest vertex from an axis beside the origin."""
    offset = (10.0, -5.0, 0.0)
    info = BopModelInfo(
        100.0, symmetries_continuous=[ContinuousSymmetry([0, 0, 2.0], list(offset))]
    )
    symmetries = symmetries_of(info)
    assert len(symmetries) == 315  # 2 pi by steps of at most 0.02
    farthest = np.hypot(30 + 10, 20 + 5)
    for degrees in (0, 1, 77.7, 180, 359):
        pose = AHEAD @ turned(degrees, about=offset)
        assert mssd(pose, AHEAD, BOX, symmetries) <= 0.01 * farthest + 1e-9
    aside = AHEAD @ turned(77.7, axis=(1, 0, 0), about=offset)
    assert mssd(aside, AHEAD, BOX, symmetries) > 20


def test_the_best_score_chooses_first_and_an_object_is_hit_once():
    errors = np.array([[1.0, 4.0], [2.0, 9.0], [3.0, 5.0]])
    # the second pose takes the first object, the third the other one, the first one is left
    assert matched(errors, [0.2, 0.9, 0.5], 6.0) == [-1, 0, 1]
    assert matched(errors, [0.9, 0.5, 0.2], 4.5) == [0, -1, -1]
    assert matched(errors, [0.9, 0.5, 0.2], 4.0) == [0, -1, -1]
    assert matched(np.zeros((2, 0)), [0.5, 0.4], 1.0) == [-1, -1]


def test_thresholds_are_those_of_bop():
    """7 mm of a diameter of 100: 10 % to 50 %; 12 pixels of 1280 across: 20 to 100."""
    hits = hits_of(np.array([[7.0]]), np.array([[12.0]]), [0.9], [True], 100.0, 1280)
    assert hits.average_mssd == pytest.approx(0.9)
    assert hits.average_mspd == pytest.approx(0.9)
    # an error of a threshold itself is none below it: 15 % of 100 mm is found from 20 % on
    exact = hits_of(np.array([[15.0]]), np.array([[50.0]]), [0.9], [True], 100.0, 640)
    assert exact.average_mssd == pytest.approx(0.7)
    assert exact.average_mspd == 0
    assert exact.average == pytest.approx(0.35)
