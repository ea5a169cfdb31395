"""``nextview list`` and ``nextview download``: bundled models and published datasets."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

from rich.table import Table

from nextview.cli.progress import Terminal, console
from nextview.files import sha256_of
from nextview.recognition.model_card import bundled_cards, find_card


def show(
    what: Literal["models", "measures"],
    name: str | None = None,
    /,
) -> None:
    """List the bundled models or the view measures.

    A view measure is a number that scores a view. Measures that need only the depth are computed
    from a view store; docs/add_a_measure.md describes the others, and how to add your own.

    Args:
        what: list to print: models or measures.
        name: model whose card is printed instead of the list.
    """
    if what == "measures":
        from nextview.data.measures import all_measures

        table = Table("measure", "needs", "better views", "source")
        table.columns[0].no_wrap = True
        for key, measure in all_measures().items():
            table.add_row(
                key,
                measure.needs,
                "high" if measure.good == "peak" else "low",
                measure.source,
            )
        return Terminal().print(table)
    if name:
        return print(find_card(name).card_path.read_text(encoding="utf-8"))
    table = Table("model", "kind", "MB", "scores on test", "file")
    table.columns[0].no_wrap = True
    for card in bundled_cards().values():
        tested = []
        for split, scores in card.scores.items():
            if split.startswith("test"):
                tested.append(split)
                for score, value in scores.items():
                    mean = (
                        f"{value['instance']}\n    class mean {value['class']}"
                        if isinstance(value, dict)
                        else value
                    )
                    tested.append(f"  {score.replace('_', ' ')} {mean}")
        intact = "intact" if sha256_of(card.path) == card.sha256 else "DAMAGED"
        table.add_row(
            card.name,
            card.kind,
            f"{card.path.stat().st_size / 1e6:.1f}",
            "\n".join(tested),
            intact,
        )
    return Terminal().print(table)


def download(
    name: Literal["modelnet10", "modelnet40"],
    out: Path,
    /,
) -> None:
    """Download ModelNet10 (473 MB) or ModelNet40 (2 GB), verify and unpack it.

    Args:
        name: dataset to download.
        out: folder into which it is unpacked, as OUT/ModelNet10.
    """
    from rich.progress import (
        BarColumn,
        DownloadColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
        TransferSpeedColumn,
    )

    from nextview.data.downloading import ARCHIVES
    from nextview.data.downloading import download as fetch

    archive = ARCHIVES[name]
    columns = (
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(
        TextColumn("{task.description}"),
        *columns,
        console=console,
    ) as progress:
        move = partial(
            progress.update,
            progress.add_task(f"downloading {archive.folder}", total=None),
        )
        # the interface that pooch expects of a progress bar
        bar = SimpleNamespace(
            total=0, reset=partial(move, completed=0), close=lambda: None
        )
        bar.update = lambda advance: move(advance=advance, total=bar.total)
        console.print(f"{fetch(archive, out, bar=bar)}")
