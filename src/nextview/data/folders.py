"""Folders of meshes: ModelNet's layout (class/split/mesh) or plain class folders (class/mesh)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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


def list_dataset(root: str | Path) -> list[Entry]:
    """All meshes of a dataset folder, sorted by class, split and name.

    Raises:
        DatasetError: the folder is missing or holds no class folders with meshes, or one whose name cannot be printed.
    """
    root = Path(root)
    if not root.is_dir():
        raise DatasetError(f"{root}: there is no such folder")
    entries = []
    for path in sorted(root.rglob("*")):
        if path.suffix.lower() not in FORMATS or not path.is_file():
            continue
        parts = path.relative_to(root).parts
        if len(parts) == 3 and parts[1] in SPLITS:
            entries.append(Entry(path, path.stem, parts[0], parts[1]))
        elif len(parts) == 2:
            entries.append(Entry(path, path.stem, parts[0], ""))
    if not entries:
        raise DatasetError(f"{root}: no meshes in CLASS/MESH or CLASS/train|test/MESH below it")
    for entry in entries:
        if not (entry.label + entry.name).isprintable():
            raise DatasetError(f"{entry.path}: its name holds what cannot be printed; rename it")
    names = [entry.name for entry in entries]
    if len(set(names)) < len(names):  # plain collections number their meshes within each class
        entries = [Entry(e.path, f"{e.label}_{e.name}", e.label, e.split) for e in entries]
    return sorted(entries, key=lambda e: (e.label, e.split != "train", e.name))
