"""What an object's size says of its class, for cameras that know their scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ModelError
from nextview.json_file import Fields

Float = NDArray[np.float64]


@dataclass(frozen=True)
class SizeEvidence:
    """How likely each size is for an object of each class; it is added to the logits of every view.

    Attributes:
        radii: object radii, metres, ascending, (R,). Beyond them the nearest counts.
        log_density: of the logarithm of the radius, for each class at these radii, (C, R).
        weight: of it beside the logits.

    Raises:
        ModelError: numbers that make no sense, or shapes that do not fit.
    """

    radii: Float
    log_density: Float
    weight: float

    def __post_init__(self) -> None:
        fits = self.radii.ndim == 1 and self.log_density.ndim == 2 and self.log_density.shape[1:] == self.radii.shape
        if not fits or not (self.radii > 0).all() or not (np.diff(self.radii) > 0).all():
            raise ModelError("sizes that do not fit together")
        if not np.isfinite(self.log_density).all() or not 0 <= self.weight < np.inf:
            raise ModelError("a density or weight of sizes that is not a finite number")

    def logits(self, radii: NDArray[np.floating]) -> NDArray[np.float32]:
        """What is added to the logits.

        Args:
            radii: object radii, metres, (B,); NaN where not known.

        Returns:
            (B, C) float32; zero where the size is not known.
        """
        at = np.log(np.where(np.isfinite(radii), radii, 1.0))
        grid = np.log(self.radii)
        found = np.stack([np.interp(at, grid, row) for row in self.log_density], 1)
        return np.where(np.isfinite(radii)[:, None], self.weight * found, 0).astype(np.float32)

    @classmethod
    def from_dict(cls, values: Any) -> SizeEvidence:
        """From what a recogniser's card says under "size".

        Raises:
            ModelError: it makes no sense.
        """
        fields = Fields(values, "the size")
        radii, density = fields.numbers("radii_m", 1), fields.numbers("log_density", 2)
        found = cls(radii, density, fields.number("weight"))
        fields.end()
        return found

    def to_dict(self) -> dict[str, Any]:
        """What ``from_dict`` reads, for JSON."""
        return {
            "weight": round(self.weight, 4),
            "radii_m": np.round(self.radii, 5).tolist(),
            "log_density": np.round(self.log_density, 3).tolist(),
        }
