"""Find the things of a folder: mesh files, class folders, and captured frames."""

import os
from dataclasses import dataclass
from pathlib import Path

from nextview.captured.bag import ENDINGS, is_bag
from nextview.captured.folders import is_capture
from nextview.captured.turntable import is_turntable
from nextview.checks import one_line
from nextview.data.folders import Entry, left_out_phrases, read_folder
from nextview.errors import DatasetError, option
from nextview.geometry.mesh import FORMATS

RESULT_FOLDER = "is where the result goes"


@dataclass(frozen=True)
class ThingSource:
    """One thing to be taught.

    Attributes:
        name: name of the thing.
        label: class of the thing.
        path: its mesh file, or the folder or bag of captured frames.
    """

    name: str
    label: str
    path: Path


@dataclass(frozen=True)
class Found:
    """Things in a folder.

    Attributes:
        things: the things, sorted by class and name.
        left_out: ignored files and the reasons, a phrase each.
        notes: interpretation of the folder, a sentence each.
    """

    things: list[ThingSource]
    left_out: list[str]
    notes: tuple[str, ...] = ()


def find_things(
    folder: Path,
    out: Path | None = None,
    one_class: bool = False,
) -> Found:
    """Find the things in a folder.

    A mesh in the folder itself, and a folder or a ROS 2 bag of captured frames, is a thing and a
    class of its own name. Everything else is read as a dataset (``data.folders``): each mesh in a
    class folder is a thing of that class; if there are splits, only "train" is used.

    Args:
        folder: folder to be searched.
        out: output folder, which is ignored if it lies in the folder.
        one_class: whether all things may belong to one class.

    Returns:
        The things, and all that was left out.

    Raises:
        DatasetError: there is no such folder, nothing in it can be taught, two things have one
            name, or all belong to one class: an extra folder around the things, as in an archive,
            looks the same.
    """
    if folder.is_file():
        raise DatasetError(
            f"{folder}: is a file, and things are taught from the folder that holds them:"
            f" {folder.absolute().parent}"
        )
    if not folder.is_dir():
        raise DatasetError(
            f"{folder}: there is no such file"
            if folder.suffix.lower() in (*FORMATS, *ENDINGS)
            else f"{folder}: there is no such folder"
        )
    if not str(folder).isprintable():
        raise DatasetError(
            f"{one_line(str(folder), 200)}: its name cannot be printed; rename it"
        )

    captures = _captures(folder)
    skip = dict.fromkeys(captures, "")
    if out is not None and out.is_dir() and not out.samefile(folder):
        skip[out] = RESULT_FOLDER
    listing = read_folder(folder, loose=True, skip=skip)

    entries, other_splits = _to_be_taught(listing.entries)
    in_bags = {path.relative_to(folder) for path in captures}
    left_out = left_out_phrases(
        [(path, reason) for path, reason in listing.left_out if path not in in_bags]
        + [
            (e.path.relative_to(folder), f"of the split {e.split}")
            for e in other_splits
        ]
    )
    things = [_of_frames(path) for path in captures]
    things += [ThingSource(entry.name, entry.label, entry.path) for entry in entries]
    if not things and is_capture(folder):
        raise DatasetError(
            f"{folder}: is the capture of one thing: give the folder above, with a folder for each"
            " thing"
        )
    if not things:
        text = (
            f"{folder}: holds no mesh ({', '.join(FORMATS)}) and no folder or bag of depth"
            " frames with poses"
        )
        raise DatasetError(
            "; left out: ".join([text, *filter(None, ["; ".join(left_out)])])
        )
    things.sort(key=lambda thing: (thing.label, thing.name))
    _check_names(things)
    if not one_class:
        _check_classes(folder, things)

    layout = [listing.layout()] if entries else []
    bags = sum(is_bag(path) for path in captures)
    layout += _counted(bags, "ROS 2 bag", "ROS 2 bags")
    layout += _counted(
        len(captures) - bags,
        "folder of depth frames",
        "folders of depth frames",
    )
    notes = (f"in {folder}: {', '.join(layout)}", *listing.notes)
    return Found(things, left_out, notes)


def _captures(folder: Path) -> list[Path]:
    """Folders and bags of captured frames in a folder, sorted by name."""
    inside = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    return [
        path
        for path in inside
        if path.name.isprintable()
        and (
            is_bag(path) or (path.is_dir() and (is_capture(path) or is_turntable(path)))
        )
    ]


def _counted(count: int, one: str, several: str) -> list[str]:
    """A phrase with a count; nothing for zero."""
    if count == 0:
        return []
    return [f"{count} {one if count == 1 else several}"]


def is_of_frames(path: Path) -> bool:
    """Whether a thing is taught from depth frames, a folder or a bag, and not from a mesh file.

    Args:
        path: path of the thing.
    """
    return path.is_dir() or is_bag(path)


def _of_frames(path: Path) -> ThingSource:
    """The thing of a folder of captured frames or of a bag."""
    name = path.name if path.is_dir() else path.stem
    return ThingSource(name, name, path)


def _to_be_taught(entries: list[Entry]) -> tuple[list[Entry], list[Entry]]:
    """Split the entries into those to be taught and those of test and validation splits."""
    if not any(entry.split == "train" for entry in entries):
        return entries, []
    taught = [entry for entry in entries if entry.split in ("train", "")]
    return taught, [entry for entry in entries if entry.split not in ("train", "")]


def _check_names(things: list[ThingSource]) -> None:
    first: dict[str, ThingSource] = {}
    for thing in things:
        if first.setdefault(thing.name, thing) is not thing:
            both = f"{first[thing.name].path} and {thing.path}"
            raise DatasetError(
                f"{both} would both be called {thing.name}; rename one of them"
            )


def _check_classes(folder: Path, things: list[ThingSource]) -> None:
    """Refuse several things that all lie in one class folder."""
    label = things[0].label
    if len(things) == 1 or any(thing.label != label for thing in things):
        return
    all_things = f"all {len(things)} things are of the one class {one_line(label)}"
    inside = one_line(os.path.commonpath([thing.path.parent for thing in things]), 200)
    raise DatasetError(
        f"{folder}: {all_things}; give {inside} if that holds the things, or"
        f" {option('one_class', True)} if they are one"
    )
