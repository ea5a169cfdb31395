"""``nextview-lab download``: published datasets."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

from nextview.cli.progress import console


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

    from nextview_lab.data.downloading import ARCHIVES
    from nextview_lab.data.downloading import download as fetch

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
