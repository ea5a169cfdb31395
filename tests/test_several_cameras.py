"""Several cameras at one table: names of frames, sets of frames, errors of the cameras' poses,
folders of several cameras, and what a standing camera changes.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from factories import (
    TABLE,
    PlacedThing,
    SimulatedTable,
    TableCamera,
    box,
    camera_over,
    meshes_of,
    pose_at,
    refused,
    view,
)
from PIL import Image
from programs import main
from ros_messages import (
    CAMERA_INFO,
    DEPTH,
    header,
    image_message,
    info_message,
    tf_message,
    transform_message,
    write_bag,
)
from scipy.spatial.transform import Rotation

import nextview
from nextview.captured.check import check_capture
from nextview.captured.folders import read_capture
from nextview.captured.still_moments import still_moments
from nextview.errors import DatasetError, ObservationError
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.sensing import Frame, ObservedObject
from nextview.sensing.known_frames import KnownFrames
from nextview.sensing.registration import camera_offsets
from nextview.simulation.sensor import SENSORS

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

SENSOR = SENSORS["stereo"]
RAYS = PinholeCamera.of(SENSOR.intrinsics, SENSOR.shape).rays.reshape(-1, 3)
LEFT = pose_at(45, 20, 0.65, (0, 0, 0.04))
RIGHT = pose_at(50, 100, 0.7, (0, 0, 0.04))


def things(rng) -> list[trimesh.Trimesh]:
    """Boxes and cans that stand on a table at random."""
    found = [TABLE]
    for k, (x, y) in enumerate(
        [(-0.12, -0.1), (0.1, -0.11), (-0.1, 0.12), (0.13, 0.1)]
    ):
        size = rng.uniform(0.06, 0.14, 3)
        thing = (
            box(size, (0, 0, size[2] / 2))
            if k % 2
            else trimesh.creation.cylinder(size[0] / 2, size[2]).apply_translation(
                (0, 0, size[2] / 2)
            )
        )
        turn = trimesh.transformations.rotation_matrix(rng.uniform(0, 6.28), (0, 0, 1))
        thing.apply_transform(turn)
        found.append(thing.apply_translation((x, y, 0)))
    return found


def seen(meshes, pose, rng, camera="", told=None) -> Frame:
    """A frame through the stereo sensor, with the pose that it was taken from or another one."""
    caster = RayCaster([(mesh.vertices, mesh.faces) for mesh in meshes])
    depth, _ = caster.cast(pose[:3, 3], RAYS @ pose[:3, :3].T)
    clean = np.where(np.isfinite(depth), depth, 0).reshape(SENSOR.shape)
    measured, _ = SENSOR.measure(clean.astype(np.float32), rng)
    return Frame(
        measured,
        SENSOR.intrinsics,
        pose if told is None else told,
        pixel_centre=0.5,
        camera=camera,
    )


def an_error(rng, millimetres=4.0, degrees=0.6):
    """A rigid motion in the axes of a camera, in a random direction."""
    turn, shift = rng.normal(size=(2, 3))
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec(
        np.radians(degrees) * turn / np.linalg.norm(turn)
    ).as_matrix()
    error[:3, 3] = millimetres / 1000 * shift / np.linalg.norm(shift)
    return error


def moments_of(rng, error, count, cameras=(LEFT, RIGHT)):
    """Frames of several cameras; the stated poses of all but the first err."""
    names = ("left", "right", "top")
    found = []
    for _ in range(count):
        table = things(rng)
        found.append(
            [
                seen(table, pose, rng, name, pose @ np.linalg.inv(error) if k else pose)
                for k, (name, pose) in enumerate(zip(names, cameras, strict=False))
            ]
        )
    return found


@pytest.fixture(scope="module")
def erring():
    """Frames of two cameras at four moments, and the error of the right one."""
    rng = np.random.default_rng(11)
    error = an_error(rng)
    return moments_of(rng, error, 4), error


def test_an_error_of_a_camera_is_told(erring):
    """4 mm and .6 degrees, within 1 mm and .15 degrees."""
    moments, error = erring
    (offset,) = camera_offsets(moments)
    assert offset.noticed
    assert (offset.camera, offset.reference) == ("right", "left")
    assert offset.millimetres == pytest.approx(4, abs=1)
    assert offset.degrees == pytest.approx(0.6, abs=0.15)
    np.testing.assert_allclose(offset.correction[:3, 3], error[:3, 3], atol=0.002)
    assert str(offset).startswith("camera right is ")
    assert "relative to camera left" in str(offset)


def test_exact_cameras_are_not_reported():
    rng = np.random.default_rng(50)
    (offset,) = camera_offsets(moments_of(rng, np.eye(4), 2))
    assert not offset.noticed


def test_a_third_camera_is_compared_with_all_and_one_that_sees_nothing_in_common_is_left_out():
    rng = np.random.default_rng(7)
    error = an_error(rng)
    top = pose_at(80, 200, 0.7, (0, 0, 0.04))
    away = top.copy()
    away[:3, 3] += [9, 0, 0]
    moments = moments_of(rng, error, 2, (LEFT, RIGHT, top))
    both = camera_offsets(moments)
    assert [one.camera for one in both] == ["right", "top"]
    assert all(one.noticed for one in both)

    elsewhere = [[*pair[:2], pair[2].with_pose(away)] for pair in moments[:1]]
    assert [one.camera for one in camera_offsets(elsewhere)] == ["right"]


def test_a_single_plane_says_nothing_of_motions_along_it():
    """Only height and tilt are seen; the uncertainty says so."""
    rng = np.random.default_rng(3)
    pair = [seen([TABLE], LEFT, rng, "left"), seen([TABLE], RIGHT, rng, "right")]
    (offset,) = camera_offsets([pair])
    assert not offset.noticed
    assert offset.uncertainty[0] > 5


# A known world


def test_cameras_are_named_by_text():
    with pytest.raises(ObservationError):
        Frame(
            np.ones((20, 20)),
            np.array([[20, 0, 10], [0, 20, 10], [0, 0, 1.0]]),
            camera=3,
        )


def test_an_error_of_a_camera_is_a_warning_that_leaves_names_confident():
    rng = np.random.default_rng(1)
    ((left, right),) = moments_of(rng, an_error(rng, 12, 1.5), 1)
    found = KnownFrames((left,), (None,)).check(right, None)
    assert [warning.name for warning in found] == ["camera"]
    assert not found[0].holds
    assert "camera right is " in found[0].message
    assert KnownFrames((left,), (None,)).check(replace(right, camera=""), None) == []


def test_a_camera_with_a_name_may_stand_still_while_the_scene_changes():
    """Without a name the pose may be an old one."""
    rng = np.random.default_rng(2)
    before = seen([TABLE], LEFT, rng)
    after = seen([TABLE, box((0.3, 0.3, 0.3), (0, 0, 0.15))], LEFT, rng)
    known = KnownFrames((before,), (None,))
    assert [warning.name for warning in known.check(after, None)] == ["stale pose"]

    left = replace(before, camera="left")
    named = KnownFrames((left,), (None,))
    assert named.stands(replace(after, camera="left"))
    assert named.check(replace(after, camera="left"), None) == []
    # once it has moved, it may have an old pose
    moved = KnownFrames(
        (replace(seen([TABLE], RIGHT, rng), camera="left"), left), (None, None)
    )
    found = moved.check(replace(after, camera="left"), None)
    assert [warning.name for warning in found] == ["stale pose"]


# A folder


def write_rig(folder, moments):
    """A folder with one folder for each camera."""
    for number, frames in enumerate(moments):
        for frame in frames:
            own = folder / frame.camera
            (own / "depth").mkdir(parents=True, exist_ok=True)
            steps = np.rint(1e4 * frame.depth).astype(np.uint16)
            Image.fromarray(steps).save(own / f"depth/{number:06d}.png")
            np.savetxt(own / "pose.txt", frame.pose)
            k = frame.intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
            camera = {"fx": k[0, 0], "fy": k[1, 1], "ppx": k[0, 2], "ppy": k[1, 2]}
            camera |= {"depth_scale": 1e-4}
            (own / "intrinsics.json").write_text(json.dumps(camera))


@pytest.fixture(scope="module")
def rig(tmp_path_factory, erring):
    """A folder of two cameras, of which the right one errs, and its frames."""
    folder = tmp_path_factory.mktemp("rigs") / "rig"
    moments, _ = erring
    write_rig(folder, moments)
    return folder, moments


def test_a_folder_of_several_cameras_is_read(rig):
    folder, moments = rig
    capture = read_capture(folder)
    assert capture.layout == "several cameras"
    assert capture.cameras == ("left", "right")
    assert capture.stands
    assert [frame.name for frame in capture.frames[:2]] == [
        "left/000000",
        "left/000001",
    ]
    assert [[one.camera for one in together] for together in capture.moments] == [
        ["left", "right"]
    ] * 4
    for together, given in zip(capture.moments, moments, strict=True):
        for captured, frame in zip(together, given, strict=True):
            read = captured.read()
            assert read.camera == frame.camera
            np.testing.assert_allclose(read.pose, frame.pose, atol=1e-6)
            np.testing.assert_allclose(read.intrinsics, frame.intrinsics)
            np.testing.assert_allclose(read.depth, frame.depth, atol=1e-4)
    # the scene changed between the moments, which is no contradiction
    usable, refused_frames = check_capture(capture)
    assert len(usable.frames) == 8
    assert refused_frames == {}


def test_a_pose_in_another_world_is_refused(rig, tmp_path):
    _, moments = rig
    turned = trimesh.transformations.rotation_matrix(0.5, (1, 0, 0))
    wrong = [[left, right.with_pose(right.pose @ turned)] for left, right in moments]
    write_rig(tmp_path / "rig", wrong)
    with pytest.raises(DatasetError):
        check_capture(read_capture(tmp_path / "rig"))


def test_a_camera_without_a_pose_is_refused(rig, tmp_path, capsys):
    _, moments = rig
    write_rig(tmp_path / "rig", moments[:1])
    (tmp_path / "rig/left/pose.txt").unlink()
    said = refused(capsys, "check", tmp_path / "rig")
    assert "the pose of camera left is missing" in said


# A camera that stands still


def recording(folder, moments, step=0.5):
    """A bag of a standing camera that takes these frames, one each half a second."""
    start = 1_700_000_000.0
    stand = transform_message(moments[0].pose, "optical", 0.0, "base")
    said = [("/tf_static", start, tf_message(stand))]
    k = moments[0].intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    for number, frame in enumerate(moments):
        stamped = header("optical", start + step * number)
        image = image_message(frame.depth, "32FC1", header=stamped)
        info = info_message(k, frame.shape, header=stamped)
        said.append((DEPTH, start + step * number, image))
        said.append((CAMERA_INFO, start + step * number, info))
    return write_bag(folder, said)


def hand(x, y):
    """Something that reaches over the table."""
    return box((0.1, 0.5, 0.06), (x, y + 0.2, 0.15))


def test_moments_are_those_at_which_the_scene_stands_still_and_has_changed(tmp_path):
    rng = np.random.default_rng(5)
    carton = box((0.08, 0.06, 0.1), (0, 0, 0.05))
    nudged = box((0.08, 0.06, 0.1), (0.02, 0, 0.05))
    scenes = [
        [TABLE],
        [TABLE],
        [TABLE, hand(0.1, 0)],
        [TABLE, carton, hand(0, 0)],
        [TABLE, carton],
        [TABLE, carton],
        [TABLE, nudged],
        [TABLE, nudged],
        [TABLE, hand(0.02, 0.1)],
        [TABLE],
    ]
    bag = recording(tmp_path / "bag", [seen(scene, LEFT, rng) for scene in scenes])
    moments = still_moments(read_capture(bag))
    assert [captured.name for (captured,) in moments] == [
        "0.000",
        "2.000",
        "3.000",
        "4.500",
    ]


def test_a_scene_takes_the_frames_of_a_standing_camera_over_time(tmp_path, capsys):
    """A can comes, a box is moved and goes away; the names and the poses are those of the truth."""
    meshes = meshes_of(["cracker_box", "tomato_soup_can"])
    poses = {"cracker_box": (-0.1, 0.02), "tomato_soup_can": (0.1, -0.05)}

    def table(**places):
        things = []
        for name, (x, y) in places.items():
            metres = meshes[name].vertices * meshes[name].radius + meshes[name].centre
            pose = np.eye(4)
            pose[:3, 3] = x, y, -metres[:, 2].min()
            things.append(PlacedThing(name, metres, meshes[name].faces, pose))
        return SimulatedTable(tuple(things))

    box_only = {"cracker_box": poses["cracker_box"]}
    moved = poses | {"cracker_box": (-0.06, 0.1)}
    can_only = {"tomato_soup_can": poses["tomato_soup_can"]}
    camera = TableCamera(table(**box_only), SENSOR, np.random.default_rng(1))
    frames = []
    for places in (box_only, poses, moved, can_only):
        camera.change(table(**places))
        frames += [camera.frame(view(20)) for _ in range(2)]

    bag = recording(tmp_path / "bag", frames)
    main(["look", str(bag), "--json", "--up", "z"])
    told = json.loads(capsys.readouterr().out)
    looks = told["frames"]
    assert [look["name"] for look in looks] == ["0.000", "1.000", "2.000", "3.000"]
    assert all(look["taken"] for look in looks)
    assert [look["appeared"] for look in looks] == [[1], [2], [], []]
    (move,) = looks[2]["moved"]
    assert move["number"] == 1
    way = np.array(move["after"])[:3, 3] - np.array(move["before"])[:3, 3]
    np.testing.assert_allclose(way, [0.04, 0.08, 0], atol=0.005)
    assert looks[3]["gone"] == [1]
    (left,) = told["objects"]
    assert left["name"] == "tomato_soup_can"
    assert left["confident"]


# Sets of frames


@pytest.fixture(scope="module")
def pair():
    """Two cameras' frames of a box and a can, of which the second pose errs by 3 mm."""
    meshes = meshes_of(["cracker_box", "tomato_soup_can"])
    camera = camera_over(list(meshes.values()), 2)
    poses = view(20), view(110)
    left, right = (camera.frame(pose) for pose in poses)
    stated = poses[1].copy()
    stated[:3, 3] += [0.002, -0.002, 0.001]
    return (
        replace(left, camera="left"),
        replace(right.with_pose(stated), camera="right"),
        camera.truth,
    )


def test_a_scene_takes_frames_of_both_cameras_together(ycb, pair):
    left, right, truth = pair
    scene = nextview.Scene(ycb)
    looks = scene.update([left, right])
    assert [look.taken for look in looks] == [True, True]
    assert scene.frames == (left, right)
    for thing in scene.objects:
        # the mean of both cameras is off by half of the error; a box may be turned by half a turn
        centre = (truth[thing.name] @ [*thing.candidates[0].centre, 1])[:3]
        np.testing.assert_allclose(thing.place, centre, atol=0.004)
    assert {thing.name for thing in scene.objects} == set(truth)


def test_frames_enter_together_or_not_at_all(ycb, pair):
    left, right, _ = pair
    scene = nextview.Scene(ycb)
    lost = Frame(right.depth, SENSOR.intrinsics, camera="right")
    with pytest.raises(ObservationError):
        scene.update([left, lost])
    assert scene.frames == ()

    def begun():
        system = nextview.load("ycb", threshold=1.0)
        return system.session(object=ObservedObject(point=(0, 0, 0.05)))

    session = begun()
    with pytest.raises(ObservationError):
        session.update([left, lost])
    assert session.views == []
    assert session.object.sightings == ()
    alone = begun()
    np.testing.assert_array_equal(
        session.update(left).belief,
        alone.update(left).belief,
    )


def test_a_session_takes_frames_of_both_cameras_until_it_ends(ycb, pair):
    left, right, truth = pair
    name, pose = next(iter(truth.items()))
    thing = ObservedObject(point=pose[:3, 3])
    session = nextview.load("ycb", threshold=1.0).session(object=thing)
    views = session.update([left, right])
    assert len(views) == len(session.views) == 2
    assert session.result.answer == name

    quick = nextview.load("ycb", max_views=1).session(
        object=ObservedObject(point=pose[:3, 3])
    )
    assert len(quick.update([left, right])) == 1
    assert quick.done
