"""Captured views: three layouts read against closed forms, the nearest view, the way there and back, damage."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pipeline import refused

import nextview
from nextview.cli.main import main
from nextview.data.samples import sample_mesh
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.simulation.captured import read_box, read_capture
from nextview.simulation.captured_camera import CapturedCamera
from nextview.simulation.capturing import write_capture

TWELVE = ViewSphere.named("12")
RADIUS = 0.55
"""Metres; the sample chair's is 0.54."""


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


def write_bop(folder):
    world_to_camera = np.linalg.inv(DOWN)
    camera = {
        "cam_K": np.ravel(K).tolist(),
        "depth_scale": 0.5,
        "cam_R_w2c": world_to_camera[:3, :3].ravel().tolist(),
        "cam_t_w2c": (1000 * world_to_camera[:3, 3]).tolist(),
    }
    write_png(folder / "depth/000007.png", depth_image())
    (folder / "scene_camera.json").write_text(json.dumps({"7": camera}))
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


@pytest.mark.parametrize("layout", WRITERS)
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


# There and back


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """The sample chair on a table, from twelve viewpoints."""
    folder = tmp_path_factory.mktemp("captures") / "chair"
    done = list(write_capture(sample_mesh("chair"), folder, TWELVE, RADIUS, table=True))
    assert done == list(range(1, 13))
    return folder


@pytest.fixture(scope="module")
def system():
    return nextview.load(policy="spread", threshold=1.0, max_views=3, viewpoints="12")


def test_captured_from_the_viewpoints_it_is_the_same_as_looking(captured, system):
    """With the box known no pose is off, the same views are taken, and they are believed as those of the mesh."""
    camera = CapturedCamera(read_capture(captured), up=(0, 0, 1), box=read_box(captured / "box.json"))
    found, looked = system.recognise(camera, start=4), system.recognise(sample_mesh("chair"), start=4)
    assert max(view.degrees_off for view in found.views) < 1e-5
    assert [view.index for view in found.views] == [view.index for view in looked.views]
    assert [camera.capture.frames.index(taken.frame) for taken in camera.taken] == [v.index for v in looked.views]
    assert found.answer == looked.answer == "chair"
    centre, height = camera.object.object_frame.centre, -RADIUS * sample_mesh("chair").vertices[:, 2].min()
    np.testing.assert_allclose(centre, [0, 0, height], atol=1e-9)
    for view in found.views:
        np.testing.assert_allclose(view.observation.pose, TWELVE.poses[view.index], atol=1e-6)


def test_the_object_is_found_without_a_box(captured, system):
    result = system.recognise(captured, start=4)
    assert result.answer == "chair"
    assert all(view.degrees_off < 3 for view in result.views)
    assert result.views[0].observation.radius == pytest.approx(RADIUS, rel=0.1)


def test_an_object_without_a_table_is_found_by_its_masks(tmp_path, system):
    list(write_capture(sample_mesh("chair"), tmp_path / "free", TWELVE, RADIUS))
    result = system.recognise(tmp_path / "free", start=0, up="z")
    assert result.answer == "chair"
    assert all(view.degrees_off < 3 for view in result.views)


# The nearest view


def test_every_request_gets_the_nearest_view_that_is_left(captured):
    capture = read_capture(captured)
    box = read_box(captured / "box.json")
    camera = CapturedCamera(capture, box=box)
    asked = look_at_origin(np.radians([50, 30, 70, 10]), np.radians([130, 128, 131, 310]))
    left = dict(enumerate(capture.frames))
    for pose in asked:
        camera.observe(pose)

        def cosine(i, pose=pose):
            position = left[i].pose[:3, 3] - box.object_frame.centre
            return position @ pose[:3, 3] / np.linalg.norm(position)

        assert camera.taken[-1].frame.name == left.pop(max(left, key=cosine)).name
    assert len(camera.taken) == 4


def test_views_that_do_not_show_the_object_are_left_out(captured, tmp_path, system):
    shutil.copytree(captured, tmp_path / "some")
    write_png(tmp_path / "some" / "depth" / "000004.png", np.zeros((480, 640)))
    camera = CapturedCamera(read_capture(tmp_path / "some"))
    result = system.recognise(camera, start=4)
    assert list(camera.left_out) == ["000004"]
    assert camera.taken[0].degrees_off == pytest.approx(20.9, abs=2)  # the next one: 30 degrees round, at 45 up
    assert result.answer == "chair"


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


def edited(change):
    def edit(path):
        values = json.loads(path.read_text())
        change(values["7"])
        path.write_text(json.dumps(values))

    return edit


def put(text):
    return lambda path: path.write_text(text)


def link_out(path):
    """What was there lies elsewhere now, a file or a folder, and is linked to."""
    there = path.rename(path.parents[1] / f"elsewhere-{path.name}")
    path.symlink_to(there)


CAMERAS, TRAJECTORY = "scene_camera.json", "groundtruth.txt"
POSE, DEPTH = "frame-000003.pose.txt", "frame-000003.depth.png"
DAMAGE = {
    "a missing image": ("bop", "depth/000007.png", Path.unlink, "no such file"),
    "a truncated image": ("7scenes", DEPTH, lambda p: p.write_bytes(p.read_bytes()[:-40]), "damaged"),
    "a link to an image elsewhere": ("7scenes", DEPTH, link_out, "link out of this folder"),
    "a link to a list elsewhere": ("tum", TRAJECTORY, link_out, "link out of this folder"),
    "a link to a folder elsewhere": ("bop", "depth", link_out, "link out of this folder"),
    "8 bits": ("tum", "depth/a.png", lambda p: write_png(p, depth_image(90), np.uint8), "16 bits"),
    "no JSON": ("bop", CAMERAS, put("{"), "not the cameras"),
    "no scale": ("bop", CAMERAS, edited(lambda v: v.update(depth_scale=0)), "depth_scale"),
    "no translation": ("bop", CAMERAS, edited(lambda v: v.pop("cam_t_w2c")), "cam_t"),
    "no rotation": ("bop", CAMERAS, edited(lambda v: v.update(cam_R_w2c=[2, 0, 0, 0, 2, 0, 0, 0, 2])), "scaled by 2"),
    "a lost camera": ("7scenes", POSE, put(4 * "nan nan nan nan\n"), "NaN"),
    "an empty trajectory": ("tum", TRAJECTORY, put("# t\n"), "lists nothing"),
    "no quaternion": ("tum", TRAJECTORY, put("10 0 0 0 0 0 0 0\n"), "quaternion"),
    "another clock": ("tum", TRAJECTORY, put("99 0 0 0 0 0 0 1\n"), "one clock"),
    "an image elsewhere": ("tum", "depth.txt", put("10 /etc/passwd\n"), "no file of this folder"),
    "no intrinsics": ("tum", "camera-intrinsics.txt", Path.unlink, "--intrinsics"),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_what_is_damaged_is_named(what, tmp_path, capsys):
    layout, name, damage, said = DAMAGE[what]
    folder = tmp_path / "capture"
    folder.mkdir()
    WRITERS[layout](folder)
    damage(folder / name)
    sentence = refused(capsys, "recognise", folder).replace(" ", "")  # it may be broken in two lines anywhere
    assert said.replace(" ", "") in sentence
    assert (folder.name if what == "no intrinsics" else name) in sentence
