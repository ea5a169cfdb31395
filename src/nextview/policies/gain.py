"""A policy that has learned what a look at each view is worth, and pays a price for travel.

It knows the ring (from gravity), never the object's azimuth: all views are written as cells (see ``policies.tables``)
seen from where the camera stands. An object and its mirror image are taken to be alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.policies.base import EpisodeState, best_in_window
from nextview.policies.tables import cells_from, cells_to
from nextview.viewsphere import ViewSphere

Float = NDArray[np.float64]
Layers = tuple[tuple[Float, Float], ...]

INPUTS = ("belief", "look", "place", "lem")
"""What a network may be told: the belief over all looks; what the last look alone says; the ring and the views that are
visited; the predicted local entropy map."""

FLOOR = np.log(1e-4)
"""Beliefs below this are taken for it: nobody knows such small ones."""


def mirrored(sphere: ViewSphere) -> NDArray[np.int64]:
    """The cell that lies as far behind as each lies ahead, (V,) int64."""
    n = sphere.azimuths
    return sphere.ring * n + (-sphere.azimuth_index) % n


def told(sphere: ViewSphere, state: EpisodeState, inputs: Sequence[str]) -> Float:
    """What a network is told of B episodes, none of it depending on the absolute azimuth.

    Args:
        sphere: the viewpoints.
        state: the episodes.
        inputs: some of INPUTS.

    Returns:
        (B, D) float64.
    """
    rows = np.arange(len(state.current))
    parts: list[NDArray] = []
    if "belief" in inputs:
        parts += _facets(state.belief)
    if "look" in inputs:
        shifted = state.evidence.logits - state.evidence.logits.max(1, keepdims=True)
        alone = np.exp(shifted.astype(np.float64))
        parts += _facets(alone / alone.sum(1, keepdims=True))
    if "place" in inputs:
        parts.append(np.eye(sphere.rings)[sphere.ring[state.current]])
        parts.append(state.visited[rows[:, None], cells_from(sphere)[state.current]])
    if "lem" in inputs:
        parts.append(np.asarray(state.evidence.maps["lem"]).reshape(len(rows), -1))
    return np.concatenate([np.asarray(part, np.float64).reshape(len(rows), -1) for part in parts], 1)


def _facets(belief: Float) -> list[Float]:
    """A belief, its logarithm, and both of its three highest in order."""
    logs = np.maximum(np.log(np.maximum(belief, 1e-300)), FLOOR) / -FLOOR + 1
    return [belief, logs, -np.sort(-logs, 1)[:, :3]]


def told_mirrored(sphere: ViewSphere, classes: int, inputs: Sequence[str]) -> NDArray[np.int64]:
    """Which of the numbers of ``told`` stands in each place for the mirror image of an object, (D,) int64."""
    facets = 2 * classes + min(3, classes)
    blocks = {
        "belief": np.arange(facets),
        "look": np.arange(facets),
        "place": np.concatenate([np.arange(sphere.rings), sphere.rings + mirrored(sphere)]),
        "lem": np.arange(sphere.rings * 3).reshape(-1, 3)[:, ::-1].ravel(),
    }
    found, begin = [], 0
    for name in [name for name in INPUTS if name in inputs]:
        found.append(begin + blocks[name])
        begin += len(blocks[name])
    return np.concatenate(found)


@dataclass(frozen=True)
class Gain:
    """The unvisited view whose predicted gain, less the price of the way there, is highest.

    Attributes:
        sphere: the viewpoints.
        classes: how many.
        networks: some multilayer perceptrons, each a chain of weights (in, out) and biases (out,), ReLU between them;
            what they give for each cell is averaged.
        inputs: what they are told, some of INPUTS.
        price: of a grid cell of travel, in what the networks were trained to predict.
        anywhere: among all views; otherwise among those of the local window.
    """

    sphere: ViewSphere
    classes: int
    networks: tuple[Layers, ...]
    inputs: tuple[str, ...] = INPUTS
    price: float = 0.0
    anywhere: bool = True

    def __post_init__(self) -> None:
        if unknown := set(self.inputs) - set(INPUTS):
            raise ValueError(f"a gain policy is told some of {', '.join(INPUTS)}, not {', '.join(sorted(unknown))}")
        width = len(told_mirrored(self.sphere, self.classes, self.inputs))
        for layers in self.networks:
            shapes = [weights.shape for weights, _ in layers]
            wide = [width, *(bias.size for _, bias in layers)]
            if shapes != list(pairwise(wide)) or wide[-1] != len(self.sphere):
                raise ValueError(f"weights of the shapes {shapes} do not lead from {width} inputs to the views")
            if not all(np.isfinite(numbers).all() for layer in layers for numbers in layer):
                raise ValueError("a weight is not a finite number")
        if not self.networks or not np.isfinite(self.price) or self.price < 0:
            raise ValueError(f"needs at least one network and a price that is not negative, not {self.price}")

    @property
    def needs(self) -> tuple[str, ...]:
        """The local entropy map, if the networks are told it."""
        return ("lem",) if "lem" in self.inputs else ()

    @classmethod
    def of_table(cls, sphere: ViewSphere, table: dict[str, Any], anywhere: bool) -> Gain:
        """From what a policy's card says."""
        networks = [[(np.array(w, np.float64), np.array(b, np.float64)) for w, b in n] for n in table["networks"]]
        chains = tuple(tuple(layers) for layers in networks)
        return cls(sphere, table["classes"], chains, tuple(table["inputs"]), table["price"], anywhere)

    def facts(self) -> dict[str, Any]:
        """What ``of_table`` reads, for JSON; weights to four digits."""

        def rounded(numbers: Float) -> Any:
            return [rounded(row) for row in numbers] if numbers.ndim > 1 else [float(f"{x:.4g}") for x in numbers]

        networks = [[(rounded(weights), rounded(bias)) for weights, bias in layers] for layers in self.networks]
        return {"classes": self.classes, "inputs": self.inputs, "price": self.price, "networks": networks}

    def gains(self, state: EpisodeState) -> Float:
        """What each view is predicted to be worth, (B, V); only differences between views mean anything."""
        seen = told(self.sphere, state, self.inputs)
        flip = mirrored(self.sphere)
        cells = np.zeros((len(seen), len(self.sphere)))
        for layers in self.networks:
            cells += _forward(seen, layers)
            cells += _forward(seen[:, told_mirrored(self.sphere, self.classes, self.inputs)], layers)[:, flip]
        cells /= 2 * len(self.networks)
        cells -= 1e-9 * np.arange(len(self.sphere))  # else rounding decides between two cells that are mirror images
        return np.take_along_axis(cells, cells_to(self.sphere)[state.current], 1)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        scores = self.gains(state) - self.price * self.sphere.travel[state.current]
        if self.anywhere:
            return np.where(state.visited, -np.inf, scores).argmax(1)
        rows = np.arange(len(scores))[:, None, None]
        return best_in_window(self.sphere, state, scores[rows, self.sphere.windows[state.current]])


def _forward(values: Float, layers: Layers) -> Float:
    for weights, bias in layers[:-1]:
        values = np.maximum(values @ weights + bias, 0)
    weights, bias = layers[-1]
    return values @ weights + bias
