"""A policy that has learned what a view of each view is worth, and pays a travel weight.

It knows the ring (from gravity), never where the object's azimuth zero is: all views are written as cells (see
``policies.tables``) seen from where the camera stands, or from where the recogniser believes the object's own zero to
be. An object and its mirror image are taken to be alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from nextview.errors import PolicyError
from nextview.policies.base import EpisodeState, best_in_window
from nextview.policies.learned_tables import cells_from, cells_to
from nextview.viewsphere import ViewSphere

Float = NDArray[np.float64]

MAPS = ("lem", "lcm", "lem-sphere", "lcm-sphere")
"""Predicted maps that a network may be told, of the local window or of the whole sphere."""

INPUTS = ("belief", "view", "place", *MAPS, "azimuth_bin")
"""What a network may be told: the belief over all views; what the last view alone says; the ring and the views that are
visited; the maps that were predicted from the last view; and which side of the object is seen, if it is of the class
that is believed most, and over all classes."""

Frame = Literal["camera", "object"]
"""From where the azimuths of cells are counted: from the camera's, or from that at which the object, if it is of the
class that is believed most, in all likelihood shows its azimuth bin 0."""

FLOOR = np.log(1e-4)
"""Beliefs below this are taken for it: nobody knows such small ones."""


def mirrored(sphere: ViewSphere) -> NDArray[np.int64]:
    """The cell that lies as far behind as each lies ahead, (V,) int64."""
    n = sphere.azimuths
    return sphere.ring * n + (-sphere.azimuth_index) % n


def origin(sphere: ViewSphere, state: EpisodeState, frame: Frame) -> NDArray[np.int64]:
    """The view from which the cells of each episode are counted, (B,) int64.

    Raises:
        PolicyError: the frame is the object's, and the recogniser does not tell its azimuth bins apart.
    """
    if frame == "camera":
        return state.current
    side = _own(state.belief, _bin_belief(sphere, state)).argmax(1)
    n = sphere.azimuths
    return sphere.ring[state.current] * n + (sphere.azimuth_index[state.current] - side) % n


def _bin_belief(sphere: ViewSphere, state: EpisodeState) -> Float:
    """Belief in the azimuth bin that is seen from the current view, for each class, (B, C, azimuths)."""
    if state.azimuth_bins is None or state.azimuth_bins.shape[2] != sphere.azimuths:
        raise PolicyError(
            f"this policy needs a recogniser that tells {sphere.azimuths} azimuth bins of an object apart"
        )
    return state.azimuth_bins


def _own(belief: Float, azimuth_bins: Float) -> Float:
    """The azimuth bins of the class that is believed most, (B, azimuths)."""
    return azimuth_bins[np.arange(len(belief)), belief.argmax(1)]


def features(sphere: ViewSphere, state: EpisodeState, inputs: Sequence[str], frame: Frame = "camera") -> Float:
    """What a network is told of B episodes, none of it depending on the absolute azimuth.

    Args:
        sphere: the viewpoints.
        state: the episodes.
        inputs: some of INPUTS.
        frame: in which cells are counted.

    Returns:
        (B, D) float64.

    Raises:
        PolicyError: the azimuth bins matter, and the recogniser does not tell as many apart as the sphere has azimuths.
    """
    n, start = sphere.azimuths, origin(sphere, state, frame)
    ahead = (sphere.azimuth_index[state.current] - sphere.azimuth_index[start]) % n
    rows = np.arange(len(state.current))
    parts: list[NDArray] = []
    if "belief" in inputs:
        parts += _facets(state.belief)
    if "view" in inputs:
        shifted = state.evidence.logits - state.evidence.logits.max(1, keepdims=True)
        alone = np.exp(shifted.astype(np.float64))
        parts += _facets(alone / alone.sum(1, keepdims=True))
    if "place" in inputs:
        parts.append(np.eye(sphere.rings)[sphere.ring[state.current]])
        parts.append(state.visited[rows[:, None], cells_from(sphere)[start]])
    for name in MAPS:
        if name in inputs:
            values = np.asarray(state.evidence.maps[name])
            if name.endswith("-sphere"):  # its columns are counted from the camera
                columns = (np.arange(n) - ahead[:, None]) % n
                values = np.take_along_axis(values, columns[:, None], 2)
            parts.append(values)
    if "azimuth_bin" in inputs:
        parts += [np.eye(n)[ahead]] if frame == "object" else []
        azimuth_bins = _bin_belief(sphere, state)
        for believed in (_own(state.belief, azimuth_bins), (state.belief[:, :, None] * azimuth_bins).sum(1)):
            parts.append(np.take_along_axis(believed, (np.arange(n) + ahead[:, None]) % n, 1))
    return np.concatenate([np.asarray(part, np.float64).reshape(len(rows), -1) for part in parts], 1)


def _facets(belief: Float) -> list[Float]:
    """A belief, its logarithm, and both of its three highest in order."""
    logs = np.maximum(np.log(np.maximum(belief, 1e-300)), FLOOR) / -FLOOR + 1
    return [belief, logs, -np.sort(-logs, 1)[:, :3]]


def mirrored_features(
    sphere: ViewSphere, classes: int, inputs: Sequence[str], frame: Frame = "camera"
) -> NDArray[np.int64]:
    """Which of the numbers of ``features`` stands in each place for the mirror image of an object, (D,) int64."""
    facets = 2 * classes + min(3, classes)
    blocks = {
        "belief": np.arange(facets),
        "view": np.arange(facets),
        "place": np.concatenate([np.arange(sphere.rings), sphere.rings + mirrored(sphere)]),
    }
    window = np.arange(sphere.rings * 3).reshape(-1, 3)[:, ::-1].ravel()
    blocks |= {name: mirrored(sphere) if name.endswith("-sphere") else window for name in MAPS}
    n = sphere.azimuths
    blocks["azimuth_bin"] = np.concatenate([k * n + -np.arange(n) % n for k in range(2 if frame == "camera" else 3)])
    found, begin = [], 0
    for name in [name for name in INPUTS if name in inputs]:
        found.append(begin + blocks[name])
        begin += len(blocks[name])
    return np.concatenate(found)


@dataclass(frozen=True)
class Gain:
    """The unvisited view whose predicted gain, less the travel weight of the way there, is highest.

    Attributes:
        sphere: the viewpoints.
        classes: how many.
        score: from what is told, (B, D) float32, to what each cell is worth, (B, V) float32: the mean over some
            networks and over the object and its mirror image. Each row by itself, to the last bit.
        inputs: what the score is told, some of INPUTS.
        travel_weight: of a grid cell of travel, in what the networks were trained to predict.
        anywhere: among all views; otherwise among those of the local window.
        frame: in which cells are counted.
    """

    sphere: ViewSphere
    classes: int
    score: Callable[[NDArray[np.float32]], NDArray[np.floating]]
    inputs: tuple[str, ...] = INPUTS
    travel_weight: float = 0.0
    anywhere: bool = True
    frame: Frame = "camera"

    def __post_init__(self) -> None:
        if unknown := set(self.inputs) - set(INPUTS):
            raise PolicyError(f"a gain policy takes some of {', '.join(INPUTS)}, not {', '.join(sorted(unknown))}")
        if not np.isfinite(self.travel_weight) or self.travel_weight < 0:
            raise PolicyError(f"needs a travel weight that is not negative, not {self.travel_weight}")
        if self.frame not in get_args(Frame):
            raise PolicyError(f"cells are counted from one of {', '.join(get_args(Frame))}, not {self.frame!r}")

    @property
    def needs(self) -> tuple[str, ...]:
        """The maps that the score is told, and the azimuth bins."""
        azimuth_bins = "azimuth_bin" in self.inputs or self.frame == "object"
        return (*(name for name in MAPS if name in self.inputs), *(["azimuth_bins"] if azimuth_bins else []))

    def facts(self) -> dict[str, Any]:
        """What a card says of it beside the sphere, for JSON."""
        return {
            "classes": self.classes,
            "inputs": self.inputs,
            "travel_weight": self.travel_weight,
            "frame": self.frame,
        }

    def gains(self, state: EpisodeState) -> Float:
        """What each view is predicted to be worth, (B, V); only differences between views mean anything."""
        seen = features(self.sphere, state, self.inputs, self.frame).astype(np.float32)
        cells = self.score(seen).astype(np.float64)
        cells -= 1e-9 * np.arange(len(self.sphere))  # cells that are mirror images may tie; the first of them is taken
        return np.take_along_axis(cells, cells_to(self.sphere)[origin(self.sphere, state, self.frame)], 1)

    def view_values(self, state: EpisodeState) -> Float:
        """Predicted gain of each view less the weighted travel there, (B, V); differences between views count."""
        return self.gains(state) - self.travel_weight * self.sphere.travel[state.current]

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> NDArray[np.int64]:
        """See ``Policy.next_views``."""
        scores = self.view_values(state)
        if self.anywhere:
            return np.where(state.visited, -np.inf, scores).argmax(1)
        rows = np.arange(len(scores))[:, None, None]
        return best_in_window(self.sphere, state, scores[rows, self.sphere.windows[state.current]])
