"""Learn the tables of ``nextview.policies.learned_tables``: those after whose views the true class
is believed most.

python -m research.fit_policies predictions.npz policies [--validation-share 1] [--travel-weight
0.01] ...
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tyro
from numpy.typing import NDArray

from nextview.cli.exit_status import orderly_end
from nextview.errors import UsageError
from nextview.files import check_new, command, sha256_of
from nextview.policies.base import Scope
from nextview.policies.learned_tables import FixedRing, cells_from, cells_to
from nextview.policies.policy_card import LearnedFrom, PolicyCard, write_policy_card
from nextview.recognition.belief import Calibration, of_true_class
from nextview_lab.data.predictions import Predictions
from nextview_lab.data.splits import divide
from nextview_lab.errors import PredictionsError
from nextview_lab.training.card_fits import calibration_of
from nextview_lab.training.fitting_set import blind_walks, for_fitting

Float = NDArray[np.float64]
VARIANTS: tuple[tuple[str, Scope], ...] = (
    ("", "global"),
    ("-local", "local"),
    ("-near", "global"),
)
KINDS = ("fixed-sequence", "class-table", "fixed-ring")
NAMES = [
    f"{kind}{suffix}"
    for suffix, _ in VARIANTS
    for kind in KINDS
    if (kind, suffix) != ("fixed-ring", "-near")
]


@dataclass(frozen=True)
class FittedPolicies:
    """What ``fit_policies`` wrote."""

    cards: tuple[Path, ...]
    objects: int


def fit_policies(
    predictions: Path,
    out: Path,
    validation_share: float = 0.1,
    split_seed: int = 0,
    length: int = 7,
    max_views: int = 5,
    shrinkage: float = 20.0,
    travel_weight: float = 0.01,
    seed: int = 0,
    overwrite: bool = False,
) -> FittedPolicies:
    """Learn the policies that follow a table: fixed sequence, fixed ring, class table.

    Each over the whole sphere (NAME), in the local window (NAME-local), and at a travel weight
    (NAME-near; no ring).

    Args:
        predictions: of the training split (nextview-lab predict --split train).
        out: folder for NAME.json; run one with --policy OUT/NAME.json.
        validation_share: part of every class that the recogniser was not trained on; 1 for
            out-of-fold predictions.
        split_seed: the recogniser's seed, which decided which.
        length: moves of the fixed sequence.
        max_views: over which the ring and the class table are chosen.
        shrinkage: objects by whose weight the gains of one believed class are drawn towards those
            of all.
        travel_weight: of one cell of travel for NAME-near, in units of the logarithm of the belief
            in the true class.
        seed: of the walks behind the class table.
        overwrite: replace cards of these names.

    Raises:
        UsageError, PredictionsError, ResultsError: arguments without sense, nothing to fit to, or a
            card that exists.
    """
    if length < 1 or max_views < 2 or shrinkage < 0 or travel_weight < 0:
        raise UsageError(
            "length has to be at least 1, views at least 2, shrinkage and travel weight not"
            " negative"
        )
    cards = {name: out / f"{name}.json" for name in NAMES}
    for path in cards.values():
        check_new(path, overwrite)
    table = Predictions.load(predictions)
    data = fitting_set(table, validation_share, split_seed)
    calibration = calibration_of(
        data,
        np.random.default_rng([seed, 0]),
        walks=1 + 8000 // len(data),
    )
    values = fit_class_table(
        data,
        max_views,
        shrinkage,
        calibration,
        np.random.default_rng(seed),
    )
    settings = {
        "length": length,
        "n_views": max_views,
        "shrinkage": shrinkage,
        "seed": seed,
    }
    for suffix, scope in VARIANTS:
        settings["travel_weight"] = travel_weight if suffix == "-near" else 0.0
        card = PolicyCard(
            "fixed-ring",
            scope,
            table.sphere.elevations,
            table.sphere.azimuths,
            table.classes,
            {},
            f"{len(data)} objects of the training split, classes weighted evenly",
            (LearnedFrom(sha256_of(predictions), table.models),),
            ((calibration.temperature, calibration.correlation),),
            settings,
            (*table.commands, command()),
        )
        for kind, entries in _tables(data, calibration, card, values).items():
            if (name := f"{kind}{suffix}") in cards:
                write_policy_card(
                    cards[name],
                    msgspec.structs.replace(card, kind=kind, table=entries),
                    overwrite=True,
                )
    return FittedPolicies(tuple(cards.values()), len(data))


def fitting_set(predictions: Predictions, validation: float, seed: int) -> Predictions:
    """The objects of the training split that the recogniser was not trained on, duplicates left
    out.
    """
    for_fitting(predictions)
    if not 0 < validation <= 1:
        raise PredictionsError(
            f"the validation part lies between 0 and 1, not {validation}"
        )
    _, kept = divide(predictions.labels, predictions.depth_entropy, validation, seed)
    if len(kept) == 0:
        raise PredictionsError("no object is left to fit to")
    return predictions.of_objects(kept).deduplicate()


def _tables(
    data: Predictions,
    calibration: Calibration,
    card: PolicyCard,
    values: Float,
) -> dict[str, dict[str, Any]]:
    """The tables of a scope and travel weight, by the kinds of their cards; ``values`` are those
    of the class table.
    """
    length, n_views, paid = (
        card.settings[name] for name in ("length", "n_views", "travel_weight")
    )
    travel = data.sphere.travel[:: data.sphere.azimuths]  # from each ring to each cell
    ring, steps = fit_ring(data, card.scope, n_views, calibration)
    return {
        "fixed-sequence": {
            "moves": fit_sequence(data, card.scope, length, calibration, paid).tolist()
        },
        "class-table": {"values": np.round(values - paid * travel, 5).tolist()},
        "fixed-ring": {"ring": ring, "steps": steps},
    }


def log_belief(
    data: Predictions,
    calibration: Calibration,
    total: NDArray[np.floating],
    n_views: int,
) -> Float:
    """Logarithm of the belief in the true class, (N, ...), after so many views with that sum,
    (N, ..., D).
    """
    return of_true_class(
        calibration.log_belief(total, n_views, len(data.classes)),
        data.labels,
    )


def fit_sequence(
    data: Predictions,
    scope: Scope,
    length: int,
    calibration: Calibration,
    travel_weight: float = 0.0,
) -> NDArray[np.int64]:
    """The greedily best moves from each ring, for all objects and azimuths together: (rings,
    length) cells, int64.
    """
    sphere = data.sphere
    moves = []
    for starts in np.arange(len(sphere)).reshape(sphere.rings, -1):
        # of each cell, (azimuths, V)
        path = [int(starts[0])]
        view = cells_from(sphere)[starts]
        total = data.log_evidence[:, view[:, path[0]]].astype(np.float64)
        for k in range(2, min(length, len(sphere) - 1) + 2):
            reachable = (
                np.arange(len(sphere))
                if scope == "global"
                else sphere.windows[path[-1]].ravel()
            )
            free = np.setdiff1d(reachable, path)
            free = free if len(free) else np.setdiff1d(np.arange(len(sphere)), path)
            beliefs = [
                log_belief(
                    data,
                    calibration,
                    total + data.log_evidence[:, view[:, v]],
                    k,
                ).mean(1)
                for v in free
            ]
            value = (
                np.array(beliefs) @ data.weights / len(data)
                - travel_weight * sphere.travel[path[-1], free]
            )
            path.append(int(free[np.argmax(value)]))
            total += data.log_evidence[:, view[:, path[-1]]]
        moves.append(cells_to(sphere)[path[:-1], path[1:]])
    return np.array(moves)


def fit_ring(
    data: Predictions,
    scope: Scope,
    n_views: int,
    calibration: Calibration,
) -> tuple[int, int]:
    """The best ring to go to and the azimuth steps along it, over all starts, after 2 to
    ``n_views`` views.
    """
    sphere = data.sphere
    n_views = min(n_views, len(data.sphere))

    def value(walk: tuple[int, int]) -> float:
        # nothing is drawn
        policy = FixedRing(sphere, *walk)
        rng = np.random.default_rng(0)
        total = np.zeros(data.log_evidence.shape)
        sum_over_views = 0.0
        for k, views in enumerate(
            blind_walks(sphere, policy, np.arange(len(sphere)), n_views, rng).T,
            1,
        ):
            total += data.log_evidence[:, views]
            if k > 1:
                sum_over_views += float(
                    data.weights @ log_belief(data, calibration, total, k).mean(1)
                )
        return sum_over_views

    steps = range(1, sphere.azimuths // 2 + 1) if scope == "global" else (1,)
    return max(
        ((ring, step) for ring in range(sphere.rings) for step in steps),
        key=value,
    )


def fit_class_table(
    data: Predictions,
    n_views: int,
    shrinkage: float,
    calibration: Calibration,
    rng: np.random.Generator,
    walks: int = 8,
) -> Float:
    """Mean gain of views 2 to ``n_views`` by believed class, current ring and cell: (classes,
    rings, V) float64.
    """
    sphere = data.sphere
    c = len(data.classes)
    n = len(data)
    gains = np.zeros((c, sphere.rings, len(sphere)))
    weight = np.zeros((c, sphere.rings, len(sphere)))
    cell = cells_to(sphere)
    for _ in range(walks):
        walk = rng.permuted(np.tile(np.arange(len(sphere)), (n, 1)), axis=1)
        total = np.zeros((n, data.log_evidence.shape[2]))
        for k in range(1, min(n_views, len(sphere))):
            current = walk[:, k - 1]
            total += data.log_evidence[np.arange(n), current]
            now = log_belief(data, calibration, total, k)
            after = log_belief(
                data,
                calibration,
                total[:, None] + data.log_evidence,
                k + 1,
            )
            free = np.ones((n, len(sphere)), bool)
            free[np.arange(n)[:, None], walk[:, :k]] = False
            believed = calibration.log_belief(total, k, c).argmax(1)
            at = (believed[:, None], sphere.ring[current][:, None], cell[current])
            each = free * data.weights[:, None]
            np.add.at(gains, at, each * (after - now[:, None]))
            np.add.at(weight, at, each)
    shared = gains.sum(0) / np.maximum(weight.sum(0), 1e-12)
    # A cell is met once in so many views of a walk: what one object weighs in the sums over all
    # walks.
    met = walks * (min(n_views, len(sphere)) - 1) / sphere.rings
    return (gains + shrinkage * met * shared) / np.maximum(
        weight + shrinkage * met,
        1e-12,
    )


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        found = tyro.cli(fit_policies, config=(tyro.conf.PositionalRequiredArgs,))
        print(
            f"{found.objects} objects: run one of these with --policy:"
            f" {', '.join(map(str, found.cards))}"
        )
