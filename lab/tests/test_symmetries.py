"""Symmetries of machine parts, of which the true ones are known, and those that a person names."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from symmetric_parts import degrees_off, parts, turns_of

from nextview.recognition.model_card import Symmetry
from nextview.recognition.poses import PoseCandidate, turn_apart
from nextview.teaching.symmetries import named_symmetries
from nextview.things.surface import Surface
from nextview.things.symmetry import find_near_symmetries, find_symmetries

PARTS = parts()
NEAR = 3.0  # degrees by which an axis may be off


def placed(vertices, faces, seed=0):
    """A surface in metres, from millimetres, turned and displaced at random; and its turn."""
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    inside = (vertices @ turn.T / 1000 + (0.4, -0.2, 0.1)).astype(np.float32)
    return Surface("part", inside, np.asarray(faces, np.int32)), turn


def posed(turn, symmetries):
    pose = np.eye(4)
    pose[:3, :3] = turn
    return PoseCandidate("part", 0, pose, 0.5, symmetry=tuple(symmetries))


@pytest.mark.parametrize("name", PARTS)
def test_the_symmetries_of_a_part_are_its_true_ones_and_no_others(name):
    part = PARTS[name]
    surface, turn = placed(*part.solid)
    found = find_symmetries(surface)
    true = turns_of(part)
    rng = np.random.default_rng(1)
    others = [*Rotation.random(40, rng=rng).as_matrix(), *true]
    others += [
        Rotation.from_rotvec(angle * np.array(axis), degrees=True).as_matrix()
        for axis in np.eye(3)
        for angle in range(15, 360, 15)
    ]
    for other in others:
        apart = turn_apart(posed(np.eye(3), found), posed(turn @ other @ turn.T, found))
        assert apart == pytest.approx(degrees_off(other, np.eye(3), true), abs=NEAR)


def test_a_detail_that_breaks_a_symmetry_leaves_a_near_symmetry():
    # Without its keyway the gear comes back after each tooth, and the flange without its holes
    # after any turn. A bracket is like nothing else.
    expected = {"gear_with_keyway": 20, "flange_of_six": 0, "bracket": None}
    for name, order in expected.items():
        surface, turn = placed(*PARTS[name].solid)
        found = find_near_symmetries(surface)
        assert [one.order for one in found] == ([] if order is None else [order])
        assert all(abs(turn[:, 2] @ one.axis) > 0.999 for one in found)


def test_a_scan_that_is_off_by_a_hundredth_is_as_round_as_the_can():
    can = trimesh.creation.cylinder(33, 100, sections=48).subdivide_to_size(6)
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.4, can.vertices.shape)
    surface, turn = placed(can.vertices + noise, can.faces)
    found = find_symmetries(surface)
    assert [one.order for one in found] == [0, 2]
    assert abs(turn[:, 2] @ found[0].axis) > 0.998


def test_a_person_names_symmetries():
    found = named_symmetries(
        ["mug=none", "can=z,x:2", "a=b=z:6", "ball=ball", "bar=1/0/1:2"]
    )
    half = 1 / np.sqrt(2)
    assert found == {
        "mug": (),
        "can": (Symmetry((0, 0, 1), 0), Symmetry((1, 0, 0), 2)),
        "a=b": (Symmetry((0, 0, 1), 6),),
        "ball": tuple(Symmetry(tuple(axis), 0) for axis in np.eye(3)),
        "bar": (Symmetry((half, 0, half), 2),),
    }
