"""A policy that has learned what a look at each view is worth, and pays a price for travel.

It knows the ring (from gravity), never the object's azimuth: all views are written as cells (see ``policies.tables``)
seen from where the camera stands. An object and its mirror image are taken to be alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.policies.base import EpisodeState, best_in_window
from nextview.policies.tables import cells_from, cells_to
from nextview.viewsphere import ViewSphere

Float = NDArray[np.float64]

MAPS = ("lem", "lcm", "lem-sphere", "lcm-sphere")
"""Predicted maps that a network may be told, of the local window or of the whole sphere."""

INPUTS = ("belief", "look", "place", *MAPS)
"""What a network may be told: the belief over all looks; what the last look alone says; the ring and the views that are
visited; the maps that were predicted from the last look."""

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
    parts += [np.asarray(state.evidence.maps[name]) for name in MAPS if name in inputs]
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
    }
    window = np.arange(sphere.rings * 3).reshape(-1, 3)[:, ::-1].ravel()
    blocks |= {name: mirrored(sphere) if name.endswith("-sphere") else window for name in MAPS}
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
        score: from what is told, (B, D) float32, to what each cell is worth, (B, V) float32: the mean over some
            networks and over the object and its mirror image. Each row by itself, to the last bit.
        inputs: what the score is told, some of INPUTS.
        price: of a grid cell of travel, in what the networks were trained to predict.
        anywhere: among all views; otherwise among those of the local window.
    """

    sphere: ViewSphere
    classes: int
    score: Callable[[NDArray[np.float32]], NDArray[np.floating]]
    inputs: tuple[str, ...] = INPUTS
    price: float = 0.0
    anywhere: bool = True

    def __post_init__(self) -> None:
        if unknown := set(self.inputs) - set(INPUTS):
            raise ValueError(f"a gain policy is told some of {', '.join(INPUTS)}, not {', '.join(sorted(unknown))}")
        if not np.isfinite(self.price) or self.price < 0:
            raise ValueError(f"needs a price that is not negative, not {self.price}")

    @property
    def needs(self) -> tuple[str, ...]:
        """The maps that the score is told."""
        return tuple(name for name in MAPS if name in self.inputs)

    def facts(self) -> dict[str, Any]:
        """What a card says of it beside the sphere, for JSON."""
        return {"classes": self.classes, "inputs": self.inputs, "price": self.price}

    def gains(self, state: EpisodeState) -> Float:
        """What each view is predicted to be worth, (B, V); only differences between views mean anything."""
        cells = self.score(told(self.sphere, state, self.inputs).astype(np.float32)).astype(np.float64)
        cells -= 1e-9 * np.arange(len(self.sphere))  # cells that are mirror images may tie; the first of them is taken
        return np.take_along_axis(cells, cells_to(self.sphere)[state.current], 1)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        scores = self.gains(state) - self.price * self.sphere.travel[state.current]
        if self.anywhere:
            return np.where(state.visited, -np.inf, scores).argmax(1)
        rows = np.arange(len(scores))[:, None, None]
        return best_in_window(self.sphere, state, scores[rows, self.sphere.windows[state.current]])
