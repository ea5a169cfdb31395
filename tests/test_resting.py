"""In which poses things rest: each kind of pose once, and none that is likely is forgotten."""

import numpy as np
import pytest
from factories import box
from scipy.spatial.transform import Rotation
from trimesh import Trimesh, creation

from nextview.geometry.mesh import UNITS, make_mesh
from nextview.geometry.resting import resting_poses, rotated, stable_poses

SIDE = 24  # faces around things that are round


def of(shape):
    return make_mesh(shape.vertices, shape.faces)


def cup(height=2.0, top=1.0, bottom=0.8):
    """A cup without a handle: a closed frustum of a cone."""
    shape = creation.cylinder(1, height, sections=SIDE)
    shape.vertices[:, :2] *= np.where(shape.vertices[:, 2:] > 0, top, bottom)
    return shape


def plate(points):
    """A sheet without thickness, cut along a polygon that is seen whole from its first corner."""
    fan = [(0, k, k + 1) for k in range(1, len(points) - 1)]
    return Trimesh(
        np.pad(np.array(points, float), ((0, 0), (0, 1))), fan, process=False
    )


def test_a_box_rests_on_its_faces_and_keeps_its_size():
    shape = box((3, 2, 1))
    brick = make_mesh(shape.vertices, shape.faces, unit="cm")
    found = resting_poses(brick)
    assert len(found) == 3  # of its six sides two and two look alike
    np.testing.assert_array_equal(found[0], np.eye(3))
    np.testing.assert_allclose(
        sorted(np.abs(found[:, 2]).tolist()), np.eye(3)[::-1], atol=1e-6
    )
    for rotation in found:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        turned = rotated(brick, rotation)
        assert turned.unit == "cm"
        assert turned.metres == turned.radius
        assert turned.metres == pytest.approx(np.sqrt(14) / 2 * UNITS["cm"])


@pytest.mark.parametrize(
    (
        "shape",
        "tilts",
    ),  # between the axis of the shape and the vertical, in each pose, degrees
    [
        (creation.cylinder(1, 2, sections=SIDE), [0, 90]),
        (creation.cylinder(1, 0.1, sections=SIDE), [0]),
        (cup(1.6), [0, 0, 83]),  # upside down, too
        (plate([(0, 0), (2, 0), (2, 1), (0, 1)]), [0]),
        (
            plate([(0, 0), (3, 0), (3, 0.5), (0.5, 0.5), (0.5, 1.5), (0, 1.5)]),
            [0, 0],
        ),  # its back is a mirror image
    ],
)
@pytest.mark.parametrize("turn", [(0, 0, 0), (40, 30, 70)])
def test_poses_that_look_alike_are_one_however_the_file_has_the_thing(
    shape, tilts, turn
):
    away = Rotation.from_euler("zxz", turn, degrees=True)
    mesh = of(Trimesh(away.apply(shape.vertices), shape.faces, process=False))
    upwards = np.abs(resting_poses(mesh) @ away.apply((0, 0, 1)))[:, 2]
    found = np.degrees(np.arccos(upwards.clip(max=1)))
    # its own pose is always among them, and the first
    expected = [turn[1], *tilts] if any(turn) else tilts
    np.testing.assert_allclose(sorted(found), sorted(expected), atol=5)
    assert found[0] == pytest.approx(expected[0], abs=1e-3)


@pytest.mark.parametrize(
    "shape", [creation.icosphere(3), creation.box((1, 1, 1)), creation.icosphere(1)]
)
def test_a_ball_and_a_die_have_one_pose(shape):
    assert len(resting_poses(of(shape))) == 1


@pytest.mark.parametrize("sides", [(3.0, 2.0, 0.8), (2.0, 1.5, 1.0), (1.0, 0.7, 1.3)])
def test_shares_of_the_throws_are_those_of_the_solid_angles(sides):
    """A box ends on the side that its centre of mass is above when it is dropped."""
    found = stable_poses(of(box(sides)))
    assert found.shares.sum() == pytest.approx(1)
    for axis in range(3):
        a, b = (side for other, side in enumerate(sides) if other != axis)
        away = sides[axis]  # twice the distance from the centre
        angle = 4 * np.arctan(a * b / (away * np.sqrt(away**2 + a**2 + b**2)))
        on_it = np.abs(found.rotations[:, 2, axis]) > 0.99  # on either of two sides
        assert found.shares[on_it].sum() == pytest.approx(
            2 * angle / (4 * np.pi), abs=0.01
        )
