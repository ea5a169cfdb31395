"""Captured views: three layouts read against closed forms, the nearest view, the way there and
back, damage.
"""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from factories import refused
from PIL import Image
from programs import main
from scipy.spatial.transform import Rotation

import nextview
from nextview.captured.camera import CapturedCamera
from nextview.captured.check import check_capture
from nextview.captured.folders import read_box, read_capture
from nextview.data.samples import sample_mesh
from nextview.errors import DatasetError
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview.teaching.learn import learn
from nextview_lab.data.writing import write_capture
from nextview_lab.worlds.scene import square

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
    (folder / "groundtruth.txt").write_text(
        "# t\n9.99 9 9 9 0 0 0 1\n10.004 0.25 -0.5 2 1 0 0 0\n10.1 8 8 8 0 0 0 1\n"
    )
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
    assert (
        capture.layout
        == {"bop": "BOP", "tum": "TUM RGB-D", "7scenes": "7-Scenes"}[layout]
    )
    (captured,) = capture.frames
    np.testing.assert_allclose(captured.pose, DOWN, atol=1e-9)
    frame = captured.read()
    assert frame.depth[0, 0] == frame.depth[0, 1] == 0
    np.testing.assert_allclose(frame.depth.ravel()[2:], 2, rtol=1e-6)
    # The pixel at the principal point sees the floor right below the camera; 50 columns of 500 are
    # 0.1 of the depth.
    expected = (np.array([3 - 7.5, 4 - 5.5]) / [500, 510] * 2) * [1, -1] + [0.25, -0.5]
    np.testing.assert_allclose(
        frame.positions(np.array([4]), np.array([3]))[0],
        [*expected, 0],
        atol=1e-6,
    )


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
    """With the box known no pose is off, the same views are taken, and they are believed as
    those of the mesh.
    """
    camera = CapturedCamera(
        read_capture(captured),
        up=(0, 0, 1),
        box=read_box(captured / "box.json"),
    )
    found, looked = (
        system.recognise(camera, start=4),
        system.recognise(sample_mesh("chair"), start=4),
    )
    assert max(view.degrees_off for view in found.views) < 1e-5
    assert [view.index for view in found.views] == [view.index for view in looked.views]
    assert [camera.capture.frames.index(taken.frame) for taken in camera.taken] == [
        v.index for v in looked.views
    ]
    assert found.answer == looked.answer == "chair"
    centre, height = (
        camera.object.object_frame.centre,
        -RADIUS * sample_mesh("chair").vertices[:, 2].min(),
    )
    np.testing.assert_allclose(centre, [0, 0, height], atol=1e-9)
    for view in found.views:
        np.testing.assert_allclose(
            view.observation.pose,
            TWELVE.poses[view.index],
            atol=1e-6,
        )


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
    asked = look_at_origin(
        np.radians([50, 30, 70, 10]),
        np.radians([130, 128, 131, 310]),
    )
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
    # the next one: 30 degrees round, at 45 up
    assert camera.taken[0].degrees_off == pytest.approx(20.9, abs=2)
    assert result.answer == "chair"


def test_the_section_of_the_guide_runs(tmp_path, monkeypatch, capsys):
    root = Path(__file__).parent.parent
    section = (
        (root / "docs" / "your_camera.md")
        .read_text()
        .split("## Captured images\n")[1]
        .split("\n## ")[0]
    )
    shutil.copytree(root / "samples", tmp_path / "samples")
    monkeypatch.chdir(tmp_path)
    for line in re.search(r"```sh\n(.*?)```", section, re.S)[1].splitlines():
        main(line.partition("#")[0].split()[1:])
    assert "It is a chair" in capsys.readouterr().out
    exec(re.search(r"```python\n(.*?)```", section, re.S)[1], {"nextview": nextview})
    assert "chair (belief" in capsys.readouterr().out


# Frames that do not fit together


SMALL_K = np.array([[131.25, 0, 80], [0, 131.25, 60], [0, 0, 1]])
STEPS = {"bop": 0.001, "tum": 1 / 5000, "7scenes": 0.001}  # metres, of the depth images


def seen(count=9, moved=0.0, turned=0.0, evenly=False, thing=None):
    """Depth images, metres, of a thing on a table, by default the sample chair, and poses around
    it.

    The poses are off by some metres and degrees; they are random or evenly around at one height.
    """
    rng = np.random.default_rng(3)
    if thing is None:
        mesh = sample_mesh("chair")
        thing = 0.3 * (mesh.vertices - [0, 0, mesh.vertices[:, 2].min()]), mesh.faces
    caster = RayCaster([thing, square(0.6, 0.0)])
    rays = PinholeCamera.of(SMALL_K, (120, 160)).rays.reshape(-1, 3)
    if evenly:
        elevation = np.full(count, np.radians(35))
        azimuth = 2 * np.pi * np.arange(count) / count
    else:
        elevation = np.radians(rng.uniform(20, 70, count))
        azimuth = rng.uniform(0, 2 * np.pi, count)
    poses = look_at_origin(elevation, azimuth, 1.0)
    poses[:, 2, 3] += 0.25
    depths = []
    for pose in poses:
        turn = Rotation.from_rotvec(rng.normal(0, turned, 3), degrees=True).as_matrix()
        there = pose[:3, 3] + rng.normal(0, moved, 3)
        depth, which = caster.cast(
            there,
            rays @ np.ascontiguousarray((pose[:3, :3] @ turn).T, np.float32),
        )
        depths.append(np.where(which < 0, 0, depth).reshape(120, 160))
    return depths, poses


def reordered(rotations):
    """Rotations of quaternions w, x, y, z that are taken for x, y, z, w."""
    return Rotation.from_quat(
        np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=1)
    ).as_matrix()


def write_frames(folder, layout, depths, poses, step=1.0, unit=1.0, swapped=False):
    """Frames in a layout; the depth images have steps other than the layout's, the translations
    another unit.
    """
    stored = np.linalg.inv(poses) if layout == "bop" else poses.copy()
    if swapped and layout != "tum":
        stored[:, :3, :3] = reordered(stored[:, :3, :3])
    stored[:, :3, 3] *= unit * (1000 if layout == "bop" else 1)
    k, cameras, times, lines = (
        SMALL_K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]),
        {},
        [],
        [],
    )
    for i, (depth, pose) in enumerate(zip(depths, stored, strict=True)):
        name = {
            "bop": f"depth/{i:06d}.png",
            "tum": f"depth/{i}.png",
            "7scenes": f"frame-{i:06d}.depth.png",
        }[layout]
        write_png(
            folder / name,
            np.minimum(np.rint(depth / (step * STEPS[layout])), 65534),
        )
        if layout == "bop":
            there = {
                "cam_R_w2c": pose[:3, :3].ravel().tolist(),
                "cam_t_w2c": pose[:3, 3].tolist(),
            }
            cameras[str(i)] = {"cam_K": k.ravel().tolist(), "depth_scale": 1.0, **there}
        elif layout == "tum":
            quaternion = np.roll(
                Rotation.from_matrix(pose[:3, :3]).as_quat(),
                int(swapped),
            )
            lines.append(
                " ".join(f"{value:.6f}" for value in (i, *pose[:3, 3], *quaternion))
            )
            times.append(f"{i} {name}")
        else:
            np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)
    if layout == "bop":
        (folder / "scene_camera.json").write_text(json.dumps(cameras))
    else:
        np.savetxt(folder / "camera-intrinsics.txt", k)
    if layout == "tum":
        (folder / "depth.txt").write_text("\n".join(times))
        (folder / "groundtruth.txt").write_text("\n".join(lines))
    return folder


@pytest.fixture(scope="module")
def nine():
    return seen()


UNITS = {"bop": 0.001, "tum": 1000, "7scenes": 1000}  # metres for millimetres, and back
OPENGL = np.diag([1.0, -1, -1, 1])
MISTAKES = {
    "quaternions": (lambda p: p, {"swapped": True}, "in the order w, x, y, z"),
    "inverse": (np.linalg.inv, {}, "the poses are inverse"),
    "unit": (lambda p: p, {"unit": UNITS}, "the translations are in m"),
    "five times too large": (
        lambda p: p,
        {"step": 0.2},
        "the depth is 5 times too large",
    ),
    "four times too large": (
        lambda p: p,
        {"step": 0.25},
        "the depth is 4 times too large",
    ),
    "five times too small": (
        lambda p: p,
        {"step": 5},
        "the depth is 5 times too small",
    ),
    "late": (lambda p: np.concatenate([p[:1], p[:-1]]), {}, "one frame late"),
    "early": (lambda p: np.concatenate([p[1:], p[-1:]]), {}, "one frame early"),
    "two late": (
        lambda p: np.concatenate([p[:2], p[:-2]]),
        {},
        "the poses are 2 frames late",
    ),
    "two early": (
        lambda p: np.concatenate([p[2:], p[-2:]]),
        {},
        "the poses are 2 frames early",
    ),
    "axes": (lambda p: p @ OPENGL, {}, "those of OpenGL"),
    "inverse, and axes": (lambda p: np.linalg.inv(p @ OPENGL), {}, "are inverse"),
}


OF_LAYOUT = ("quaternions", "inverse", "unit")
"""These are other mistakes in the files of each layout; the rest is the same once it is read."""


@pytest.mark.parametrize(
    ("what", "layout"),
    [
        (what, layout)
        for what in MISTAKES
        for layout in (WRITERS if what in OF_LAYOUT else ["7scenes"])
    ],
)
def test_a_mistake_in_all_poses_is_named(what, layout, nine, tmp_path):
    depths, poses = nine
    change, options, said = MISTAKES[what]
    options = {
        name: value[layout] if isinstance(value, dict) else value
        for name, value in options.items()
    }
    write_frames(tmp_path, layout, depths, change(poses), **options)
    with pytest.raises(DatasetError, match=said):
        CapturedCamera(read_capture(tmp_path))


@pytest.mark.parametrize(
    ("layout", "count", "moved", "turned"),
    [
        *((layout, 9, 0, 0) for layout in WRITERS),
        ("7scenes", 9, 0.004, 0.5),
        ("7scenes", 5, 0.004, 0.5),
        ("7scenes", 2, 0, 0),
    ],
)
def test_right_frames_pass(layout, count, moved, turned, tmp_path):
    write_frames(tmp_path, layout, *seen(count, moved, turned))
    checked, left_out = check_capture(read_capture(tmp_path))
    assert len(checked.frames) == count
    assert left_out == {}


@pytest.fixture(scope="module")
def around():
    """The sample chair on a table, from 24 places around it at one height: a turn leaves the
    table as it is.
    """
    return seen(24, evenly=True)


def late_from(first, frames, end=None):
    """Poses of which those from one frame on are the ones of some frames before."""

    def change(poses):
        changed = poses.copy()
        for i in range(first, len(poses) if end is None else end):
            changed[i] = poses[min(max(i - frames, 0), len(poses) - 1)]
        return changed

    return change


def two_lost(poses):
    changed = late_from(7, 1)(poses)
    changed[16:] = late_from(16, 2)(poses)[16:]
    return changed


def moved(x, y, z):
    """Poses of a place beside the camera, in all frames the same, metres in the camera's axes."""
    step = np.eye(4)
    step[:3, 3] = x, y, z
    return lambda poses: poses @ step


def bumped(poses):
    changed = poses.copy()
    changed[12:, 0, 3] += 0.15
    return changed


PARTS = {
    "one image lost": (
        late_from(12, 1),
        "from frame 000012 on the poses are one frame late",
    ),
    "one image lost early": (
        late_from(4, 1),
        "from frame 000004 on the poses are one frame late",
    ),
    "two images lost": (
        late_from(9, 2),
        "from frame 000009 on the poses are 2 frames late",
    ),
    "one pose lost": (
        late_from(12, -1),
        "from frame 00001. to 00002. the poses are one frame early",
    ),
    "an image lost twice": (
        two_lost,
        "from frame 000007 to .* one frame late.* and from frame 0000.* 2 frames late",
    ),
    "bumped": (bumped, "the frames from 000012 on contradict those before"),
}


@pytest.mark.parametrize("what", PARTS)
def test_the_frame_from_which_poses_are_wrong_is_named(what, around, tmp_path):
    depths, poses = around
    change, said = PARTS[what]
    write_frames(tmp_path, "7scenes", depths, change(poses))
    with pytest.raises(DatasetError, match=said):
        check_capture(read_capture(tmp_path))


def test_a_few_frames_with_the_poses_of_others_are_left_out_and_named(around, tmp_path):
    depths, poses = around
    write_frames(tmp_path, "7scenes", depths, late_from(10, 1, end=12)(poses))
    left_out = check_capture(read_capture(tmp_path))[1]
    assert set(left_out) <= {"000010", "000011"}
    assert "its pose is one frame late" in left_out["000010"]


CAMERAS_WRONG = {
    "offset along x": (lambda d: d, moved(0.1, 0, 0), 1.0, "beside its poses"),
    "offset along z": (lambda d: d, moved(0, 0, -0.1), 1.0, "beside its poses"),
    "offset": (lambda d: d, moved(0.08, 0.05, 0.04), 1.0, "hand-eye"),
    "mirrored": (np.fliplr, lambda p: p, 1.0, "flipped left to right"),
    "flipped": (np.flipud, lambda p: p, 1.0, "flipped top to bottom"),
    "long focal length": (
        lambda d: d,
        lambda p: p,
        1.15,
        "the focal length is some 1[3-7] % too long",
    ),
    "short focal length": (
        lambda d: d,
        lambda p: p,
        0.85,
        "the focal length is some 1[3-7] % too short",
    ),
}


@pytest.fixture(scope="module")
def half_as_many(around):
    depths, poses = around
    return depths[::2], poses[::2]


@pytest.mark.parametrize("what", CAMERAS_WRONG)
def test_a_mistake_of_the_camera_is_named(what, half_as_many, tmp_path):
    depths, poses = half_as_many
    see, change, times, said = CAMERAS_WRONG[what]
    write_frames(tmp_path, "7scenes", [see(depth) for depth in depths], change(poses))
    path = tmp_path / "camera-intrinsics.txt"
    np.savetxt(path, np.loadtxt(path) * [[times, 1, 1], [1, times, 1], [1, 1, 1]])
    with pytest.raises(DatasetError, match=said):
        check_capture(read_capture(tmp_path))


@pytest.mark.parametrize("change", [lambda p: p, late_from(6, 1)])
def test_of_a_can_on_a_table_nothing_is_said(change, tmp_path):
    """Whatever it is turned by, it looks the same."""
    can = trimesh.creation.cylinder(0.15, 0.4, sections=180)
    can.apply_translation([0, 0, 0.2])
    depths, poses = seen(
        12,
        evenly=True,
        thing=(can.vertices, can.faces.astype(np.int32)),
    )
    write_frames(tmp_path, "7scenes", depths, change(poses))
    assert check_capture(read_capture(tmp_path))[1] == {}


def test_a_thing_that_looks_the_same_from_all_sides_contradicts_nothing(tmp_path):
    """A ball without a table around: shifted poses are as good as others."""
    poses = seen(5)[1]
    y, x = np.mgrid[:120, :160]
    across = np.hypot((x + 0.5 - 80) / 131.25, (y + 0.5 - 60) / 131.25)
    depth = np.where(
        across < 0.18,
        1 - 0.2 * np.sqrt(np.maximum(0, 1 - (across / 0.2) ** 2)),
        0,
    )
    write_frames(tmp_path, "7scenes", [depth] * 5, np.roll(poses, 1, axis=0))
    assert check_capture(read_capture(tmp_path))[1] == {}


def lose_pose(folder):
    np.savetxt(folder / "frame-000004.pose.txt", np.full((4, 4), np.nan))


def turn_pose(folder):
    """The pose of another place altogether."""
    pose = np.loadtxt(folder / "frame-000004.pose.txt")
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([0.3, 0.2, 0.9]).as_matrix()
    np.savetxt(folder / "frame-000004.pose.txt", pose)


def cut_image(folder, number=4):
    path = folder / f"frame-00000{number}.depth.png"
    path.write_bytes(path.read_bytes()[:-200])


ONE_BAD = {
    "a lost pose": (lose_pose, "NaN"),
    "a wrong pose": (turn_pose, "contradicts the other frames"),
    "a cut image": (cut_image, "damaged"),
    "an empty image": (
        lambda f: write_png(f / "frame-000004.depth.png", np.zeros((120, 160))),
        "no pixel has a depth",
    ),
}


@pytest.mark.parametrize("what", ONE_BAD)
def test_one_bad_frame_is_left_out_and_named_and_several_are_refused(
    what,
    nine,
    tmp_path,
):
    harm, said = ONE_BAD[what]
    write_frames(tmp_path, "7scenes", *nine)
    harm(tmp_path)
    camera = CapturedCamera(read_capture(tmp_path))
    assert list(camera.left_out) == ["000004"]
    assert said in camera.left_out["000004"]
    cut_image(tmp_path, 7)
    with pytest.raises(DatasetError, match="2 of 9 frames cannot be used"):
        CapturedCamera(read_capture(tmp_path))


def test_learn_names_the_frames_that_it_leaves_out_and_refuses_wrong_poses(
    nine,
    tmp_path,
):
    depths, poses = nine
    write_frames(tmp_path / "things/stool", "7scenes", depths, poses)
    cut_image(tmp_path / "things/stool")
    write_frames(tmp_path / "things/wrong", "7scenes", depths, np.linalg.inv(poses))
    learned = learn(tmp_path / "things", tmp_path / "mine", workers=0)
    assert learned.things == 1
    wrong, frame = sorted(learned.left_out, key=lambda phrase: "stool" in phrase)
    assert "the poses are inverse" in wrong
    assert "1 of 9 frames" in frame
    assert "000004" in frame


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
    "a truncated image": (
        "7scenes",
        DEPTH,
        lambda p: p.write_bytes(p.read_bytes()[:-40]),
        "damaged",
    ),
    "a link to an image elsewhere": (
        "7scenes",
        DEPTH,
        link_out,
        "link out of this folder",
    ),
    "a link to a list elsewhere": (
        "tum",
        TRAJECTORY,
        link_out,
        "link out of this folder",
    ),
    "a link to a folder elsewhere": (
        "bop",
        "depth",
        link_out,
        "link out of this folder",
    ),
    "8 bits": (
        "tum",
        "depth/a.png",
        lambda p: write_png(p, depth_image(90), np.uint8),
        "16 bits",
    ),
    "no JSON": ("bop", CAMERAS, put("{"), "not the cameras"),
    "no scale": (
        "bop",
        CAMERAS,
        edited(lambda v: v.update(depth_scale=0)),
        "depth_scale",
    ),
    "no translation": ("bop", CAMERAS, edited(lambda v: v.pop("cam_t_w2c")), "cam_t"),
    "no rotation": (
        "bop",
        CAMERAS,
        edited(lambda v: v.update(cam_R_w2c=[2, 0, 0, 0, 2, 0, 0, 0, 2])),
        "scaled by 2",
    ),
    "a lost camera": ("7scenes", POSE, put(4 * "nan nan nan nan\n"), "NaN"),
    "an empty trajectory": ("tum", TRAJECTORY, put("# t\n"), "lists nothing"),
    "no quaternion": ("tum", TRAJECTORY, put("10 0 0 0 0 0 0 0\n"), "quaternion"),
    "another clock": ("tum", TRAJECTORY, put("99 0 0 0 0 0 0 1\n"), "one clock"),
    "an image elsewhere": (
        "tum",
        "depth.txt",
        put("10 /etc/passwd\n"),
        "no file of this folder",
    ),
    "no intrinsics": ("tum", "camera-intrinsics.txt", Path.unlink, "--intrinsics"),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_what_is_damaged_is_named(what, tmp_path, capsys):
    layout, name, damage, said = DAMAGE[what]
    folder = tmp_path / "capture"
    folder.mkdir()
    WRITERS[layout](folder)
    damage(folder / name)
    # it may be broken in two lines anywhere
    sentence = refused(capsys, "recognise", folder).replace(" ", "")
    assert said.replace(" ", "") in sentence
    assert (folder.name if what == "no intrinsics" else name) in sentence
