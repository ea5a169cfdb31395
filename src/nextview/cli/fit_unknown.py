"""``nextview fit unknown``: teach a recogniser to tell objects of no class that it knows."""

from __future__ import annotations

from pathlib import Path

import tyro


def fit_unknown(
    store: tyro.conf.Positional[Path],
    meshes: tyro.conf.Positional[Path],
    card: tyro.conf.Positional[Path],
    /,
    made_up: int = 1700,
    seed: int = 0,
    sensed: tuple[Path, Path] | None = None,
    workers: int | None = None,
) -> None:
    """Teach a recogniser to tell objects of no class that it knows, at a false-alarm rate that can be chosen.

    What it finds goes into NAME.novelty.safetensors beside the card, and its SHA-256 into the card. Nothing is learned
    from the test split.

    Args:
        store: view store of the recogniser's training objects.
        meshes: folder of their meshes; objects of no class are made up of these.
        card: of the recogniser; the objects that it calls held out decide the false-alarm rate.
        made_up: so many objects.
        seed: of all that is drawn.
        sensed: stores of the objects that it learned and of those that it holds out, through sensors (nextview render
            --sensor mix, and the same with --held-out): so seen, they are known as well.
        workers: processes; one for each core by default.
    """
    from nextview.calibration import stages
    from nextview.cli.progress import console, track

    found = stages.fit_unknown(store, meshes, card, made_up, seed, sensed, workers, track)
    console.print(
        f"{found.objects} known objects against {found.made_up} made-up ones; false-alarm rates by {found.held_out} "
        "others"
    )
