"""The networks of the gain policy while they are trained: some small perceptrons, averaged, in numpy."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ModelError
from nextview.policies.gain import Frame, mirrored, mirrored_features
from nextview.viewsphere import ViewSphere

Layers = tuple[tuple[NDArray[np.floating], NDArray[np.floating]], ...]


@dataclass(frozen=True)
class Perceptrons:
    """What several networks say of an object and of its mirror image, averaged: the score of a ``Gain``.

    Attributes:
        networks: each a chain of weights (in, out) and biases (out,), ReLU between them.
        features_flip: which of the inputs stands in each place for the mirror image, (D,) int64.
        cells_flip: which cell lies in each place in the mirror, (V,) int64.
    """

    networks: tuple[Layers, ...]
    features_flip: NDArray[np.int64]
    cells_flip: NDArray[np.int64]

    def __post_init__(self) -> None:
        if not self.networks:
            raise ModelError("needs at least one network")
        for layers in self.networks:
            shapes = [weights.shape for weights, _ in layers]
            wide = [len(self.features_flip), *(bias.size for _, bias in layers)]
            if shapes != list(pairwise(wide)) or wide[-1] != len(self.cells_flip):
                raise ModelError(f"weights of the shapes {shapes} do not lead from {wide[0]} inputs to the views")
            if not all(np.isfinite(numbers).all() for layer in layers for numbers in layer):
                raise ModelError("a weight is not a finite number")

    @classmethod
    def of(
        cls,
        sphere: ViewSphere,
        classes: int,
        inputs: tuple[str, ...],
        networks: tuple[Layers, ...],
        frame: Frame = "camera",
    ) -> Perceptrons:
        """With the mirror of a sphere; the other arguments as those of ``Gain``."""
        return cls(networks, mirrored_features(sphere, classes, inputs, frame), mirrored(sphere))

    def __call__(self, features: NDArray[np.floating]) -> NDArray[np.floating]:
        """What each cell is worth, (B, V), from what is told, (B, D); as precise as the numbers that are given."""
        both = [
            _forward(features, n) + _forward(features[:, self.features_flip], n)[:, self.cells_flip]
            for n in self.networks
        ]
        return sum(both[1:], both[0]) / (2 * len(both))


def _forward(values: NDArray[np.floating], layers: Layers) -> NDArray[np.floating]:
    for weights, bias in layers[:-1]:
        values = np.maximum(values @ weights + bias, 0)
    weights, bias = layers[-1]
    return values @ weights + bias
