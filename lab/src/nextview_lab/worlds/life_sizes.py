"""Usual sizes of furniture, for meshes without a unit of length."""

from dataclasses import dataclass

import numpy as np

from nextview.errors import UsageError
from nextview.geometry.mesh import Mesh

MOST_LENGTH = 2.6  # metres, largest length on the floor; wider tables are scaled down


@dataclass(frozen=True)
class LifeSize:
    """Usual size of the objects of a class.

    Attributes:
        measure: "height", or "length" for the longer side on the floor.
        low: metres.
        high: metres.
    """

    measure: str
    low: float
    high: float


LIFE_SIZES = {
    "bathtub": LifeSize("length", 1.5, 1.8),
    "bed": LifeSize("length", 1.9, 2.2),
    "chair": LifeSize("height", 0.78, 1.0),
    "desk": LifeSize("height", 0.70, 0.78),
    "dresser": LifeSize("height", 0.8, 1.25),
    "monitor": LifeSize("length", 0.4, 0.7),
    "night_stand": LifeSize("height", 0.45, 0.65),
    "sofa": LifeSize("length", 1.5, 2.2),
    "table": LifeSize("height", 0.70, 0.78),
    "toilet": LifeSize("height", 0.68, 0.82),
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
    size = LIFE_SIZES.get(label)
    if size is None:
        known = ", ".join(LIFE_SIZES)
        raise UsageError(
            f"{mesh.name}: how large is a {label}? Give the files' --unit; without one, rooms hold"
            f" {known}"
        )
    extent = np.ptp(mesh.vertices, axis=0)
    measured = extent[2] if size.measure == "height" else extent[:2].max()
    radius = rng.uniform(size.low, size.high) / max(measured, 1e-6)
    return float(min(radius, MOST_LENGTH / max(extent[:2].max(), 1e-6)))
