"""``nextview fit``: what is fitted to predictions or stored views, without torch."""

from __future__ import annotations

from pathlib import Path

import tyro


def fit_calibration(
    predictions: tyro.conf.Positional[Path],
    card: tyro.conf.Positional[Path],
    /,
    validation: float | None = None,
    split_seed: int = 0,
    sensed: tuple[Path, ...] = (),
    delta: float = 0.1,
    seed: int = 0,
) -> None:
    """Calibrate a recogniser: how far to trust the sum of several views, and which error rates can be promised.

    Both go into its card; nextview predict takes them into predictions made before, without predicting again. How large
    the objects are is left aside.

    Args:
        predictions: of the training split (nextview predict --held-out, or --split train).
        card: of the recogniser; "calibration" is written into it. Those objects are taken that it calls held out.
        validation: take this part of every class instead, as training kept it out of the whole split; 1 for
            out-of-fold predictions. A card that names no held-out objects needs it.
        split_seed: the recogniser's seed, which decided that part.
        sensed: predictions of the same objects through sensors (nextview render --sensor mix), to be fitted to as well.
        delta: how often a promised error rate may not hold.
        seed: decides the walks over which is fitted.
    """
    from nextview.calibration import stages
    from nextview.cli.progress import console

    found = stages.fit_calibration(predictions, card, validation, split_seed, delta, seed, sensed)
    console.print(
        f"{found.objects} objects: temperature of one view {found.calibration.temperature}, correlation of two views "
        f"{found.calibration.correlation}; negative log-likelihood over 1 to 5 views {found.before:.3f} before, "
        f"{found.after:.3f} after"
    )


def fit_size(
    store: tyro.conf.Positional[Path],
    predictions: tyro.conf.Positional[Path],
    card: tyro.conf.Positional[Path],
    /,
) -> None:
    """Tell a recogniser how large the objects of each class are, for stores and cameras that know it.

    It goes into its card; nextview predict takes it into predictions made before, without predicting again.

    Args:
        store: view store that knows the unit of its meshes (nextview render --unit); its training objects teach, except
            those in the predictions.
        predictions: of training objects that the recogniser has not seen (nextview predict --held-out); they decide how
            much the size counts beside the shape.
        card: of the recogniser; "size" is written into it.
    """
    from nextview.calibration import stages
    from nextview.cli.progress import console

    found = stages.fit_size(store, predictions, card)
    console.print(
        f"sizes of {found.objects} objects; by {found.weighed_on} others, weight beside the logits "
        f"{found.size.weight:.2f}; negative log-likelihood of single views {found.before:.3f} by shape alone, "
        f"{found.after:.3f} with the size"
    )


def fit_valleys(
    predictions: tyro.conf.Positional[Path],
    card: tyro.conf.Positional[Path],
    /,
) -> None:
    """Choose the classes for which the valley of a predicted map is the better view than its peak.

    They go into the map network's card; nextview predict takes them into predictions made before, without predicting
    again.

    Args:
        predictions: of the training split; those of objects are taken that the map network was not trained on. Let
            neither be the recogniser (nextview predict --held-out).
        card: of the map network; "valley_classes" is written into it.
    """
    from nextview.calibration import stages
    from nextview.cli.progress import console

    found = stages.fit_valleys(predictions, card)
    console.print(f"{found.objects} objects: the valley is better for {', '.join(found.classes) or 'no class'}")
