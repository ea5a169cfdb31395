"""Usual sizes of furniture, for meshes without a unit of length."""

import numpy as np

from nextview.errors import UsageError
from nextview.geometry.mesh import Mesh

MOST_LENGTH = 2.6  # metres, largest length on the floor; wider tables are scaled down


LIFE_SIZES = {  # by class: "height", or "length" for the longer side on the floor; metres
    "bathtub": ("length", 1.5, 1.8),
    "bed": ("length", 1.9, 2.2),
    "chair": ("height", 0.78, 1.0),
    "desk": ("height", 0.70, 0.78),
    "dresser": ("height", 0.8, 1.25),
    "monitor": ("length", 0.4, 0.7),
    "night_stand": ("height", 0.45, 0.65),
    "sofa": ("length", 1.5, 2.2),
    "table": ("height", 0.70, 0.78),
    "toilet": ("height", 0.68, 0.82),
}


def life_radius(mesh: Mesh, label: str, rng: np.random.Generator) -> float:
    """Return the real object radius of a mesh, metres: from its unit, or drawn for its class.

    Args:
        mesh: of the object.
        label: its class.
        rng: for the size.

    Raises:
        UsageError: neither its unit nor the size of its class is known.
    """
    if mesh.metres is not None:
        return mesh.metres
    if label not in LIFE_SIZES:
        known = ", ".join(LIFE_SIZES)
        raise UsageError(
            f"{mesh.name}: how large is a {label}? Give the files' --unit; without one, rooms hold"
            f" {known}"
        )
    side, low, high = LIFE_SIZES[label]
    extent = np.ptp(mesh.vertices, axis=0)
    measured = extent[2] if side == "height" else extent[:2].max()
    radius = rng.uniform(low, high) / max(measured, 1e-6)
    return float(min(radius, MOST_LENGTH / max(extent[:2].max(), 1e-6)))
