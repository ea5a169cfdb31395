"""``nextview fit policies``: the policies that follow a table."""

from __future__ import annotations

from pathlib import Path

import tyro


def fit_policies(
    predictions: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    /,
    validation: float = 0.1,
    split_seed: int = 0,
    length: int = 7,
    n_views: int = 5,
    shrinkage: float = 20.0,
    travel_weight: float = 0.01,
    seed: int = 0,
) -> None:
    """Learn the policies that follow a table: fixed sequence, fixed ring, class table.

    Each in three variants: over the whole sphere (NAME), in the local window (NAME-local), and over the whole sphere at
    a travel weight (NAME-near; a ring has none).

    Args:
        predictions: of the training split (nextview predict --split train).
        out: folder for NAME.json; run one with --policy OUT/NAME.json.
        validation: part of every class that the recogniser was not trained on; 1 for out-of-fold predictions.
        split_seed: the recogniser's seed, which decided which.
        length: moves of the fixed sequence.
        n_views: over which the ring and the class table are chosen.
        shrinkage: objects by whose weight the gains of one believed class are drawn towards those of all.
        travel_weight: of one cell of travel for NAME-near, in units of the logarithm of the belief in the true class.
        seed: decides the walks behind the class table.
    """
    from nextview.calibration import stages
    from nextview.cli.progress import console

    found = stages.fit_policies(
        predictions, out, validation, split_seed, length, n_views, shrinkage, travel_weight, seed
    )
    console.print(f"{len(found.cards)} policies, learned from {found.objects} objects, are in {out}")
