"""The predictions that something may be fitted to: never of the test split, nor of objects the recogniser learned."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from nextview.data.predictions import SAME, Predictions
from nextview.data.splits import deduplicated, divide, duplicate_groups
from nextview.data.store import ViewStore
from nextview.errors import DatasetError, ModelError, PredictionsError
from nextview.files import command, only_one
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import Evidence, Policy
from nextview.recognition.belief import FixedLength, log_evidence_of
from nextview.recognition.model_card import ModelCard, read_card, write_card
from nextview.session.episode import run_episodes

Indices = NDArray[np.int64]


def hold_out(labels: Indices, measured: NDArray[np.floating], folds: int, seed: int) -> list[Indices]:
    """Divide objects into parts, each to be held out from one network; every class is spread evenly."""
    if not 2 <= folds <= len(labels):
        raise DatasetError(f"{len(labels)} objects cannot be divided into {folds} folds: there have to be two at least")
    rng = np.random.default_rng([seed, folds])
    group = duplicate_groups(measured)
    first = rng.permutation(np.unique(group, return_index=True)[1])  # one object stands for its group
    first = first[np.argsort(labels[first], kind="stable")]  # dealt out class by class
    fold_of_group = np.empty(len(first), np.int64)
    fold_of_group[group[first]] = np.arange(len(first)) % folds
    return [np.flatnonzero(fold_of_group[group] == k) for k in range(folds)]


@dataclass(frozen=True)
class FittingSet:
    """What a held-out recogniser says of N objects from V views."""

    logits: NDArray[np.float32]  # (N, V, C)
    labels: Indices  # (N,)
    sphere: ViewSphere
    classes: tuple[str, ...]
    azimuth_bins: NDArray[np.float32] | None = None  # (N, V, C, bins)

    @classmethod
    def of_all(cls, predictions: Predictions) -> FittingSet:
        """All objects of predictions, in their order."""
        p = predictions
        if (p.splits == "test").any():
            raise PredictionsError("these predictions hold objects of the test split, to which nothing may be fitted")
        return cls(p.logits, p.labels, p.sphere, p.classes, p.azimuth_bins)

    @classmethod
    def joined(cls, parts: Sequence[FittingSet]) -> FittingSet:
        """All objects of some sets of the same classes and viewpoints, one set after the other."""
        bins = [part.azimuth_bins for part in parts if part.azimuth_bins is not None]
        logits, labels = (np.concatenate([getattr(part, name) for part in parts]) for name in ("logits", "labels"))
        azimuth_bins = np.concatenate(bins) if len(bins) == len(parts) else None
        return replace(parts[0], logits=logits, labels=labels, azimuth_bins=azimuth_bins)

    def __len__(self) -> int:
        return len(self.labels)

    @cached_property
    def log_evidence(self) -> NDArray[np.float32]:
        """Evidence of every view, which can be summed, (N, V, D); see ``log_evidence_of``."""
        return log_evidence_of(self.logits, self.azimuth_bins, self.sphere.azimuth)

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """Whether anything was seen in each view, (N, V)."""
        return np.ptp(self.logits, axis=2) > SAME

    def select(self, kept: NDArray) -> FittingSet:
        """Some of the objects, by index."""
        azimuth_bins = None if self.azimuth_bins is None else self.azimuth_bins[kept]
        return replace(self, logits=self.logits[kept], labels=self.labels[kept], azimuth_bins=azimuth_bins)

    @property
    def weights(self) -> NDArray[np.float64]:
        """Of the objects, (N,), sum N: all classes that occur count the same."""
        count = np.bincount(self.labels, minlength=len(self.classes))
        return len(self) / ((count > 0).sum() * count[self.labels])


def fitting_set(predictions: Predictions, validation: float, seed: int) -> FittingSet:
    """The objects of the training split that the recogniser was not trained on, duplicates left out."""
    data = FittingSet.of_all(predictions)
    if not 0 < validation <= 1:
        raise PredictionsError(f"the validation part lies between 0 and 1, not {validation}")
    _, kept = divide(predictions.labels, predictions.depth_entropy, validation, seed)
    if len(kept) == 0:
        raise PredictionsError("no object is left to fit to")
    return data.select(kept[deduplicated(predictions.labels[kept], predictions.depth_entropy[kept])])


def held_out_by(card: ModelCard, predictions: Predictions) -> Indices:
    """Indices of the objects that a card calls held out of its training, without duplicates."""
    once = deduplicated(predictions.labels, predictions.depth_entropy)
    return once[np.isin(np.array(predictions.names)[once], card.held_out)]


def load_sensed(paths: Sequence[Path], table: Predictions) -> list[Predictions]:
    """Predictions of the objects of ``table`` through sensors, in its order."""
    loaded = []
    for path in paths:
        other = Predictions.load(path).by_shape()
        row = {name: i for i, name in enumerate(other.names)}
        missing = [name for name in table.names if name not in row]
        if missing:
            raise PredictionsError(f"{path}: lacks {len(missing)} of the {len(table)} objects, {missing[0]} among them")
        if (other.classes, other.sphere, other.models) != (table.classes, table.sphere, table.models):
            raise PredictionsError(f"{path}: is of other models, classes or viewpoints")
        loaded.append(other.of_objects(np.array([row[name] for name in table.names])))
    return loaded


def blind_walks(sphere: ViewSphere, policy: Policy, starts: Indices, n_views: int, rng: np.random.Generator) -> Indices:
    """Views in order, (E, views) int64, of a policy that knows only where it has been; ``starts`` is (E,)."""

    def nothing(episodes: Indices, views: Indices) -> Evidence:
        return Evidence(np.zeros((len(episodes), 1)))

    return run_episodes(nothing, sphere, policy, starts, FixedLength(max_views=n_views), rng).outcome.views


@contextmanager
def card_to_fit(path: Path, recogniser: bool = True) -> Iterator[tuple[ModelCard, Callable[..., None]]]:
    """A card and ``write(name, about, sources, **fields)``, for what was fitted to it; only one run fits it.

    ``name`` and ``about`` are an entry of the card's ``fitted_to``; ``sources`` are what it was fitted to.
    """
    with only_one(path):
        card, known = read_card(path), path.read_bytes()
        if recogniser and not card.is_recogniser:
            raise ModelError(f"{path}: is a {card.kind}, not a recogniser")

        def write(name: str, about: str, sources: Sequence[Predictions | ViewStore], **fields: Any) -> None:
            nonlocal known
            fitted = msgspec.structs.replace(card, **fields, fitted_to={**card.fitted_to, name: about})
            lines = (line for source in sources for line in source.commands)
            if path.read_bytes() != known:
                raise ModelError(f"{path}: was changed while this ran, and is left as it is; run the command again")
            write_card(path, fitted.made_by(*lines, command()))
            known = path.read_bytes()

        yield card, write


def check_recogniser(path: Path, card: ModelCard, predictions: Path, table: Predictions) -> None:
    """Refuse predictions by another recogniser than a card's. Those that name none are the user's word."""
    by = table.models.get("recogniser")
    if card.sha256 != by[1] if by else card.classes != table.classes:
        raise PredictionsError(f"{predictions}: comes from another recogniser than {path}")


def described(objects: int) -> str:
    """Words for a card."""
    return f"{objects} objects of the training split, classes weighted evenly"
