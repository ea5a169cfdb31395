"""Find the things that look most alike by their surfaces alone, independent of any recogniser."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from nextview.geometry.viewsphere import rotation_z
from nextview.things.surface import Surface
from nextview.types import Float, Mask

COMPARED_SURFACE_POINTS = 300  # sampled points of each surface
AZIMUTHS_TRIED = 16  # tried rotations about the vertical
RADII_APART = 1.25  # ratio of radii above which two things are not alike


@dataclass(frozen=True, eq=False)
class Alikeness:
    """Similarity of things.

    Attributes:
        names: of the things.
        nearest: name of the most similar other thing; its own name if no other one has a similar
            size.
        distance: mean distance of the two surfaces at the best azimuth, in mean radii, (T,)
            float64; infinity if no other one has a similar size.
    """

    names: tuple[str, ...]
    nearest: tuple[str, ...]
    distance: Float

    @property
    def confusable(self) -> Mask:
        """Half of the things with the most similar counterparts, (T,) bool."""
        rank = np.argsort(np.argsort(self.distance, kind="stable"), kind="stable")
        return rank < len(self.names) // 2

    def of(self, names: Collection[str]) -> "Alikeness":
        """Select some of the things; the nearest of each may be another one.

        Args:
            names: of the selected things.
        """
        rows = [row for row, name in enumerate(self.names) if name in names]
        some = tuple(self.names[row] for row in rows)
        nearest = tuple(self.nearest[row] for row in rows)
        return Alikeness(some, nearest, self.distance[rows])


def distances_between(surfaces: Sequence[Surface]) -> Float:
    """Compare the surfaces of things in the orientation of their files.

    Args:
        surfaces: of T things.

    Returns:
        Mean distance of two surfaces at the best azimuth, as a share of their mean radius, (T, T)
        float64; infinity if their sizes differ, and on the diagonal.
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
    """Find the most similar other thing of each thing, see ``distances_between``.

    Args:
        surfaces: of the things.

    Returns:
        The similarity of the things.
    """
    apart = distances_between(surfaces)
    distance = apart.min(1)
    own = np.arange(len(apart))
    nearest = np.where(np.isfinite(distance), apart.argmin(1), own)
    names = tuple(surface.name for surface in surfaces)
    return Alikeness(names, tuple(names[k] for k in nearest), distance)
