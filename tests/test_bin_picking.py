"""The cell that empties a bin: what is gripped is carried by friction, and falls into the box."""

import importlib
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the extra 'arm' of nextview-lab is not installed")

from nextview.geometry.mesh import make_mesh
from nextview.scene.grasps import FreeGrasp, propose_grasps

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def examples():
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(str(ROOT / "examples"))
        names = ("bin_parts", "bin_cell", "bin_picking")
        yield {name: importlib.import_module(name) for name in names}


@pytest.fixture(scope="module")
def cell(examples):
    known = examples["bin_parts"].bin_parts()
    rng = np.random.default_rng(3)
    return examples["bin_cell"].Cell(known, ["hex_bolt", "bearing_block"], rng)


def test_flat_parts_that_fall_on_each_other_do_not_sink_into_the_bottom(examples):
    module = examples["bin_cell"]
    known = examples["bin_parts"].bin_parts()
    poured = ["flange", "bracket"] * 4
    cell = module.Cell(known, poured, np.random.default_rng(4))
    for row, name in enumerate(poured):
        pose = cell.pose_of(row)
        points = 0.001 * known[name].solid[0] @ pose[:3, :3].T + pose[:3, 3]
        assert points[:, 2].min() > module.WALL - 0.001


@pytest.mark.parametrize("row", [0, 1])
def test_a_part_is_gripped_by_friction_and_dropped_into_the_box(examples, cell, row):
    module = examples["bin_cell"]
    solid = examples["bin_parts"].bin_parts()[cell.names[row]].solid
    mesh = make_mesh(0.001 * solid[0], solid[1], cell.names[row], "m")
    pose = cell.pose_of(row)
    low = (0.001 * solid[0] @ pose[:3, :3].T + pose[:3, 3])[:, 2].min()
    assert abs(low - module.WALL) < 0.002  # it lies on the bottom, not in it

    picker = examples["bin_picking"].Picker(cell, None, {})
    assert row in picker.still_inside
    for grasp in propose_grasps(mesh, module.GRIPPER, 400):
        there = pose @ grasp.pose
        if there[2, 2] > -0.9 or there[2, 3] < module.WALL + 0.003:
            continue
        if picker.can_grasp(there):
            break
    before = cell.seconds
    opening = grasp.width + 0.012
    picker.execute(FreeGrasp(1, "", there, grasp.width, opening, 0.0, 1.0))
    assert cell.seconds - before < 20
    assert row in cell.inside(module.BOX, module.BOX_INSIDE)
    assert row not in picker.still_inside


def test_the_camera_sees_the_parts_where_they_are(cell, examples):
    module = examples["bin_cell"]
    picker = examples["bin_picking"].Picker(cell, None, {})
    picker.move_camera(picker.first_pose)
    frame = cell.look()
    asked = picker.first_pose
    assert np.linalg.norm(frame.pose[:3, 3] - asked[:3, 3]) < 0.01
    assert frame.pose[:3, 2] @ asked[:3, 2] > np.cos(np.radians(1))
    points = frame.positions(*np.nonzero(frame.depth > 0))
    inside = (np.abs(points[:, :2] - module.BIN) < 0.1).all(1)
    assert abs(np.median(points[inside, 2]) - module.WALL) < 0.004
