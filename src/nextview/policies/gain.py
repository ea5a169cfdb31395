"""Policy that predicts the value of each view and weighs it against the travel.

Its inputs do not depend on the azimuth zero of the object. It knows the ring (from gravity), but
not the absolute azimuth: all views are expressed as cells (see ``policies.learned_tables``),
relative to the camera, or to the estimated azimuth zero of the object. An object and its mirror
image are treated alike.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from nextview.errors import ModelError, PolicyError
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import (
    EpisodeState,
    Scope,
    best_view,
    check_weight,
    considered,
    travel_from,
    visibility_of,
)
from nextview.policies.learned_tables import cells_from, cells_to
from nextview.recognition.map_names import SPHERE_SUFFIX, in_order, maps_among
from nextview.runtime import OnnxFile, check_end, open_onnx, run_onnx
from nextview.types import Float, Float32, Floats, Index

INPUTS = ("belief", "view", "place", "azimuth_bin")
"""Inputs of a network: the belief over all views; the belief from the last view alone; the ring and
the visited views; and the azimuth bin of the current view, for the most likely class and over all
classes. Any other name is that of a map."""
# another input, for scenes: the expected visible share of the object from each view
VISIBILITY = "visibility"
CellFrame = Literal["camera", "object"]
"""Origin of the azimuths of cells: the camera, or the estimated view of azimuth bin 0 of the object
as the most likely class."""
FLOOR = np.log(1e-4)  # lower bound of log-beliefs
FEATURES_INPUT = "told"  # name of the features in the ONNX file


# Features


def maps_of(inputs: Sequence[str]) -> tuple[str, ...]:
    """Return the predicted maps among some inputs, in the order of ``map_names.in_order``."""
    return tuple(in_order(name for name in inputs if name not in (*INPUTS, VISIBILITY)))


def ordered(inputs: Sequence[str]) -> tuple[str, ...]:
    """Sort inputs in the order of ``features``, each once; maps follow the place."""
    *before, azimuth_bin = INPUTS
    return tuple(
        name
        for name in (*before, *maps_of(inputs), azimuth_bin, VISIBILITY)
        if name in inputs
    )


def mirrored(sphere: ViewSphere) -> Index:
    """Return the mirror image of each cell with respect to the camera, (V,) int64."""
    n = sphere.azimuths
    return sphere.ring * n + (-sphere.azimuth_index) % n


def origin(sphere: ViewSphere, state: EpisodeState, frame: CellFrame) -> Index:
    """Return the view at the origin of the cells in each episode.

    Args:
        sphere: the candidate views.
        state: the state of B episodes.
        frame: "camera" for the current view; "object" for the estimated azimuth bin 0.

    Returns:
        The view, (B,) int64.
    """
    if frame == "camera":
        return state.current
    azimuth_bin = _most_believed(state.belief, _bin_belief(sphere, state)).argmax(1)
    n = sphere.azimuths
    return (
        sphere.ring[state.current] * n
        + (sphere.azimuth_index[state.current] - azimuth_bin) % n
    )


def _bin_belief(sphere: ViewSphere, state: EpisodeState) -> Float:
    """Return the belief in the current azimuth bin, for each class, (B, C, azimuths)."""
    if state.azimuth_bins is None or state.azimuth_bins.shape[2] != sphere.azimuths:
        raise PolicyError(
            f"this policy needs a recogniser that discriminates {sphere.azimuths} azimuth bins"
        )
    return state.azimuth_bins


def _most_believed(belief: Float, azimuth_bins: Float) -> Float:
    """Return the azimuth belief of the most likely class, (B, azimuths)."""
    return azimuth_bins[np.arange(len(belief)), belief.argmax(1)]


def features(
    sphere: ViewSphere,
    state: EpisodeState,
    inputs: Sequence[str],
    frame: CellFrame = "camera",
) -> Float:
    """Compute the input of the gain network from the state of episodes.

    The features do not depend on the absolute azimuth, which a robot does not know.

    Args:
        sphere: the candidate views.
        state: the state of B episodes.
        inputs: names of the parts, such as "belief", "view", "place", "azimuth_bin" and maps.
        frame: origin of the cells, "camera" or "object".

    Returns:
        Features, (B, D) float32.
    """
    n = sphere.azimuths
    start = origin(sphere, state, frame)
    ahead = (sphere.azimuth_index[state.current] - sphere.azimuth_index[start]) % n
    rows = np.arange(len(state.current))
    parts: list[NDArray] = []
    if "belief" in inputs:
        parts += _facets(state.belief)
    if "view" in inputs:
        alone = np.exp(
            (
                state.evidence.logits - state.evidence.logits.max(1, keepdims=True)
            ).astype(np.float64)
        )
        parts += _facets(alone / alone.sum(1, keepdims=True))
    if "place" in inputs:
        parts.append(np.eye(sphere.rings)[sphere.ring[state.current]])
        parts.append(state.visited[rows[:, None], cells_from(sphere)[start]])
    for name in maps_of(inputs):
        values = np.asarray(state.evidence.maps[name])
        if name.endswith(SPHERE_SUFFIX):  # columns are relative to the camera
            columns = (np.arange(n) - ahead[:, None]) % n
            values = np.take_along_axis(values, columns[:, None], 2)
        parts.append(values)
    if "azimuth_bin" in inputs:
        parts += [np.eye(n)[ahead]] if frame == "object" else []
        azimuth_bins = _bin_belief(sphere, state)
        for believed in (
            _most_believed(state.belief, azimuth_bins),
            (state.belief[:, :, None] * azimuth_bins).sum(1),
        ):
            parts.append(
                np.take_along_axis(believed, (np.arange(n) + ahead[:, None]) % n, 1)
            )
    if VISIBILITY in inputs:
        parts.append(visibility_of(state)[rows[:, None], cells_from(sphere)[start]])

    return np.concatenate(
        [np.asarray(part, np.float64).reshape(len(rows), -1) for part in parts],
        1,
    )


def _facets(belief: Float) -> list[Float]:
    """Return a belief, its logarithm, and the three highest logarithms in order."""
    logs = np.maximum(np.log(np.maximum(belief, 1e-300)), FLOOR) / -FLOOR + 1
    return [belief, logs, -np.sort(-logs, 1)[:, :3]]


def mirrored_features(
    sphere: ViewSphere,
    classes: int,
    inputs: Sequence[str],
    frame: CellFrame = "camera",
) -> Index:
    """Return the permutation of features for the mirror image of an object.

    Args:
        sphere: the candidate views.
        classes: number of classes.
        inputs: names of the parts, as for ``features``.
        frame: origin of the cells, "camera" or "object".

    Returns:
        Source index of each feature, (D,) int64.
    """
    n = sphere.azimuths
    facets = 2 * classes + min(3, classes)
    window = np.arange(sphere.rings * 3).reshape(-1, 3)[:, ::-1].ravel()

    blocks = {
        "belief": np.arange(facets),
        "view": np.arange(facets),
        "place": np.concatenate(
            [np.arange(sphere.rings), sphere.rings + mirrored(sphere)]
        ),
        "azimuth_bin": np.concatenate(
            [k * n + -np.arange(n) % n for k in range(2 if frame == "camera" else 3)]
        ),
        VISIBILITY: mirrored(sphere),
    } | {
        name: mirrored(sphere) if name.endswith(SPHERE_SUFFIX) else window
        for name in maps_of(inputs)
    }

    chosen = [blocks[name] for name in ordered(inputs)]
    begins = np.cumsum([0, *map(len, chosen)])
    return np.concatenate(
        [begin + block for begin, block in zip(begins, chosen, strict=False)]
    )


# The policy


@dataclass(frozen=True)
class Gain:
    """The unvisited view with the highest predicted value minus weighted travel.

    Small networks, trained on replayed predictions, estimate the belief in the true class after
    each possible next view (``nextview-lab train gain``). This is fitted one-step lookahead, as in
    the value functions for sensor planning of Denzler and Brown, "Information theoretic sensor data
    selection for active object recognition", PAMI 24 (2002), but regressed from the decision state
    instead of simulated. The networks use ``features`` alone.

    Attributes:
        sphere: of the views.
        classes: number of classes, C.
        score: from features, (B, D) float32, to the value of each cell, (B, V): the mean over
            several networks and over the object and its mirror image; rows are bitwise independent.
        inputs: parts of the features.
        travel_weight: of a grid cell, in the unit of the values, which is log-belief for the
            bundled policy.
        scope: views that may be chosen.
        frame: origin of the cells.
    """

    sphere: ViewSphere
    classes: int
    score: Callable[[Float32], Floats]
    inputs: tuple[str, ...]
    travel_weight: float = 0.0
    scope: Scope = "global"
    frame: CellFrame = "camera"

    def __post_init__(self) -> None:
        maps = maps_of(self.inputs)
        # names of other inputs
        unknown = [name for name in maps if name not in maps_among(maps)]
        if unknown or not self.inputs:
            known = ", ".join((*INPUTS, VISIBILITY))
            other = ", ".join(unknown) or "nothing"
            raise PolicyError(
                f"a gain policy takes some of {known} and of the maps that are predicted, not"
                f" {other}"
            )

        check_weight(self.travel_weight)
        if self.frame not in get_args(CellFrame):
            raise PolicyError(
                f"cells are counted from one of {', '.join(get_args(CellFrame))}, not"
                f" {self.frame!r}"
            )

    @property
    def needs(self) -> tuple[str, ...]:
        azimuth_bins = "azimuth_bin" in self.inputs or self.frame == "object"
        others = {"azimuth_bins": azimuth_bins, VISIBILITY: VISIBILITY in self.inputs}
        return (
            *maps_of(self.inputs),
            *(name for name, taken in others.items() if taken),
        )

    def gains(self, state: EpisodeState) -> Float:
        """Return the predicted value of each view, (B, V) float64.

        Only differences between views are meaningful.
        """
        cells = self.score(
            features(self.sphere, state, self.inputs, self.frame).astype(np.float32)
        ).astype(np.float64)
        # cells that are mirror images may tie; the first one is taken
        cells -= 1e-9 * np.arange(len(self.sphere))
        return np.take_along_axis(
            cells,
            cells_to(self.sphere)[origin(self.sphere, state, self.frame)],
            1,
        )

    def view_values(self, state: EpisodeState) -> Float:
        """Return the predicted value of each view minus weighted travel, (B, V)."""
        return self.gains(state) - self.travel_weight * travel_from(self.sphere, state)

    def scores(self, state: EpisodeState) -> Float:
        """Return the gains of the views in scope; see ``ScoresViews``."""
        return considered(self.sphere, state, self.gains(state), self.scope)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the view with the highest predicted gain minus weighted travel.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        return best_view(self.sphere, state, self.view_values(state), self.scope)


@dataclass(frozen=True)
class VisibleGain:
    """The free view with the highest product of visible share and value of an unoccluded view.

    The learned gain is relative to other views. A fully visible view is therefore assumed to
    resolve, on average, the entropy of the belief. Without occlusion the choice is that of the gain
    policy.

    Attributes:
        gain: the policy that values unoccluded views.
        travel_weight: of a grid cell of travel, in the unit of its values.
    """

    gain: Gain
    travel_weight: float = 0.0

    def __post_init__(self) -> None:
        check_weight(self.travel_weight)

    @property
    def sphere(self) -> ViewSphere:
        """The viewpoints."""
        return self.gain.sphere

    @property
    def needs(self) -> tuple[str, ...]:
        return (
            *(name for name in self.gain.needs if name != "visibility"),
            "visibility",
        )

    def scores(self, state: EpisodeState) -> Float:
        """Return the products, (B, V); see ``ScoresViews``."""
        gains = self.gain.gains(state)
        free = state.free
        mean = (gains * free).sum(1, keepdims=True) / np.maximum(
            free.sum(1, keepdims=True),
            1,
        )
        lacking = -(state.belief * np.log(np.maximum(state.belief, 1e-300))).sum(
            1,
            keepdims=True,
        )
        return visibility_of(state) * (lacking + gains - mean)

    def view_values(self, state: EpisodeState) -> Float:
        """Return the products minus weighted travel, (B, V)."""
        return self.scores(state) - self.travel_weight * travel_from(self.sphere, state)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the view with the highest product of visible share and predicted gain.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        return best_view(self.sphere, state, self.view_values(state))


# File format


class GainTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The gain policy's part of a card; attributes as in ``Gain``."""

    classes: int
    inputs: tuple[str, ...]
    travel_weight: float
    frame: CellFrame


def _cells(weights: Path, session: OnnxFile, features: Float32) -> Float32:
    return run_onnx(weights, session, ["cells"], features)[0]


def read_gain(
    sphere: ViewSphere,
    table: GainTable,
    scope: Scope,
    weights: Path,
    sha256: str,
) -> Gain:
    """Open the gain policy of a card.

    Args:
        sphere: the candidate views.
        table: the policy's part of the card.
        scope: "global" for all views, "local" for the local window.
        weights: path of the ONNX file.
        sha256: expected hash of its content.

    Returns:
        The policy.

    Raises:
        ModelError: the file is missing, has another hash, or does not agree with the card.
    """
    session = open_onnx(weights, sha256, threads=1)
    score = partial(_cells, weights, session)
    policy = Gain(
        sphere,
        table.classes,
        score,
        table.inputs,
        table.travel_weight,
        scope,
        table.frame,
    )
    width = len(mirrored_features(sphere, policy.classes, policy.inputs, policy.frame))
    ends = [*session.get_inputs(), *session.get_outputs()]
    if [end.name for end in ends] != [FEATURES_INPUT, "cells"]:
        names = ", ".join(end.name for end in ends)
        raise ModelError(f"{weights}: has {names}, not {FEATURES_INPUT} and cells")
    for end, size in zip(ends, (width, len(sphere)), strict=True):
        check_end(weights, end, "tensor(float)", (size,))
    # If any weight is not finite, the output is NaN for every input.
    score(np.zeros((1, width), np.float32))
    return policy
