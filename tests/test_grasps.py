"""Grasps of things, and those that are free in a scene, against closed forms and plain loops."""

import json
import re
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import nextview
from nextview.errors import DatasetError, NextviewError, UsageError
from nextview.geometry.mesh import make_mesh
from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.viewsphere import look_at_origin
from nextview.scene.grasps import (
    HALF_TURN,
    Grasp,
    Gripper,
    load_grasps,
    propose_grasps,
    save_grasps,
)
from nextview.sensing import Frame
from nextview.simulation.sensor import SENSORS

ROOT = Path(__file__).parents[1]
SIDES = np.array(
    [0.03, 0.05, 0.12]
)  # of a box, metres; the last one is too long to grip
GRIPPER = Gripper(
    opening=0.08,
    finger_width=0.018,
    finger_thickness=0.008,
    finger_length=0.09,
    palm=(0.07, 0.21, 0.12),
)


def box_mesh(sides=SIDES):
    box = trimesh.creation.box(sides)
    return make_mesh(box.vertices, box.faces, "box", "m")


@pytest.fixture(scope="module")
def proposed():
    return propose_grasps(box_mesh(), GRIPPER, 300)


def test_proposals_hold_a_box_by_its_parallel_sides(proposed):
    assert len(proposed) > 100
    for grasp in proposed:
        closing = np.abs(grasp.pose[:3, 1])
        axis = int(closing.argmax())
        assert closing[axis] == pytest.approx(1, abs=1e-6)  # the box is along the axes
        assert axis in (0, 1)
        assert grasp.width == pytest.approx(SIDES[axis], abs=1e-6)
        assert np.abs(grasp.pose[axis, 3]) < 1e-6  # midway between the two sides
        np.testing.assert_allclose(
            grasp.pose[:3, :3] @ grasp.pose[:3, :3].T, np.eye(3), atol=1e-9
        )


def test_no_part_of_the_gripper_is_in_the_thing(proposed):
    rng = np.random.default_rng(1)
    inside = rng.uniform(-SIDES / 2, SIDES / 2, (4000, 3)) * 0.97
    for grasp in proposed:
        x, y, z = ((inside - grasp.pose[:3, 3]) @ grasp.pose[:3, :3]).T
        aside = np.abs(y) - grasp.width / 2
        fingers = (np.abs(x) < 0.009) & (np.abs(z + 0.045) < 0.045) & (aside > 0)
        assert not (fingers & (aside < 0.008)).any()
        assert not ((np.abs(x) < 0.035) & (np.abs(y) < 0.105) & (z < -0.0905)).any()


def test_a_file_of_grasps_is_read_as_it_was_written(proposed, tmp_path):
    path = tmp_path / "things.grasps"
    save_grasps(path, {"box": proposed[:5], "none": ()})
    read = load_grasps(path)
    assert list(read) == ["box", "none"]
    for one, other in zip(read["box"], proposed[:5], strict=True):
        np.testing.assert_array_equal(one.pose, other.pose)
        assert (one.width, one.quality) == (other.width, other.quality)
    with pytest.raises(NextviewError):
        save_grasps(path, {})
    path.write_text('{"grasps": {"box": [{"pose": [[1, 0], [0, 1]], "width": 1}]}}')
    with pytest.raises(DatasetError):
        load_grasps(path)
    with pytest.raises(NextviewError):
        Grasp(np.diag([2.0, 1, 1, 1]), 0.01)
    with pytest.raises(UsageError):
        Grasp(np.eye(4), 0.0)
    rows = np.eye(4).tolist()
    path.write_text(
        json.dumps({"grasps": {"box": [{"pose": rows, "width": w} for w in (0.1, 0)]}})
    )
    with pytest.raises(DatasetError):
        load_grasps(path)
    with pytest.raises(UsageError):
        Gripper(opening=0.0)


# In a scene


class StandIn:
    """The module ``robot`` of the page, with a bin whose parts lie side by side."""

    OVERVIEW = look_at_origin(np.radians(75), np.pi, 0.45)
    OVERVIEW[:3, 3] += [0.5, 0, 0.03]
    SENSOR = SENSORS["stereo"]
    CLOSER = look_at_origin(np.radians(75), np.pi, 0.3)
    CLOSER[:3, 3] += [0.5, 0, 0.03]
    INTRINSICS = SENSOR.intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]

    def __init__(self, parts):
        self.parts = parts  # name: vertices in the world, faces
        self.pose = self.OVERVIEW
        self.rng = np.random.default_rng(0)
        self.picked = []
        self.dropped = []
        self.asked = 0

    def can_look_from(self, pose):
        return bool(pose[2, 3] > 0.2)

    def can_grasp(self, pose):
        self.asked += 1
        return bool(pose[2, 2] < -0.5)  # from above

    def move_camera(self, pose):
        self.pose = pose

    def camera_pose(self):
        return self.pose

    def depth(self):
        rays = PinholeCamera.of(self.SENSOR.intrinsics, self.SENSOR.shape).rays
        rays = rays.reshape(-1, 3) @ self.pose[:3, :3].T
        depth, _ = RayCaster([*self.parts.values(), *walls()]).cast(
            self.pose[:3, 3], rays
        )
        depth = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
        return self.SENSOR.measure(depth.reshape(self.SENSOR.shape), self.rng)[0]

    def pick(self, pose, opening):
        between = pose[:3, 3] - 0.005 * pose[:3, 2]
        away = {
            name: np.abs((one[0] - between) @ pose[:3, 1]).min()
            + np.linalg.norm(one[0].mean(0) - between)
            for name, one in self.parts.items()
        }
        self.picked.append(min(away, key=away.get))
        del self.parts[self.picked[-1]]
        assert 0 < opening <= GRIPPER.opening

    def drop(self, name):
        self.dropped.append(name)


def walls():
    """A table and the four walls of the bin of the page."""
    sides = [(0.9, 0.9, 0.02, 0, 0, -0.01)]
    sides += [(0.006, 0.252, 0.07, side * 0.163, 0, 0.035) for side in (-1, 1)]
    sides += [(0.32, 0.006, 0.07, 0, side * 0.123, 0.035) for side in (-1, 1)]
    for x, y, z, *at in sides:
        box = trimesh.creation.box((x, y, z)).apply_translation(np.add(at, [0.5, 0, 0]))
        yield np.asarray(box.vertices), np.asarray(box.faces, np.int32)


@pytest.fixture(scope="module")
def parts():
    sys.path.insert(0, str(ROOT / "examples"))
    try:
        from bin_parts import bin_parts

        known = bin_parts()
    finally:
        sys.path.remove(str(ROOT / "examples"))
    return {name: known[name].solid for name in ("flange",)}


@pytest.fixture(scope="module")
def emptied(parts, tmp_path_factory):
    """The program of the page, after it has emptied a bin, and its robot."""
    folder = tmp_path_factory.mktemp("cell")
    (folder / "parts").mkdir()
    placed = {}
    for k, (name, solid) in enumerate(parts.items()):
        trimesh.Trimesh(*solid, process=False).export(folder / f"parts/{name}.stl")
        turn = Rotation.from_euler("z", 25 + 40 * k, degrees=True)
        vertices = np.add(
            turn.apply(0.001 * solid[0]), [0.44 + 0.12 * k, 0.02 - 0.05 * k, 0]
        )
        placed[name] = vertices, solid[1].astype(np.int32)

    robot = StandIn(placed)
    page = (ROOT / "docs/picking.md").read_text()
    (program,) = re.findall(r"```python\n(.*?)```", page, re.S)
    assert len(program.splitlines()) < 45
    module = types.ModuleType("robot")
    for name in dir(robot):
        if not name.startswith("_"):
            setattr(module, name, getattr(robot, name))
    names: dict = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "robot", module)
        patch.chdir(folder)
        exec(program, names)
    return names, robot, folder


def test_the_program_of_the_page_empties_the_bin(emptied):
    _, robot, _ = emptied
    assert robot.parts == {}
    assert robot.dropped == robot.picked == ["flange"]


def frame_of(robot):
    return Frame(robot.depth(), robot.INTRINSICS, robot.camera_pose())


def scene_of(names, robot):
    scene = nextview.Scene(names["system"], region=names["BIN"])
    robot.move_camera(robot.CLOSER)
    scene.update(frame_of(robot))
    return scene


@pytest.fixture(scope="module")
def lonely(emptied, parts):
    """A flange in the middle of the bin: the scene, all free grasps, and the robot."""
    names, _, _ = emptied
    solid = parts["flange"]
    robot = StandIn(
        {"flange": (0.001 * solid[0] + [0.5, 0, 0], solid[1].astype(np.int32))}
    )
    scene = scene_of(names, robot)
    found = scene.grasps(names["grasps"], names["GRIPPER"])
    return names, scene, found, robot


def test_free_grasps_come_best_first_and_reach_neither_bottom_nor_walls(lonely):
    names, scene, found, _ = lonely
    assert found
    assert [one.score for one in found] == sorted(
        (o.score for o in found), reverse=True
    )
    gripper = names["GRIPPER"]
    for one in found:
        assert one.name == "flange"
        (thing,) = (each for each in scene.objects if each.number == one.number)
        assert thing.confident
        tips = [
            one.pose
            @ [x * gripper.finger_width / 2, y * (one.opening / 2 + 0.01), 0, 1]
            for x in (-1, 1)
            for y in (-1, 1)
        ]
        assert min(tip[2] for tip in tips) > 0
        inside = np.abs(np.array(tips)[:, :2] - [0.5, 0]) < [0.16, 0.12]
        assert inside.all()


def test_the_arm_is_asked_for_the_best_grasps_only(lonely):
    names, scene, found, robot = lonely
    robot.asked = 0
    (first,) = scene.grasps(names["grasps"], names["GRIPPER"], robot.can_grasp, most=1)
    before = [one.score for one in found if one.score > first.score]
    assert robot.asked <= 2 * (len(before) + 1)
    assert first.pose[2, 2] < -0.5

    turned = scene.grasps(
        names["grasps"],
        names["GRIPPER"],
        lambda pose: bool(np.abs(pose - found[0].pose @ HALF_TURN).max() < 1e-9),
    )
    assert len(turned) == 1
    assert scene.grasps(names["grasps"], names["GRIPPER"], lambda pose: False) == []


def test_a_neighbour_and_a_larger_clearance_leave_fewer_grasps(lonely, parts):
    names, scene, found, robot = lonely
    near = scene.grasps(names["grasps"], names["GRIPPER"], clearance=0.006)
    assert 0 < len(near) < len(found)

    block = trimesh.creation.box((0.02, 0.2, 0.05)).apply_translation((0.541, 0, 0.025))
    beside = np.asarray(block.vertices), np.asarray(block.faces, np.int32)
    other = StandIn({**robot.parts, "unknown": beside})
    crowded = scene_of(names, other).grasps(names["grasps"], names["GRIPPER"])
    assert len(crowded) < len(found)
    gripper = names["GRIPPER"]
    inside = np.random.default_rng(0).uniform(
        block.bounds[0] + 0.002, block.bounds[1] - [0.002, 0.002, 0], (3000, 3)
    )
    for one in crowded:  # no finger is in the block
        x, y, z = ((inside - one.pose[:3, 3]) @ one.pose[:3, :3]).T
        span = one.opening / 2 + gripper.finger_thickness
        hit = (np.abs(x) < gripper.finger_width / 2) & (np.abs(y) < span)
        assert not (hit & (z < 0) & (z > -gripper.finger_length)).any()


def test_what_no_frame_has_shown_is_not_free(lonely):
    names, scene, found, robot = lonely
    unseen = [one.unseen for one in found]
    assert max(unseen) <= 0.25
    strict = scene.grasps(names["grasps"], names["GRIPPER"], most_unseen=0.0)
    assert len(strict) == sum(share == 0 for share in unseen)

    caster = RayCaster([*robot.parts.values(), *walls()])
    camera = robot.CLOSER[:3, 3]
    for one in strict[:20]:  # every place of the fingers is in the line of sight
        for side in (-1, 1):
            own = [0, side * (one.opening + 0.01) / 2, -0.01, 1]
            place = (one.pose @ own)[:3]
            share, _ = caster.cast(camera, (place - camera)[None])
            assert share[0] > 0.98
