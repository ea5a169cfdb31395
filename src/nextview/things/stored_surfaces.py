"""Compact storage of surfaces: 16-bit coordinates in the bounding box of each thing."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.checks import check_array
from nextview.errors import ModelError
from nextview.things.surface import Surface
from nextview.types import Float, Index

BOX_STEPS = 65535  # steps of a box along each axis: 5 micrometres for a thing of 30 cm
SHORT = 65536  # most vertices with 16-bit indices
LARGEST_EXTENT = 1e4  # largest extent of a box, and distance from the origin, metres


@dataclass(frozen=True, eq=False)
class StoredSurfaces:
    """Surfaces of T things, concatenated.

    Attributes:
        places: coordinates of all vertices, in steps of the box of their thing, (V, 3) uint16.
        faces: indices of vertices within the thing, (F, 3) uint16 or uint32.
        counts: number of vertices and of faces of each thing, (T, 2) int64.
        boxes: lowest corner and extents of the bounding box of each thing, in the frame of its scan
            file, (T, 2, 3) float64, metres.
    """

    places: NDArray[np.uint16]
    faces: NDArray[np.unsignedinteger]
    counts: Index
    boxes: Float

    def __post_init__(self) -> None:
        check_array("its places", self.places, np.uint16, (None, 3))
        check_array("its faces", self.faces, np.unsignedinteger, (None, 3))
        check_array("its counts", self.counts, np.int64, (None, 2))
        check_array("its boxes", self.boxes, np.float64, (len(self.counts), 2, 3))

        if (self.counts < 1).any():
            raise ModelError("its counts are not valid for surfaces")
        totals = (len(self.places), len(self.faces))
        if _sums(self.counts) != totals:
            raise ModelError("its counts do not add up to its places and faces")

        extents = self.boxes[:, 1]
        if (np.abs(self.boxes) > LARGEST_EXTENT).any() or (extents < 0).any():
            raise ModelError("its boxes have invalid sizes or positions")
        if (extents.max(1) == 0).any():
            raise ModelError("its boxes contain things without extent")

        limits = np.repeat(self.counts[:, 0], self.counts[:, 1])
        if (self.faces >= limits[:, None]).any():
            raise ModelError("its faces refer to missing vertices")
        for thing in range(len(self.counts)):
            self._check_surface(thing)

    def _check_surface(self, thing: int) -> None:
        """Check that a surface fills its box and has an area, as the registration requires."""
        places, faces = self._of(thing)
        extents = self.boxes[thing, 1]
        steps = np.where(extents > 0, BOX_STEPS, 0)
        if (places.min(0) != 0).any() or (places.max(0) != steps).any():
            raise ModelError("its places do not fill the boxes of their things")
        corners = (places * extents)[faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        if not across.any():
            raise ModelError("its faces have no area")

    def _of(self, thing: int) -> tuple[NDArray[np.uint16], NDArray[np.unsignedinteger]]:
        """Coordinates and faces of a thing."""
        vertices, faces = self.counts[thing].tolist()
        vertex, face = self.counts[:thing].sum(0).tolist()
        return self.places[vertex : vertex + vertices], self.faces[face : face + faces]

    @classmethod
    def of(cls, surfaces: Sequence[Surface]) -> "StoredSurfaces":
        """Store surfaces.

        Args:
            surfaces: surface of each thing.

        Returns:
            The surfaces, rounded to the steps of their boxes.
        """
        places = []
        faces = []
        counts = np.zeros((len(surfaces), 2), np.int64)
        boxes = np.zeros((len(surfaces), 2, 3))

        for number, surface in enumerate(surfaces):
            vertices = surface.vertices.astype(np.float64)
            low = vertices.min(0)
            extents = vertices.max(0) - low
            steps = np.divide(
                vertices - low,
                extents,
                np.zeros_like(vertices),
                where=extents > 0,
            )
            places.append(np.rint(steps * BOX_STEPS).astype(np.uint16))
            faces.append(surface.faces.astype(np.uint32))
            counts[number] = len(vertices), len(surface.faces)
            boxes[number] = low, extents

        together: NDArray[np.unsignedinteger] = np.concatenate(faces)
        if counts[:, 0].max() <= SHORT:
            together = together.astype(np.uint16)
        return cls(np.concatenate(places), together, counts, boxes)

    def __len__(self) -> int:
        """Number of things."""
        return len(self.counts)

    def surface(self, thing: int, name: str) -> Surface:
        """Restore the surface of a thing.

        Args:
            thing: number of the thing.
            name: name of the thing.

        Returns:
            The surface.
        """
        places, faces = self._of(thing)
        low, extents = self.boxes[thing]
        return Surface(
            name,
            (low + places / BOX_STEPS * extents).astype(np.float32),
            faces.astype(np.int32),
        )


def _sums(counts: Index) -> tuple[int, int]:
    """Sums of counts, (T, 2); Python integers do not overflow."""
    vertices, faces = counts.T.tolist()
    return sum(vertices), sum(faces)
