"""Run networks with ONNX Runtime: the recogniser and map networks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ModelError
from nextview.geometry.viewsphere import ViewSphere
from nextview.recognition.evidence import Evidence
from nextview.recognition.map_names import SPHERE_SUFFIX, maps_among
from nextview.recognition.model_card import (
    FEATURE_NETWORK,
    RECOGNISER,
    ModelCard,
    find_card,
)
from nextview.recognition.network_input import from_observations
from nextview.recognition.novelty import (
    Novelty,
    Quantiles,
    ViewScore,
    novelty_path,
    read_novelty,
)
from nextview.recognition.protocol import Recogniser
from nextview.runtime import InputShape, check_end, open_onnx, ort, run_onnx
from nextview.sensing.observation import Observation
from nextview.types import Float, Float32

INPUT = "input"
BINS_OUTPUT = "sides"
FEATURES_OUTPUT = "features"
EMBEDDING_OUTPUT = "embedding"
"""Ends of ONNX files; "features" are what the last layers of a recogniser make the logits of,
(B, F).
"""


def open_weights(card: ModelCard, threads: int = 0) -> ort.InferenceSession:
    """Open a model's file and check its inputs and outputs against its card.

    Args:
        card: of the model.
        threads: of ONNX Runtime; 0 for one on each core.

    Returns:
        The open network.

    Raises:
        ModelError: the file does not agree with the card.
    """
    session = open_onnx(card.path, card.sha256, threads)
    kind = "tensor(float)" if card.input.kind == "cloud" else "tensor(uint8)"

    ends = {end.name: end for end in session.get_outputs()}
    shapes: dict[str, InputShape] = {"map": (None, 3)} | (
        {"sphere": (None, None)} if card.output == "sphere" else {}
    )
    if card.is_recogniser:
        bins = (
            {BINS_OUTPUT: (len(card.classes), card.azimuth_bins)}
            if card.azimuth_bins
            else {}
        )
        shapes = {"logits": (len(card.classes),), **bins}

    taken = session.get_inputs()
    called = f" called {INPUT}" if card.is_recogniser else ""
    if len(taken) != 1 or (called and taken[0].name != INPUT):
        wants = ", ".join(end.name for end in taken) or "nothing"
        raise ModelError(f"{card.path}: takes {wants}, not one input{called}")

    check_end(card.path, taken[0], kind, card.input.shape)
    for name, shape in shapes.items():
        if name not in ends:
            raise ModelError(f"{card.path}: gives no {name}, which its card promises")
        check_end(card.path, ends[name], "tensor(float)", shape)
    return session


class NetworkRecogniser:
    """Classifies the object in each view, by its shape and, where the camera knows it, by its size.

    ``model`` is the name of a bundled model, or the path of a card, ``threads`` those of ONNX
    Runtime, 0 for one on each core. It discriminates so many ``azimuth_bins``, 0 for none;
    ``novelty`` is None if that was not fitted.
    """

    def __init__(self, model: str | Path = RECOGNISER, threads: int = 0) -> None:
        self.card = find_card(model)
        if not self.card.is_recogniser:
            raise ModelError(
                f"model {self.card.name} is a {self.card.kind}, not a recogniser"
            )

        self.classes = self.card.classes
        self.azimuth_bins = self.card.azimuth_bins
        self.calibration = self.card.calibration
        self._session = open_weights(self.card, threads)
        self._known: Features | None = None
        self._threads = threads
        sha256 = self.card.novelty_sha256
        self.novelty: Quantiles | None = (
            read_novelty(novelty_path(self.card.path), sha256) if sha256 else None
        )

    @property
    def name(self) -> str:
        """What its card calls it."""
        return self.card.name

    def __call__(self, observations: Sequence[Observation]) -> Evidence:
        """Return the evidence of B views from one camera.

        Views in which nothing is seen are marked, see ``Evidence.seen``.
        """
        evidence = replace(
            self.by_shape(observations),
            seen=np.array([o.seen for o in observations]),
        )

        if isinstance(self.novelty, Novelty):
            evidence = replace(
                evidence,
                novelty=[ViewScore(o, self.novelty_scores) for o in observations],
            )

        if self.card.size is None:
            return evidence
        radii = np.array(
            [np.nan if o.radius is None else o.radius for o in observations]
        )
        return replace(evidence, logits=evidence.logits + self.card.size.logits(radii))

    def by_shape(self, observations: Sequence[Observation]) -> Evidence:
        """Return the evidence of B views by shape alone, without their size."""
        return self.from_inputs(from_observations(self.card.input, observations))

    def from_inputs(self, inputs: NDArray[Any]) -> Evidence:
        """Return the evidence by shape alone from prepared inputs.

        Args:
            inputs: what the network takes, (B, ...).

        Returns:
            The evidence of the views.

        Raises:
            ModelError: the network fails.
        """
        names = ["logits"]
        if self.azimuth_bins:
            names.append(BINS_OUTPUT)
        outputs = dict(
            zip(
                names,
                run_onnx(self.card.path, self._session, names, inputs),
                strict=True,
            )
        )
        return Evidence(outputs["logits"], azimuth_bins=outputs.get(BINS_OUTPUT))

    def novelty_scores(self, observations: Sequence[Observation]) -> Float:
        """Return the novelty scores of B views, (B,).

        ModelError if no score was fitted.
        """
        if not isinstance(self.novelty, Novelty):
            raise ModelError(f"{self.card.path}: has no novelty score of views")

        if self._known is None:
            self._known = Features(self._threads)
            known = self.novelty.neighbours.shape[1]
            if known != self._known.size:
                file = novelty_path(self.card.path)
                hint = "run nextview-lab fit unknown again"
                raise ModelError(
                    f"{file}: was fitted to {known} features, not {self._known.size}; {hint}"
                )

        inputs = np.concatenate(
            [from_observations(self._known.card.input, [o]) for o in observations]
        )
        return self.novelty.scores(
            self._known(inputs),
            np.array([o.exact for o in observations]),
        )


class Features:
    """The bundled network without classes; it maps views to embeddings, unit vectors."""

    def __init__(self, threads: int = 0) -> None:
        self.card = find_card(FEATURE_NETWORK)
        self._session = open_onnx(self.card.path, self.card.sha256, threads)

    @property
    def size(self) -> int:
        """How many numbers an embedding has, F."""
        ends = {end.name: end for end in self._session.get_outputs()}
        return int(ends[EMBEDDING_OUTPUT].shape[1])

    def __call__(self, inputs: NDArray[Any]) -> Float32:
        """Embeddings, (B, F) float32, from what the network takes, see ``network_input``."""
        return run_onnx(self.card.path, self._session, [EMBEDDING_OUTPUT], inputs)[0]


class MapNetwork:
    """Predicts the local map around each view.

    Its input is the geometry seen or the partial cloud, as its card says.

    ``rings`` is how many rings of views the map has, and ``azimuths`` how many views on each ring
    that of the whole sphere has; None if its file leaves that open, or without such a map.
    Arguments as of ``NetworkRecogniser``.
    """

    def __init__(self, model: str | Path, threads: int = 0) -> None:
        self.card = find_card(model)
        if self.card.is_recogniser:
            raise ModelError(
                f"model {self.card.name} is a recogniser, not a map network"
            )
        self._session = open_weights(self.card, threads)
        shapes = {end.name: end.shape for end in self._session.get_outputs()}
        self.rings = _fixed(shapes["map"][1])
        whole = shapes["sphere"] if self.card.output == "sphere" else (None,)
        self.azimuths = _fixed(whole[-1])

    def fits(self, sphere: ViewSphere) -> bool:
        """Whether the maps have the views of a sphere."""
        return self.rings in (None, sphere.rings) and self.azimuths in (
            None,
            sphere.azimuths,
        )

    def __call__(self, observations: Sequence[Observation]) -> dict[str, Float32]:
        """Maps of views from one camera, by name: see ``Evidence.maps``."""
        return self.from_inputs(from_observations(self.card.input, observations))

    def from_inputs(self, inputs: NDArray[Any]) -> dict[str, Float32]:
        """The same from what the network takes, see ``network_input``."""
        ends = ["map", "sphere"][: len(self.card.maps)]
        return dict(
            zip(
                self.card.maps,
                run_onnx(self.card.path, self._session, ends, inputs),
                strict=True,
            )
        )


def _fixed(size: int | str | None) -> int | None:
    """Size of an output; None where the file leaves it open."""
    return size if isinstance(size, int) else None


@dataclass(frozen=True)
class Models:
    """The recogniser and the map networks that a policy needs.

    Attributes:
        recogniser: turns views into evidence.
        maps: networks by the name of the local map that they predict.

    Example:
        >>> nextview.load().models.classes[:2]
        ('bathtub', 'bed')
    """

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
        """Return the classes for which the valley of a map is the better view.

        They are indices, as the map's card says; none without that map.
        """
        network = self.maps.get(map_name)
        valleys = () if network is None else network.card.valleys(self.classes)
        return tuple(self.classes.index(c) for c in valleys if c in self.classes)

    def evidence(self, observations: Sequence[Observation]) -> Evidence:
        """Return what the recogniser and the maps say of views from one camera.

        Args:
            observations: B views.

        Returns:
            Their evidence, a row for each view.

        Raises:
            ObservationError: there is no view.
            ModelError: a network fails.
        """
        maps = {
            name: values
            for network in self.maps.values()
            for name, values in network(observations).items()
        }
        return replace(
            self.recogniser(observations),
            maps=maps,
            observations=observations,
        )


def names_of(networks: Mapping[str, MapNetwork]) -> tuple[str, ...]:
    """Names of the maps that some networks predict."""
    return tuple(name for network in networks.values() for name in network.card.maps)


def open_maps(
    cards: Mapping[str, str | Path],
    needs: Sequence[str],
    threads: int = 0,
) -> dict[str, MapNetwork]:
    """Open the networks that predict the maps which a policy needs.

    Args:
        cards: names or paths of cards by the name of the local map.
        needs: of the policy.
        threads: of ONNX Runtime; 0 for one on each core.

    Returns:
        The networks by the name of the local map.

    Raises:
        ModelError: no card predicts one of the maps, or a network cannot be opened.
    """
    wanted = maps_among(needs)
    names = dict.fromkeys(name.removesuffix(SPHERE_SUFFIX) for name in wanted)
    networks = {
        name: MapNetwork(cards[name], threads) for name in names if name in cards
    }
    missing = [name for name in wanted if name not in names_of(networks)]
    if missing:
        known = (name for card in cards.values() for name in find_card(card).maps)
        raise ModelError(
            f"no network predicts the map {missing[0]!r}; there are {', '.join(known)}"
        )
    return networks
