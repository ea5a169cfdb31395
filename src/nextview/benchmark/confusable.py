"""Which things look most alike, by their surfaces alone: no answer of a recogniser counts."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from nextview.geometry.viewsphere import rotation_z
from nextview.things.surface import Surface
from nextview.types import Float, Mask

COMPARED_SURFACE_POINTS = 300  # by which two things are compared
AZIMUTHS_TRIED = 16  # at which one is laid over the other
RADII_APART = 1.25  # times as large as another, from which a thing is not like it


@dataclass(frozen=True, eq=False)
class Alikeness:
    """How alike things are.

    Attributes:
        names: of the things.
        nearest: name of the thing that is most like each; its own where none is of about its size.
        distance: mean distance of the two surfaces at the best azimuth, in mean radii, (T,)
            float64; infinity where none is of about its size.
    """

    names: tuple[str, ...]
    nearest: tuple[str, ...]
    distance: Float

    @property
    def confusable(self) -> Mask:
        """The half of the things to which another one is most like, (T,) bool."""
        rank = np.argsort(np.argsort(self.distance, kind="stable"), kind="stable")
        return rank < len(self.names) // 2

    def of(self, names: Collection[str]) -> "Alikeness":
        """The same of some of the things; the nearest of each may be none of them.

        Args:
            names: of these.
        """
        rows = [row for row, name in enumerate(self.names) if name in names]
        some = tuple(self.names[row] for row in rows)
        nearest = tuple(self.nearest[row] for row in rows)
        return Alikeness(some, nearest, self.distance[rows])


def distances_between(surfaces: Sequence[Surface]) -> Float:
    """Lay the surfaces of things over each other, as they stand in their files.

    Args:
        surfaces: of T things.

    Returns:
        Mean distance of two surfaces at the best azimuth, as a share of their mean radius, (T, T)
        float64; infinity where they are of different sizes, and for a thing itself.
    """
    rng = np.random.default_rng(0)
    points = [surface.sample(COMPARED_SURFACE_POINTS, rng) for surface in surfaces]
    points = [cloud - (cloud.max(0) + cloud.min(0)) / 2 for cloud in points]
    trees = [cKDTree(cloud) for cloud in points]
    radii = np.array([surface.radius for surface in surfaces])
    turns = rotation_z(2 * np.pi * np.arange(AZIMUTHS_TRIED) / AZIMUTHS_TRIED)

    apart = np.full((len(surfaces), len(surfaces)), np.inf)
    for first, second in zip(*np.triu_indices(len(surfaces), 1), strict=True):
        larger = max(radii[first], radii[second])
        if larger > RADII_APART * min(radii[first], radii[second]):
            continue
        turned = points[first] @ turns.swapaxes(1, 2)
        there = np.asarray(trees[second].query(turned)[0]).mean(1)
        back = np.asarray(trees[first].query(points[second] @ turns)[0]).mean(1)
        mean = (radii[first] + radii[second]) / 2
        apart[first, second] = apart[second, first] = ((there + back) / 2).min() / mean
    return apart


def how_alike(surfaces: Sequence[Surface]) -> Alikeness:
    """Which other thing is most like each, see ``distances_between``.

    Args:
        surfaces: of the things.

    Returns:
        The nearest other thing of each.
    """
    apart = distances_between(surfaces)
    distance = apart.min(1)
    own = np.arange(len(apart))
    nearest = np.where(np.isfinite(distance), apart.argmin(1), own)
    names = tuple(surface.name for surface in surfaces)
    return Alikeness(names, tuple(names[k] for k in nearest), distance)
