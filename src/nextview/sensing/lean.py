"""Estimate the tilt of the support plane against the assumed up direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.sensing.planes import Plane
from nextview.types import Float

DEPTH_LEAN = np.radians(2.0)
"""Standard deviation of the tilt caused by systematic depth errors, constant in the camera frame.

In fifty frames of a real Kinect with exact poses, the median tilt is 1.3 degrees, and the largest
tenth exceeds 2.7 degrees.
"""
# standard deviation of the tilt caused by the pose of a single frame, in addition to noise
FRAME_LEAN = np.radians(0.5)
UNKNOWN_LEAN = np.radians(30.0)  # standard deviation of an unknown tilt
LEAN_NOTICED = 3.0  # standard deviations from which a tilt is reported
LEAST_LEAN = np.radians(1.0)  # smaller tilts are not reported


@dataclass(frozen=True)
class Lean:
    """Tilt of a support plane in the world.

    Attributes:
        lean: horizontal components of its unit normal, (2,), approximately radians.
        deviation: standard deviation of each component, radians.
    """

    lean: Float
    deviation: float

    @property
    def degrees(self) -> float:
        """Angle between the plane's normal and up, degrees."""
        return float(np.degrees(np.linalg.norm(self.lean)))

    @property
    def noticed(self) -> bool:
        """True if the tilt is relevant and not explained by camera errors."""
        size = float(np.linalg.norm(self.lean))
        return size > max(LEAN_NOTICED * self.deviation, LEAST_LEAN)


def lean_of(planes: Sequence[Plane], cameras: Sequence[Float], axes: Float) -> Lean:
    """Estimate the tilt of the support plane from several frames.

    Depth errors tilt the plane in a direction fixed to the camera, which changes in the world with
    the viewing direction. The tilt that is constant in the world belongs to the plane.

    Args:
        planes: the support plane in each frame.
        cameras: camera-to-world poses, (4, 4) each.
        axes: rows x, y and z (up), (3, 3).
    """
    leans = np.array([axes[:2] @ plane.normal for plane in planes])
    weights = 1 / (
        FRAME_LEAN**2 + np.array([plane.lean_error for plane in planes]) ** 2
    )
    ahead = np.array([axes[:2] @ pose[:3, 2] for pose in cameras])
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)

    # In complex numbers: lean = own + ahead * of_camera + error of the frame.
    measured = leans @ [1, 1j]
    turned = ahead @ [1, 1j]
    matrix = np.stack([np.ones(len(measured)), turned], 1)
    prior = np.diag([1 / UNKNOWN_LEAN**2, 1 / DEPTH_LEAN**2])
    information = (matrix.conj().T * weights) @ matrix + prior
    covariance = np.linalg.inv(information)
    found = covariance @ ((matrix.conj().T * weights) @ measured)

    # Increase the uncertainty if frames disagree by more than their pose errors.
    left = np.abs(measured - matrix @ found) ** 2 * weights / 2
    disagree = max(1.0, float(np.sqrt(left.sum() / max(1, len(left) - 1))))
    deviation = disagree * float(np.sqrt(covariance[0, 0].real))
    return Lean(np.array([found[0].real, found[0].imag]), deviation)
