"""The layout of a scene around a target: a JSON file from which the scene is rebuilt exactly."""

import re
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from nextview.errors import DatasetError
from nextview.files import read_record, write_record
from nextview.types import Float

# mean visible share of the target
CLUTTER_LEVELS = {"light": 0.85, "medium": 0.65, "heavy": 0.45}
ROOM = "room"  # level of a scene in a room, where things are life-size
# half the side of the square table, object radii, with room for the clutter
SCENE_TABLE = 3.4
# names of generated scenes: target, level and number
NAMED = re.compile(r".*@(\w+)-\d+")
SUFFIX = ".json"
LAYOUT_VIEWS = 40
# or radians; limited to preserve numerical precision
Length = Annotated[float, Meta(ge=-1000, le=1000)]
Size = Annotated[float, Meta(gt=0, le=1000)]
Hash = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
LAYOUT_LENGTH = Meta(max_length=1000)
Rotation = Annotated[tuple[Length, ...], Meta(min_length=9, max_length=9)]
Pose = Annotated[tuple[Length, ...], Meta(min_length=16, max_length=16)]
UPRIGHT: Rotation = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def clutter_level(name: str) -> str:
    """Return the clutter level in a scene's name; "" for other names, such as those of objects."""
    match = NAMED.fullmatch(name)
    return match[1] if match else ""


def below_the_meshes(path: str) -> None:
    """Check that a path is below the folder of meshes; ValueError otherwise."""
    paths = PurePosixPath(path), PureWindowsPath(path)
    if not path.isprintable() or any(one.anchor or ".." in one.parts for one in paths):
        raise ValueError("a mesh is a path below the folder of meshes")


class Placement(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """An object on the table: its mesh file and its position.

    Attributes:
        mesh: path of the mesh file.
        sha256: of the mesh file.
        x: centre of the bounding box, object radii of the target.
        y: centre of the bounding box, object radii of the target.
        azimuth: rotation about the vertical, radians.
        radius: of the object, object radii of the target.
        rotation: to its resting pose, (3, 3), row by row; the azimuth follows.
    """

    mesh: str
    sha256: Hash
    x: Length = 0.0
    y: Length = 0.0
    azimuth: Length = 0.0
    radius: Size = 1.0
    rotation: Rotation = UPRIGHT

    def __post_init__(self) -> None:
        below_the_meshes(self.mesh)


class Block(Struct, frozen=True, forbid_unknown_fields=True):
    """An upright box on the table.

    Attributes:
        x: of its centre, object radii of the target.
        y: of its centre, object radii of the target.
        azimuth: rotation about the vertical, radians.
        width: object radii of the target.
        depth: object radii of the target.
        height: object radii of the target.
        wall: whether the camera cannot be behind it.
        z: of its bottom above the table, object radii of the target.
    """

    x: Length
    y: Length
    azimuth: Length
    width: Size
    depth: Size
    height: Size
    wall: bool = False
    z: Length = 0.0


class SceneLayout(Struct, frozen=True, forbid_unknown_fields=True):
    """A target at rest on a table or a floor, in its object frame, and the objects around it.

    Attributes:
        name: unique in its folder, "chair_0890@medium-1".
        level: clutter level, one of CLUTTER_LEVELS, ROOM, or a custom word.
        seed: with which the scene was drawn.
        target: in the centre of the table, at azimuth 0.
        objects: the other objects.
        blocks: boxes and walls.
        visible: visible share of the target's pixels from each of the 40 views; () if not measured.
        unreachable: indices of the views that no camera can reach.
        table: half the side of the square table or floor, object radii.
        label: class of the target; "" if not known.
        metres: object radius of the target; None if not known.
        pose: of the first camera in a room, camera-to-world, (4, 4), row by row, metres; None for
            none.
    """

    name: str
    level: str
    seed: int
    target: Placement
    objects: Annotated[tuple[Placement, ...], LAYOUT_LENGTH] = ()
    blocks: Annotated[tuple[Block, ...], LAYOUT_LENGTH] = ()
    visible: Annotated[
        tuple[Annotated[float, Meta(ge=0, le=1)], ...],
        Meta(max_length=LAYOUT_VIEWS),
    ] = ()
    unreachable: Annotated[
        tuple[Annotated[int, Meta(ge=0, lt=LAYOUT_VIEWS)], ...],
        Meta(max_length=LAYOUT_VIEWS),
    ] = ()
    table: Size = SCENE_TABLE
    label: str = ""
    metres: Size | None = None
    pose: Pose | None = None

    def __post_init__(self) -> None:
        mine = self.target
        if mine != Placement(mine.mesh, mine.sha256, rotation=mine.rotation):
            raise ValueError("the target stands in the middle as it is")
        if len(self.visible) not in (0, LAYOUT_VIEWS):
            raise ValueError(f"visible has {LAYOUT_VIEWS} numbers")

    @property
    def first_pose(self) -> Float:
        """Pose of the first camera in a room, (4, 4), metres."""
        return np.reshape(np.array(self.pose, np.float64), (4, 4))

    def save(self, path: Path) -> None:
        """Write the file, completely or not at all. The same scene gives identical files."""
        write_record(path, self)

    @classmethod
    def load(cls, path: str | Path) -> "SceneLayout":
        """Read a file written by ``save``; DatasetError if it is missing or invalid."""
        return read_record(Path(path), cls, "a scene", DatasetError)
