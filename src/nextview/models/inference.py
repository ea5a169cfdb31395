"""Run the networks with ONNX Runtime."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from nextview.belief import Calibration
from nextview.errors import ModelError, ObservationError
from nextview.models.cloud_input import cloud_input
from nextview.models.geometry_input import geometry_input
from nextview.models.image_input import image_input
from nextview.models.model_card import Card, find_card
from nextview.models.onnx_file import open_onnx
from nextview.models.size_evidence import SizeEvidence
from nextview.observation import Observation
from nextview.policies.base import Evidence, maps_among

RECOGNISER = "recogniser-modelnet10"
BINS_OUTPUT = "sides"
"""The name that the azimuth bins have in a recogniser's ONNX file."""
MAPS = {"lem": "lem-modelnet10", "lcm": "lcm-modelnet10"}


def open_weights(card: Card, threads: int = 0) -> ort.InferenceSession:
    """Check a model's hash and hand it to ONNX Runtime.

    Args:
        card: the model.
        threads: of ONNX Runtime, 0 for one on each core.

    Raises:
        ModelError: the file is not the one that the card describes, or ONNX Runtime refuses it.
    """
    try:
        return open_onnx(card.path, card.sha256, threads)
    except ModelError as error:
        raise ModelError(str(error)) from None


def sight(card: Card) -> tuple[str, int]:
    """What a network sees, "geometry", "image" or "cloud", and the side of its image in pixels, 0 for clouds.

    Cards that do not say it are of the first recognisers, which see geometry, and of the first maps, which see clouds.
    """
    return card.facts.get("sees", "geometry" if card.kind == "recogniser" else "cloud"), card.facts.get("input_size", 0)


def knows_sphere(card: Card) -> bool:
    """Whether a map network predicts all views of the sphere, not those of the local window alone."""
    return card.facts.get("around") == "sphere"


def see(observations: Sequence[Observation], sees: str, size: int) -> NDArray[Any]:
    """What a network sees of views from one camera.

    Args:
        observations: B views.
        sees: "geometry", "image" or "cloud".
        size: side of the network's image, pixels; clouds have none.

    Returns:
        Geometry (B, 4, size, size) or image (B, 1, size, size), uint8; or clouds (B, 1024, 3) float32.

    Raises:
        ObservationError: they are not from one camera, or their image does not suit the network.
    """
    first = observations[0]
    for other in observations[1:]:
        if other.depth.shape != first.depth.shape or not np.array_equal(other.intrinsics, first.intrinsics):
            raise ObservationError("views that are handed in together are from one camera: of one size and one pinhole")
    poses = np.stack([o.pose for o in observations])
    if sees == "cloud":
        return cloud_input(np.stack([o.points for o in observations]), poses)
    if sees == "image":
        return image_input(np.stack([o.picture for o in observations]), size)
    return geometry_input(np.stack([o.depth for o in observations]), poses, first.intrinsics, size)


def size_evidence(card: Card) -> SizeEvidence | None:
    """What a recogniser's card says of sizes; None if nothing.

    Raises:
        ModelError: it makes no sense.
    """
    facts = card.facts.get("size")
    try:
        return None if facts is None else SizeEvidence.of_facts(facts, len(card.facts["classes"]))
    except ValueError as error:
        raise ModelError(f"{card.path.with_suffix('.json')}: {error}") from None


class Recogniser:
    """Names the object in each view, by what is seen and, where the camera knows it, by how large the object is.

    ``azimuth bins`` is how many azimuth bins of the object it tells apart, 0 if it was not taught to.

    Args:
        model: name of a bundled model, or path of a card.
        threads: of ONNX Runtime, 0 for one on each core.
    """

    def __init__(self, model: str | Path = RECOGNISER, threads: int = 0) -> None:
        self.card = find_card(model)
        if self.card.kind != "recogniser":
            raise ModelError(f"model {self.card.name} is a {self.card.kind}, not a recogniser")
        self.classes: tuple[str, ...] = tuple(self.card.facts["classes"])
        self.sees = sight(self.card)
        self.azimuth_bins: int = self.card.facts.get("azimuth_bins", 0)
        self._size = size_evidence(self.card)
        try:
            self.calibration = Calibration.of_facts(self.card.facts.get("calibration"))
        except ValueError as error:
            raise ModelError(f"{self.card.path.with_suffix('.json')}: {error}") from None
        self._session = open_weights(self.card, threads)

    def __call__(self, observations: Sequence[Observation]) -> Evidence:
        """Evidence of B views from one camera: logits, and azimuth bins if it knows them.

        Views in which nothing is seen are marked and carry none, see ``Evidence.seen``.
        """
        evidence = replace(
            self.from_inputs(see(observations, *self.sees)), seen=np.array([o.seen for o in observations])
        )
        if self._size is None:
            return evidence
        radii = np.array([np.nan if o.radius is None else o.radius for o in observations])
        return replace(evidence, logits=evidence.logits + self._size.logits(radii))

    def from_inputs(self, inputs: NDArray[Any]) -> Evidence:
        """The same by what is seen alone, see ``see``."""
        logits, *azimuth_bins = self._session.run(
            ["logits", BINS_OUTPUT] if self.azimuth_bins else ["logits"], {"input": inputs}
        )
        return Evidence(logits, azimuth_bins=azimuth_bins[0] if azimuth_bins else None)


class MapNetwork:
    """Predicts the local map around each view from the geometry seen, or from its partial cloud, as its card says.

    Args:
        model: name of a bundled model, or path of a card.
        threads: of ONNX Runtime, 0 for one on each core.
    """

    def __init__(self, model: str | Path, threads: int = 0) -> None:
        self.card = find_card(model)
        if self.card.kind == "recogniser":
            raise ModelError(f"model {self.card.name} is a recogniser, not a map network")
        self.sees = sight(self.card)
        self.valley_classes: tuple[str, ...] = tuple(self.card.facts.get("valley_classes", ()))
        self._session = open_weights(self.card, threads)

    def __call__(self, observations: Sequence[Observation]) -> dict[str, NDArray[np.float32]]:
        """Maps of views from one camera, by name.

        The local one, (B, rings, 3), columns azimuth -1, 0, +1, has the name of the card's kind ("lem"). If the network
        knows it, that of the sphere, (B, rings, azimuths), columns azimuth 0, 1, ... from here, is NAME-sphere.
        """
        return self.from_inputs(see(observations, *self.sees))

    def from_inputs(self, seen: NDArray[Any]) -> dict[str, NDArray[np.float32]]:
        """The same from what is seen, see ``see``."""
        names = {"map": self.card.kind} | ({"sphere": f"{self.card.kind}-sphere"} if knows_sphere(self.card) else {})
        found = self._session.run(list(names), {self._session.get_inputs()[0].name: seen})
        return dict(zip(names.values(), found, strict=True))


@dataclass(frozen=True)
class Models:
    """The recogniser and the map networks that a policy needs."""

    recogniser: Recogniser
    maps: dict[str, MapNetwork]

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the logits."""
        return self.recogniser.classes

    def valley_classes(self, map_name: str) -> tuple[int, ...]:
        """Classes (indices) for which a map's valley is the better view, as its card says; none without that map."""
        network = self.maps.get(map_name)
        return (
            () if network is None else tuple(self.classes.index(c) for c in network.valley_classes if c in self.classes)
        )

    def evidence(self, observations: Sequence[Observation]) -> Evidence:
        """What the models say of views from one camera."""
        maps = {name: values for network in self.maps.values() for name, values in network(observations).items()}
        return replace(self.recogniser(observations), maps=maps)


def load_models(maps: Sequence[str] = ("lem",), recogniser: str | Path = RECOGNISER, threads: int = 0) -> Models:
    """The bundled recogniser, or the one whose card is given, and the bundled map networks of the given names.

    The names may be a policy's needs: "azimuth bins" takes no network beside the recogniser.

    Raises:
        ModelError: a model is missing, damaged or of the wrong kind.
    """
    names = list(dict.fromkeys(name.removesuffix("-sphere") for name in maps_among(maps)))
    unknown = [name for name in names if name not in MAPS]
    if unknown:
        raise ModelError(f"no map is called {unknown[0]!r}; there are {', '.join(MAPS)}")
    return Models(Recogniser(recogniser, threads), {name: MapNetwork(MAPS[name], threads) for name in names})
