"""Folders of meshes: which files are objects, of which class and split, and what is left out.

Understood are CLASS/MESH, CLASS/SPLIT/MESH and SPLIT/CLASS/MESH, each also with folders between the last of these and
the mesh (CLASS/ID/models/MESH). Links are followed.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from nextview.errors import DatasetError
from nextview.geometry.mesh import FORMATS

SPLITS = ("train", "test", "val")
FEW = 3
"""Files that are named of those left out for one reason."""


@dataclass(frozen=True)
class Entry:
    """One mesh of a dataset: its path, name (unique), class, split (of SPLITS, or "") and the layout it lies in."""

    path: Path
    name: str
    label: str
    split: str
    layout: str = ""


@dataclass(frozen=True)
class Listing:
    """The objects of a dataset folder, sorted by class, split and name; and what was left out, with the reason."""

    entries: list[Entry]
    left_out: list[tuple[Path, str]]

    def summary(self) -> str:
        """How many objects lie in which layout, and what was left out, for people to read."""
        total = len(self.entries) + len(self.left_out)
        layouts = Counter(
            entry.layout.replace("SPLIT", entry.split) if entry.split else entry.layout for entry in self.entries
        )
        text = f"{len(self.entries)} of {total} objects: " + ", ".join(f"{n} in {at}" for at, n in layouts.items())
        if not self.left_out:
            return text
        reasons: dict[str, list[str]] = {}
        for path, reason in self.left_out:
            reasons.setdefault(reason, []).append(str(path))
        parts = [
            f"{len(paths)} ({reason}): {', '.join(paths[:FEW])}" + (", ..." if len(paths) > FEW else "")
            for reason, paths in reasons.items()
        ]
        return f"{text}; left out: {'; '.join(parts)}"


def list_dataset(root: str | Path, suffixes: tuple[str, ...] = FORMATS) -> list[Entry]:
    """All meshes of a dataset folder, or other files in its layout; see ``scan_dataset``."""
    return scan_dataset(root, suffixes).entries


def scan_dataset(root: str | Path, suffixes: tuple[str, ...] = FORMATS) -> Listing:
    """All meshes of a dataset folder, or other files in its layout, and those that were left out."""
    root = Path(root)
    if not root.is_dir():
        raise DatasetError(f"{root}: there is no such folder")
    files, left_out = _walk(root, suffixes)
    split_first = {parts[0] for parts in files if len(parts) > 1} <= set(SPLITS)
    entries = []
    for parts, path in files.items():
        entry = _entry(parts, path, split_first)
        if entry is None:
            left_out.append((Path(*parts), "not in a class folder"))
        else:
            entries.append(entry)
    if not entries:
        what = "meshes" if suffixes == FORMATS else "scenes"
        raise DatasetError(f"{root}: no {what} in CLASS/NAME, CLASS/SPLIT/NAME or SPLIT/CLASS/NAME below it")
    for entry in entries:
        if not (entry.label + entry.name).isprintable():
            raise DatasetError(f"{entry.path}: its name holds what cannot be printed; rename it")
    return Listing(sorted(_named(entries, root), key=lambda e: (e.label, e.split != "train", e.name)), left_out)


def _walk(root: Path, suffixes: tuple[str, ...]) -> tuple[dict[tuple[str, ...], Path], list[tuple[Path, str]]]:
    """All files with one of the suffixes by the parts of their relative paths; each folder once."""
    files: dict[tuple[str, ...], Path] = {}
    left_out: list[tuple[Path, str]] = []
    seen: set[Path] = set()
    top = root.resolve()

    def unreadable(error: OSError) -> None:
        left_out.append((Path(error.filename).relative_to(root), f"{error.strerror}"))

    for folder, below, names in os.walk(root, onerror=unreadable, followlinks=True):
        place = Path(folder).relative_to(root)
        below.sort()
        for name in sorted(name for name in names if Path(name).suffix.lower() in suffixes):
            path = Path(folder, name)
            if any(part.startswith(".") for part in (place / name).parts):
                left_out.append((place / name, "hidden"))
            elif not path.is_file():
                left_out.append((place / name, "no file"))
            else:
                files[(place / name).parts] = path
        for name in list(below):
            real = Path(folder, name).resolve()
            if real in seen or top.is_relative_to(real):
                left_out.append((place / name, "a folder that is listed already"))
                below.remove(name)
            seen.add(real)
    return files, left_out


def _entry(parts: tuple[str, ...], path: Path, split_first: bool) -> Entry | None:
    """What the parts of a file's path say of it; None if they name no class."""
    *folders, _ = parts
    if split_first and len(folders) > 1:
        (split, label), rest, layout = folders[:2], folders[2:], "SPLIT/CLASS"
    elif not folders or split_first:
        return None
    elif len(folders) > 1 and folders[1] in SPLITS:
        (label, split), rest, layout = folders[:2], folders[2:], "CLASS/SPLIT"
    else:
        label, split, rest, layout = folders[0], "", folders[1:], "CLASS"
    return Entry(path, path.stem, label, split, layout + ("/.../MESH" if rest else "/MESH"))


def _named(entries: list[Entry], root: Path) -> list[Entry]:
    """The entries with unique names: their file's, or as much of their path before it as it takes."""

    def folder(entry: Entry) -> str:  # CLASS/ID/models/MESH: the ID
        between = entry.path.relative_to(root).parts[1 + bool(entry.split) : -1]
        return between[0] if between else entry.path.stem

    def whole(entry: Entry) -> str:
        parts = entry.path.relative_to(root).with_suffix("").parts
        return "_".join([entry.label, *filter(None, [entry.split]), *parts[1 + bool(entry.split) :]])

    rules = [lambda e: e.path.stem, folder, lambda e: f"{e.label}_{e.path.stem}", whole]
    for rule in rules:
        named = [replace(entry, name=rule(entry)) for entry in entries]
        if len({entry.name for entry in named}) == len(named):
            return named
    first: dict[str, Entry] = {}
    twice = next(entry for entry in named if first.setdefault(entry.name, entry) is not entry)
    raise DatasetError(
        f"{first[twice.name].path} and {twice.path} would both be called {twice.name}; rename one of them"
    )
