"""The pinhole camera against its matrix, and there and back."""

import numpy as np
import pytest

from nextview.geometry.camera import pinhole
from nextview.geometry.pinhole import PinholeCamera

MATRIX = np.array([[610.0, 0, 301.5], [0, 590.0, 260.25], [0, 0, 1]])
SHAPE = (480, 640)
CAMERA = PinholeCamera.of(MATRIX, SHAPE)


def test_projects_as_its_matrix_does() -> None:
    points = np.random.default_rng(1).uniform([-1, -1, 0.5], [1, 1, 4], (50, 3))

    homogeneous = points @ MATRIX.T
    assert np.allclose(CAMERA.project(points), homogeneous[:, :2] / homogeneous[:, 2:])
    assert (CAMERA.matrix == MATRIX).all()


def test_a_ray_through_a_pixel_leads_back_to_its_centre() -> None:
    rng = np.random.default_rng(2)
    rows = rng.integers(0, SHAPE[0], 50)
    columns = rng.integers(0, SHAPE[1], 50)
    depth = rng.uniform(0.3, 5, 50)

    rays = CAMERA.rays_through(rows, columns)
    at = CAMERA.project(rays * depth[:, None])
    assert np.allclose(at, np.stack([columns, rows], 1) + 0.5)
    assert np.allclose(CAMERA.rays[rows, columns], rays, atol=1e-6)


@pytest.mark.parametrize("distance", [1.5, 3.0])
def test_a_picture_just_contains_the_unit_sphere(distance: float) -> None:
    """The tangent from the camera to the sphere is seen at the border of the image."""
    camera = PinholeCamera.of(pinhole(64, distance), (64, 64))
    half_angle = np.arcsin(1 / distance)

    tangent = np.array([[np.sin(half_angle), 0.0, np.cos(half_angle)]])
    assert np.allclose(camera.project(tangent), [[64, 32]])
