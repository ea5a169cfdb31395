"""Household things of simple shapes, taught and shown through the wrist sensor: what is known,
and what is not.
"""

import numpy as np
import pytest
import trimesh
from factories import box

import nextview
from nextview.teaching.learn import learn

pytestmark = pytest.mark.long


def dish(length, width, height=0.022, rim=0.012) -> trimesh.Trimesh:
    """A flat dish with an upright rim, metres."""
    parts = [box((length, width, 0.006), (0, 0, 0.003))]
    for side in (-1, 1):
        parts.append(
            box((length, rim, height), (0, side * (width - rim) / 2, height / 2))
        )
        parts.append(
            box((rim, width, height), (side * (length - rim) / 2, 0, height / 2))
        )
    return trimesh.util.concatenate(parts)


def soap() -> trimesh.Trimesh:
    """A bar with round edges, 9.5 x 6 x 3 cm."""
    ball = trimesh.creation.icosphere(4)
    rounded = np.sign(ball.vertices) * np.sqrt(np.abs(ball.vertices))
    ball.vertices = rounded / np.abs(rounded).max(0) * np.array([0.0475, 0.03, 0.015])
    return ball


def mug() -> trimesh.Trimesh:
    wall = trimesh.creation.annulus(0.036, 0.04, 0.1)
    bottom = trimesh.creation.cylinder(0.04, 0.006).apply_translation((0, 0, -0.047))
    handle = trimesh.creation.torus(0.03, 0.006)
    handle.apply_transform(
        trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0))
    )
    handle.apply_translation((0.055, 0, 0))
    return trimesh.util.concatenate([wall, bottom, handle])


def bottle() -> trimesh.Trimesh:
    body = trimesh.creation.cylinder(0.035, 0.16)
    neck = trimesh.creation.cylinder(0.013, 0.06).apply_translation((0, 0, 0.11))
    return trimesh.util.concatenate([body, neck])


THINGS = {
    "soap": soap,
    "plate": lambda: dish(0.18, 0.18),
    "tin": lambda: trimesh.creation.cylinder(0.037, 0.11),
    "carton": lambda: box((0.07, 0.07, 0.2)),
    "ball": lambda: trimesh.creation.icosphere(4, 0.035),
    "mug": mug,
    "box": lambda: box((0.16, 0.11, 0.06)),
    "bottle": bottle,
}


@pytest.fixture(scope="module")
def system(shared):
    def make(folder):
        (folder / "scans").mkdir()
        for name, thing in THINGS.items():
            thing().export(folder / "scans" / f"{name}.ply")
        learn(folder / "scans", folder / "mine", unit="m", workers=0)

    return nextview.load(models=shared("household", make) / "mine", threads=1)


def shown(system, thing, folder, draws) -> list[nextview.Recognition]:
    """Whole episodes with a thing, turned at random, from random first views."""
    found = []
    for seed in range(draws):
        turned = thing.copy()
        angle = np.random.default_rng(seed).uniform(0, 2 * np.pi)
        turned.apply_transform(
            trimesh.transformations.rotation_matrix(angle, (0, 0, 1))
        )
        turned.export(folder / "thing.ply")
        found.append(
            system.recognise(folder / "thing.ply", unit="m", sensor="wrist", seed=seed)
        )
    return found


def test_a_taught_soap_is_known_wherever_it_lies(system, tmp_path):
    answers = [result.answer for result in shown(system, soap(), tmp_path, 6)]
    assert answers == ["soap"] * 6


@pytest.mark.xfail(
    strict=True,
    reason="a taught thing is known by its radius and features, not by its proportions",
)
def test_a_plate_of_other_proportions_is_not_the_taught_one(system, tmp_path):
    results = shown(system, dish(0.21, 0.19), tmp_path, 7)
    assert not any(result.answer == "plate" and result.confident for result in results)
