"""The layout of a room: a small JSON file from which the room is rebuilt exactly.

Lengths are in metres and angles in radians. The world frame is z up; its origin is in the centre of
the floor.
"""

from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, Struct

from nextview.errors import DatasetError
from nextview.files import read_record, write_record
from nextview_lab.worlds.scene_layout import (
    LAYOUT_LENGTH,
    Hash,
    Length,
    Size,
    below_the_meshes,
)

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
Rotation = Annotated[tuple[Length, ...], Meta(min_length=9, max_length=9)]
Pose = Annotated[tuple[Length, ...], Meta(min_length=16, max_length=16)]


class Standing(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A life-size mesh at rest on a floor or a table.

    Attributes:
        mesh: its file, below the folder of meshes.
        sha256: of that file.
        radius: its object radius.
        x: centre of its bounding box.
        y: centre of its bounding box.
        z: of its lowest point.
        azimuth: rotation about the vertical, applied after ``rotation``.
        rotation: to its resting pose, (3, 3), row by row.
    """

    mesh: str
    sha256: Hash
    radius: Size
    x: Length = 0.0
    y: Length = 0.0
    z: Length = 0.0
    azimuth: Length = 0.0
    rotation: Rotation = IDENTITY

    def __post_init__(self) -> None:
        below_the_meshes(self.mesh)


class Slab(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """An upright box: a table top, its legs, a cabinet.

    Attributes:
        x: of its centre.
        y: of its centre.
        z: of its bottom.
        azimuth: rotation about the vertical.
        width: along its own x axis.
        depth: along its own y axis.
        height: of the box.
        even: whether its top is flat; table tops are slightly uneven.
    """

    x: Length
    y: Length
    z: Length
    azimuth: Length
    width: Size
    depth: Size
    height: Size
    even: bool = True


class RoomLayout(Struct, frozen=True, forbid_unknown_fields=True):
    """A room with a target on its floor or on a table, and a first camera pose.

    Attributes:
        name: unique in its folder, "chair_0890@room-1".
        kind: support of the target.
        seed: with which the room was drawn.
        label: the class of the target.
        target: the target object.
        width: of the room, along x.
        depth: of the room, along y.
        height: of the room.
        pose: of the first camera, camera-to-world, (4, 4), row by row; OpenCV axes, level.
        objects: other meshes.
        slabs: boxes.
    """

    name: str
    kind: Literal["floor", "table"]
    seed: int
    label: str
    target: Standing
    width: Size
    depth: Size
    height: Size
    pose: Pose
    objects: Annotated[tuple[Standing, ...], LAYOUT_LENGTH] = ()
    slabs: Annotated[tuple[Slab, ...], LAYOUT_LENGTH] = ()

    def save(self, path: Path) -> None:
        """Write the file, completely or not at all. The same room gives identical files."""
        write_record(path, self)

    @classmethod
    def load(cls, path: str | Path) -> "RoomLayout":
        """Read a file written by ``save``; DatasetError if it is missing or invalid."""
        return read_record(Path(path), cls, "a room", DatasetError)
