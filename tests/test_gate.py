"""The gate counts what is right, wrong, and on things that nobody taught."""

import ast
import json
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import numbers
from benchmarks.gate import compared, nearest_of, summed, table_of
from benchmarks.gate_frames import INTRINSICS, case, cloud, machine_parts

SHAPES = {name: cloud(mesh) for name, mesh in machine_parts().items()}


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """Five parts in a box, drawn and read again."""
    folder = tmp_path_factory.mktemp("frames")
    drawn = case("parts", 10, {}, folder)
    kept = case("parts", 10, {}, folder)
    assert all(
        np.array_equal(vars(drawn)[name], vars(kept)[name]) for name in vars(kept)
    )
    return kept


def told(seen, **shifts):
    """The true things of the first frame, each confident, some of them shifted, metres."""
    poses = dict(zip(seen.names.tolist(), seen.poses[0].copy(), strict=True))
    for name, shift in shifts.items():
        poses[name][:3, 3] += shift
    return [
        SimpleNamespace(name=name, confident=True, pose=poses[name]) for name in SHAPES
    ]


def test_the_truth_is_right(box):
    row = compared(told(box), box, 0, SHAPES)
    assert (row["known"], row["right"], row["sure wrong"]) == (5, 5, 0)
    assert max(row["mm"]) < 1e-6


def test_a_name_at_another_place_is_wrong(box):
    row = compared(told(box, tee=(0, 0, 0.05)), box, 0, SHAPES)
    assert (row["right"], row["sure wrong"], row["missed"]) == (4, 1, ["tee"])


def test_millimetres_along_the_normal(box):
    flange = compared(told(box, flange=(0, 0, 0.004)), box, 0, SHAPES)["mm"][0]
    assert 1 < flange < 4  # flat parts move by all of it, upright ones by nothing


def test_a_name_twice_and_one_on_the_box(box):
    wall = np.eye(4)
    wall[:3, 3] = box.points[-1][0] + (0, 0, 0.02)
    wall = box.poses[0][-1] @ wall
    again = SimpleNamespace(name="bolt", confident=False, pose=wall)
    row = compared([*told(box), again], box, 0, SHAPES)
    assert (row["named"], row["right"], row["on strangers"]) == (6, 5, 1)
    assert (row["sure on strangers"], row["wrong"]) == (0, ["bolt"])


def test_depth_is_that_of_the_things(box):
    rows, columns = np.nonzero(box.labels[0])
    depth = box.depth[0][rows, columns] / 1000
    rays = np.c_[columns, rows, np.ones(len(rows))] @ np.linalg.inv(INTRINSICS).T
    camera = rays * depth[:, None]
    world = camera @ box.told[0][:3, :3].T + box.told[0][:3, 3]
    high = world[depth > 0, 2]
    assert (depth > 0).mean() > 0.8
    assert (np.percentile(high, (2, 98)) > (-0.015, 0.03)).all()
    assert (np.percentile(high, (2, 98)) < (0.015, 0.075)).all()


def test_tables_beside_another_run():
    rows = [
        {"group": "one", "named": 4, "right": 3, "seconds": [1.0, 3.0]},
        {"group": "one", "named": 4, "right": 3, "seconds": [2.0]},
    ]
    figures = summed(rows)
    assert figures["right"] == 6
    assert figures["precision %"] == 75
    assert (figures["seconds, median"], figures["seconds, worst"]) == (2, 3)
    table = table_of({"one": figures}, {"one": {**figures, "right": 8, "mm, worst": 2}})
    assert "8 > 6 (-2)" in table
    assert "2 > none" in table
    assert table.count(">") == 2  # what has not changed stands alone


def test_what_is_gone_is_nearest_to_nothing():
    here, gone = np.zeros((1, 3)), np.full((1, 3), np.nan)
    assert nearest_of({"gone": gone, "here": here}, np.ones(3)) == "here"


def test_the_page_of_the_numbers_is_what_its_script_writes():
    results = json.loads(numbers.RESULTS.read_text())
    page = (numbers.HERE / "numbers.md").read_text()
    assert page == numbers.page(results), "python -m benchmarks.numbers writes it"


@pytest.mark.parametrize(
    "module",
    [
        "contour",
        "flat",
        "naming",
        "point_pairs",
        "propose",
        "register",
        "score",
        "world",
    ],
)
def test_no_number_of_the_explanation_is_missing_on_the_page(module):
    text = (numbers.PACKAGE / f"things/{module}.py").read_text()
    constants = {
        name
        for node in ast.parse(text).body
        if isinstance(node, ast.Assign)
        and any(isinstance(one, ast.Constant) for one in ast.walk(node.value))
        for name in ast.unparse(node.targets[0]).strip("()").split(", ")
        if name.isupper()
    }
    listed = {one.name for one in numbers.numbers()}
    assert {f"things/{module}.{name}" for name in constants} <= listed
