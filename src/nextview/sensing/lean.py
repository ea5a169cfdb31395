"""By how much the support plane leans against the direction that is taken for up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.sensing.planes import Plane
from nextview.types import Float

DEPTH_LEAN = np.radians(2.0)
"""By how much errors of a depth camera lean a plane, standard deviation, always the same way as
the camera sees it: of fifty frames of a real Kinect whose poses are exact, half lean by 1.3 degrees
or more, and a tenth by 2.7.
"""
# by how much the pose of a single frame leans it, beside its noise
FRAME_LEAN = np.radians(0.5)
UNKNOWN_LEAN = np.radians(30.0)  # deviation of a lean of which nothing is known
LEAN_NOTICED = 3.0  # standard deviations that errors do not explain
LEAST_LEAN = np.radians(1.0)  # below which it does not matter


@dataclass(frozen=True)
class Lean:
    """The lean of a support plane in the world.

    Attributes:
        lean: horizontal part of its unit normal, (2,), about radians.
        deviation: standard deviation of each of both, radians.
    """

    lean: Float
    deviation: float

    @property
    def degrees(self) -> float:
        """Of the plane against up."""
        return float(np.degrees(np.linalg.norm(self.lean)))

    @property
    def noticed(self) -> bool:
        """Whether it is more than errors of the camera explain, and matters."""
        size = float(np.linalg.norm(self.lean))
        return size > max(LEAN_NOTICED * self.deviation, LEAST_LEAN)


def lean_of(planes: Sequence[Plane], cameras: Sequence[Float], axes: Float) -> Lean:
    """What some frames together say of the lean of the support plane.

    A camera whose depth errs leans the plane with itself: it leans another way in the world when
    the camera looks from another side. What stays the same in the world is the plane's own.

    Args:
        planes: the support plane as each frame shows it.
        cameras: camera-to-world poses, (4, 4) each.
        axes: rows x, y and z (up), (3, 3).
    """
    leans = np.array([axes[:2] @ plane.normal for plane in planes])
    weights = 1 / (
        FRAME_LEAN**2 + np.array([plane.lean_error for plane in planes]) ** 2
    )
    ahead = np.array([axes[:2] @ pose[:3, 2] for pose in cameras])
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)

    # As complex numbers: lean = own + ahead * of_camera + error of the frame.
    measured = leans @ [1, 1j]
    turned = ahead @ [1, 1j]
    matrix = np.stack([np.ones(len(measured)), turned], 1)
    prior = np.diag([1 / UNKNOWN_LEAN**2, 1 / DEPTH_LEAN**2])
    information = (matrix.conj().T * weights) @ matrix + prior
    covariance = np.linalg.inv(information)
    found = covariance @ ((matrix.conj().T * weights) @ measured)

    # Frames that disagree by more than their poses should say less.
    left = np.abs(measured - matrix @ found) ** 2 * weights / 2
    disagree = max(1.0, float(np.sqrt(left.sum() / max(1, len(left) - 1))))
    deviation = disagree * float(np.sqrt(covariance[0, 0].real))
    return Lean(np.array([found[0].real, found[0].imag]), deviation)
