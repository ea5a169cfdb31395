"""Real frames against what is known of them: several kinds of truth, and a run that goes on."""

import csv
import json

import numpy as np
import pytest
from bop_datasets import pose_as
from factories import camera_over, meshes_of, view
from lab_programs import main, refused
from PIL import Image
from scipy.io import savemat

from nextview.errors import DatasetError
from nextview_lab.benchmark.frame_answers import FoundObject, FrameAnswer
from nextview_lab.benchmark.real import compared, recognise_real
from nextview_lab.data.real_frames import Told, real_frames, write_frames
from nextview_lab.studies.confidence import NAMED, RIGHT, shares

NAMES = ("mug", "cracker_box", "banana")
TAUGHT = NAMES[:2]  # nobody taught the banana


@pytest.fixture(scope="module")
def clouds():
    """Points on the scans of what is taught, by name."""
    meshes = meshes_of(TAUGHT)
    return {
        name: (one.vertices * one.radius + one.centre)[::9]
        for name, one in meshes.items()
    }


@pytest.fixture(scope="module")
def seen():
    """Depth in millimetres, intrinsics, thing of each pixel, and poses in the camera by name."""
    camera = camera_over(list(meshes_of(NAMES).values()))
    frame = camera.frame(view(20))
    matrix = frame.intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    to_camera = np.linalg.inv(camera.true_pose)
    poses = {one.name: to_camera @ one.pose for one in camera.table.things}
    depth = np.rint(1000 * frame.depth).astype(np.uint16)
    return depth, matrix, (camera.owner + 1).astype(np.uint8), poses


@pytest.fixture
def labelled(seen, tmp_path):
    """A folder a frame, with an image of labels; the banana has no name."""
    depth, matrix, labels, poses = seen
    told = [
        Told(name=name if name in TAUGHT else "", label=number, pose=pose.tolist())
        for number, (name, pose) in enumerate(poses.items(), 1)
    ]
    write_frames(tmp_path / "labelled", matrix, {"first": (depth, labels, told)})
    return tmp_path / "labelled"


@pytest.fixture
def pointed(labelled, seen):
    """The same frame, of which a pixel on each taught thing is known."""
    _, _, labels, poses = seen
    told = []
    for number, name in enumerate(poses, 1):
        row, column = np.argwhere(labels == number).mean(0).tolist()
        told += [{"name": name, "column": column, "row": row}] if name in TAUGHT else []
    (labelled / "truth.json").write_text(json.dumps({"first": told}))
    (labelled / "labels/first.png").unlink()
    return labelled


@pytest.fixture
def posed(seen, tmp_path):
    """The same frame in the layout of BOP, with poses and no masks; names.txt has the names."""
    depth, matrix, _, poses = seen
    folder = tmp_path / "posed"
    (folder / "depth").mkdir(parents=True)
    Image.fromarray(depth).save(folder / "depth/000007.png")
    camera = {"cam_K": matrix.ravel().tolist(), "depth_scale": 1.0}
    (folder / "scene_camera.json").write_text(json.dumps({7: camera}))
    objects = [
        {"obj_id": NAMES.index(name), **pose_as(pose, "m", "c")}
        for name, pose in poses.items()
    ]
    (folder / "scene_gt.json").write_text(json.dumps({7: objects}))
    (folder / "names.txt").write_text(" ".join(NAMES))
    return folder


@pytest.fixture
def video(seen, tmp_path):
    """The same frame in the layout of YCB-Video, with labels; only the taught things have names."""
    depth, matrix, labels, poses = seen
    folder = tmp_path / "video"
    folder.mkdir()
    Image.fromarray(depth).save(folder / "000001-depth.png")
    Image.fromarray(labels).save(folder / "000001-label.png")
    camera = {"intrinsic_matrix": matrix, "factor_depth": 1000.0}
    of_labels = {
        "cls_indexes": np.arange(1, len(poses) + 1)[:, None],
        "poses": np.stack([pose[:3] for pose in poses.values()], axis=2),
    }
    savemat(folder / "000001-meta.mat", camera | of_labels)
    (folder / "names.txt").write_text(" ".join(["none", *NAMES[:2]]))
    return folder


def said(poses, **shifts):
    """Confident names of the taught things, some of them shifted along x, metres."""
    found = []
    for name in TAUGHT:
        pose = poses[name].copy()
        pose[0, 3] += shifts.get(name, 0.0)
        flat = tuple(pose.ravel().tolist())
        found.append(FoundObject(name, 0.99, True, True, flat))
    return FrameAnswer(tuple(found), 0.5, 0.4)


def test_frames_without_poses_are_read_from_one_folder(seen, tmp_path):
    depth, matrix, labels, _ = seen
    for name in ("a", "b"):
        for kind, image in (("depth", depth), ("labels", labels)):
            (tmp_path / kind).mkdir(exist_ok=True)
            Image.fromarray(image).save(tmp_path / kind / f"{name}.png")
    camera = {"K": matrix.ravel().tolist(), "depth_scale": 0.001}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    frames = real_frames(tmp_path)
    assert [frame.name for frame in frames] == ["a", "b"]
    # without names the things are strangers
    assert [one.name for one in frames[1].things()] == [""] * 3
    assert len(real_frames(tmp_path, first_label=2)[1].things()) == 2


@pytest.mark.parametrize("truth", ["labelled", "pointed", "posed", "video"])
def test_what_is_right_by_each_kind_of_truth(truth, seen, clouds, request):
    (frame,) = real_frames(request.getfixturevalue(truth))
    assert frame.read().pose is None
    assert np.array_equal(np.rint(1000 * frame.read().depth), seen[0])

    rows = compared(frame, said(seen[3]), clouds)
    assert [row.name for row in rows if row.right] == list(TAUGHT)
    known = [row.add_s is not None for row in rows if row.right]
    assert known == [truth != "pointed"] * 2
    assert {row.thing for row in rows if row.taught} == set(TAUGHT)
    # no name was given to the banana, if anything is known of it
    assert sum(not row.taught for row in rows) == (truth != "pointed")

    rows = compared(frame, said(seen[3], mug=0.2), clouds)
    assert [row.name for row in rows if row.right] == ["cracker_box"]
    wrong = next(row for row in rows if row.name == "mug")
    assert (wrong.confident, wrong.right) == (True, False)
    assert any(row.thing == "mug" and not row.name for row in rows)


def test_the_pose_error_and_the_stranger_that_gets_a_name(labelled, seen, clouds):
    (frame,) = real_frames(labelled)
    rows = compared(frame, said(seen[3], mug=0.01), clouds)
    off = {row.name: row.add_s for row in rows if row.right}
    assert off["cracker_box"] == pytest.approx(0, abs=1e-6)
    assert 1 < off["mug"] < 10

    middles = {
        name: seen[3][name] @ [*mesh.centre, 1]
        for name, mesh in meshes_of(NAMES).items()
    }
    pose = seen[3]["mug"].copy()
    pose[:3, 3] += (middles["banana"] - middles["mug"])[:3]
    one = FoundObject("mug", 0.6, True, False, tuple(pose.ravel().tolist()))
    rows = compared(frame, FrameAnswer((one,), 0.5, 0.4), clouds)
    on = next(row for row in rows if row.name)
    assert (on.number, on.thing, on.taught, on.right) == (3, "", False, False)


def test_a_table_of_all_things_and_a_run_that_goes_on(
    labelled, posed, tmp_path, capsys
):
    out = tmp_path / "out.csv"

    def stopped(done, total, what):
        next(iter(done))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        recognise_real(labelled, (posed,), out=out, track=stopped)
    assert not out.exists()

    # the first frame is not looked at again: now it shows nothing
    depth = labelled / "first/depth.png"
    Image.fromarray(np.zeros_like(np.asarray(Image.open(depth)))).save(depth)
    main(["real", str(labelled), str(posed), "--out", str(out)])
    table = capsys.readouterr().out
    assert "taught things" in table
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    right = [row for row in rows if row["right"] == "True" and row["named"] == "True"]
    assert {row["frame"] for row in right} == {"first", "000007"}
    assert all(float(row["add_s"]) < 10 for row in right)
    by_belief = shares(out)
    assert sum(count for count, _ in by_belief[RIGHT]) == len(right)
    # the banana that has no name
    assert {total for _, total in by_belief[NAMED]} == {1}
    assert not list(tmp_path.glob(".*"))


def test_a_damaged_truth_is_named(labelled, tmp_path, capsys):
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(labelled / "labels/first.png")
    (frame,) = real_frames(labelled)
    with pytest.raises(DatasetError, match=r"labels/first\.png"):
        frame.things()
    (labelled / "truth.json").write_text('{"first": [{"colour": "red"}]}')
    assert "truth.json" in refused(
        capsys, "real", labelled, "--out", tmp_path / "o.csv"
    )
