"""The error of a rotation modulo symmetries, which a benchmark prints, against closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nextview.recognition.model_card import Symmetry
from nextview_lab.studies.verified_things import rotation_error

ERROR = 3.0  # degrees
BOX = (Symmetry((1.0, 0.0, 0.0), 2), Symmetry((0.0, 1.0, 0.0), 2))
CUP = (Symmetry((0.0, 0.0, 1.0), 0),)
CAN = (*CUP, Symmetry((1.0, 0.0, 0.0), 2))


@pytest.mark.parametrize(
    ("symmetries", "angles"),
    [
        ((), (0, 0)),
        (BOX, (180, 0)),
        (BOX, (0, 180)),
        (BOX, (180, 180)),
        (CUP, (77, 0)),
        (CAN, (77, 180)),
    ],
)
def test_a_turn_that_changes_nothing_is_no_error(
    symmetries: tuple[Symmetry, ...],
    angles: tuple[float, float],
) -> None:
    true = Rotation.random(rng=np.random.default_rng(0))
    error = Rotation.from_euler("x", ERROR, degrees=True)
    found = true * error * Rotation.from_euler("zx", angles, degrees=True)
    measured = rotation_error(found.as_matrix(), true.as_matrix(), symmetries)
    assert measured == pytest.approx(ERROR, abs=1e-6)


def test_a_turn_that_shows_is_an_error() -> None:
    upside_down = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    assert rotation_error(upside_down, np.eye(3), CUP) == pytest.approx(180)
    assert rotation_error(upside_down, np.eye(3), CAN) == pytest.approx(0, abs=1e-6)
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    assert rotation_error(quarter, np.eye(3), BOX) == pytest.approx(90)


def test_a_ball_has_no_rotation() -> None:
    ball = tuple(
        Symmetry(axis, 0)
        for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    )
    assert rotation_error(np.eye(3), np.eye(3), ball) is None
