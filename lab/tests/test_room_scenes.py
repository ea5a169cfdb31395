"""Rooms: life-size, nothing overlaps, frames as another ray caster sees them, the same seed, the
same room; and the benchmark that recognises objects in them.
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

from nextview.errors import DatasetError, UsageError
from nextview.geometry.viewsphere import level_pose
from nextview.sensing import ObservedObject
from nextview.simulation.sensor import SENSORS
from nextview_lab.data.room_drawing import LIFE_SIZES, draw_rooms
from nextview_lab.worlds.room import UNEVEN_HEIGHT, Room, RoomCamera, build_room
from nextview_lab.worlds.room_layout import RoomLayout, Slab, Standing
from nextview_lab.worlds.scene import footprint, mesh_hash, separation

FOUR_LEGS = 4


@pytest.fixture(scope="module")
def rooms(shared, furniture) -> Path:
    """Rooms with objects of ``furniture``, two of each split."""

    def make(folder: Path) -> None:
        list(draw_rooms(furniture, folder / "rooms", 2, seed=4, workers=0))

    return shared("rooms", make) / "rooms"


@pytest.fixture(scope="module")
def tins(tmp_path_factory) -> Path:
    """A folder of a tin and a plank, in metres."""
    folder = tmp_path_factory.mktemp("tins")
    factories.write_off(folder / "tin.off", trimesh.creation.cylinder(0.04, 0.11))
    factories.write_off(folder / "plank.off", trimesh.creation.box((0.18, 0.06, 0.02)))
    return folder


def built(folder: Path, meshes: Path) -> list[Room]:
    return [
        build_room(RoomLayout.load(path), meshes)
        for path in sorted(folder.rglob("*.json"))
    ]


def room_with(folder: Path, mesh: trimesh.Trimesh, pose: np.ndarray, **changed) -> Room:
    """A thing in the middle of a room of 6 x 4 x 2.5 m, and a camera with a pose."""
    path = factories.write_off(folder / "thing.off", mesh)
    radius = np.linalg.norm(mesh.vertices - mesh.bounds.mean(0), axis=1).max()
    given = {
        "name": "thing@room-0",
        "kind": "floor",
        "seed": 0,
        "label": "thing",
        "target": Standing(path.name, mesh_hash(path), float(radius)),
        "width": 6.0,
        "depth": 4.0,
        "height": 2.5,
        "pose": tuple(pose.ravel().tolist()),
    }
    return build_room(RoomLayout(**given | changed), folder)


def a_room(folder: Path, **changed) -> Room:
    """A cube of one metre, looked at along +x."""
    pose = np.eye(4)
    pose[:3, :3] = np.transpose([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    pose[:3, 3] = -2.5, 0, 0.5
    return room_with(folder, trimesh.creation.box((1, 1, 1)), pose, **changed)


# Geometry


def test_a_frame_shows_the_cube_the_wall_and_the_floor_where_they_are(tmp_path):
    room = a_room(tmp_path)
    frame, shown = RoomCamera(room, SENSORS["none"]).look(room.pose)
    height, width = frame.shape
    assert frame.depth[height // 2, width // 2] == pytest.approx(
        2.0,
        abs=0.002,
    )  # in millimetres
    assert shown[height // 2, width // 2]
    assert room.radius == pytest.approx(np.sqrt(0.75), abs=1e-4)
    np.testing.assert_allclose(room.centre, (0, 0, 0.5), atol=1e-6)

    # half of the cube's front is 0.5 m, at a depth of 2 m
    columns = np.flatnonzero(shown[height // 2])
    focal = frame.intrinsics[0, 0]
    assert len(columns) == pytest.approx(focal / 2, abs=2)

    rows, columns = np.nonzero(~shown & (frame.depth > 0))
    places = frame.positions(rows, columns)
    x, y, z = np.abs(places.T)
    from_surface = np.stack([z, 3 - x, 2 - y, 2.5 - z], 1)
    assert from_surface.min(1).max() < 4 * UNEVEN_HEIGHT + 0.002
    assert {*from_surface.argmin(1)} == {
        0,
        1,
        2,
        3,
    }  # floor, the wall behind, side walls, ceiling


def test_pixels_of_the_target_are_those_of_another_ray_caster(rooms, furniture):
    room = built(rooms, furniture)[0]
    sensor = SENSORS["none"]
    frame, shown = RoomCamera(room, sensor).look(room.pose)
    things = [trimesh.Trimesh(*thing, process=False) for thing in room.things]
    depth, which = factories.cast(things, room.pose, sensor.intrinsics, sensor.shape)
    assert (shown != (which == 0)).mean() < 1e-4
    np.testing.assert_allclose(frame.depth, depth, atol=0.001)


def test_noise_belongs_to_the_pose_and_the_seed(tmp_path):
    room = a_room(tmp_path)
    other = room.pose.copy()
    other[0, 3] -= 0.01
    camera = RoomCamera(room, SENSORS["stereo"], seed=1)
    first = camera.look(room.pose)[0].depth
    camera.look(other)
    np.testing.assert_array_equal(camera.look(room.pose)[0].depth, first)
    assert (
        RoomCamera(room, SENSORS["stereo"], seed=2).look(room.pose)[0].depth != first
    ).any()

    # on the wall behind, all else equal: sigma = z^2 disparity / (focal baseline)
    sensor = SENSORS["stereo"]
    exact = RoomCamera(room, SENSORS["none"]).look(room.pose)[0]
    assert exact.shape != first.shape
    middle = np.s_[220:260, 404:444]  # on the cube, 2 m away
    expected = 2.0**2 * sensor.disparity / (sensor.focal * sensor.baseline)
    known = first[middle] > 0
    assert np.std(first[middle][known]) == pytest.approx(expected, rel=0.5)


def test_reachable_camera_positions(tmp_path):
    cabinet = Slab(-2.0, 1.0, 0.0, 0.0, 0.5, 0.5, 1.5)
    room = a_room(tmp_path, slabs=(cabinet,))

    def may(*place: float) -> bool:
        pose = np.eye(4)
        pose[:3, 3] = place
        return room.reachable(pose)

    assert may(-2.5, 0, 0.5)
    assert not may(-3.5, 0, 0.5)  # behind the wall
    assert not may(-2.0, 1.0, 0.5)  # in the cabinet
    assert may(-2.0, 1.0, 1.7)  # above it
    assert not may(-2.5, 0, 0.01)
    assert not may(-2.5, 0, 2.2)


# What is drawn


def test_furniture_has_the_size_that_it_has_in_life(rooms, furniture):
    for room in built(rooms, furniture):
        if room.layout.label == "monitor":
            assert room.layout.kind == "table"
            assert 0.70 <= room.target[:, 2].min() <= 0.78
            continue
        assert room.target[:, 2].min() == pytest.approx(0, abs=1e-6)
        size = LIFE_SIZES[room.layout.label]
        assert size.low - 1e-3 <= np.ptp(room.target[:, 2]) <= size.high + 1e-3


def test_nothing_overlaps_and_the_camera_is_level_in_the_room(rooms, furniture):
    for room in built(rooms, furniture):
        layout = room.layout
        outlines = [
            footprint(corners) for corners, _ in room.things[: 1 + len(layout.objects)]
        ]
        for k, one in enumerate(outlines):
            assert all(separation(one, other) > 0 for other in outlines[:k])
        half = np.array([layout.width, layout.depth]) / 2
        assert (np.abs(room.target[:, :2]) < half).all()

        assert room.reachable(room.pose)
        assert room.pose[2, 0] == pytest.approx(0, abs=1e-5)  # its x axis is level
        assert room.pose[2, 1] < 0  # its y axis points down
        _, shown = RoomCamera(room, SENSORS["none"]).look(room.pose)
        assert shown.sum() > 300


def test_things_of_known_size_rest_on_a_table(tins, tmp_path):
    drawn = list(draw_rooms(tins, tmp_path / "tables", 12, seed=0, unit="m", workers=0))
    assert [reason for _, reason in drawn] == [None] * 12
    heights = set()
    for room in built(tmp_path / "tables", tins):
        top, *legs = room.layout.slabs[: 1 + FOUR_LEGS]
        assert room.layout.kind == "table"
        table = top.z + top.height
        assert room.target[:, 2].min() == pytest.approx(table, abs=1e-4)
        assert all(leg.z + leg.height < table for leg in legs)
        radius = {
            "tin": np.hypot(0.04, 0.055),
            "plank": np.linalg.norm((0.09, 0.03, 0.01)),
        }
        assert room.radius == pytest.approx(radius[room.layout.label], abs=1e-4)
        heights.add((room.layout.label, round(float(np.ptp(room.target[:, 2])), 2)))
    # the tin stands and lies, the plank lies
    assert {("tin", 0.11), ("tin", 0.08), ("plank", 0.02)} <= heights


def test_the_same_seed_gives_identical_files_and_resumes(rooms, furniture, tmp_path):
    before = {path.name: path.read_bytes() for path in rooms.rglob("*.json")}
    assert len(before) == 4
    out = tmp_path / "rooms"
    assert len(list(draw_rooms(furniture, out, 1, seed=4, workers=0))) == 2
    list(draw_rooms(furniture, out, 2, seed=4, workers=0))
    assert {path.name: path.read_bytes() for path in out.rglob("*.json")} == before
    with pytest.raises(DatasetError, match="another seed"):
        list(draw_rooms(furniture, out, 2, seed=5, workers=0))


def test_invalid_inputs_of_rooms_are_reported(tins, tmp_path, rooms, furniture, capsys):
    with pytest.raises(
        UsageError,
        match=r"how large is a plank\? Give the files' --unit",
    ):
        list(draw_rooms(tins, tmp_path / "out", workers=0))
    said = refused(
        capsys,
        "scenes",
        furniture,
        tmp_path / "o",
        "--room",
        "--levels",
        "light",
    )
    assert "--levels and --held-out are for cluttered tables" in said
    said = refused(capsys, "scenes", furniture, tmp_path / "o", "--unit", "m")
    assert "--unit is for --room" in said
    layout = RoomLayout.load(sorted(rooms.rglob("*.json"))[0])
    other = msgspec.structs.replace(layout.target, sha256="0" * 64)
    with pytest.raises(DatasetError, match="is not the mesh that room"):
        build_room(msgspec.structs.replace(layout, target=other), furniture)
    with pytest.raises(DatasetError, match="not a room"):
        (tmp_path / "none.json").write_text("{}")
        RoomLayout.load(tmp_path / "none.json")


# The benchmark


def run(*arguments: object) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.room", *map(str, arguments)],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
    )


def test_the_benchmark_resumes_and_draws_its_mistakes(rooms, furniture, tmp_path):
    out = tmp_path / "out"
    options = ("--by", "mask", "--sensors", "none", "--workers", "0")
    first = run(rooms / "chair", furniture, out, *options)
    assert first.returncode == 0, first.stderr
    assert "none, mask | " in first.stdout
    path = next((out / "none" / "mask").iterdir())
    ended = json.loads(path.read_text())
    assert 0.85 < ended["ratio"] < 1.15  # without noise, and by a mask

    # What is there is read, not run again.
    path.write_text(
        json.dumps(ended | {"answer": "sofa", "taken": 1, "own": 1, "ratio": 1})
    )
    page = tmp_path / "page"
    again = run(rooms / "chair", furniture, out, *options, "--mistakes", page)
    assert again.returncode == 0, again.stderr
    assert "named wrong: 1: chair (none mask)" in again.stdout
    drawn = (page / "index.html").read_text()
    assert '<img src="6_named_wrong.png"' in drawn
    assert (page / "6_named_wrong.png").stat().st_size > 10_000

    refused = run(rooms / "chair", furniture, out, *options, "--seed", "1")
    assert refused.returncode == 2
    assert "holds episodes of other models or another seed" in refused.stderr


# What is found in rooms


def looked_at(
    folder: Path,
    mesh: trimesh.Trimesh,
    distance: float,
    height: float,
) -> Room:
    """A thing in the middle of a room, and a camera aimed at its centre."""
    centre = np.array([0, 0, np.ptp(mesh.vertices[:, 2]) / 2])
    aside = np.array([-distance, 0.3, height - centre[2]])
    pose = level_pose(aside / np.linalg.norm(aside), float(np.linalg.norm(aside)))
    pose[:3, 3] += centre
    return room_with(folder, mesh, pose, width=8.0, height=2.4)


def found_in(room: Room, **asked) -> tuple[float, float, float]:
    """Share of the thing that is taken for it, share of that which is the thing's, and the radius
    as a part of the true one.
    """
    frame, shown = RoomCamera(room, SENSORS["stereo"]).look(room.pose)
    thing = ObservedObject(**asked)
    thing.add(frame)
    found = thing.sightings[0].mask
    both = (found & shown).sum()
    return (
        both / shown.sum(),
        both / found.sum(),
        thing.object_frame.radius / room.radius,
    )


@pytest.mark.parametrize("named", ["pose", "point"])
def test_a_ceiling_is_no_part_of_what_stands_under_it(tmp_path, named):
    room = looked_at(tmp_path, trimesh.creation.box((0.5, 0.4, 0.9)), 3.5, 1.2)
    frame, shown = RoomCamera(room, SENSORS["stereo"]).look(room.pose)
    rows, columns = np.nonzero(~shown & (frame.depth > 0))
    assert (
        np.abs(frame.positions(rows, columns)[:, 2] - 2.4) < 0.1
    ).sum() > 10_000  # it is seen
    asked = {"point": room.centre} if named == "point" else {}
    taken, own, size = found_in(room, **asked)
    assert taken > 0.8
    assert own > 0.9
    assert size == pytest.approx(1, abs=0.15)
