"""How a surface bends: its edges, corners, parts and curvature. Computed once a mesh."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from research.mesh_view import Surface

SAME = 1e-6
"""Vertices no farther apart than this, object radii, are one: many files hold each triangle with
corners of its own.
"""


def bent(surface: Surface) -> BentSurface:
    """A surface with its curvature; the same one for the same surface."""
    return surface.__dict__.setdefault(
        "bent",
        BentSurface(surface.vertices, surface.faces),
    )


class BentSurface(Surface):
    """A surface with its curvature, which lies in edges and corners.

    In an edge, its length by the angle it bends by; in a corner, its angle deficit. Faces may be
    turned either way.
    """

    @cached_property
    def places(self) -> NDArray[np.int64]:
        """The faces by places instead of vertices, (F, 3) int64: vertices in one place count as
        one.
        """
        cell = np.rint((self.vertices - self.vertices.min(0)) / SAME).astype(np.int64)
        # 2e6 at most: one number holds a place, and numbers are sorted ten times as fast
        width = cell.max(0) + 1
        key = (cell[:, 0] * width[1] + cell[:, 1]) * width[2] + cell[:, 2]
        return np.unique(key, return_inverse=True)[1].reshape(-1)[self.faces]

    @cached_property
    def _pairs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The two sides of each edge at which the surface goes on, each (E,): 3 f + k for corners k
        to k + 1 of face f.

        Two faces that share an edge by their vertices, and no third; or else by the places of
        these. Where parts of an object touch, each so remains a surface of its own. Faces without
        area have no edges.
        """
        left = np.flatnonzero(np.repeat(self.areas > 0, 3))
        found = []
        for ends in (self.faces, self.places):
            both = (
                np.sort(np.stack([ends, np.roll(ends, -1, 1)], 2), 2)
                .reshape(-1, 2)[left]
                .astype(np.int64)
            )
            _, edge, count = np.unique(
                both @ [int(ends.max()) + 1, 1],
                return_inverse=True,
                return_counts=True,
            )
            two = count[edge] == 2
            found.append(left[two][np.argsort(edge[two], kind="stable")].reshape(-1, 2))
            left = left[~two]
        first, second = np.concatenate(found).T
        return first, second

    @cached_property
    def parts(self) -> NDArray[np.int64]:
        """Which connected part of the surface each face belongs to, (F,) int64."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        first, second = self._pairs
        n = len(self.faces)
        graph = coo_array(
            (np.ones(len(first), bool), (first // 3, second // 3)),
            (n, n),
        )
        return connected_components(graph, directed=False)[1].astype(np.int64)

    @cached_property
    def corners(self) -> NDArray[np.int64]:
        """Which corner of the surface each corner of a face is, (F, 3) int64: one for all faces
        around it.

        Surfaces that touch in a place have corners of their own there.
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        first, second = self._pairs
        n = self.faces.size
        place = self.places.ravel()
        begin = second
        end = second - second % 3 + (second + 1) % 3
        # the neighbour may run along the edge either way
        same = place[first] == place[begin]
        ahead = first - first % 3 + (first + 1) % 3
        one = np.concatenate([first, ahead])
        other = np.concatenate([np.where(same, begin, end), np.where(same, end, begin)])
        graph = coo_array((np.ones(len(one), bool), (one, other)), (n, n))
        return (
            connected_components(graph, directed=False)[1]
            .astype(np.int64)
            .reshape(-1, 3)
        )

    @cached_property
    def angles(self) -> NDArray[np.float64]:
        """Of each face at its three corners, (F, 3) float64, radians; 0 of a face without area."""
        corners = self.vertices[self.faces]
        ahead = np.roll(corners, -1, 1) - corners
        behind = np.roll(corners, 1, 1) - corners
        return np.arctan2(2 * self.areas[:, None], (ahead * behind).sum(2))

    @cached_property
    def deficits(self) -> NDArray[np.float64]:
        """Angle deficit of each corner, float64, radians: 2 pi, or pi on an open edge, less the
        angles of its faces.
        """
        closed = np.zeros(self.faces.size, bool)
        closed[np.concatenate(self._pairs)] = True
        face, k = np.nonzero(~closed.reshape(-1, 3) & (self.areas > 0)[:, None])
        whole = np.full(int(self.corners.max()) + 1, 2 * np.pi)
        whole[self.corners[face, k]] = whole[self.corners[face, (k + 1) % 3]] = np.pi
        total = np.bincount(self.corners.ravel(), self.angles.ravel())
        return np.where(total > 0, whole - total, 0)

    @cached_property
    def gaussian(self) -> NDArray[np.float64]:
        """Gaussian curvature at each corner, per square object radius, float64.

        The angle deficit over a third of the area of the faces around it (Polonsky et al. 2005; the
        thesis's equation 4, which has the 3 below the line: nine times less, everywhere alike). 1 /
        r^2 on a sphere of radius r.
        """
        around = (
            np.bincount(
                self.corners.ravel(),
                np.repeat(self.areas, 3),
                len(self.deficits),
            )
            / 3
        )
        return np.divide(
            self.deficits,
            around,
            out=np.zeros_like(around),
            where=around > 0,
        )

    @cached_property
    def bends(self) -> NDArray[np.float64]:
        """Angle by which the surface bends at each face's three edges (corner k to k + 1), (F, 3)
        float64, 0 .. pi.

        0 where it does not go on: at open edges, and where more than two faces meet.
        """
        corners = self.vertices[self.faces]
        along = np.roll(corners, -1, 1) - corners
        inward = np.roll(corners, -2, 1) - corners
        square = np.maximum((along**2).sum(2, keepdims=True), np.finfo(float).tiny)
        inward = (
            inward - along * (inward * along).sum(2, keepdims=True) / square
        ).reshape(-1, 3)
        first, second = self._pairs
        u = inward[first]
        v = inward[second]
        opening = np.arctan2(np.sqrt((np.cross(u, v) ** 2).sum(1)), (u * v).sum(1))
        found = np.zeros(self.faces.size)
        found[first] = found[second] = np.pi - opening
        return found.reshape(-1, 3)

    @cached_property
    def lengths(self) -> NDArray[np.float64]:
        """Of each face's three edges, (F, 3) float64, object radii."""
        corners = self.vertices[self.faces]
        return np.sqrt(((np.roll(corners, -1, 1) - corners) ** 2).sum(2))

    @cached_property
    def mean_of_faces(self) -> NDArray[np.float64]:
        """Mean curvature, unsigned, integrated over each face, (F,) float64, object radii.

        The integral over a surface that bends at its edges is half the sum of length by angle
        (Cohen-Steiner and Morvan 2003); each of an edge's two faces has half of that. So cutting
        flat faces into smaller ones changes nothing.
        """
        return (self.lengths * self.bends).sum(1) / 4

    @cached_property
    def gaussian_of_faces(self) -> NDArray[np.float64]:
        """Gaussian curvature, unsigned, integrated over each face, (F,) float64, radians squared.

        Each corner's angle deficit, without sign, shared among its faces by their angles there.
        """
        total = np.bincount(
            self.corners.ravel(),
            self.angles.ravel(),
            len(self.deficits),
        )
        each = np.divide(
            np.abs(self.deficits),
            total,
            out=np.zeros_like(total),
            where=total > 0,
        )
        return (each[self.corners] * self.angles).sum(1)
