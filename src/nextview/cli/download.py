"""``nextview download``: a published dataset, verified and unpacked."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro


def download(
    dataset: tyro.conf.Positional[Literal["modelnet10", "modelnet40"]],
    destination: tyro.conf.Positional[Path],
    /,
) -> None:
    """Download ModelNet10 (473 MB) or ModelNet40 (2 GB) and unpack it. Resumes a download that was cut off.

    Args:
        dataset: which one.
        destination: folder to put it into, as DESTINATION/ModelNet10.
    """
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

    from nextview.cli.progress import console
    from nextview.data.downloading import ARCHIVES
    from nextview.data.downloading import download as fetch

    archive = ARCHIVES[dataset]
    columns = (
        TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as progress:
        tasks = {}
        for what, done, total in fetch(archive, destination):
            if what not in tasks:
                tasks[what] = progress.add_task(f"{what} {archive.folder}", total=total)
            progress.update(tasks[what], completed=done)
    console.print(f"{destination / archive.folder}")
