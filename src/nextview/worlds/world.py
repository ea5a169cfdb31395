"""A world in words: what stands where on a table. One small JSON file, from which it is built again to the bit."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from nextview.arguments import of_kind, takes_paths
from nextview.errors import DatasetError, ModelError
from nextview.json_file import Fields, read_object
from nextview.outputs import written_whole

SCHEMA = 1
LEVELS = {"light": 0.85, "medium": 0.65, "heavy": 0.45}
"""Share of the target that shows, on the average over the 40 views."""
NAMED = re.compile(r".*@(\w+)-\d+")
"""Names of worlds that were drawn: target, level and number."""
SUFFIX = ".json"
VIEWS = 40
"""Of which a world says how much of the target they show."""
FARTHEST = 1000.0
"""Every length, place and angle of a world is at most this: what is computed with more has no precision left."""
THINGS = 1000
"""Objects and blocks around a target at most."""


def level_of(name: str) -> str:
    """The level of a world by its name; "" for what is none, such as a single object."""
    match = NAMED.fullmatch(name)
    return match[1] if match else ""


@dataclass(frozen=True)
class Placement:
    """An object that stands on the table.

    Attributes:
        mesh: its file, below the folder of meshes, with forward slashes.
        sha256: of that file.
        x: of its bounding box's centre, object radii of the target.
        y: the same.
        turn: about the vertical, radians.
        radius: its own radius, in those of the target.
    """

    mesh: str
    sha256: str
    x: float = 0.0
    y: float = 0.0
    turn: float = 0.0
    radius: float = 1.0


@dataclass(frozen=True)
class Block:
    """An upright box that stands on the table, all lengths in object radii of the target.

    Attributes:
        x: of its middle.
        y: the same.
        turn: about the vertical, radians.
        width: along its own x.
        depth: along its own y.
        height: of it.
        wall: whether it ends the space in which the camera can move: what lies beyond cannot be reached.
    """

    x: float
    y: float
    turn: float
    width: float
    depth: float
    height: float
    wall: bool = False


@dataclass(frozen=True)
class World:
    """A target at rest on a table, and what stands around it.

    Its frame is the target's object frame: the target's centre is the origin, z is up, the unit is its object radius.
    The table is as high as the target's lowest point.

    Attributes:
        name: unique in its folder, "chair_0890@medium-1".
        level: one of LEVELS, or another word for worlds of one's own.
        seed: with which it was drawn.
        target: unturned, in the middle.
        objects: others.
        blocks: boxes and walls.
        visible: share of the target's picture that nothing hides from each of the 40 views; () if it was not measured.
        unreachable: those of the 40 views to which no camera can be brought.
    """

    name: str
    level: str
    seed: int
    target: Placement
    objects: tuple[Placement, ...] = ()
    blocks: tuple[Block, ...] = ()
    visible: tuple[float, ...] = ()
    unreachable: tuple[int, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        values = asdict(self)
        target = {key: values["target"][key] for key in ("mesh", "sha256")}
        mean = {"visible_share": round(sum(self.visible) / len(self.visible), 4)} if self.visible else {}
        return {"schema": SCHEMA, **values, "target": target} | mean

    @classmethod
    def from_dict(cls, values: dict[str, Any], what: str = "a world") -> World:
        """What ``to_dict`` gave.

        Raises:
            DatasetError: it is something else.
        """
        try:
            fields = Fields(values, what)
            fields.schema(SCHEMA)
            fields.take("visible_share", None)
            lists = {name: fields.take(name, []) for name in ("objects", "blocks")}
            for name, found in lists.items():
                if not isinstance(found, list):
                    raise fields.wrong(name, "a list")
                if len(found) > THINGS:
                    raise fields.wrong(name, f"a list of at most {THINGS:,}")
            target = Fields(fields.mapping("target"), f"the target of {what}")
            world = cls(
                fields.text("name"),
                fields.text("level"),
                fields.whole("seed"),
                Placement(_mesh(target), target.sha256("sha256")),
                tuple(_placement(each, what) for each in lists["objects"]),
                tuple(_block(each, what) for each in lists["blocks"]),
                _visible(fields),
                _unreachable(fields),
            )
            target.end()
            fields.end()
        except ModelError as error:
            raise DatasetError(str(error)) from None
        return world

    @takes_paths("path")
    def save(self, path: Path) -> None:
        """Write its file, whole or not at all. The same world makes the same bytes."""
        with written_whole(path) as part:
            part.write_text(json.dumps(self.to_dict(), indent=1) + "\n")

    @classmethod
    @takes_paths("path")
    def load(cls, path: str | Path) -> World:
        """Read what ``save`` wrote.

        Raises:
            DatasetError: there is no such file, or it holds something else.
        """
        of_kind(path, str | Path, "a world is a file", DatasetError)
        path = Path(path)
        try:
            return cls.from_dict(read_object(path, "a world"), f"{path}")
        except FileNotFoundError:
            raise DatasetError(f"{path}: there is no such file") from None
        except ModelError as error:
            raise DatasetError(str(error)) from None


def _mesh(fields: Fields) -> str:
    """A mesh file below the folder of meshes: a world never makes anyone open another one."""
    name = fields.text("mesh")
    paths = PurePosixPath(name), PureWindowsPath(name)
    if not name.isprintable() or any(path.anchor or ".." in path.parts for path in paths):
        raise fields.wrong("mesh", "a path below the folder of meshes")
    return name


def _visible(fields: Fields) -> tuple[float, ...]:
    found = fields.numbers("visible", 1, np.zeros(0))
    if len(found) not in (0, VIEWS) or not ((found >= 0) & (found <= 1)).all():
        raise fields.wrong("visible", f"a list of {VIEWS} numbers from 0 to 1")
    return tuple(found.tolist())


def _unreachable(fields: Fields) -> tuple[int, ...]:
    found = fields.numbers("unreachable", 1, np.zeros(0))
    if not np.isin(found, np.arange(VIEWS)).all():
        raise fields.wrong("unreachable", f"a list of whole numbers from 0 to {VIEWS - 1}")
    return tuple(found.astype(int).tolist())


def _numbers(fields: Fields, *names: str) -> dict[str, float]:
    found = {name: fields.number(name) for name in names}
    for name, value in found.items():
        if abs(value) > FARTHEST:
            raise fields.wrong(name, f"within {FARTHEST:g} of 0")
    return found


def _placement(values: Any, what: str) -> Placement:
    fields = Fields(values, f"an object of {what}")
    numbers = _numbers(fields, "x", "y", "turn", "radius")
    found = Placement(_mesh(fields), fields.sha256("sha256"), **numbers)
    fields.end()
    if not found.radius > 0:
        raise fields.wrong("radius", "positive")
    return found


def _block(values: Any, what: str) -> Block:
    fields = Fields(values, f"a block of {what}")
    numbers = _numbers(fields, "x", "y", "turn", "width", "depth", "height")
    wall = fields.take("wall", False)
    fields.end()
    if not isinstance(wall, bool):
        raise fields.wrong("wall", "true or false")
    for name in ("width", "depth", "height"):
        if not numbers[name] > 0:
            raise fields.wrong(name, "positive")
    return Block(**numbers, wall=wall)
