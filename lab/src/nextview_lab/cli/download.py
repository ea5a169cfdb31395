"""``nextview-lab download``: published datasets."""

from pathlib import Path
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
    from nextview_lab.data.downloading import ARCHIVES
    from nextview_lab.data.downloading import download as fetch

    with console.status(f"downloading {ARCHIVES[name].url}"):
        folder = fetch(ARCHIVES[name], out)
    console.print(f"{folder}")
