"""The predictions that something may be fitted to: never of the test split, nor of objects the recogniser learned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import takes_paths
from nextview.belief import FixedLength, log_evidence_of
from nextview.data.predictions import SAME, Predictions
from nextview.data.splits import deduplicated, divide
from nextview.episode import run_episodes
from nextview.errors import PredictionsError
from nextview.models.model_card import ModelCard
from nextview.policies.base import Evidence, Policy
from nextview.viewsphere import ViewSphere


@dataclass(frozen=True)
class FittingSet:
    """What an held-out recogniser says of N objects from V views.

    Attributes:
        logits: (N, V, C) float32.
        labels: (N,) int64.
        sphere: the viewpoints.
        classes: names, in the order of the logits.
        azimuth_bins: what it says of the azimuth bins, (N, V, C, azimuth bins) float32, see ``Evidence``; None if it
            cannot tell.
    """

    logits: NDArray[np.float32]
    labels: NDArray[np.int64]
    sphere: ViewSphere
    classes: tuple[str, ...]
    azimuth_bins: NDArray[np.float32] | None = None

    @classmethod
    def of_all(cls, predictions: Predictions) -> FittingSet:
        """All objects of predictions, in their order.

        Raises:
            PredictionsError: there are test objects among them.
        """
        if (predictions.splits == "test").any():
            raise PredictionsError("these predictions hold objects of the test split, to which nothing may be fitted")
        p = predictions
        return cls(p.logits, p.labels, p.sphere, p.classes, p.azimuth_bins)

    @classmethod
    def joined(cls, parts: Sequence[FittingSet]) -> FittingSet:
        """All objects of some sets of the same classes and viewpoints, one set after the other."""
        first, bins = parts[0], [part.azimuth_bins for part in parts if part.azimuth_bins is not None]
        return replace(
            first,
            logits=np.concatenate([part.logits for part in parts]),
            labels=np.concatenate([part.labels for part in parts]),
            azimuth_bins=np.concatenate(bins) if len(bins) == len(parts) else None,
        )

    def __len__(self) -> int:
        return len(self.labels)

    @cached_property
    def log_evidence(self) -> NDArray[np.float32]:
        """All of it, so that views can be summed, (N, V, D); see ``log_evidence_of``."""
        return log_evidence_of(self.logits, self.azimuth_bins, self.sphere.turn)

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """Whether anything was seen in each view, (N, V); see ``Predictions.seen``."""
        return np.ptp(self.logits, axis=2) > SAME

    def of(self, kept: NDArray) -> FittingSet:
        """Some of the objects."""
        azimuth_bins = None if self.azimuth_bins is None else self.azimuth_bins[kept]
        return replace(self, logits=self.logits[kept], labels=self.labels[kept], azimuth_bins=azimuth_bins)

    @property
    def weights(self) -> NDArray[np.float64]:
        """Of the objects, (N,), sum N: every class that there is counts the same, whatever its share."""
        count = np.bincount(self.labels, minlength=len(self.classes))
        return len(self) / ((count > 0).sum() * count[self.labels])


def held_out_by(card: ModelCard, predictions: Predictions) -> NDArray[np.int64]:
    """Objects on which a network was not trained, as its card says, duplicates left out: their indices."""
    once = deduplicated(predictions.labels, predictions.depth_entropy)
    return once[np.isin(np.array(predictions.names)[once], card.held_out)]


@takes_paths(many=("paths",))
def load_sensed(paths: Sequence[Path], table: Predictions) -> list[Predictions]:
    """Predictions of the same objects as seen otherwise, through sensors, in the order of ``table``.

    Args:
        paths: of them.
        table: predictions that tell the objects and their order.

    Raises:
        PredictionsError: one lacks an object, or is of another recogniser, of other classes or viewpoints.
    """
    found = []
    for path in paths:
        other = Predictions.load(path).by_shape()
        row = {name: i for i, name in enumerate(other.names)}
        missing = [name for name in table.names if name not in row]
        if missing:
            raise PredictionsError(f"{path}: lacks {len(missing)} of the {len(table)} objects, {missing[0]} among them")
        if (other.classes, other.sphere, other.models) != (table.classes, table.sphere, table.models):
            raise PredictionsError(f"{path}: is of other models, classes or viewpoints")
        found.append(other.of_objects(np.array([row[name] for name in table.names])))
    return found


def fitting_set(predictions: Predictions, validation: float, seed: int) -> FittingSet:
    """The objects of the training split that the recogniser was not trained on, duplicates left out.

    Args:
        predictions: of the whole training split, as ``nextview predict --split train`` makes them.
        validation: part of every class that was kept out when the recogniser was trained (see ``data.split``); 1 if
            all of them are out of fold: each said by a network that has not seen the object.
        seed: decided which.

    Raises:
        PredictionsError: there are test objects, or none is left.
    """
    data = FittingSet.of_all(predictions)
    if not 0 < validation <= 1:
        raise PredictionsError(f"the validation part lies between 0 and 1, not {validation}")
    _, kept = divide(predictions.labels, predictions.depth_entropy, validation, seed)
    if len(kept) == 0:
        raise PredictionsError("no object is left to fit to")
    return data.of(kept[deduplicated(predictions.labels[kept], predictions.depth_entropy[kept])])


def blind_walks(
    sphere: ViewSphere, policy: Policy, starts: NDArray[np.int64], n_views: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Where a policy goes that looks at nothing but where it has been.

    Args:
        sphere: the viewpoints.
        policy: is shown a uniform belief.
        starts: first views, (E,).
        n_views: how many, at most all views.
        rng: for policies that draw.

    Returns:
        Views in order, (E, views) int64.
    """

    def nothing(episodes: NDArray[np.int64], views: NDArray[np.int64]) -> Evidence:
        return Evidence(np.zeros((len(episodes), 1)))

    return run_episodes(nothing, sphere, policy, starts, FixedLength(max_views=n_views), rng).outcome.views
