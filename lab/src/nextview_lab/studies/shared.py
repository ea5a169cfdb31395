"""What studies share: scans and their meshes."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from nextview.errors import UsageError
from nextview.geometry.mesh import FORMATS, Mesh, load_mesh


def scans_in(folder: Path, formats: Sequence[str] = FORMATS) -> dict[str, Path]:
    """The scans in a folder by their names, in order.

    Args:
        folder: of the scans.
        formats: suffixes of the files that count.

    Raises:
        UsageError: there are none.
    """
    files = {
        path.stem: path
        for path in sorted(folder.iterdir() if folder.is_dir() else ())
        if path.suffix.lower() in formats
    }
    if not files:
        raise UsageError(f"{folder}: holds no scan, NAME{formats[0]}")
    return dict(sorted(files.items()))


def mesh_of(scan: Path) -> Mesh:
    """A scan in metres, called as its file."""
    return replace(load_mesh(scan, unit="m"), name=scan.stem)
