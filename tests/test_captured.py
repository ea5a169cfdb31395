"""Frames of a capture that do not fit together: what is wrong with their poses, their camera or one
of them is named.
"""

import shutil

import numpy as np
import pytest
import trimesh
from factories import TABLE
from recordings import HALF, LAYOUTS, SHAPE, K, write_png
from scipy.spatial.transform import Rotation

from nextview.captured.bundled_table import BUNDLED_TABLE
from nextview.captured.camera import CapturedCamera
from nextview.captured.check import check_capture
from nextview.captured.folders import read_capture
from nextview.data.samples import sample_mesh
from nextview.errors import DatasetError
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.viewsphere import look_at_origin
from nextview.teaching.learn import learn


def seen(count=9, moved=0.0, turned=0.0, evenly=False, thing=None):
    """Depth images, metres, of a thing on a table, by default the sample chair, and poses around
    it.

    The poses are off by some metres and degrees; they are random or evenly around at one height.
    """
    rng = np.random.default_rng(3)
    if thing is None:
        mesh = sample_mesh("chair")
        thing = 0.3 * (mesh.vertices - [0, 0, mesh.vertices[:, 2].min()]), mesh.faces
    caster = RayCaster([thing, (TABLE.vertices, TABLE.faces.astype(np.int32))])
    rays = PinholeCamera.of(K + HALF, SHAPE).rays.reshape(-1, 3)
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
            there, rays @ np.ascontiguousarray((pose[:3, :3] @ turn).T, np.float32)
        )
        depths.append(np.where(which < 0, 0, depth).reshape(SHAPE))
    return depths, poses


def reordered(poses):
    """Poses whose quaternions, written as w, x, y, z, are taken for x, y, z, w."""
    turned = poses.copy()
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    turned[:, :3, :3] = Rotation.from_quat(np.roll(quaternions, 1, 1)).as_matrix()
    return turned


def in_unit(times):
    """Poses whose translations are in another unit."""

    def change(poses):
        changed = poses.copy()
        changed[:, :3, 3] *= times
        return changed

    return change


def write_frames(folder, depths, poses, layout="7-Scenes", step=1.0):
    """Frames in a layout; the depth images have steps other than the layout's."""
    folder.mkdir(parents=True, exist_ok=True)
    images = [np.rint(1000 * depth / step).astype(np.uint16) for depth in depths]
    return LAYOUTS[layout](folder, list(zip(images, poses, strict=True)))


@pytest.fixture(scope="module")
def nine():
    return seen()


OPENGL = np.diag([1.0, -1, -1, 1])
MISTAKES = {
    "quaternions": (reordered, "quaternions"),
    "inverse": (np.linalg.inv, "inverse pose"),
    "unit": (in_unit(1000), "scale"),
    "late": (lambda p: np.concatenate([p[:1], p[:-1]]), "late poses"),
    "two early": (lambda p: np.concatenate([p[2:], p[-2:]]), "late poses"),
    "axes": (lambda p: p @ OPENGL, "opengl axes"),
    "inverse, and axes": (
        lambda p: np.linalg.inv(p @ OPENGL),
        "inverse pose, opengl axes",
    ),
}


@pytest.mark.parametrize(
    ("what", "layout"),
    [
        *((what, "7-Scenes") for what in MISTAKES),
        *((what, "BOP") for what in ("quaternions", "inverse", "unit")),
        ("quaternions", "TUM RGB-D"),
    ],
)
def test_a_mistake_in_all_poses_is_named(what, layout, nine, tmp_path):
    depths, poses = nine
    change, kind = MISTAKES[what]
    if layout == "BOP":  # whose files hold the inverse of poses, in millimetres
        change = in_unit(0.001) if what == "unit" else change
        poses = np.linalg.inv(change(np.linalg.inv(poses)))
    else:
        poses = change(poses)
    write_frames(tmp_path, depths, poses, layout)
    with pytest.raises(DatasetError) as refused:
        CapturedCamera(read_capture(tmp_path))
    assert refused.value.kind == kind


def bundled_table(folder):
    """A copy of the bundled recording of three frames."""
    shutil.copytree(BUNDLED_TABLE, folder)
    return folder


def test_a_single_pose_with_a_mistake_is_named(tmp_path):
    table = bundled_table(tmp_path / "table")
    pose = table / "poses/000001.txt"
    np.savetxt(pose, np.linalg.inv(np.loadtxt(pose)))
    with pytest.raises(DatasetError, match="frame 000001 alone") as refused:
        check_capture(read_capture(table))
    assert refused.value.kind == "inverse pose"


def test_no_two_conventions_of_poses_are_named_at_once(tmp_path):
    """No poses explain images of a constant depth."""
    table = bundled_table(tmp_path / "table")
    for image in (table / "depth").iterdir():
        write_png(image, np.full((480, 848), 700))
    with pytest.raises(DatasetError) as refused:
        check_capture(read_capture(table))
    assert refused.value.kind.count("inverse") <= 1


def test_depth_that_is_too_large_is_named(nine, tmp_path):
    write_frames(tmp_path, *nine, step=0.2)
    with pytest.raises(DatasetError) as refused:
        CapturedCamera(read_capture(tmp_path))
    assert refused.value.kind == "scale"


@pytest.mark.parametrize(
    ("layout", "count", "moved", "turned"),
    [
        *((layout, 9, 0, 0) for layout in ("BOP", "TUM RGB-D", "7-Scenes")),
        ("7-Scenes", 9, 0.004, 0.5),
        ("7-Scenes", 2, 0, 0),
    ],
)
def test_right_frames_pass(layout, count, moved, turned, tmp_path):
    write_frames(tmp_path, *seen(count, moved, turned), layout)
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
    "one pose lost": (
        late_from(12, -1),
        "from frame 00001. to 00002. the poses are one frame early",
    ),
    "bumped": (bumped, "the frames from 000012 on contradict those before"),
}


@pytest.mark.parametrize("what", PARTS)
def test_the_frame_from_which_poses_are_wrong_is_named(what, around, tmp_path):
    depths, poses = around
    change, said = PARTS[what]
    write_frames(tmp_path, depths, change(poses))
    with pytest.raises(DatasetError, match=said):
        check_capture(read_capture(tmp_path))


def test_a_few_frames_with_the_poses_of_others_are_left_out_and_named(around, tmp_path):
    depths, poses = around
    write_frames(tmp_path, depths, late_from(10, 1, end=12)(poses))
    left_out = check_capture(read_capture(tmp_path))[1]
    assert set(left_out) <= {"000010", "000011"}
    assert "its pose is one frame late" in left_out["000010"]


CAMERAS_WRONG = {
    "offset": (lambda d: d, moved(0.08, 0.05, 0.04), 1.0, "camera offset"),
    # about the principal point
    "mirrored": (lambda d: np.roll(np.fliplr(d), 4, 1), lambda p: p, 1.0, "mirrored"),
    "flipped": (np.flipud, lambda p: p, 1.0, "mirrored"),
    "long focal length": (lambda d: d, lambda p: p, 1.15, "focal length"),
}


@pytest.fixture(scope="module")
def half_as_many(around):
    depths, poses = around
    return depths[::2], poses[::2]


@pytest.mark.parametrize("what", CAMERAS_WRONG)
def test_a_mistake_of_the_camera_is_named(what, half_as_many, tmp_path):
    depths, poses = half_as_many
    see, change, times, kind = CAMERAS_WRONG[what]
    write_frames(tmp_path, [see(depth) for depth in depths], change(poses))
    path = tmp_path / "camera-intrinsics.txt"
    np.savetxt(path, np.loadtxt(path) * [[times, 1, 1], [1, times, 1], [1, 1, 1]])
    with pytest.raises(DatasetError) as refused:
        check_capture(read_capture(tmp_path))
    assert refused.value.kind == kind


@pytest.mark.parametrize("change", [lambda p: p, late_from(6, 1)])
def test_of_a_can_on_a_table_nothing_is_said(change, tmp_path):
    """Whatever it is turned by, it looks the same."""
    can = trimesh.creation.cylinder(0.15, 0.4, sections=180)
    can.apply_translation([0, 0, 0.2])
    depths, poses = seen(
        12, evenly=True, thing=(can.vertices, can.faces.astype(np.int32))
    )
    write_frames(tmp_path, depths, change(poses))
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
        lambda f: write_png(f / "frame-000004.depth.png", np.zeros(SHAPE)),
        "no pixel has a depth",
    ),
}


@pytest.mark.parametrize("what", ONE_BAD)
def test_one_bad_frame_is_left_out_and_named_and_several_are_refused(
    what, nine, tmp_path
):
    harm, said = ONE_BAD[what]
    write_frames(tmp_path, *nine)
    harm(tmp_path)
    camera = CapturedCamera(read_capture(tmp_path))
    assert list(camera.left_out) == ["000004"]
    assert said in camera.left_out["000004"]
    cut_image(tmp_path, 7)
    with pytest.raises(DatasetError):
        CapturedCamera(read_capture(tmp_path))


def test_learn_names_the_frames_that_it_leaves_out_and_refuses_wrong_poses(
    nine, tmp_path
):
    depths, poses = nine
    write_frames(tmp_path / "things/stool", depths, poses)
    cut_image(tmp_path / "things/stool")
    write_frames(tmp_path / "things/wrong", depths, np.linalg.inv(poses))
    learned = learn(tmp_path / "things", tmp_path / "mine", workers=0)
    assert learned.things == 1
    wrong, frame = sorted(learned.left_out, key=lambda phrase: "stool" in phrase)
    assert "the poses are inverse" in wrong
    assert "1 of 9 frames" in frame
    assert "000004" in frame
