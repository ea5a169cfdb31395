"""Captured views: three layouts read against closed forms, the nearest view, the way there and back, damage."""

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import nextview
from nextview.cameras.captured import read_box, read_capture
from nextview.cameras.captured_camera import CapturedCamera
from nextview.cameras.captured_tum import TOGETHER, nearest_in_time
from nextview.cameras.capturing import Setting, write_capture
from nextview.cli.main import main
from nextview.data.samples import sample_mesh
from nextview.errors import DatasetError, NextviewError, NoViewLeftError, ObservationError, ResultsError, UsageError
from nextview.sensing import Box
from nextview.sensing.object_frame import upright_axes
from nextview.viewsphere import ViewSphere, look_at_origin

LAYOUTS = ("bop", "tum", "7scenes")
TWELVE = ViewSphere.named("12")
RADIUS = 0.55
"""Metres; the sample chair's is 0.54."""


def rng():
    return np.random.default_rng(0)


K = [[500.0, 0, 7.5], [0, 510.0, 5.5], [0, 0, 1]]
DOWN = np.array([[1.0, 0, 0, 0.25], [0, -1, 0, -0.5], [0, 0, -1, 2], [0, 0, 0, 1]])
"""A camera 2 m above the world's floor that looks straight down."""


def write_png(path, values, dtype=np.uint16):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(values, dtype)).save(path)


def depth_image(value=4000):
    depth = np.full((12, 16), value)
    depth[0, 0], depth[0, 1] = 0, 65535
    return depth


def write_bop(folder, cameras=None, gt=None):
    world_to_camera = np.linalg.inv(DOWN)
    camera = {
        "cam_K": np.ravel(K).tolist(),
        "depth_scale": 0.5,
        "cam_R_w2c": world_to_camera[:3, :3].ravel().tolist(),
        "cam_t_w2c": (1000 * world_to_camera[:3, 3]).tolist(),
    }
    write_png(folder / "depth/000007.png", depth_image())
    (folder / "scene_camera.json").write_text(json.dumps({"7": camera} if cameras is None else cameras(camera)))
    if gt is not None:
        (folder / "scene_gt.json").write_text(json.dumps(gt))
    return folder


def write_tum(folder):
    write_png(folder / "depth/a.png", depth_image(10000))
    (folder / "depth.txt").write_text("# time name\n10.00 depth/a.png\n")
    (folder / "groundtruth.txt").write_text("# t\n9.99 9 9 9 0 0 0 1\n10.004 0.25 -0.5 2 1 0 0 0\n10.1 8 8 8 0 0 0 1\n")
    np.savetxt(folder / "camera-intrinsics.txt", K)
    return folder


def write_seven(folder):
    write_png(folder / "frame-000003.depth.png", depth_image(2000))
    np.savetxt(folder / "frame-000003.pose.txt", DOWN)
    np.savetxt(folder / "camera-intrinsics.txt", K)
    return folder


WRITERS = {"bop": write_bop, "tum": write_tum, "7scenes": write_seven}


# What is read


@pytest.mark.parametrize("layout", LAYOUTS)
def test_pose_intrinsics_and_depth_are_those_of_the_layout(layout, tmp_path):
    """A camera that looks down from 2 m: worked out by hand for each."""
    capture = read_capture(WRITERS[layout](tmp_path))
    assert capture.layout == {"bop": "BOP", "tum": "TUM RGB-D", "7scenes": "7-Scenes"}[layout]
    (captured,) = capture.frames
    np.testing.assert_allclose(captured.pose, DOWN, atol=1e-9)
    frame = captured.read()
    assert frame.depth[0, 0] == frame.depth[0, 1] == 0
    np.testing.assert_allclose(frame.depth.ravel()[2:], 2, rtol=1e-6)
    # The pixel at the principal point sees the floor right below the camera; 50 columns of 500 are 0.1 of the depth.
    expected = (np.array([3 - 7.5, 4 - 5.5]) / [500, 510] * 2) * [1, -1] + [0.25, -0.5]
    np.testing.assert_allclose(frame.positions(np.array([4]), np.array([3]))[0], [*expected, 0], atol=1e-6)


def test_steps_of_16_bits_survive(tmp_path):
    write_seven(tmp_path)
    values = np.arange(12 * 16).reshape(12, 16) * 341 + 300  # up to 65431
    write_png(tmp_path / "frame-000003.depth.png", values)
    found = read_capture(tmp_path).frames[0].read().depth
    expected = np.where(values < 65000, values / 1000, 0)  # nothing is seen beyond 65 m
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_the_kinects_intrinsics_are_assumed_and_said(tmp_path):
    write_seven(tmp_path)
    (tmp_path / "camera-intrinsics.txt").unlink()
    capture = read_capture(tmp_path)
    np.testing.assert_array_equal(capture.frames[0].intrinsics, [[585, 0, 320], [0, 585, 240], [0, 0, 1]])
    assert "585" in repr(capture)
    given = read_capture(tmp_path, (500.0, 510.0, 7.5, 5.5))
    np.testing.assert_array_equal(given.frames[0].intrinsics, K)


def test_without_camera_poses_the_objects_own_will_do(tmp_path):
    """The model's frame is the world: a camera 2 m above the model."""
    model_to_camera = np.linalg.inv(DOWN)
    pose = {
        "cam_R_m2c": model_to_camera[:3, :3].ravel().tolist(),
        "cam_t_m2c": (1000 * model_to_camera[:3, 3]).tolist(),
    }
    gt = {"7": [{"obj_id": 4, **pose, "cam_t_m2c": [9, 9, 9]}, {"obj_id": 6, **pose}]}
    write_bop(tmp_path, lambda camera: {"7": {k: camera[k] for k in ("cam_K", "depth_scale")}}, gt)
    np.testing.assert_allclose(read_capture(tmp_path, object_id=6).frames[0].pose, DOWN, atol=1e-9)
    with pytest.raises(DatasetError, match="--object-id"):
        read_capture(tmp_path)
    with pytest.raises(DatasetError, match="there are 4, 6"):
        read_capture(tmp_path, object_id=5)


def test_the_mask_is_that_of_the_object_meant(tmp_path):
    write_bop(tmp_path, gt={"7": [{"obj_id": 4}, {"obj_id": 6}]})
    for i, column in enumerate((5, 9)):
        mask = np.zeros((12, 16))
        mask[6, column] = 255
        write_png(tmp_path / f"mask_visib/000007_00000{i}.png", mask, np.uint8)
    for number, column in ((4, 5), (6, 9)):
        mask = read_capture(tmp_path, object_id=number).frames[0].read().mask
        assert np.argwhere(mask).tolist() == [[6, column]]
    ambiguous = read_capture(tmp_path)
    assert ambiguous.frames[0].mask is None
    assert "--object-id" in repr(ambiguous)


@given(
    st.lists(st.floats(0, 1), min_size=1, max_size=30), st.lists(st.floats(0, 1), min_size=1, max_size=30, unique=True)
)
def test_the_nearest_time_is_found_as_brute_force_finds_it(times, others):
    times, others = np.array(times), np.array(others)
    at, near = nearest_in_time(times, others)
    gaps = np.abs(times[:, None] - others)
    np.testing.assert_array_equal(gaps[np.arange(len(times)), at], gaps.min(1))
    clear = np.abs(gaps.min(1) - TOGETHER) > 1e-5
    np.testing.assert_array_equal(near[clear], (gaps.min(1) < TOGETHER)[clear])


def test_images_without_a_pose_in_time_are_left_out_and_counted(tmp_path):
    write_tum(tmp_path)
    (tmp_path / "depth.txt").write_text("10.00 depth/a.png\n11.0 depth/b.png\n")
    capture = read_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == ["a"]
    assert "1 depth image" in repr(capture)


# There and back


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """The sample chair on a table, from twelve viewpoints, in each layout."""
    folder = tmp_path_factory.mktemp("captures")
    for layout in LAYOUTS:
        setting = Setting(RADIUS, table=True, masks=layout != "7scenes")
        done = list(write_capture(sample_mesh("chair"), folder / layout, layout, TWELVE, setting, rng()))
        assert done == list(range(1, 13))
    return folder


@pytest.fixture(scope="module")
def system():
    return nextview.load(policy="spread", threshold=1.0, max_views=3, viewpoints="12")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_captured_from_the_viewpoints_it_is_the_same_as_looking(layout, captures, system):
    """With the box known no pose is off, the same views are taken, and they are believed as those of the mesh."""
    folder = captures / layout
    camera = CapturedCamera(read_capture(folder), up=(0, 0, 1), box=read_box(folder / "box.json"))
    captured, looked = system.recognise(camera, start=4), system.recognise(sample_mesh("chair"), start=4)
    assert max(view.degrees_off for view in captured.views) < 1e-5
    assert [view.index for view in captured.views] == [view.index for view in looked.views]
    assert [camera.capture.frames.index(taken.frame) for taken in camera.taken] == [v.index for v in looked.views]
    assert captured.answer == looked.answer == "chair"
    centre, height = camera.object.object_frame.centre, -RADIUS * sample_mesh("chair").vertices[:, 2].min()
    np.testing.assert_allclose(centre, [0, 0, height], atol=1e-9)
    for view in captured.views:
        np.testing.assert_allclose(view.observation.pose, TWELVE.poses[view.index], atol=1e-6)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_object_is_found_without_a_box(layout, captures, system):
    result = system.recognise(captures / layout, start=4)
    assert result.answer == "chair"
    assert all(view.degrees_off < 3 for view in result.views)
    assert result.views[0].observation.radius == pytest.approx(RADIUS, rel=0.1)


def test_an_object_without_a_table_is_found_by_its_masks(tmp_path, system):
    list(write_capture(sample_mesh("chair"), tmp_path / "free", "7scenes", TWELVE, Setting(RADIUS), rng()))
    result = system.recognise(tmp_path / "free", start=0, up="z")
    assert result.answer == "chair"
    assert all(view.degrees_off < 3 for view in result.views)
    with pytest.raises(ObservationError, match="where up is"):
        system.recognise(tmp_path / "free")


def test_poses_of_jittered_viewpoints_are_as_far_off_as_drawn(tmp_path):
    setting = Setting(RADIUS, table=True, jitter=5)
    list(write_capture(sample_mesh("table"), tmp_path / "j", "bop", TWELVE, setting, np.random.default_rng(1)))
    box = read_box(tmp_path / "j" / "box.json")
    camera = CapturedCamera(read_capture(tmp_path / "j"), box=box)
    off = []
    for pose in TWELVE.poses[:4]:
        camera.observe(pose)
        position = camera.taken[-1].frame.pose[:3, 3] - box.object_frame.centre
        cosine = position @ pose[:3, 3] / np.linalg.norm(position) / np.linalg.norm(pose[:3, 3])
        off.append(camera.taken[-1].degrees_off)
        assert off[-1] == pytest.approx(np.degrees(np.arccos(cosine)), abs=1e-5)
    assert 0.5 < np.mean(off) < 20


# The nearest view


def test_every_request_gets_the_nearest_view_that_is_left(captures):
    capture = read_capture(captures / "bop")
    box = read_box(captures / "bop" / "box.json")
    camera = CapturedCamera(capture, box=box)
    asked = look_at_origin(np.radians([50, 30, 70, 10]), np.radians([130, 128, 131, 310]))
    left = dict(enumerate(capture.frames))
    for pose in asked:
        camera.observe(pose)

        def cosine(i, pose=pose):
            position = left[i].pose[:3, 3] - box.object_frame.centre
            return position @ pose[:3, 3] / np.linalg.norm(position)

        best = max(left, key=cosine)
        assert camera.taken[-1].frame.name == left.pop(best).name
    assert camera.left == 8


def test_an_episode_ends_with_the_views(captures, tmp_path, capsys):
    """Two frames, and a threshold that is never reached: two views, none of them twice, and no promise."""
    shutil.copytree(captures / "7scenes", tmp_path / "few")
    for path in sorted((tmp_path / "few").glob("frame-*.depth.png"))[2:]:
        path.unlink()
    result = nextview.load(threshold=1.0).recognise(tmp_path / "few", start=3)
    assert len(result.views) == 2
    assert not result.confident
    assert result.views[-1].next_view is None
    main(["recognise", str(tmp_path / "few"), "--threshold", "1", "--start", "3"])
    printed = capsys.readouterr().out
    assert "000000" in printed
    assert "000001" in printed
    assert "° off" in printed


def test_views_that_do_not_show_the_object_are_left_out(captures, tmp_path, system):
    shutil.copytree(captures / "bop", tmp_path / "some")
    empty = tmp_path / "some" / "depth" / "000004.png"
    write_png(empty, np.zeros((480, 640)))
    camera = CapturedCamera(read_capture(tmp_path / "some"))
    result = system.recognise(camera, start=4)
    assert list(camera.left_out) == ["000004"]
    assert camera.taken[0].degrees_off == pytest.approx(20.9, abs=2)  # the next one: 30 degrees round, at 45 up
    assert result.answer == "chair"


def test_a_camera_without_views_says_so(captures):
    camera = CapturedCamera(read_capture(captures / "tum"))
    for _ in range(12):
        camera.observe(TWELVE.poses[0])
    with pytest.raises(NoViewLeftError, match="no view is left"):
        camera.observe(TWELVE.poses[0])


def test_json_tells_the_frames(captures, capsys):
    main(["recognise", str(captures / "tum"), "--start", "20", "--json", "--box", str(captures / "tum" / "box.json")])
    episode = json.loads(capsys.readouterr().out)
    assert episode["answer"] == "chair"
    assert episode["views"][0]["frame"].startswith("1.")
    # View 20 is 36 degrees up at 180 round; the nearest of the twelve is 45 up there.
    assert episode["views"][0]["degrees_off"] == pytest.approx(9, abs=1e-4)


@pytest.mark.parametrize("how", ["point", "numbers"])
def test_which_object_is_meant(how, captures, capsys):
    box = json.loads((captures / "7scenes" / "box.json").read_text())
    numbers = [str(x) for x in (*box["low"], *box["high"])]
    options = ["--point", "0.1", "-0.1", "0.4"] if how == "point" else ["--up", "z", "--box", *numbers]
    main(["recognise", str(captures / "7scenes"), "--start", "3", "--json", *options])
    assert json.loads(capsys.readouterr().out)["answer"] == "chair"


def test_the_section_of_the_guide_runs(tmp_path, monkeypatch, capsys):
    root = Path(__file__).parent.parent
    section = (root / "docs" / "your_camera.md").read_text().split("## Captured images\n")[1].split("\n## ")[0]
    shutil.copytree(root / "samples", tmp_path / "samples")
    monkeypatch.chdir(tmp_path)
    for line in re.search(r"```sh\n(.*?)```", section, re.S)[1].splitlines():
        main(line.partition("#")[0].split()[1:])
    assert "It is a chair" in capsys.readouterr().out
    exec(re.search(r"```python\n(.*?)```", section, re.S)[1], {"nextview": nextview})
    assert "chair (belief" in capsys.readouterr().out


# What is wrong is said in one sentence


def sentence(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    assert end.value.code == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if " layout, " not in line]
    return " ".join(lines)


def truncate(path):
    path.write_bytes(path.read_bytes()[:-40])


def edit_json(path, change):
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


def put(path, text):
    path.write_text(text)


DAMAGE = {
    "a missing image": ("bop", "depth/000007.png", Path.unlink, "no such file"),
    "a truncated image": ("7scenes", "frame-000003.depth.png", truncate, "damaged"),
    "no image at all": ("tum", "depth/a.png", lambda p: put(p, "P5 nothing"), "not a PNG"),
    "8 bits": ("tum", "depth/a.png", lambda p: write_png(p, depth_image(90), np.uint8), "16 bits"),
    "no JSON": ("bop", "scene_camera.json", lambda p: put(p, "{"), "not the cameras"),
    "a list": ("bop", "scene_camera.json", lambda p: put(p, "[]"), "no JSON object"),
    "no images": ("bop", "scene_camera.json", lambda p: put(p, "{}"), "numbers of images"),
    "a name for a number": ("bop", "scene_camera.json", lambda p: put(p, '{"a": {}}'), "'a'"),
    "no K": ("bop", "scene_camera.json", lambda p: edit_json(p, lambda v: v["7"].pop("cam_K")), "cam_K"),
    "a short K": ("bop", "scene_camera.json", lambda p: edit_json(p, lambda v: v["7"].update(cam_K=[1])), "9"),
    "no scale": (
        "bop",
        "scene_camera.json",
        lambda p: edit_json(p, lambda v: v["7"].update(depth_scale=0)),
        "positive",
    ),
    "NaN": ("bop", "scene_camera.json", lambda p: put(p, '{"7": {"depth_scale": NaN}}'), "NaN"),
    "no translation": ("bop", "scene_camera.json", lambda p: edit_json(p, lambda v: v["7"].pop("cam_t_w2c")), "cam_t"),
    "no rotation": (
        "bop",
        "scene_camera.json",
        lambda p: edit_json(p, lambda v: v["7"].update(cam_R_w2c=[2.0, 0, 0, 0, 2, 0, 0, 0, 2])),
        "scaled by 2",
    ),
    "a lost camera": ("7scenes", "frame-000003.pose.txt", lambda p: put(p, 4 * "nan nan nan nan\n"), "NaN"),
    "half a pose": ("7scenes", "frame-000003.pose.txt", lambda p: put(p, "1 0 0 0\n"), "4 x 4"),
    "words": ("7scenes", "frame-000003.pose.txt", lambda p: put(p, "a b c d\n"), "4 x 4"),
    "bytes": ("7scenes", "frame-000003.pose.txt", lambda p: p.write_bytes(b"\xff\xfe\x00"), "4 x 4"),
    "no pose": ("7scenes", "frame-000003.pose.txt", Path.unlink, "no such file"),
    "no trajectory": ("tum", "groundtruth.txt", Path.unlink, "no such file"),
    "an empty trajectory": ("tum", "groundtruth.txt", lambda p: put(p, "# t\n"), "lists nothing"),
    "a short line": ("tum", "groundtruth.txt", lambda p: put(p, "1 2 3\n"), "line 1"),
    "NaN in a trajectory": ("tum", "groundtruth.txt", lambda p: put(p, "10 nan 0 0 0 0 0 1\n"), "NaN"),
    "a word in a trajectory": ("tum", "groundtruth.txt", lambda p: put(p, "10 x 0 0 0 0 0 1\n"), "number"),
    "no quaternion": ("tum", "groundtruth.txt", lambda p: put(p, "10 0 0 0 0 0 0 0\n"), "quaternion"),
    "another clock": ("tum", "groundtruth.txt", lambda p: put(p, "99 0 0 0 0 0 0 1\n"), "one clock"),
    "no intrinsics": ("tum", "camera-intrinsics.txt", Path.unlink, "--intrinsics"),
    "odd intrinsics": ("tum", "camera-intrinsics.txt", lambda p: put(p, "1 2 3\n"), "3 x 3"),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_what_is_damaged_is_named(what, tmp_path, capsys):
    layout, name, damage, said = DAMAGE[what]
    WRITERS[layout](tmp_path)
    damage(tmp_path / name)
    message = sentence(capsys, "recognise", tmp_path)
    joined = message.replace(" ", "")
    assert said.replace(" ", "") in joined
    assert (name if "intrinsics" not in what or what == "odd intrinsics" else tmp_path.name) in joined


def test_a_mask_of_another_size_is_refused(tmp_path):
    write_seven(tmp_path)
    write_png(tmp_path / "frame-000003.mask.png", np.full((6, 8), 255), np.uint8)
    with pytest.raises(DatasetError, match=r"mask.png: is 8 x 6 pixels, and the depth image beside it 16 x 12"):
        read_capture(tmp_path).frames[0].read()


def test_folders_of_no_layout_or_of_two_are_refused(tmp_path, capsys):
    assert "no captured views" in sentence(capsys, "recognise", tmp_path)
    write_seven(tmp_path)
    write_bop(tmp_path)
    assert "two layouts" in sentence(capsys, "recognise", tmp_path)


def test_a_folder_in_which_nothing_is_found_is_refused(tmp_path, capsys):
    write_seven(tmp_path)
    write_png(tmp_path / "frame-000003.depth.png", np.zeros((12, 16)))
    assert "in none of the views" in sentence(capsys, "recognise", tmp_path)


def test_options_of_the_other_kind_are_refused(captures, tmp_path, capsys):
    (tmp_path / "a.off").write_text("OFF\n")
    assert "--point is for folders" in sentence(capsys, "recognise", tmp_path / "a.off", "--point", 0, 0, 0)
    assert "--raw is for folders" in sentence(capsys, "recognise", tmp_path / "a.off", "--raw")
    assert "y or z" in sentence(capsys, "recognise", tmp_path / "a.off", "--up", 0, 0, 1)
    assert "--unit is for mesh" in sentence(capsys, "recognise", captures / "bop", "--unit", "mm")
    assert "--up" in sentence(capsys, "recognise", captures / "7scenes", "--box", 0, 0, 0, 1, 1, 1)
    with pytest.raises(UsageError, match="BOP"):
        read_capture(captures / "tum", object_id=1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "not a box"),
        ('{"low": [0, 0, 0]}', "high"),
        ('{"low": [0, 0, 0], "high": [1, 1, 0]}', "low and a high corner"),
        ('{"low": [0, 0, 0], "high": [1, 1, 1], "axes": [[1, 0, 0], [0, 2, 0], [0, 0, 1]]}', "rotation"),
        ('{"low": [0, 0, 0], "high": [1, 1, 1], "colour": 1}', "colour"),
    ],
)
def test_boxes_that_are_none_are_refused(text, said, tmp_path):
    (tmp_path / "box.json").write_text(text)
    with pytest.raises(NextviewError, match=said) as error:
        read_box(tmp_path / "box.json")
    assert "box.json" in str(error.value)


# nextview capture


def test_capture_writes_what_recognise_reads(tmp_path, capsys):
    arguments = [
        "samples/monitor.off",
        tmp_path / "new",
        "--layout",
        "tum",
        "--viewpoints",
        "12",
        "--unit",
        "cm",
        "--table",
    ]
    main(["capture", *map(str, arguments)])
    err = capsys.readouterr().err
    assert "12/12" in err
    main(["recognise", str(tmp_path / "new"), "--json"])
    assert json.loads(capsys.readouterr().out)["answer"] == "monitor"
    before = {path: path.read_bytes() for path in (tmp_path / "new").rglob("*.*") if path.is_file()}
    assert "holds something" in sentence(capsys, "capture", *arguments)
    assert {path: path.read_bytes() for path in (tmp_path / "new").rglob("*.*") if path.is_file()} == before


def test_capture_refuses_what_makes_no_sense(tmp_path, capsys):
    chair = "samples/chair.off"
    assert "--radius" in sentence(capsys, "capture", chair, tmp_path / "a")
    assert "positive" in sentence(capsys, "capture", chair, tmp_path / "a", "--radius", -1)
    assert "more than one" in sentence(capsys, "capture", chair, tmp_path / "a", "--radius", 1, "--distance", 1)
    assert "end at" in sentence(capsys, "capture", chair, tmp_path / "a", "--radius", 9)
    (tmp_path / "file").write_text("mine")
    assert "is a file" in sentence(capsys, "capture", chair, tmp_path / "file", "--radius", 1)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_capture_that_is_cut_off_leaves_nothing(tmp_path):
    writing = write_capture(sample_mesh("chair"), tmp_path / "cut", "bop", TWELVE, Setting(RADIUS), rng())
    assert next(writing) == 1
    writing.close()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "mine").write_text("mine")
    with pytest.raises(ResultsError, match="holds something"):
        next(write_capture(sample_mesh("chair"), tmp_path / "cut", "bop", TWELVE, Setting(1), rng()))


# A real Kinect

KITCHEN = Path(os.environ.get("NEXTVIEW_DATA", "")) / "real_kinect"


@pytest.mark.skipif(
    "NEXTVIEW_DATA" not in os.environ or not KITCHEN.is_dir(), reason="NEXTVIEW_DATA names no folder with real_kinect"
)
def test_a_real_chair_is_recognised():
    axes = upright_axes((0.00707587, -0.89330292, -0.44939944))
    box = Box(np.array([-1.38, 1.40, -1.497]), np.array([-0.90, 2.05, -0.587]), axes)
    capture = read_capture(KITCHEN)
    assert len(capture.frames) == 50
    camera = CapturedCamera(capture, box=box, up=axes[2])
    assert nextview.load().recognise(camera, start=11).answer == "chair"
