"""Run the networks with ONNX Runtime."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from nextview.errors import ModelError
from nextview.measures.map_names import LCM, LEM, SPHERE
from nextview.models.model_card import ModelCard, find_card
from nextview.models.network_input import from_observations
from nextview.models.onnx_file import check_end, check_input, open_onnx, run_onnx
from nextview.novelty import novelty_path, read_novelty
from nextview.observation import Observation
from nextview.occupancy import shown_share
from nextview.policies.base import Evidence, maps_among

RECOGNISER = "recogniser-modelnet10"
INPUT = "input"
"""The name of what a recogniser takes in its ONNX file."""
BINS_OUTPUT = "sides"
"""The name that the azimuth bins have in a recogniser's ONNX file."""
FEATURES_OUTPUT = "features"
"""The name there of what the last layers make the logits of, (B, F): only the novelty score needs it."""
MAPS = {LEM: "lem-modelnet10", LCM: "lcm-modelnet10"}
"""The map networks that are bundled, by the name of the map."""


def open_weights(card: ModelCard, threads: int = 0) -> ort.InferenceSession:
    """Check a model's file against its card and hand it to ONNX Runtime.

    Args:
        card: the model.
        threads: of ONNX Runtime, 0 for one on each core.

    Raises:
        ModelError: the file is not the one that the card describes, has other inputs or outputs, or ONNX Runtime
            refuses it.
    """
    session = open_onnx(card.path, card.sha256, threads)
    kind = "tensor(float)" if card.input.kind == "cloud" else "tensor(uint8)"
    ends = {end.name: end for end in session.get_outputs()}
    shapes: dict[str, tuple[int | None, ...]]
    if card.is_recogniser:
        shapes = {"logits": (len(card.classes),)}
        if card.azimuth_bins:
            shapes[BINS_OUTPUT] = (len(card.classes), card.azimuth_bins)
        if card.novelty_sha256:
            shapes[FEATURES_OUTPUT] = (None,)
    else:
        shapes = {"map": (None, 3)} | ({"sphere": (None, None)} if card.output == "sphere" else {})
    check_input(card.path, session, INPUT if card.is_recogniser else None, kind, card.input.shape)
    for name, shape in shapes.items():
        if name not in ends:
            raise ModelError(f"{card.path}: gives no {name}, which its card promises")
        check_end(card.path, ends[name], "tensor(float)", shape)
    return session


class Recogniser:
    """Names the object in each view, by what is seen and, where the camera knows it, by how large the object is.

    ``azimuth_bins`` is how many azimuth bins of the object it tells apart, 0 if it was not taught to. ``novelty`` tells
    how strange a view is, see ``nextview.novelty``; None if that was not fitted.

    Args:
        model: name of a bundled model, or path of a card.
        threads: of ONNX Runtime, 0 for one on each core.
    """

    def __init__(self, model: str | Path = RECOGNISER, threads: int = 0) -> None:
        self.card = find_card(model)
        if not self.card.is_recogniser:
            raise ModelError(f"model {self.card.name} is a {self.card.kind}, not a recogniser")
        self.classes = self.card.classes
        self.azimuth_bins = self.card.azimuth_bins
        self.calibration = self.card.calibration
        self._session = open_weights(self.card, threads)
        sha256 = self.card.novelty_sha256
        self.novelty = read_novelty(novelty_path(self.card.path), sha256) if sha256 else None

    def __call__(self, observations: Sequence[Observation]) -> Evidence:
        """Evidence of B views from one camera: logits, and azimuth bins if it knows them.

        Views in which nothing is seen are marked and carry none, see ``Evidence.seen``.
        """
        inputs = from_observations(self.card.input, observations)
        evidence = replace(self.from_inputs(inputs), seen=np.array([o.seen for o in observations]))
        if self.card.size is None:
            return evidence
        radii = np.array([np.nan if o.radius is None else o.radius for o in observations])
        return replace(evidence, logits=evidence.logits + self.card.size.logits(radii))

    def from_inputs(self, inputs: NDArray[Any]) -> Evidence:
        """The same by what is seen alone, see ``network_input``."""
        names = ["logits"] + [BINS_OUTPUT] * bool(self.azimuth_bins) + [FEATURES_OUTPUT] * (self.novelty is not None)
        found = dict(zip(names, run_onnx(self.card.path, self._session, names, inputs), strict=True))
        novelty = None if self.novelty is None else self.novelty.scores(found[FEATURES_OUTPUT])
        return Evidence(found["logits"], azimuth_bins=found.get(BINS_OUTPUT), novelty=novelty)

    def features(self, inputs: NDArray[Any]) -> NDArray[np.float32]:
        """What the last layer makes the logits of, (B, F), see ``network_input``.

        Raises:
            ModelError: the file does not give it.
        """
        if FEATURES_OUTPUT not in [end.name for end in self._session.get_outputs()]:
            raise ModelError(f"{self.card.path}: gives no {FEATURES_OUTPUT}; export the recogniser again")
        return run_onnx(self.card.path, self._session, [FEATURES_OUTPUT], inputs)[0]


class MapNetwork:
    """Predicts the local map around each view from the geometry seen, or from its partial cloud, as its card says.

    ``rings`` is how many rings of views the map has, None if its file leaves that open.

    Args:
        model: name of a bundled model, or path of a card.
        threads: of ONNX Runtime, 0 for one on each core.
    """

    def __init__(self, model: str | Path, threads: int = 0) -> None:
        self.card = find_card(model)
        if self.card.is_recogniser:
            raise ModelError(f"model {self.card.name} is a recogniser, not a map network")
        self._session = open_weights(self.card, threads)
        rings = next(end.shape[1] for end in self._session.get_outputs() if end.name == "map")
        self.rings: int | None = rings if isinstance(rings, int) else None

    def __call__(self, observations: Sequence[Observation]) -> dict[str, NDArray[np.float32]]:
        """Maps of views from one camera, by name.

        The local one, (B, rings, 3), columns azimuth -1, 0, +1, has the name of the card's kind ("lem"). If the network
        knows it, that of the sphere, (B, rings, azimuths), columns azimuth 0, 1, ... from here, is NAME-sphere.
        """
        return self.from_inputs(from_observations(self.card.input, observations))

    def from_inputs(self, inputs: NDArray[Any]) -> dict[str, NDArray[np.float32]]:
        """The same from what the network takes, see ``network_input``."""
        names = self.card.maps
        found = run_onnx(self.card.path, self._session, ["map", "sphere"][: len(names)], inputs)
        return dict(zip(names, found, strict=True))


@dataclass(frozen=True)
class Models:
    """The recogniser and the map networks that a policy needs."""

    recogniser: Recogniser
    maps: dict[str, MapNetwork]

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the logits."""
        return self.recogniser.classes

    @property
    def map_names(self) -> tuple[str, ...]:
        """Names of the maps that the networks predict."""
        return names_of(self.maps)

    def valley_classes(self, map_name: str) -> tuple[int, ...]:
        """Classes (indices) for which a map's valley is the better view, as its card says; none without that map."""
        network = self.maps.get(map_name)
        valleys = () if network is None else network.card.valleys(self.classes)
        return tuple(self.classes.index(c) for c in valleys if c in self.classes)

    def evidence(self, observations: Sequence[Observation]) -> Evidence:
        """What the models say of views from one camera."""
        maps = {name: values for network in self.maps.values() for name, values in network(observations).items()}
        said, shown = self.recogniser(observations), None
        if self.recogniser.calibration.visibility is not None:
            shown = np.array([1.0 if seen.scene is None else shown_share(seen.scene) for seen in observations])
        return replace(said, maps=maps, observations=observations, shown=shown)


def names_of(networks: Mapping[str, MapNetwork]) -> tuple[str, ...]:
    """Names of the maps that some networks predict."""
    return tuple(name for network in networks.values() for name in network.card.maps)


def open_maps(cards: Mapping[str, str | Path], needs: Sequence[str], threads: int = 0) -> dict[str, MapNetwork]:
    """The networks that predict the maps which are needed, by the name of the map of the local window.

    Args:
        cards: of map networks, by that name: names of bundled models, or paths of cards.
        needs: a policy's; those that are no maps take no network.
        threads: of ONNX Runtime, 0 for one on each core.

    Raises:
        ModelError: no network predicts one of the maps, or one is missing, damaged or of the wrong kind.
    """
    wanted = maps_among(needs)
    names = dict.fromkeys(name.removesuffix(SPHERE) for name in wanted)
    networks = {name: MapNetwork(cards[name], threads) for name in names if name in cards}
    missing = [name for name in wanted if name not in names_of(networks)]
    if missing:
        known = (name for card in cards.values() for name in find_card(card).maps)
        raise ModelError(f"no network predicts the map {missing[0]!r}; there are {', '.join(known)}")
    return networks


def load_models(maps: Sequence[str] = (), recogniser: str | Path = RECOGNISER, threads: int = 0) -> Models:
    """The bundled recogniser, or the one whose card is given, and the bundled map networks of the given names.

    The names may be a policy's needs: "azimuth_bins" takes no network beside the recogniser.

    Raises:
        ModelError: a model is missing, damaged or of the wrong kind.
    """
    return Models(Recogniser(recogniser, threads), open_maps(MAPS, maps, threads))
