"""Folders of meshes: the objects in them, with class and split, and the files that are left out.

Supported layouts, with MESH for a file, are:

- MESH in the folder itself: each is a class of its own, if all meshes are there.
- CLASS/MESH, CLASS/SPLIT/MESH and SPLIT/CLASS/MESH, each also with further folders before the mesh
  (CLASS/ID/models/MESH).
- SPLIT/MESH, with at least two splits: each mesh is a class of its own.
- NAME/google_16k/nontextured.ply, the download of the YCB object set: each NAME is one object.

A SPLIT is a folder with one of the names in SPLIT_NAMES, in any case. Files with the same name in
several formats are one model, of which the best is used. Links are followed. ``read_folder``
implements these rules, and reports everything that it leaves out.
"""

import logging
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from nextview.checks import one_line
from nextview.errors import DatasetError
from nextview.geometry.mesh import FORMATS
from nextview.recognition.model_card import find_card

SPLIT_NAMES = {  # names of folders, in lower case, and their splits
    "train": "train",
    "training": "train",
    "test": "test",
    "testing": "test",
    "val": "val",
    "valid": "val",
    "validation": "val",
}
NAMED_FILES = 3  # files named per reason for leaving them out
LONGEST_FOLDER_PATH = 200  # characters of a path in a message
# The best first: STL has no shared vertices, and the axes of a GLB file are often wrong.
BEST_FORMATS = (".ply", ".off", ".obj", ".glb", ".stl")
# Formats of shapes that are not supported; other files next to meshes are images, materials and
# notes.
OTHER_SHAPES = (
    ".3ds",
    ".3mf",
    ".abc",
    ".blend",
    ".brep",
    ".ctm",
    ".dae",
    ".dwg",
    ".dxf",
    ".fbx",
    ".gltf",
    ".iges",
    ".igs",
    ".jt",
    ".ma",
    ".max",
    ".mb",
    ".nif",
    ".pcd",
    ".prt",
    ".skp",
    ".sldprt",
    ".step",
    ".stp",
    ".usd",
    ".usda",
    ".usdc",
    ".usdz",
    ".vrml",
    ".vtk",
    ".vtp",
    ".wrl",
    ".x3d",
    ".x_t",
    ".xyz",
)
# scans of one object, the best first
YCB_SCANS = ("google_16k", "google_64k", "google_512k", "poisson", "tsdf", "clouds")
METADATA_FOLDERS = ("__MACOSX",)

_log = logging.getLogger("nextview")

HIDDEN_FILE = "hidden"
LISTED_ALREADY = "a folder that is listed already"
NO_CLASS = "not in a class folder"
NOT_READ = f"of a format that is not read; export it as {', '.join(FORMATS)}"
BROKEN_LINK = "a link that leads nowhere"
UNPRINTABLE = "its name cannot be printed; rename it"
VIEW_STORE = "a view store"


@dataclass(frozen=True)
class Entry:
    """One object of a dataset.

    Attributes:
        path: its file.
        name: unique in the dataset.
        label: its class.
        split: "train", "test" or "val"; "" for none.
        layout: of the folder, such as "CLASS/MESH".
    """

    path: Path
    name: str
    label: str
    split: str
    layout: str = ""


@dataclass(frozen=True)
class Listing:
    """Contents of a folder.

    Attributes:
        entries: the objects, sorted by class, split and name.
        left_out: paths in the folder that are not used, with reasons.
        notes: decisions about the layout, a sentence each.
    """

    entries: list[Entry]
    left_out: list[tuple[Path, str]]
    notes: list[str] = field(default_factory=list)

    def summary(self) -> str:
        """Describe the objects by layout, and the files that were left out."""
        objects = (
            "1 object" if len(self.entries) == 1 else f"{len(self.entries)} objects"
        )
        text = "; ".join([f"{objects}: {self.layout()}", *self.notes])
        phrases = left_out_phrases(self.left_out)
        return f"{text}; left out: {'; '.join(phrases)}" if phrases else text

    def layout(self) -> str:
        """Describe the number of objects in each layout, such as "5 meshes as CLASS/MESH"."""
        phrases = []
        for layout, count in Counter(entry.layout for entry in self.entries).items():
            meshes = "1 mesh" if count == 1 else f"{count} meshes"
            phrases.append(meshes if layout == "MESH" else f"{meshes} as {layout}")
        return ", ".join(phrases)


def left_out_phrases(left_out: Iterable[tuple[Path, str]]) -> list[str]:
    """Describe the files that were left out, one phrase per reason.

    Args:
        left_out: paths with reasons.

    Returns:
        Phrases such as "a.step, b.step: of a format that is not read".
    """
    reasons: dict[str, list[str]] = {}
    for path, reason in left_out:
        reasons.setdefault(reason, []).append(one_line(str(path), LONGEST_FOLDER_PATH))

    phrases = []
    for reason, paths in reasons.items():
        named = ", ".join(paths[:NAMED_FILES])
        if len(paths) > NAMED_FILES:
            named += f" and {len(paths) - NAMED_FILES} more"
        phrases.append(f"{named}: {reason}")
    return phrases


def list_dataset(root: str | Path, loose: bool = False) -> list[Entry]:
    """List all meshes of a dataset folder and log the files left out; see ``scan_dataset``.

    Args:
        root: the folder.
        loose: whether to list meshes outside class folders, too.

    Returns:
        The meshes.

    Raises:
        DatasetError: there is no such folder, or no mesh in it.
    """
    listing = scan_dataset(root, loose=loose)
    for phrase in left_out_phrases(listing.left_out):
        _log.warning("%s: left out: %s", root, phrase)
    return listing.entries


def scan_dataset(
    root: str | Path,
    suffixes: tuple[str, ...] = FORMATS,
    loose: bool = False,
) -> Listing:
    """List the objects of a dataset folder and the files left out; see ``read_folder``.

    Args:
        root: the folder.
        suffixes: of the object files.
        loose: whether to list files outside class folders, too.

    Returns:
        The objects and the files left out.

    Raises:
        DatasetError: there is no such folder, it contains no object, or two objects would have the
            same name.
    """
    listing = read_folder(Path(root), suffixes, loose)
    if listing.entries:
        return listing

    what = "meshes" if suffixes == FORMATS else "scenes"
    text = f"{root}: no {what} in CLASS/NAME, CLASS/SPLIT/NAME or SPLIT/CLASS/NAME below it"
    phrases = left_out_phrases(listing.left_out)
    raise DatasetError(f"{text}; left out: {'; '.join(phrases)}" if phrases else text)


def read_folder(
    root: Path,
    suffixes: tuple[str, ...] = FORMATS,
    loose: bool = False,
    skip: Mapping[Path, str] = {},
) -> Listing:
    """Find the objects in a folder, their layout, and the files that are left out.

    Args:
        root: the folder.
        suffixes: of the object files, in lower case.
        loose: whether a mesh in the folder itself is a class of its own even if there are class
            folders; otherwise it is left out in that case.
        skip: subfolders that are left out, with reasons; an empty reason is not reported.

    Returns:
        The contents, possibly without any object.

    Raises:
        DatasetError: there is no such folder, or two objects would have the same name.
    """
    if not root.is_dir():
        raise DatasetError(
            f"{root}: is a file, and a folder of meshes is expected"
            if root.is_file()
            else f"{root}: there is no such folder"
        )
    content = _walk(root, suffixes, skip)
    models, left_out = _best_files(content.files)
    left_out = (
        content.left_out
        + left_out
        + content.without_objects("mesh" if suffixes == FORMATS else "scene")
    )

    in_folders = [model for model in models if len(model.parts) > 1]
    split_first = _split_first(in_folders)
    classes_in_splits = any(len(model.parts) > 2 for model in in_folders)
    flat = suffixes == FORMATS and not in_folders

    found: dict[Path, Entry] = {}
    for model, place in models.items():
        alone = (loose or flat) if len(model.parts) < 2 else not classes_in_splits
        named_by_folder = model != place.with_suffix("")
        entry = _entry(root, model, root / place, split_first, alone or named_by_folder)
        if entry is None:
            left_out.append((place, NO_CLASS))
            continue
        if named_by_folder:
            layout = f"{entry.layout.removesuffix('MESH')}NAME/{place.parent.name}/MESH"
            entry = replace(entry, layout=layout)
        found[model] = entry

    entries = _uniquely_named(found)
    entries.sort(key=lambda entry: (entry.label, entry.split != "train", entry.name))
    return Listing(entries, left_out, _notes(root, entries))


def select(
    entries: list[Entry],
    dataset: Path,
    split: str | None,
    held_out: str | Path | None,
) -> list[Entry]:
    """Select objects by split and by the held-out objects of a card.

    Args:
        entries: of the folder.
        dataset: the folder, for messages.
        split: name of the split; None for all.
        held_out: name or path of a card, whose held-out objects are selected (scenes by their
            target); None for all.

    Returns:
        The selected objects.

    Raises:
        DatasetError: none is left.
    """
    entries = [entry for entry in entries if split in (None, entry.split)]
    if not entries:
        raise DatasetError(f"{dataset}: nothing in CLASS/{split}/NAME below it")
    if held_out is not None:
        kept = set(find_card(held_out).held_out)
        entries = [entry for entry in entries if entry.name.partition("@")[0] in kept]
        if not entries:
            raise DatasetError(
                f"{dataset}: holds no object that {held_out} calls held out"
            )
    return entries


@dataclass(frozen=True)
class _Content:
    """Everything below a folder, with relative paths.

    Attributes:
        files: possible objects.
        left_out: everything that cannot be an object, with reasons.
        other_files: files of other kinds.
        folders: all visited folders.
    """

    files: list[Path] = field(default_factory=list)
    left_out: list[tuple[Path, str]] = field(default_factory=list)
    other_files: list[Path] = field(default_factory=list)
    folders: list[Path] = field(default_factory=list)

    def without_objects(self, kind: str) -> list[tuple[Path, str]]:
        """Return files that are not objects, and whole folders without any object."""
        told = [*self.files, *(place for place, _ in self.left_out)]
        worth_entering = {
            Path(),
            *(folder for place in told for folder in place.parents),
        }
        found: dict[Path, str] = {}

        for place in [*self.other_files, *self.folders]:
            empty = [
                folder
                for folder in reversed(place.parents)
                if folder not in worth_entering
            ]
            top = empty[0] if empty else place
            if top not in worth_entering:
                found[top] = (
                    f"no {kind}" if top in self.other_files else f"holds no {kind}"
                )

        return list(found.items())


def _walk(root: Path, suffixes: tuple[str, ...], skip: Mapping[Path, str]) -> _Content:
    """List everything below a folder; each folder is visited once, even with circular links."""
    content = _Content()
    unreadable: list[OSError] = []
    top = _real(root)
    skipped = {_real(folder): reason for folder, reason in skip.items()}
    seen = set[Path]()

    for folder, below, names in os.walk(
        root,
        onerror=unreadable.append,
        followlinks=True,
    ):
        here = Path(folder).relative_to(root)
        for name in sorted(names):
            _note_file(content, root, here / name, suffixes)

        entered = []
        for name in sorted(below):
            real = _real(Path(folder, name))
            reason = skipped.get(real, _not_entered(Path(folder, name)))
            if real in seen or top.is_relative_to(real):
                reason = LISTED_ALREADY
            seen.add(real)
            if reason is None:
                entered.append(name)
                content.folders.append(here / name)
            elif reason:
                content.left_out.append((here / name, reason))
        below[:] = entered

    for error in unreadable:
        content.left_out.append(
            (Path(error.filename).relative_to(root), f"{error.strerror}")
        )
    return content


def _real(path: Path) -> Path:
    # Path.resolve raises an error for circular links
    return Path(os.path.realpath(path))


def _not_entered(folder: Path) -> str | None:
    """Return the reason why a folder is not searched for objects, or None."""
    if folder.name.startswith(".") or folder.name in METADATA_FOLDERS:
        return HIDDEN_FILE
    if not folder.name.isprintable():
        return UNPRINTABLE
    return VIEW_STORE if (folder / "zarr.json").exists() else None


def _note_file(
    content: _Content,
    root: Path,
    place: Path,
    suffixes: tuple[str, ...],
) -> None:
    """Add a file to the contents, by its path."""
    suffix = place.suffix.lower()
    wanted = suffix in suffixes
    shape = wanted or suffix in OTHER_SHAPES

    if place.name.startswith("."):
        if shape:
            content.left_out.append((place, HIDDEN_FILE))
    elif not place.name.isprintable():
        content.left_out.append((place, UNPRINTABLE))
    elif not (root / place).is_file():
        content.left_out.append(
            (place, BROKEN_LINK if (root / place).is_symlink() else "no file")
        )
    elif wanted:
        content.files.append(place)
    elif shape and suffixes == FORMATS:
        content.left_out.append((place, NOT_READ))
    else:
        content.other_files.append(place)


def _best_files(files: list[Path]) -> tuple[dict[Path, Path], list[tuple[Path, str]]]:
    """Return the best file of each model, by the common part of their paths; and the others."""
    models: dict[Path, list[Path]] = {}
    for place in files:
        models.setdefault(_model_of(place), []).append(place)

    best: dict[Path, Path] = {}
    others: list[tuple[Path, str]] = []
    for model, places in models.items():
        best[model], *rest = sorted(places, key=_preference)
        taken = best[model].suffix.lower()
        for place in rest:
            which = (
                "another"
                if place.suffix.lower() == taken
                else f"the {taken[1:].upper()}"
            )
            others.append((place, f"{which} file of the same model is taken"))
    return best, others


def _model_of(place: Path) -> Path:
    """Return the common part of the paths of one model's files.

    It is the path without suffix; in a YCB download, the folder of the object.
    """
    return (
        place.parent.parent if place.parent.name in YCB_SCANS else place.with_suffix("")
    )


def _preference(place: Path) -> tuple[int, bool, int, str]:
    """Sort key of the files of one model, the best first."""
    folder = place.parent.name
    scan = YCB_SCANS.index(folder) if folder in YCB_SCANS else 0
    suffix = place.suffix.lower()
    kind = BEST_FORMATS.index(suffix) if suffix in BEST_FORMATS else len(BEST_FORMATS)
    return scan, place.stem != "nontextured", kind, str(place)


def _split_first(in_folders: list[Path]) -> bool:
    """Return True if the top-level folders are splits.

    A single folder called "train" that contains meshes, and no class folders, is a class.
    """
    tops = {model.parts[0] for model in in_folders}
    with_classes = any(len(model.parts) > 2 for model in in_folders)
    splits = {_split_of(top) for top in tops}
    return bool(tops) and "" not in splits and (with_classes or len(splits) > 1)


def _split_of(folder: str) -> str:
    """Return the split for the name of a folder; "" if it is none."""
    return SPLIT_NAMES.get(folder.lower(), "")


def _entry(
    root: Path,
    model: Path,
    path: Path,
    split_first: bool,
    own_class: bool,
) -> Entry | None:
    """Return the object for the path of a model; None if the path has no class."""
    # the folder may be that of a single object in a YCB download
    *folders, stem = model.parts or (_real(root).name,)
    split = ""
    layout = ""
    if split_first and folders:
        split = _split_of(folders.pop(0))
        layout = f"{split}/"
    if not folders:
        return Entry(path, stem, stem, split, f"{layout}MESH") if own_class else None

    label, *rest = folders
    layout += "CLASS/"
    if rest and _split_of(rest[0]) and not split_first:
        split = _split_of(rest.pop(0))
        layout += f"{split}/"
    return Entry(path, stem, label, split, layout + (".../MESH" if rest else "MESH"))


def _uniquely_named(found: Mapping[Path, Entry]) -> list[Entry]:
    """Name entries by their file, or by as much of the path as needed for unique names."""

    # CLASS/ID/models/MESH: ID, models, MESH
    def below(model: Path, entry: Entry) -> tuple[str, ...]:
        return model.parts[1 + bool(entry.split) :]

    def whole(model: Path, entry: Entry) -> str:
        return "_".join(
            [entry.label, *filter(None, [entry.split]), *below(model, entry)]
        )

    rules: list[Callable[[Path, Entry], str]] = [
        lambda model, entry: entry.name,
        lambda model, entry: next(iter(below(model, entry)), entry.name),
        lambda model, entry: (
            f"{entry.label}_{entry.name}" if below(model, entry) else entry.name
        ),
        whole,
    ]
    for rule in rules:
        named = [
            replace(entry, name=rule(model, entry)) for model, entry in found.items()
        ]
        if len({entry.name for entry in named}) == len(named):
            return named

    first: dict[str, Entry] = {}
    twice = next(
        entry for entry in named if first.setdefault(entry.name, entry) is not entry
    )
    both = f"{first[twice.name].path} and {twice.path}"
    raise DatasetError(f"{both} would both be called {twice.name}; rename one of them")


def _notes(root: Path, entries: list[Entry]) -> list[str]:
    """Describe decisions about ambiguous folders, a sentence each."""
    labels = sorted({entry.label for entry in entries})
    notes = [
        f"the folder {label} is taken for a class, not for a split"
        for label in labels
        if _split_of(label)
    ]
    if len(labels) == 1 and any(count > 1 for count in _deep_folders(entries).values()):
        inside = one_line(str(root / labels[0]), LONGEST_FOLDER_PATH)
        notes.append(
            f"all are of the class {labels[0]}; if the folders in it are the classes, give {inside}"
        )
    return notes


def _deep_folders(entries: list[Entry]) -> Counter[Path]:
    """Count the objects directly in each folder below the class folders."""
    return Counter(
        entry.path.parent for entry in entries if entry.layout.endswith(".../MESH")
    )
