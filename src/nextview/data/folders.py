"""Folders of meshes: which files are objects, of which class and split, and what is left out.

Understood are CLASS/MESH, CLASS/SPLIT/MESH and SPLIT/CLASS/MESH, each also with folders before the mesh
(CLASS/ID/models/MESH). Where all meshes lie in the folder itself, each is a class of its own. Links are followed.
"""

import os
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from nextview.errors import DatasetError
from nextview.geometry.mesh import FORMATS
from nextview.recognition.model_card import find_card

SPLITS = ("train", "test", "val")
FEW = 3  # files that are named of those left out for one reason


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
        layouts = Counter(entry.layout for entry in self.entries)
        total = len(self.entries) + len(self.left_out)
        text = f"{len(self.entries)} of {total} objects: " + ", ".join(f"{n} in {at}" for at, n in layouts.items())
        reasons: dict[str, list[str]] = {}
        for path, reason in self.left_out:
            reasons.setdefault(reason, []).append(str(path))
        parts = [
            f"{len(p)} ({why}): {', '.join(p[:FEW])}{', ...' if len(p) > FEW else ''}" for why, p in reasons.items()
        ]
        return f"{text}; left out: {'; '.join(parts)}" if parts else text


def list_dataset(root: str | Path) -> list[Entry]:
    """All meshes of a dataset folder; see ``scan_dataset``."""
    return scan_dataset(root).entries


def scan_dataset(root: str | Path, suffixes: tuple[str, ...] = FORMATS) -> Listing:
    """All meshes of a dataset folder, or other files in its layout, and those that were left out.

    DatasetError if there is no such folder, it holds none, or two of them would have one name.
    """
    root = Path(root)
    if not root.is_dir():
        raise DatasetError(f"{root}: there is no such folder")
    files, left_out = _walk(root, suffixes)
    split_first = {place.parts[0] for place in files if len(place.parts) > 1} <= set(SPLITS)
    found = {place: _entry(place, path, split_first) for place, path in files.items()}
    if all(len(place.parts) == 1 for place in files) and suffixes == FORMATS:
        found = {place: Entry(path, path.stem, path.stem, "", "MESH") for place, path in files.items()}
    left_out += [(place, "not in a class folder") for place, entry in found.items() if entry is None]
    entries = [entry for entry in found.values() if entry is not None]
    if not entries:
        what = "meshes" if suffixes == FORMATS else "scenes"
        raise DatasetError(f"{root}: no {what} in CLASS/NAME, CLASS/SPLIT/NAME or SPLIT/CLASS/NAME below it")
    for entry in entries:
        if not (entry.label + entry.name).isprintable():
            raise DatasetError(f"{entry.path}: its name holds what cannot be printed; rename it")
    return Listing(sorted(_named(entries, root), key=lambda e: (e.label, e.split != "train", e.name)), left_out)


def select(entries: list[Entry], dataset: Path, split: str | None, held_out: str | Path | None) -> list[Entry]:
    """Those of one split, and those (meshes, or scenes by their target) that a card calls held out of its training."""
    entries = [entry for entry in entries if split in (None, entry.split)]
    if not entries:
        raise DatasetError(f"{dataset}: nothing in CLASS/{split}/NAME below it")
    if held_out is not None:
        kept = set(find_card(held_out).held_out)
        entries = [entry for entry in entries if entry.name.partition("@")[0] in kept]
        if not entries:
            raise DatasetError(f"{dataset}: holds no object that {held_out} calls held out")
    return entries


def _walk(root: Path, suffixes: tuple[str, ...]) -> tuple[dict[Path, Path], list[tuple[Path, str]]]:
    """All files with one of the suffixes by their relative paths, each folder once; and those that are left out."""
    files: dict[Path, Path] = {}
    left_out: list[tuple[Path, str]] = []
    unreadable: list[OSError] = []
    seen, top = set[Path](), root.resolve()
    for folder, below, names in os.walk(root, onerror=unreadable.append, followlinks=True):
        for path in sorted(Path(folder, name) for name in names):
            place = path.relative_to(root)
            if path.suffix.lower() not in suffixes:
                continue
            if any(part.startswith(".") for part in place.parts):
                left_out.append((place, "hidden"))
            elif not path.is_file():
                left_out.append((place, "no file"))
            else:
                files[place] = path
        for name in sorted(below):
            real = Path(folder, name).resolve()
            if real in seen or top.is_relative_to(real):
                left_out.append((Path(folder, name).relative_to(root), "a folder that is listed already"))
                below.remove(name)
            seen.add(real)
        below.sort()
    return files, left_out + [(Path(error.filename).relative_to(root), f"{error.strerror}") for error in unreadable]


def _entry(place: Path, path: Path, split_first: bool) -> Entry | None:
    """What a file's relative path says of it; None if it names no class."""
    *folders, _ = place.parts
    if split_first and len(folders) > 1:
        (split, label), rest, layout = folders[:2], folders[2:], f"{folders[0]}/CLASS"
    elif not folders or split_first:
        return None
    elif len(folders) > 1 and folders[1] in SPLITS:
        (label, split), rest, layout = folders[:2], folders[2:], f"CLASS/{folders[1]}"
    else:
        label, split, rest, layout = folders[0], "", folders[1:], "CLASS"
    return Entry(path, path.stem, label, split, layout + ("/.../MESH" if rest else "/MESH"))


def _named(entries: list[Entry], root: Path) -> list[Entry]:
    """The entries with unique names: their file's, or as much of their path before it as it takes."""

    def below(entry: Entry) -> tuple[str, ...]:  # CLASS/ID/models/MESH: ID, models, MESH
        return entry.path.relative_to(root).with_suffix("").parts[1 + bool(entry.split) :]

    rules = [
        lambda e: e.path.stem,
        lambda e: below(e)[0],
        lambda e: f"{e.label}_{e.path.stem}",
        lambda e: "_".join([e.label, *filter(None, [e.split]), *below(e)]),
    ]
    for rule in rules:
        named = [replace(entry, name=rule(entry)) for entry in entries]
        if len({entry.name for entry in named}) == len(named):
            return named
    first: dict[str, Entry] = {}
    twice = next(entry for entry in named if first.setdefault(entry.name, entry) is not entry)
    both = f"{first[twice.name].path} and {twice.path}"
    raise DatasetError(f"{both} would both be called {twice.name}; rename one of them")
