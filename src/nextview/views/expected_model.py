"""What a further view of a thing is expected to tell: the numbers of its model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from nextview.recognition.poses import PoseCandidate
from nextview.things.library import Library
from nextview.types import Float, Index

OUTLINE_PIXELS = 1.5  # standard deviation of an outline, pixels
FREE_WEIGHT = 1e-3  # weight of the prior of an unknown without prior knowledge
MOST_LEADING = 10  # hypotheses that are rendered


@dataclass(frozen=True)
class ExpectedModel:
    """Model of the pixels of a further view.

    Attributes:
        outlier: log-likelihood of a pixel that the hypothesis does not explain, relative to an
            exact match.
        hole: log-likelihood of a missing measurement on the surface at normal incidence.
        steep: lateral error on a steep surface, pixels.
        edge: distance to the outline within which deviations are usual, pixels.
        tilt: standard deviation of the vertical, radians.
        camera: of the position of a camera, metres.
        aim: of its viewing direction, radians.
        pixels: effective number of independent pixels of a view.
        geometry: weight of the mean log-likelihood of the pixels of a view.
        correlation: of two views, 0 to 1.
    """

    outlier: float = -4.0
    hole: float = -0.5
    steep: float = 1.0
    edge: float = 3.0
    tilt: float = 0.04
    camera: float = 0.003
    aim: float = 0.006
    pixels: float = 60.0
    geometry: float = 40.0
    correlation: float = 0.5


@dataclass(frozen=True, eq=False)
class Leading:
    """The leading hypotheses, things in poses, that the next view has to separate.

    Attributes:
        things: number of the surface of each, (H,) int64.
        poses: poses of the scan files' frames in the object frame, (H, 4, 4) float64, metres.
        belief: belief in each, (H,) float64, sums to 1.
    """

    things: Index
    poses: Float
    belief: Float

    @classmethod
    def of(
        cls,
        library: Library,
        poses: Sequence[PoseCandidate],
        beliefs: Mapping[str, float],
        to_object: Float,
    ) -> Leading | None:
        """Return the likeliest of some poses; None if no name is believed.

        Args:
            library: the things.
            poses: the likeliest first.
            beliefs: in the names of the library.
            to_object: from the world to the object frame, (4, 4).
        """
        kept = [one for one in poses if beliefs.get(one.thing, 0) > 0][:MOST_LEADING]
        if not kept:
            return None
        belief = np.array([one.probability * beliefs[one.thing] for one in kept])
        return cls(
            np.array([library.names.index(one.thing) for one in kept]),
            np.stack([to_object @ one.pose for one in kept]),
            belief / belief.sum(),
        )

    @classmethod
    def as_large_as(cls, points: Float, library: Library) -> Leading:
        """Return the taught thing that is as large as something unknown, in its place.

        Args:
            points: on it, (N, 3), object frame, metres.
            library: the things.
        """
        middle = (points.min(0) + points.max(0)) / 2
        radius = np.linalg.norm(points - middle, axis=1).max()
        thing = int(np.abs(library.radii - radius).argmin())
        pose = np.eye(4)
        pose[:3, 3] = middle - library.centres[thing]
        return cls(np.array([thing]), pose[None], np.ones(1))


def inverses(information: Float) -> Float:
    """Inverses of symmetric matrices without negative variances.

    In single precision, a hardly determined direction may get a zero or negative eigenvalue. It is
    raised to the resolution of single precision.

    Args:
        information: matrices, (H, N, N).

    Returns:
        Inverses, (H, N, N) float64.
    """
    scale = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), FREE_WEIGHT))
    # rotations and translations have different units
    scaled = information / (scale[:, :, None] * scale[:, None])
    values, vectors = np.linalg.eigh((scaled + scaled.swapaxes(1, 2)) / 2)
    values = np.maximum(values, np.finfo(np.float32).eps)
    inverse = (vectors / values[:, None]) @ vectors.swapaxes(1, 2)
    return np.asarray(inverse / (scale[:, :, None] * scale[:, None]), np.float64)
