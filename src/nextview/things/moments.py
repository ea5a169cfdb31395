"""Propose things and poses by the moments of what a view shows of them, where it shows them whole.

The mean and the covariance of the points that a camera sees of a thing tell from where it is seen.
Noise hardly changes them, even where a thing has too few pixels for normals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nextview.geometry.axes import looking_from
from nextview.sensing.view import View
from nextview.things.point_pairs import FEWEST, TURNS
from nextview.types import Float, Float32, Floats, Index, Mask


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments of what cameras in all directions see of things.

    Attributes:
        means: of the points, relative to the centre, in the axes of the camera, (T, D, 3) float64,
            metres.
        products: covariances in the axes of the camera after each turn about its ray, as vectors of
            the same length, (T, D * TURNS, 6) float32, square metres.
        looks: axes of the cameras, (D, 3, 3) float64.
    """

    means: Float
    products: Float32
    looks: Float

    @classmethod
    def of(cls, points: Float32, looks: Float) -> Moments:
        """Return the moments of points.

        Args:
            points: that each camera sees of each thing, relative to its centre, (T, D, N, 3)
                float32, metres.
            looks: rotations to the axes of the cameras, (D, 3, 3).
        """
        own = points @ looks.swapaxes(1, 2).astype(np.float32)
        means = own.mean(2)
        off = own - means[:, :, None]
        each = off.swapaxes(2, 3) @ off / off.shape[2]
        turns = about_the_ray()
        turned = turns @ each[:, :, None] @ turns.swapaxes(1, 2)
        return cls(
            means.astype(np.float64),
            as_vectors(turned).reshape(len(points), -1, 6).astype(np.float32),
            looks,
        )

    def propose(
        self, view: View, mask: Mask, among: Mask, most: int, of_one: int
    ) -> tuple[Index, Float, Float]:
        """Propose poses of things that a segment may show as a whole.

        Args:
            view: the view.
            mask: pixels of the segment, (H, W) bool.
            among: things that it may show, (T,) bool.
            most: number of poses, at most.
            of_one: number of poses of one thing, at most.

        Returns:
            M poses, those with the most similar moments first, as ``PointPairs.propose`` returns
            them.
        """
        stride = view.stride
        own = mask[::stride, ::stride] & (view.grid().depth > 0)
        points = view.points(np.flatnonzero(own))
        if len(points) < FEWEST:
            return np.zeros(0, np.int64), np.zeros((0, 3, 3)), np.zeros((0, 3))
        middle = points.mean(0)
        ray = view.camera[:3, 3] - middle
        look = looking_from((ray / np.linalg.norm(ray))[None])[0]
        seen = (points - middle) @ look.T
        goal = as_vectors(np.cov(seen.T, bias=True)).astype(np.float32)

        # the most similar poses of each thing, then of all
        off = np.einsum("tpi,tpi->tp", self.products, self.products)
        off -= 2 * (self.products @ goal)
        off[~among] = np.inf
        poses = np.argpartition(off, of_one, axis=1)[:, :of_one]
        things = np.repeat(np.arange(len(off)), of_one)
        order = np.argsort(np.take_along_axis(off, poses, 1).ravel(), kind="stable")
        order = order[among[things[order]]][:most]
        things = things[order]
        direction, turn = np.divmod(poses.ravel()[order], TURNS)
        to_world = look.T @ about_the_ray()[turn]
        arms = np.einsum("nij,nj->ni", to_world, self.means[things, direction])
        return things, to_world @ self.looks[direction], middle - arms


def about_the_ray() -> Float:
    """Return rotations about the third axis, (TURNS, 3, 3)."""
    angle = np.arange(TURNS) * (2 * np.pi / TURNS)
    found = np.zeros((TURNS, 3, 3))
    found[:, 0, 0] = found[:, 1, 1] = np.cos(angle)
    found[:, 1, 0] = np.sin(angle)
    found[:, 0, 1] = -np.sin(angle)
    found[:, 2, 2] = 1
    return found


def as_vectors(matrices: Floats) -> Floats:
    """Return symmetric matrices as vectors of the same length, (..., 3, 3) to (..., 6)."""
    rows, columns = np.triu_indices(3)
    return matrices[..., rows, columns] * np.where(rows == columns, 1, np.sqrt(2))
