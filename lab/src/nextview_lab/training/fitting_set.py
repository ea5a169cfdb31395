"""Predictions for fits, which never contain the test split or the recogniser's training objects."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from nextview.errors import DatasetError, ModelError
from nextview.files import command, only_one
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import Evidence, Policy
from nextview.recognition.belief import FixedLength
from nextview.recognition.model_card import ModelCard, read_card, write_card
from nextview.session.episode import run_episodes
from nextview.types import Floats, Index
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.splits import duplicate_groups
from nextview_lab.data.store import ViewStore
from nextview_lab.errors import PredictionsError


def hold_out(labels: Index, measured: Floats, folds: int, seed: int) -> list[Index]:
    """Divide objects into parts, each of which is held out from one network.

    Every class is spread evenly; copies of a shape stay together.

    Args:
        labels: class of each object, (N,).
        measured: depth entropy of the views, (N, V), which identifies copies.
        folds: number of parts.
        seed: of the random division.

    Returns:
        Index of the objects of each part.

    Raises:
        DatasetError: there are fewer objects than parts, or fewer than two parts.
    """
    if not 2 <= folds <= len(labels):
        raise DatasetError(
            f"{len(labels)} objects cannot be divided into {folds} folds: two folds and as many"
            " objects are needed at least"
        )
    rng = np.random.default_rng([seed, folds])
    group = duplicate_groups(measured)
    # one object represents its group
    first = rng.permutation(np.unique(group, return_index=True)[1])
    first = first[
        np.argsort(labels[first], kind="stable")
    ]  # distributed class by class
    fold_of_group = np.empty(len(first), np.int64)
    fold_of_group[group[first]] = np.arange(len(first)) % folds
    return [np.flatnonzero(fold_of_group[group] == k) for k in range(folds)]


def for_fitting(predictions: Predictions) -> Predictions:
    """Return the predictions; PredictionsError if they contain objects of the test split."""
    if (predictions.splits == "test").any():
        raise PredictionsError(
            "these predictions hold objects of the test split, to which nothing may be fitted"
        )
    return predictions


def load_sensed(paths: Sequence[Path], table: Predictions) -> list[Predictions]:
    """Load predictions of the same objects through sensors.

    Args:
        paths: of the predictions.
        table: predictions of the objects.

    Returns:
        The predictions, in the order of ``table``.

    Raises:
        PredictionsError: an object is missing, or models, classes or viewpoints differ.
    """
    loaded = []
    for path in paths:
        other = Predictions.load(path).by_shape()
        row = {name: i for i, name in enumerate(other.names)}

        missing = [name for name in table.names if name not in row]
        if missing:
            raise PredictionsError(
                f"{path}: lacks {len(missing)} of the {len(table)} objects, {missing[0]} among them"
            )

        if (other.classes, other.sphere, other.models) != (
            table.classes,
            table.sphere,
            table.models,
        ):
            raise PredictionsError(f"{path}: is of other models, classes or viewpoints")

        loaded.append(other.of_objects(np.array([row[name] for name in table.names])))
    return loaded


def blind_walks(
    sphere: ViewSphere,
    policy: Policy,
    starts: Index,
    n_views: int,
    rng: np.random.Generator,
) -> Index:
    """Return the views of a policy that uses only its previous views.

    Args:
        sphere: the viewpoints.
        policy: the policy.
        starts: first views, (E,) int64.
        n_views: views of each walk.
        rng: source of all random numbers.

    Returns:
        Views in order, (E, n_views) int64.
    """

    def nothing(episodes: Index, views: Index) -> Evidence:
        return Evidence(np.zeros((len(episodes), 1)))

    return run_episodes(
        nothing,
        sphere,
        policy,
        starts,
        FixedLength(max_views=n_views),
        rng,
    ).outcome.views


@contextmanager
def card_to_fit(
    path: Path,
    recogniser: bool = True,
) -> Iterator[tuple[ModelCard, Callable[..., None]]]:
    """Open a card for a fit, with a lock against other runs.

    Args:
        path: of the card.
        recogniser: whether it must be the card of a recogniser.

    Yields:
        The card, and ``write(name, about, sources, **fields)``, which writes the result of a fit to
        sources.

    Raises:
        ModelError: the card is of another kind, or was changed meanwhile.
    """
    with only_one(path):
        card = read_card(path)
        known = path.read_bytes()
        if recogniser and not card.is_recogniser:
            raise ModelError(f"{path}: is a {card.kind}, not a recogniser")

        def write(
            name: str,
            about: str,
            sources: Sequence[Predictions | ViewStore],
            **fields: Any,
        ) -> None:
            nonlocal known
            fitted = msgspec.structs.replace(
                card,
                **fields,
                fitted_to={**card.fitted_to, name: about},
            )
            lines = (line for source in sources for line in source.commands)
            if path.read_bytes() != known:
                raise ModelError(
                    f"{path}: was changed while this ran, and is left as it is; run the command"
                    " again"
                )
            write_card(path, fitted.made_by(*lines, command()))
            known = path.read_bytes()

        yield card, write
