"""Directions and axes: those that a user gives, and those of cameras."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nextview.checks import points
from nextview.errors import UsageError
from nextview.geometry.camera import LARGEST_ENTRY
from nextview.types import Float


def three(values: Any, what: str) -> Float:
    """Check three real numbers that can be metres.

    Args:
        values: the numbers.
        what: name of the numbers in the error message.

    Returns:
        The numbers, (3,) float64.

    Raises:
        UsageError: they are not three such numbers.
    """
    given = points([values], f"{what}, in a list,")[0]
    if not (np.abs(given) < LARGEST_ENTRY).all():
        raise UsageError(f"{what} is three numbers, metres, not {given.tolist()}")
    return given


def upright_axes(up: ArrayLike, front: ArrayLike | None = None) -> Float:
    """Return axes with z along a direction and x as close as possible to another.

    Args:
        up: direction of z, (3,).
        front: direction of x, (3,); None for the world's x, or its y where x is up.

    Returns:
        Rows x, y and z, (3, 3) float64.

    Raises:
        UsageError: up is not a direction.
    """
    z = three(up, "up")
    if not z.any():
        raise UsageError("up is a direction, three numbers, not 0, 0, 0")
    z = z / np.abs(z).max()  # first, or squares of the smallest numbers would be zero
    z = z / np.linalg.norm(z)
    x = np.eye(3)[0 if abs(z[0]) < 0.9 else 1]
    if front is not None:
        x = np.asarray(front, np.float64)
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def looking_from(directions: Float) -> Float:
    """Rotations from the world to cameras that look at the origin.

    Args:
        directions: unit vectors from the origin to the cameras, (N, 3).

    Returns:
        Rotation matrices, (N, 3, 3), whose rows are the camera axes: x right, y down, z forward.
    """
    forward = -directions
    aside = np.where(np.abs(forward[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    right = np.cross(forward, aside)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], 1)
