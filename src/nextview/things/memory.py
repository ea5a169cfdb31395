"""The memory of taught things: their surfaces, sizes and pictures."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from nextview.checks import check_array, did_you_mean, one_line
from nextview.errors import ModelError
from nextview.files import arrays_in, checked_bytes, new_file
from nextview.geometry.mesh import Mesh, make_mesh
from nextview.recognition.model_card import ModelCard, find_card
from nextview.recognition.novelty import ROUNDED
from nextview.things.stored_surfaces import StoredSurfaces
from nextview.types import Floats

THING_PICTURE = 64  # side of the picture of a thing, pixels
# metres: a camera cannot go around a larger thing
LARGEST_THING_RADIUS = 1e4


@dataclass(frozen=True)
class Memory:
    """T things, sorted by class.

    Attributes:
        rotations: Rotation from the axes of the file of each thing to z up, (T, 3, 3) float32.
        radii: Object radius of each thing, metres, (T,) float32.
        pictures: A picture of each thing, (T, 64, 64) uint8.
        surfaces: Surfaces of the things, in metres, in the frames of their scan files.
    """

    rotations: Floats
    radii: Floats
    pictures: NDArray[np.uint8]
    surfaces: StoredSurfaces

    def __post_init__(self) -> None:
        things = len(self.surfaces)
        check_array("its rotations", self.rotations, np.floating, (things, 3, 3))
        check_array("its radii", self.radii, np.floating, (things,))
        pictures = (things, THING_PICTURE, THING_PICTURE)
        check_array("its pictures", self.pictures, np.uint8, pictures)

        if not ((self.radii > 0) & (self.radii <= LARGEST_THING_RADIUS)).all():
            raise ModelError(
                f"its radii are not above zero and at most {LARGEST_THING_RADIUS:g} m"
            )

        rotations = self.rotations.astype(np.float64)
        products = rotations @ rotations.swapaxes(1, 2)
        turned = (
            np.abs(products - np.eye(3)).max() < ROUNDED
            and (np.linalg.det(rotations) > 0).all()
        )
        if not turned:
            raise ModelError("its rotations are not rotation matrices")

    def save(self, path: Path, overwrite: bool = False) -> str:
        """Write the memory to a .safetensors file.

        Args:
            path: path of the file.
            overwrite: whether to replace an existing file.

        Returns:
            SHA-256 of the file.
        """
        arrays = {name: np.ascontiguousarray(getattr(self, name)) for name in _ARRAYS}
        arrays |= {name: getattr(self.surfaces, name) for name in _OF_SURFACES}
        content = save(arrays)
        with new_file(path, overwrite) as part:
            part.write_bytes(content)
        return hashlib.sha256(content).hexdigest()


_OF_SURFACES = tuple(f.name for f in fields(StoredSurfaces))
_ARRAYS = tuple(f.name for f in fields(Memory) if f.name != "surfaces")


@lru_cache(maxsize=2)
def read_memory(path: Path, sha256: str) -> Memory:
    """Read a file that ``Memory.save`` wrote.

    Args:
        path: path of the file.
        sha256: expected hash of its content.

    Returns:
        The memory.

    Raises:
        ModelError: the file is missing, has another hash, or contains an invalid value.
    """
    content = checked_bytes(path, sha256, "a memory")
    where = f"{path}: not a memory"
    arrays = arrays_in(content, _ARRAYS, where)
    surfaces = arrays_in(content, _OF_SURFACES, where)
    try:
        return Memory(**arrays, surfaces=StoredSurfaces(**surfaces))
    except ModelError as error:
        raise ModelError(f"{where} ({error})") from None


def open_memory(model: str | Path) -> tuple[ModelCard, Memory]:
    """Open the card of a memory of taught things and the memory, and check that they agree.

    Args:
        model: name of a bundled memory, or the path of its card.

    Returns:
        The card and the memory.

    Raises:
        ModelError: one of them is missing or damaged, the memory was taught without a unit by an
            earlier version, or the two do not agree.
    """
    card = find_card(model)
    if card.memory is None:
        raise ModelError(f"{card.card_path}: is not a memory of things")
    if card.azimuth_bins:
        raise ModelError(
            f"{card.card_path}: is of an earlier version, and stores features of views, which are"
            " no longer used; teach it again with nextview learn and the unit of its meshes"
        )

    memory = read_memory(card.path, card.sha256)
    counts = {len(card.memory.things), len(card.calibration.hypotheses)}
    if counts != {len(memory.radii)}:
        raise ModelError(
            f"{card.path}: its things are not those of its card, {card.card_path}"
        )
    return card, memory


def taught_meshes(model: str | Path, names: Sequence[str]) -> list[Mesh]:
    """Return the stored surfaces of taught things as meshes, for example to simulate them.

    Args:
        model: name of a bundled memory, or the path of its card.
        names: of the things.

    Returns:
        The meshes, in metres, in the order of the names.

    Raises:
        ModelError: see ``open_memory``; or a thing is not known.
    """
    card, memory = open_memory(model)
    assert card.memory is not None
    known = [thing.name for thing in card.memory.things]
    meshes = []
    for name in names:
        if name not in known:
            raise ModelError(
                f"{card.card_path}: knows no {one_line(name)}{did_you_mean(name, known)}"
            )
        surface = memory.surfaces.surface(known.index(name), name)
        vertices = surface.vertices.astype(np.float64)
        meshes.append(make_mesh(vertices, surface.faces, name, "m"))
    return meshes
