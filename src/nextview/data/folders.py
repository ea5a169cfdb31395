"""Folders of meshes: ModelNet's layout (class/split/mesh) or plain class folders (class/mesh)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from nextview.arguments import takes_paths
from nextview.errors import DatasetError
from nextview.mesh import FORMATS

SPLITS = ("train", "test")


@dataclass(frozen=True)
class Entry:
    """One mesh of a dataset: its path, name (unique), class and split ("train", "test" or "")."""

    path: Path
    name: str
    label: str
    split: str


@takes_paths("root")
def list_dataset(root: str | Path, suffixes: tuple[str, ...] = FORMATS) -> list[Entry]:
    """All meshes of a dataset folder, or other files in its layout, sorted by class, split and name.

    Raises:
        DatasetError: the folder is missing or holds no class folders with meshes, one whose name cannot be printed, or
            two meshes of one name in one place.
    """
    root = Path(root)
    if not root.is_dir():
        raise DatasetError(f"{root}: there is no such folder")
    entries = []
    for path in sorted(root.rglob("*")):
        if path.suffix.lower() not in suffixes or not path.is_file():
            continue
        parts = path.relative_to(root).parts
        if len(parts) == 3 and parts[1] in SPLITS:
            entries.append(Entry(path, path.stem, parts[0], parts[1]))
        elif len(parts) == 2:
            entries.append(Entry(path, path.stem, parts[0], ""))
    if not entries:
        what, name = ("meshes", "MESH") if suffixes == FORMATS else ("worlds", "WORLD")
        raise DatasetError(f"{root}: no {what} in CLASS/{name} or CLASS/train|test/{name} below it")
    for entry in entries:
        if not (entry.label + entry.name).isprintable():
            raise DatasetError(f"{entry.path}: its name holds what cannot be printed; rename it")
    if _repeated(entries):  # plain collections number their meshes within each class
        entries = [replace(e, name=f"{e.label}_{e.name}") for e in entries]
    if _repeated(entries):  # or within each split of it
        entries = [replace(e, name="_".join(filter(None, (e.label, e.split, e.path.stem)))) for e in entries]
    twice = _repeated(entries)
    if twice:
        first, second, *_ = (entry.path for entry in entries if entry.name == twice)
        raise DatasetError(f"{first} and {second} would both be called {twice}; rename one of them")
    return sorted(entries, key=lambda e: (e.label, e.split != "train", e.name))


def _repeated(entries: list[Entry]) -> str | None:
    """A name that two of them have."""
    names = sorted(entry.name for entry in entries)
    return next((name for name, other in pairwise(names) if name == other), None)
