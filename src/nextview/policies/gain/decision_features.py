"""What the gain policy is given to decide by: numbers that do not depend on where the object's azimuth zero is.

It knows the ring (from gravity), never the absolute azimuth: all views are written as cells (see
``policies.learned_tables``) seen from where the camera stands, or from where the recogniser believes the object's own
zero to be. An object and its mirror image are taken to be alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nextview.errors import PolicyError
from nextview.measures.map_names import SPHERE, in_order
from nextview.policies.base import EpisodeState, visibility_of
from nextview.policies.learned_tables import cells_from
from nextview.viewsphere import ViewSphere

Float = NDArray[np.float64]

INPUTS = ("belief", "view", "place", "azimuth_bin")
"""What a network may take: the belief over all views; what the last view alone says; the ring and the views that are
visited; and which azimuth bin of the object is seen, if it is of the class that is believed most, and over all classes.
Any other name is that of a map that was predicted from the last view: of the local window, or of the whole sphere where
it ends in "-sphere"."""

VISIBILITY = "visibility"
"""One more input, for worlds: the share of the object that is expected to show from each view."""

Frame = Literal["camera", "object"]
"""From where the azimuths of cells are counted: from the camera's, or from that at which the object, if it is of the
class that is believed most, in all likelihood shows its azimuth bin 0."""

FLOOR = np.log(1e-4)
"""Beliefs below this are taken for it: nobody knows such small ones."""


def maps_of(inputs: Sequence[str]) -> tuple[str, ...]:
    """The predicted maps among some inputs, in the order of ``map_names.in_order``."""
    return tuple(in_order(name for name in inputs if name not in (*INPUTS, VISIBILITY)))


def ordered(inputs: Sequence[str]) -> tuple[str, ...]:
    """Some inputs, each once, in the order of ``features``, whatever theirs: the maps stand behind the place."""
    *before, azimuth_bin = INPUTS
    return tuple(name for name in (*before, *maps_of(inputs), azimuth_bin, VISIBILITY) if name in inputs)


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
    azimuth_bin = _own(state.belief, _bin_belief(sphere, state)).argmax(1)
    n = sphere.azimuths
    return sphere.ring[state.current] * n + (sphere.azimuth_index[state.current] - azimuth_bin) % n


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
    """What a network takes of B episodes, none of it depending on the absolute azimuth.

    Args:
        sphere: the viewpoints.
        state: the episodes.
        inputs: some of INPUTS, VISIBILITY and maps; their order does not matter, see ``ordered``.
        frame: in which cells are counted.

    Returns:
        (B, D) float64.

    Raises:
        PolicyError: the azimuth bins matter, and the recogniser does not tell as many apart as the sphere has azimuths;
            or what shows matters and is not told.
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
    for name in maps_of(inputs):
        values = np.asarray(state.evidence.maps[name])
        if name.endswith(SPHERE):  # its columns are counted from the camera
            columns = (np.arange(n) - ahead[:, None]) % n
            values = np.take_along_axis(values, columns[:, None], 2)
        parts.append(values)
    if "azimuth_bin" in inputs:
        parts += [np.eye(n)[ahead]] if frame == "object" else []
        azimuth_bins = _bin_belief(sphere, state)
        for believed in (_own(state.belief, azimuth_bins), (state.belief[:, :, None] * azimuth_bins).sum(1)):
            parts.append(np.take_along_axis(believed, (np.arange(n) + ahead[:, None]) % n, 1))
    if VISIBILITY in inputs:
        parts.append(visibility_of(state)[rows[:, None], cells_from(sphere)[start]])
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
    blocks |= {name: mirrored(sphere) if name.endswith(SPHERE) else window for name in maps_of(inputs)}
    n = sphere.azimuths
    blocks["azimuth_bin"] = np.concatenate([k * n + -np.arange(n) % n for k in range(2 if frame == "camera" else 3)])
    blocks[VISIBILITY] = mirrored(sphere)
    found, begin = [], 0
    for name in ordered(inputs):
        found.append(begin + blocks[name])
        begin += len(blocks[name])
    return np.concatenate(found)
