"""Rooms: life-size, frames as another ray caster sees them, the same seed, the same room; and the
benchmark that recognises objects in them.
"""

import json
import subprocess
import sys
from pathlib import Path

import factories
import msgspec
import numpy as np
import pytest
import trimesh
from lab_programs import refused

from nextview.errors import UsageError
from nextview.geometry.viewsphere import level_pose
from nextview.sensing import ObservedObject
from nextview.simulation.sensor import SENSORS
from nextview_lab.data.scene_drawing import TABLE_HEIGHTS, draw_scenes
from nextview_lab.worlds.life_sizes import LIFE_SIZES
from nextview_lab.worlds.scene import TargetScene, build_scene, mesh_hash
from nextview_lab.worlds.scene_cameras import RoomCamera
from nextview_lab.worlds.scene_layout import ROOM, Block, Placement, SceneLayout


@pytest.fixture(scope="module")
def rooms(shared, furniture) -> Path:
    """Rooms with objects of ``furniture``, two of each split."""

    def make(folder: Path) -> None:
        list(draw_scenes(furniture, folder / "rooms", [ROOM], 2, 4, workers=0))

    return shared("rooms", make) / "rooms"


@pytest.fixture(scope="module")
def tins(tmp_path_factory) -> Path:
    """A folder of a tin and a plank, in metres."""
    folder = tmp_path_factory.mktemp("tins")
    factories.write_off(folder / "tin.off", trimesh.creation.cylinder(0.04, 0.11))
    factories.write_off(folder / "plank.off", trimesh.creation.box((0.18, 0.06, 0.02)))
    return folder


Room = tuple[SceneLayout, TargetScene]


def built(folder: Path, meshes: Path) -> list[Room]:
    layouts = [SceneLayout.load(path) for path in sorted(folder.rglob("*.json"))]
    return [(layout, build_scene(layout, meshes)) for layout in layouts]


def room_with(folder: Path, mesh: trimesh.Trimesh, *more: Block) -> TargetScene:
    """A thing in the middle of a room of 6 x 4 x 2.5 m."""
    path = factories.write_off(folder / "thing.off", mesh)
    metres = np.linalg.norm(mesh.vertices - mesh.bounds.mean(0), axis=1).max()
    walls = (
        Block(3.05, 0, 0, 0.1, 6, 2.5, wall=True),
        Block(-3.05, 0, 0, 0.1, 6, 2.5, wall=True),
        Block(0, 2.05, 0, 6, 0.1, 2.5, wall=True),
        Block(0, -2.05, 0, 6, 0.1, 2.5, wall=True),
        Block(0, 0, 0, 6, 6, 0.1, z=2.5),
    )
    blocks = []
    for block in (*walls, *more):
        lengths = ("x", "y", "width", "depth", "height", "z")
        radii = {name: getattr(block, name) / float(metres) for name in lengths}
        blocks.append(msgspec.structs.replace(block, **radii))
    layout = SceneLayout(
        "thing@room-0",
        ROOM,
        0,
        Placement(path.name, mesh_hash(path)),
        blocks=tuple(blocks),
        table=3.5 / float(metres),
        metres=float(metres),
    )
    return build_scene(layout, folder)


CUBE = trimesh.creation.box((1, 1, 1))
AHEAD = np.eye(4)
"""2 m in front of the cube, looking along +x, and level."""
AHEAD[:3, :3] = np.transpose([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
AHEAD[0, 3] = -2.5


# Geometry


def test_a_frame_shows_the_cube_the_wall_and_the_floor_where_they_are(tmp_path):
    room = room_with(tmp_path, CUBE)
    frame, shown = RoomCamera(room, SENSORS["none"]).look(AHEAD)
    height, width = frame.shape
    # in millimetres
    assert frame.depth[height // 2, width // 2] == pytest.approx(2.0, abs=0.002)
    assert shown[height // 2, width // 2]
    assert room.metres == pytest.approx(np.sqrt(0.75), abs=1e-4)

    # half of the cube's front is 0.5 m, at a depth of 2 m
    columns = np.flatnonzero(shown[height // 2])
    focal = frame.intrinsics[0, 0]
    assert len(columns) == pytest.approx(focal / 2, abs=2)

    rows, columns = np.nonzero(~shown & (frame.depth > 0))
    x, y, z = frame.positions(rows, columns).T
    surfaces = np.stack([z + 0.5, 3 - np.abs(x), 2 - np.abs(y), 2 - z], 1)
    assert np.abs(surfaces).min(1).max() < 0.004
    # floor, the wall behind, side walls, ceiling
    assert {*np.abs(surfaces).argmin(1)} == {0, 1, 2, 3}


def test_pixels_of_the_target_are_those_of_another_ray_caster(rooms, furniture):
    layout, room = built(rooms, furniture)[0]
    sensor = SENSORS["none"]
    frame, shown = RoomCamera(room, sensor).look(layout.first_pose)
    things = [
        trimesh.Trimesh(layout.metres * one.vertices, one.faces, process=False)
        for one in (room.target, room.table, *room.items)
    ]
    depth, which = factories.cast(
        things, layout.first_pose, sensor.intrinsics, sensor.shape
    )
    assert (shown != (which == 0)).mean() < 1e-4
    np.testing.assert_allclose(frame.depth, depth, atol=0.001)


def test_noise_belongs_to_the_pose_and_the_seed(tmp_path):
    room = room_with(tmp_path, CUBE)
    other = AHEAD.copy()
    other[0, 3] -= 0.01
    camera = RoomCamera(room, SENSORS["stereo"], seed=1)
    first = camera.look(AHEAD)[0].depth
    camera.look(other)
    np.testing.assert_array_equal(camera.look(AHEAD)[0].depth, first)
    assert (
        RoomCamera(room, SENSORS["stereo"], seed=2).look(AHEAD)[0].depth != first
    ).any()

    # on the wall behind, all else equal: sigma = z^2 disparity / (focal baseline)
    sensor = SENSORS["stereo"]
    exact = RoomCamera(room, SENSORS["none"]).look(AHEAD)[0]
    assert exact.shape != first.shape
    middle = np.s_[220:260, 404:444]  # on the cube, 2 m away
    expected = 2.0**2 * sensor.disparity / (sensor.focal * sensor.baseline)
    known = first[middle] > 0
    assert np.std(first[middle][known]) == pytest.approx(expected, rel=0.5)


def test_reachable_camera_positions(tmp_path):
    cabinet = Block(-2.0, 1.0, 0.0, 0.5, 0.5, 1.5)
    camera = RoomCamera(room_with(tmp_path, CUBE, cabinet), SENSORS["none"])

    def may(*place: float) -> bool:
        pose = np.eye(4)
        pose[:3, 3] = place
        return camera.reachable(pose)

    assert may(-2.5, 0, 0.0)
    assert not may(-3.5, 0, 0.0)  # behind the wall
    assert not may(-2.0, 1.0, 0.0)  # in the cabinet
    assert may(-2.0, 1.0, 1.3)  # above it
    assert not may(-2.5, 0, -0.49)
    assert not may(-2.5, 0, 1.9)  # at the ceiling


# What is drawn


def height_of(layout: SceneLayout, room: TargetScene) -> float:
    return layout.metres * float(np.ptp(room.target.vertices[:, 2]))


def above_ground(layout: SceneLayout, room: TargetScene) -> float:
    """Height of the lowest point of the target above the floor of the room, metres."""
    low = min(item.vertices[:, 2].min() for item in room.items if item.wall)
    return layout.metres * float(room.floor - low)


def test_furniture_has_the_size_that_it_has_in_life(rooms, furniture):
    for layout, room in built(rooms, furniture):
        low, high = TABLE_HEIGHTS if layout.label == "monitor" else (0, 0)
        assert low - 1e-3 <= above_ground(layout, room) <= high + 1e-3
        if layout.label != "monitor":
            size = LIFE_SIZES[layout.label]
            assert size.low - 1e-3 <= height_of(layout, room) <= size.high + 1e-3


def test_the_camera_is_level_in_the_room_and_sees_the_target(rooms, furniture):
    for layout, room in built(rooms, furniture):
        camera = RoomCamera(room, SENSORS["none"])
        pose = layout.first_pose
        assert camera.reachable(pose)
        assert pose[2, 0] == pytest.approx(0, abs=1e-5)  # its x axis is level
        assert pose[2, 1] < 0  # its y axis points down
        _, shown = camera.look(pose)
        assert shown.sum() > 300


def test_things_of_known_size_rest_on_a_table(tins, tmp_path):
    out = tmp_path / "tables"
    drawn = list(draw_scenes(tins, out, [ROOM], 12, 0, workers=0, unit="m"))
    assert [reason for _, reason in drawn] == [None] * 12
    heights = set()
    for layout, room in built(out, tins):
        low, high = TABLE_HEIGHTS
        assert low - 1e-3 <= above_ground(layout, room) <= high + 1e-3
        radius = {
            "tin": np.hypot(0.04, 0.055),
            "plank": np.linalg.norm((0.09, 0.03, 0.01)),
        }
        assert layout.metres == pytest.approx(radius[layout.label], abs=1e-4)
        heights.add((layout.label, round(height_of(layout, room), 2)))
    # the tin stands and lies, the plank lies
    assert {("tin", 0.11), ("tin", 0.08), ("plank", 0.02)} <= heights


def test_the_same_seed_gives_identical_files_and_resumes(rooms, furniture, tmp_path):
    before = {path.name: path.read_bytes() for path in rooms.rglob("*.json")}
    assert len(before) == 4
    out = tmp_path / "rooms"
    assert len(list(draw_scenes(furniture, out, [ROOM], 1, 4, workers=0))) == 2
    list(draw_scenes(furniture, out, [ROOM], 2, 4, workers=0))
    assert {path.name: path.read_bytes() for path in out.rglob("*.json")} == before


def test_invalid_inputs_of_rooms_are_reported(tins, tmp_path, furniture, capsys):
    with pytest.raises(
        UsageError,
        match=r"how large is a plank\? Give the files' --unit",
    ):
        list(draw_scenes(tins, tmp_path / "out", [ROOM], workers=0))
    said = refused(
        capsys, "scenes", furniture, tmp_path / "o", "--levels", "room", "rooms"
    )
    assert "the level of a scene is light, medium, heavy, room, not rooms" in said
    said = refused(capsys, "scenes", furniture, tmp_path / "o", "--unit", "m")
    assert "--unit is for --levels room" in said


# The benchmark


def run(*arguments: object) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "nextview_lab.studies.room", *map(str, arguments)],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
    )


def test_the_study_of_rooms_goes_on_after_a_stop(rooms, furniture, tmp_path):
    out = tmp_path / "out.jsonl"
    options = ("--by", "mask", "--sensors", "none", "--workers", "0")
    first = run(rooms / "chair", furniture, out, *options)
    assert first.returncode == 0, first.stderr
    assert "| none, mask | " in first.stdout
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    for line in lines:
        assert line["label"] == "chair"
        assert 0.85 < line["ratio"] < 1.15  # without noise, and by a mask

    # What is there is read, not run again.
    wrong = {"answer": "sofa", "confident": True, "unknown": False}
    out.write_text("".join(json.dumps(line | wrong) + "\n" for line in lines))
    again = run(rooms / "chair", furniture, out, *options)
    assert again.returncode == 0, again.stderr
    (row,) = [text for text in again.stdout.splitlines() if "none, mask" in text]
    cells = row.split(" | ")
    assert cells[1].startswith(f"0 of {len(lines)}, 0.00 (")
    assert cells[2:4] == ["0.000", "1.000"]

    other = run(rooms / "chair", furniture, out, *options, "--seed", "1")
    assert other.returncode == 0, other.stderr
    assert len(out.read_text().splitlines()) == 2 * len(lines)


# What is found in rooms


def found_in(room: TargetScene, pose: np.ndarray, **asked) -> tuple[float, ...]:
    """Share of the thing that is taken for it, share of that which is the thing's, and the radius
    as a part of the true one.
    """
    frame, shown = RoomCamera(room, SENSORS["stereo"]).look(pose)
    thing = ObservedObject(**asked)
    thing.add(frame)
    found = thing.sightings[0].mask
    both = (found & shown).sum()
    return (
        both / shown.sum(),
        both / found.sum(),
        thing.object_frame.radius / room.metres,
    )


@pytest.mark.parametrize("named", ["pose", "point"])
def test_a_ceiling_is_no_part_of_what_stands_under_it(tmp_path, named):
    room = room_with(tmp_path, trimesh.creation.box((0.5, 0.4, 0.9)))
    aside = np.array([-2.5, 0.3, 0.75])
    pose = level_pose(aside / np.linalg.norm(aside), float(np.linalg.norm(aside)))
    frame, shown = RoomCamera(room, SENSORS["stereo"]).look(pose)
    rows, columns = np.nonzero(~shown & (frame.depth > 0))
    heights = frame.positions(rows, columns)[:, 2]
    assert (np.abs(heights - 2.05) < 0.1).sum() > 1000  # the ceiling is seen
    asked = {"point": np.zeros(3)} if named == "point" else {}
    taken, own, size = found_in(room, pose, **asked)
    assert taken > 0.8
    assert own > 0.9
    assert size == pytest.approx(1, abs=0.15)
