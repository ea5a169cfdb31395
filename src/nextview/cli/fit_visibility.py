"""``nextview fit visibility``: how much a view counts that shows only a part of the object."""

from __future__ import annotations

from pathlib import Path

import tyro


def fit_visibility(
    predictions: tyro.conf.Positional[Path],
    card: tyro.conf.Positional[Path],
    /,
    seed: int = 0,
) -> None:
    """Learn from worlds how much a view counts in which other things hide a part of the object.

    It goes into the calibration of the recogniser's card; nextview predict takes it into predictions made before,
    without predicting again. Where all of an object shows it changes nothing.

    Args:
        predictions: of worlds of the training split (nextview worlds --held-out), with their store where it was.
        card: of the recogniser, after nextview fit calibration.
        seed: decides the walks over which is fitted.
    """
    from nextview.calibration import stages
    from nextview.cli.progress import console

    found = stages.fit_visibility(predictions, card, seed)
    tried = ", ".join(f"{loss:.3f} at {power:g}" for power, loss in found.losses.items())
    console.print(
        f"{found.worlds} worlds: a view counts as the share that shows to the power of {found.power:g}; negative "
        f"log-likelihood over 1 to 5 views {tried}"
    )
