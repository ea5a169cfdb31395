"""Which things a folder teaches: mesh files, class folders of them, and folders of captured depth frames."""

from dataclasses import dataclass
from pathlib import Path

from nextview.data.folders import scan_dataset
from nextview.errors import DatasetError
from nextview.geometry.mesh import FORMATS
from nextview.simulation.captured import is_capture
from nextview.simulation.turntable import is_turntable


@dataclass(frozen=True)
class Source:
    """One thing to be taught: its name, its class, and the mesh file or the folder of captured frames."""

    name: str
    label: str
    path: Path


@dataclass(frozen=True)
class Found:
    """The things of a folder, sorted by class and name; what was left out and why, a phrase each."""

    things: list[Source]
    left_out: list[str]


def find_things(folder: Path) -> Found:
    """The things that a folder teaches.

    A mesh in the folder itself, and a folder of captured frames, is a thing and a class of its own name. All else is a
    class folder, as in a dataset (``data.folders``): each of its meshes is a thing of that class; where there are
    splits, those of "train". DatasetError: there is no such folder, nothing in it can be taught, or two things have one
    name.
    """
    if not folder.is_dir():
        raise DatasetError(f"{folder}: there is no such folder")
    inside = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    captures = [path for path in inside if path.is_dir() and (is_capture(path) or is_turntable(path))]
    things = [Source(path.name, path.name, path) for path in captures]
    things += [Source(path.stem, path.stem, path) for path in inside if path.suffix.lower() in FORMATS]
    pictures = [path for path in inside if path.is_file() and path.suffix.lower() in PICTURES]
    left_out = [f"{path.name}: neither a mesh nor a folder" for path in pictures]
    nothing = f"{folder}: holds no mesh ({', '.join(FORMATS)}) and no folder of depth frames with poses"
    if any(path.is_dir() and path not in captures for path in inside):
        try:
            listing = scan_dataset(folder)
        except DatasetError:
            if not things:
                raise DatasetError(nothing) from None
        else:
            splits = {entry.split for entry in listing.entries}
            for entry in listing.entries:
                if entry.label in {path.name for path in captures}:
                    continue
                if "train" in splits and entry.split not in ("train", ""):
                    left_out.append(f"{entry.path.relative_to(folder)}: of the split {entry.split}")
                else:
                    things.append(Source(entry.name, entry.label, entry.path))
    if not things:
        raise DatasetError(nothing)
    things.sort(key=lambda thing: (thing.label, thing.name))
    first: dict[str, Source] = {}
    for thing in things:
        if first.setdefault(thing.name, thing) is not thing:
            both = f"{first[thing.name].path} and {thing.path}"
            raise DatasetError(f"{both} would both be called {thing.name}; rename one of them")
    return Found(things, left_out)


PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".bmp")  # no views: without depth and a pose they teach nothing
