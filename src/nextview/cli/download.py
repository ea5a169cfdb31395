"""``nextview download``: a published dataset, verified and unpacked."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from rich.progress import Progress


def download(dataset: Literal["modelnet10", "modelnet40"], destination: Path, /) -> None:
    """Download ModelNet10 (473 MB) or ModelNet40 (2 GB), verify and unpack it.

    Args:
        dataset: which one.
        destination: folder to put it into, as DESTINATION/ModelNet10.
    """
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

    from nextview.cli.progress import console
    from nextview.data.downloading import ARCHIVES
    from nextview.data.downloading import download as fetch

    archive = ARCHIVES[dataset]
    columns = BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn()
    with Progress(TextColumn("{task.description}"), *columns, console=console) as progress:
        console.print(f"{fetch(archive, destination, bar=_Bar(progress, archive.folder))}")


class _Bar:
    """What pooch moves while it downloads."""

    total = 0

    def __init__(self, progress: Progress, name: str) -> None:
        self._progress, self._task = progress, progress.add_task(f"downloading {name}", total=None)

    def update(self, advance: int) -> None:
        self._progress.update(self._task, advance=advance, total=self.total)

    def reset(self) -> None:
        self._progress.update(self._task, completed=0)

    def close(self) -> None: ...
