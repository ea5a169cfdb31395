"""All things on a table: found, named and placed in one frame or several, and what goes wrong."""

import json
import re
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from factories import TableCamera, camera_over, view, without
from PIL import Image
from programs import main
from scipy.spatial import cKDTree

import nextview
from nextview.errors import ObservationError, UsageError
from nextview.geometry.mesh import make_mesh
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import Box
from nextview.things.world import MOST_VIEWS


def by_name(scene) -> dict:
    return {thing.name: thing for thing in scene.objects}


@pytest.fixture(scope="module")
def first_look(ycb, ycb_meshes):
    """A camera over the things, a scene that has taken one frame of it, and what that changed."""
    camera = camera_over(list(ycb_meshes.values()))
    scene = nextview.Scene(ycb)
    return camera, scene, scene.update(camera.frame(view(20)))


@pytest.fixture
def seen_once(first_look):
    """The camera and the scene after that frame, for one test."""
    camera, scene, _ = first_look
    return camera.again(), copy(scene)


def test_of_many_frames_some_from_different_places_are_kept(seen_once):
    camera, scene = seen_once
    numbers = {one.name: one.number for one in scene.objects}
    seen = {20: camera.owner}
    for degrees in range(65, 380, 55):
        look = scene.update(camera.frame(view(degrees)))
        seen[degrees] = camera.owner
        assert look.taken
        assert look.moved == look.gone == look.joined == ()
    assert len(scene.frames) == MOST_VIEWS
    places = np.array([one.pose[:3, 3] for one in scene.frames])
    assert np.linalg.norm(places[:, None] - places, axis=2)[0, 1:].min() > 0.2

    found = by_name(scene)
    assert {name: found[name].number for name in numbers} == numbers
    for number, thing in enumerate(camera.table.things):
        for k, mask in found[thing.name].pixels.items():
            pose = scene.frames[k].pose
            (owner,) = (seen[one] for one in seen if np.allclose(view(one), pose))
            true = owner == number
            assert (mask & true).sum() > 0.7 * mask.sum()


def test_all_things_are_found_named_and_placed_in_one_frame(first_look, ycb_meshes):
    camera, scene, look = first_look
    assert look.taken
    assert len(look.appeared) == len(ycb_meshes)

    found = by_name(scene)
    assert set(found) == set(ycb_meshes)
    for number, thing in enumerate(camera.table.things):
        true = camera.owner == number
        mask = found[thing.name].pixels[0]
        assert (mask & true).sum() > 0.75 * (mask | true).sum()

        pose = found[thing.name].pose
        placed = thing.vertices @ pose[:3, :3].T + pose[:3, 3]
        diameter = np.linalg.norm(np.ptp(thing.placed, axis=0))
        add_s = cKDTree(placed).query(thing.placed)[0].mean()
        assert add_s < 0.1 * diameter


def test_the_uncertainty_of_a_pose_includes_that_of_the_camera(first_look):
    camera, scene, _ = first_look
    rough = nextview.Scene(nextview.load("ycb", camera_accuracy=(20, 0.5)))
    rough.update(camera.again().frame(view(20)))
    usual, more = by_name(scene), by_name(rough)
    assert usual.keys() == more.keys() != set()
    for name, thing in usual.items():
        assert thing.pose_uncertainty.millimetres < 20
        assert more[name].pose_uncertainty.millimetres > 20


def test_objects_keep_their_numbers_and_masks_from_frame_to_frame(ycb, ycb_meshes):
    camera = camera_over(list(ycb_meshes.values()), sensor="wrist")
    scene = nextview.Scene(ycb)
    scene.update(camera.frame(view(20)))
    before = {name: thing.number for name, thing in by_name(scene).items()}
    look = scene.update(camera.frame(view(110)))
    assert look.appeared == look.moved == look.gone == ()
    assert {name: thing.number for name, thing in by_name(scene).items()} == before
    for thing, shown in zip(camera.table.things, camera.shown, strict=True):
        if shown > 500:
            assert set(by_name(scene)[thing.name].pixels) == {0, 1}
    number = [thing.name for thing in camera.table.things].index("cracker_box")
    true = camera.owner == number
    mask = by_name(scene)["cracker_box"].pixels[1]
    assert (mask & true).sum() > 0.75 * (mask | true).sum()


def test_an_empty_table_is_reported(ycb):
    camera = camera_over([])
    scene = nextview.Scene(ycb)
    look = scene.update(camera.frame(view(20)))
    assert scene.objects == ()
    assert [warning.name for warning in look.warnings] == ["empty"]


def test_a_frame_without_a_plane_is_refused(ycb):
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.4, 3.0, (240, 320)).astype(np.float32)
    scene = nextview.Scene(ycb)
    with pytest.raises(ObservationError):
        scene.update(Frame(depth, [[300, 0, 160], [0, 300, 120], [0, 0, 1]], view(20)))
    assert scene.frames == ()


@pytest.mark.parametrize("times", [0.7, 1.6])
def test_a_focal_length_of_another_camera_is_named_and_not_the_pose(
    times, ycb, ycb_meshes
):
    """It is refused where nothing level is left in sight, and warned of where it may be right."""
    frame = camera_over([ycb_meshes["cracker_box"]]).frame(view(20))
    k = frame.intrinsics.copy()
    right = k[0, 0]
    k[[0, 1], [0, 1]] *= times
    try:
        warnings = (
            nextview.Scene(ycb, (0, 0, 1)).update(replace(frame, intrinsics=k)).warnings
        )
        told = next(one.message for one in warnings if one.name == "intrinsics")
    except ObservationError as error:
        told = str(error)
    assert "the focal length is some" in told
    (fits,) = re.findall(r"about (\d+) fit", told)
    assert float(fits) == pytest.approx(right, rel=0.08)


def test_a_second_frame_needs_a_pose(ycb, ycb_meshes):
    camera = camera_over([ycb_meshes["mug"]])
    scene = nextview.Scene(ycb)
    frame = camera.frame(view(20))
    scene.update(replace(frame, pose=None))
    with pytest.raises(ObservationError):
        scene.update(frame)


def test_strangers_are_unknown_and_have_a_size(ycb):
    ring = trimesh.creation.torus(0.06, 0.022)
    stranger = make_mesh(ring.vertices, ring.faces, "ring", "m")
    camera = camera_over([stranger])
    scene = nextview.Scene(ycb)
    for degrees in (20, 110):
        scene.update(camera.frame(view(degrees)))
    (thing,) = scene.objects
    assert thing.name == "unknown"
    assert thing.pose is None
    true = np.ptp(camera.table.things[0].placed, axis=0)
    assert thing.size[2] == pytest.approx(true[2], abs=0.01)
    assert (
        np.linalg.norm(thing.place[:2] - camera.table.things[0].placed.mean(0)[:2])
        < 0.02
    )


def test_a_thing_that_was_taken_away_is_gone(seen_once, ycb_meshes):
    camera, scene = seen_once
    mug = by_name(scene)["mug"].number
    camera.change(without(camera.table, "mug"))
    look = scene.update(camera.frame(view(80)))
    assert look.gone == (mug,)
    assert set(by_name(scene)) == set(ycb_meshes) - {"mug"}


def test_a_frame_with_a_wrong_pose_is_left_out(seen_once, ycb_meshes):
    camera, scene = seen_once
    before = {thing.number for thing in scene.objects}
    frame = camera.frame(view(80))
    shifted = frame.pose.copy()
    shifted[:2, 3] += 0.15
    turned = view(130) @ np.linalg.inv(view(80)) @ frame.pose
    for pose in (shifted, turned):
        look = scene.update(replace(frame, pose=pose))
        assert not look.taken
        assert [warning.name for warning in look.warnings] == ["pose"]
        assert {thing.number for thing in scene.objects} == before

    assert scene.update(frame).taken
    assert set(by_name(scene)) == set(ycb_meshes)


@pytest.mark.parametrize(("seed", "name"), [(3, "mug"), (9, "banana")])
def test_the_next_view_shows_hidden_areas(ycb, ycb_meshes, seed, name):
    camera = camera_over(list(ycb_meshes.values()), seed=seed)
    scene = nextview.Scene(ycb)
    scene.update(camera.frame(view(20)))
    assert name not in by_name(scene)
    assert not scene.done

    scene.update(camera.frame(scene.target))
    assert set(by_name(scene)) == set(ycb_meshes)


def test_the_cost_of_the_way_to_each_view_is_that_of_the_robot(ycb, ycb_meshes):
    camera = camera_over([ycb_meshes["mug"]])
    frame = camera.frame(view(20))
    asked = []

    def seconds(here, there):
        asked.append(here)
        return 0.0 if there[0, 3] > 0 else np.inf

    def nearest(choice, rng):
        return -choice.views.travel

    scene = nextview.Scene(ycb, travel_cost=seconds, policy=nearest)
    scene.update(frame)
    assert (scene.targets[:, 0, 3] > 0).all()
    assert all(np.array_equal(here, frame.pose) for here in asked)

    scene.travel_cost = lambda here, there: 3.0 - there[2, 3]
    highest = scene.targets[:, 2, 3]
    assert np.all(np.diff(highest) <= 1e-9)
    assert np.ptp(highest) > 0.1
    scene.travel_cost = lambda here, there: None
    with pytest.raises(UsageError):
        _ = scene.target


def test_only_the_region_is_searched(ycb, ycb_meshes):
    camera = camera_over([ycb_meshes["cracker_box"], ycb_meshes["mug"]])
    middle = camera.table.things[1].placed.mean(0)
    region = Box(middle - 0.1, middle + 0.1)
    scene = nextview.Scene(ycb, region=region)
    scene.update(camera.frame(view(20)))
    assert set(by_name(scene)) == {"mug"}


def test_a_hand_over_the_table_changes_no_name(ycb, ycb_meshes):
    camera = camera_over([ycb_meshes["cracker_box"], ycb_meshes["banana"]])
    scene = nextview.Scene(ycb)
    frame = camera.frame(view(20))
    rows, columns = np.nonzero(camera.owner == 1)  # the banana
    depth = frame.depth.copy()
    side = slice(int(columns.max()) + 40, int(columns.max()) + 120)
    below = slice(int(rows.mean()), depth.shape[0])
    depth[below, side] = 0.35  # an arm that comes in from below, before everything
    scene.update(Frame(depth, frame.intrinsics, frame.pose, pixel_centre=0.5))
    found = by_name(scene)
    assert {"cracker_box", "banana"} <= set(found)
    arm = np.zeros(depth.shape, bool)
    arm[below, side] = True
    for name in ("cracker_box", "banana"):
        assert not (found[name].pixels[0] & arm).any()


def captured(camera: TableCamera, degrees, folder) -> None:
    """Frames of a table as a folder in the layout of 7-Scenes."""
    folder.mkdir()
    np.savetxt(
        folder / "camera-intrinsics.txt", camera.sensor.intrinsics - 0.5 * _CENTRE
    )
    for number, angle in enumerate(degrees):
        frame = camera.frame(view(angle))
        name = folder / f"frame-{number:06d}"
        millimetres = np.rint(1000 * frame.depth).astype(np.uint16)
        Image.fromarray(millimetres).save(f"{name}.depth.png")
        np.savetxt(f"{name}.pose.txt", frame.pose)


# OpenCV counts from the first pixel's
_CENTRE = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0.0]])


def test_the_command_lists_the_objects_on_the_table(ycb_meshes, tmp_path, capsys):
    camera = camera_over([ycb_meshes["cracker_box"], ycb_meshes["mug"]])
    captured(camera, (20, 60), tmp_path / "table")
    figure = tmp_path / "table.png"
    main(f"look {tmp_path / 'table'} --up z --json --figure {figure}".split())
    said = json.loads(capsys.readouterr().out)
    assert {thing["name"] for thing in said["objects"]} == {"cracker_box", "mug"}
    assert [frame["taken"] for frame in said["frames"]] == [True, True]
    assert [frame["joined"] for frame in said["frames"]] == [[], []]
    for thing in said["objects"]:
        true = camera.truth[thing["name"]]
        assert np.linalg.norm(np.array(thing["pose"])[:3, 3] - true[:3, 3]) < 0.01
        assert set(thing["frames"]) == {frame["name"] for frame in said["frames"]}
    with Image.open(figure) as picture:
        assert picture.width > 1000

    one = tmp_path / "table" / "frame-000000.depth.png"
    intrinsics = tmp_path / "table" / "camera-intrinsics.txt"
    main(["look", str(one), "--intrinsics", str(intrinsics), "--depth-scale", "0.001"])
    shown = capsys.readouterr().out
    rows = [line.split() for line in shown.splitlines() if line[:3] in (" 1 ", " 2 ")]
    assert {row[1] for row in rows} == {"cracker_box", "mug"}
    assert all(len(row) >= 6 for row in rows)  # its place is on the same line

    with pytest.raises(SystemExit) as end:
        main(["look", str(tmp_path / "table"), "--frames", "0"])
    assert end.value.code == 2
    assert "at least one frame" in capsys.readouterr().err


def test_the_command_says_once_what_remains_unexplained(tmp_path, capsys):
    rows, columns = np.mgrid[:480, :640]
    steps = 800 - 40 * ((rows // 12 + columns // 12) % 2)
    Image.fromarray(steps.astype(np.uint16)).save(tmp_path / "steps.png")
    options = "--intrinsics 600 600 320 240 --depth-scale 0.001"
    main(f"look {tmp_path / 'steps.png'} {options}".split())
    said = capsys.readouterr()
    assert (said.out + said.err).count("is its unit right?") == 1
