"""One view of a session, and what followed from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import azimuth_of, elevation_of
from nextview.sensing.plausibility import ViewWarning


@dataclass(frozen=True)
class View:
    """One view and what followed from it.

    Attributes:
        index: candidate viewpoint that it was taken from, or the nearest one to where the camera stood.
        observation: what was seen.
        alone: belief by this view alone, (classes,) float64; even if nothing is seen in it.
        belief: fused over all views so far, (classes,) float64.
        maps: predicted local maps by name, each (rings, 3).
        next_view: where to look next; None where the episode ends.
        travel: so far, grid cells.
        arc: so far, radians.
        direction: unit vector from the object to where the camera stood, (3,) float64.
        azimuth_bins: belief, over all views, in the azimuth from which the object is seen here, for each class,
            (classes, azimuth bins), in even steps; None if the recogniser does not tell.
        values: what the policy valued each candidate view at, (V,) float64, NaN if not considered; None at the end, and
            for policies that value nothing.
        novelty: score of this view; None if nothing is seen in it, or the recogniser has none.
        warnings: what is likely to be wrong with the view; usually nothing.
        degrees_off: angle between the view that was asked for and where the camera stood; 0 for a first frame.
    """

    index: int
    observation: Observation
    alone: NDArray[np.float64]
    belief: NDArray[np.float64]
    maps: dict[str, NDArray[np.floating]]
    next_view: int | None
    travel: float
    arc: float
    direction: NDArray[np.float64]
    azimuth_bins: NDArray[np.float64] | None = None
    values: NDArray[np.float64] | None = None
    novelty: float | None = None
    warnings: tuple[ViewWarning, ...] = ()
    degrees_off: float = 0.0

    @property
    def angles(self) -> tuple[float, float]:
        """(elevation, azimuth) of where the camera stood, degrees."""
        return float(np.degrees(elevation_of(self.direction))), float(np.degrees(azimuth_of(self.direction)))
