"""Register hypotheses to depth images, many at once and without rendering.

Points that a camera would see of a thing in its pose are projected into the image, and moved
towards the planes at what is measured there (point to plane, with projective data association:
Blais and Levine, "Registering multiview range data to create 3D computer objects", 1995). Where
the image shows through a point, the point is pulled back into the outline of its segment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from nextview.sensing.view import View
from nextview.things.contour import contour_equations
from nextview.things.library import Hypotheses, Library
from nextview.things.score import NOT_MEASURED, OUTLIER
from nextview.types import Float, Float32, Floats, Mask

POINTS = 96  # of each thing that are compared with a view
LARGEST_TURN = 0.3  # radians in one step
LARGEST_SHIFT = 0.25  # radii of the thing in one step
LEAST_REACH = 0.003  # metres within which a measured point belongs to one of a thing
DAMPING = 0.01  # weight of the present pose, points
OUTLINE_STEP = 4  # pixels, accuracy of the outline of a segment
OUTLINE_WEIGHT = 0.5  # of a point that is seen through, against one that matches
# of a point where nothing is measured, against one that is seen through, as in the score
MISSING_WEIGHT = np.float32(NOT_MEASURED / OUTLIER)
# 1/metres^2, information of a point on the right surface: it is 2 mm off, as eight neighbours are
POINT_INFORMATION = 1 / 0.002**2 / 8
# standard deviations of the place of a thing by the error of a camera, left before each step
CAMERA_ERRORS_LEFT = (4.0, 3.0, 3.0, 2.0, 2.0, 1.0, 1.0, 0.5)
CONTOUR_REACH = 1.4  # times what is left of the error
LEAST_CAMERA_REACH = 0.02  # radii


@dataclass(frozen=True, eq=False)
class Outline:
    """Where the nearest pixel of a segment is.

    Attributes:
        row: of the nearest pixel of each block of pixels, (h, w) float32.
        column: of the nearest pixel, (h, w) float32.
        beyond: whether the block is outside of the segment, (h, w) bool.
    """

    row: Float32
    column: Float32
    beyond: Mask

    @classmethod
    def of(cls, mask: Mask) -> Outline:
        """Return the outline of a segment, (H, W) bool, to a few pixels."""
        height, width = mask.shape
        blocks = np.pad(mask, ((0, -height % OUTLINE_STEP), (0, -width % OUTLINE_STEP)))
        rows, columns = (side // OUTLINE_STEP for side in blocks.shape)
        small = blocks.reshape(rows, OUTLINE_STEP, columns, OUTLINE_STEP).max((1, 3))
        nearest = ndimage.distance_transform_edt(
            ~small, return_distances=False, return_indices=True
        )
        row, column = nearest.astype(np.float32) * OUTLINE_STEP + OUTLINE_STEP // 2
        return cls(row, column, ~small)

    def at(
        self, row: NDArray[np.int32], column: NDArray[np.int32]
    ) -> tuple[Float32, Float32, Mask]:
        """Return the way down and aside to the segment, pixels, and whether there is one."""
        at = row // OUTLINE_STEP * self.row.shape[1] + column // OUTLINE_STEP
        down = self.row.take(at) - row.astype(np.float32)
        aside = self.column.take(at) - column.astype(np.float32)
        return down, aside, self.beyond.take(at)


@dataclass(frozen=True, eq=False)
class Projected:
    """Points of hypotheses in an image.

    Attributes:
        points: in the axes of the camera, (M, 3, N) float32, metres.
        normals: in the axes of the camera, (M, 3, N) float32.
        middle: centre of each hypothesis in the axes of the camera, (M, 3) float32, metres.
        inside: points within the image, (M, N) bool.
        row: of each point, (M, N) int32; 0 outside of the image.
        column: of each point, (M, N) int32; 0 outside of the image.
        depth: that is measured there, (M, N) float32, metres; 0 for none.
        fill: share of a square around each thing that shows it, (M,) float32.
    """

    points: Float32
    normals: Float32
    middle: Float32
    inside: Mask
    row: NDArray[np.int32]
    column: NDArray[np.int32]
    depth: Float32
    fill: Float32

    @classmethod
    def of(
        cls, library: Library, view: View, some: Hypotheses, count: int
    ) -> Projected:
        """Project points of hypotheses.

        Args:
            library: the things.
            view: the image.
            some: M hypotheses.
            count: number N of points of each.
        """
        axes = view.camera[:3, :3]
        place = view.camera[:3, 3]
        towards = np.einsum("mji,mj->mi", some.rotations, place - some.centres)
        # a ray of a stretched thing, in its own axes
        towards /= some.sizes
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        own, across, fill = library.seen_from(some.things, towards, count)
        sizes = some.sizes.astype(np.float32)[:, None]
        own, across = own * sizes, across / sizes
        across /= np.linalg.norm(across, axis=2, keepdims=True) + np.float32(1e-12)
        turn = (axes.T @ some.rotations).astype(np.float32)
        middle = ((some.centres - place) @ axes).astype(np.float32)
        points = turn @ own.swapaxes(1, 2) + middle[..., None]

        camera = view.frame.pinhole
        ahead = np.maximum(points[:, 2], 0.02)
        column = np.floor(camera.fx * points[:, 0] / ahead + camera.cx)
        row = np.floor(camera.fy * points[:, 1] / ahead + camera.cy)
        height, width = view.frame.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        inside &= points[:, 2] > 0.02
        column = np.where(inside, column, 0).astype(np.int32)
        row = np.where(inside, row, 0).astype(np.int32)
        return cls(
            points,
            turn @ across.swapaxes(1, 2),
            middle,
            inside,
            row,
            column,
            view.depth[row, column],
            fill,
        )

    def measured(self, view: View) -> Float32:
        """Return the measured point at each point, (M, 3, N) float32, axes of the camera."""
        x, y = view.frame.rays
        z = self.depth
        return np.stack([x[self.column] * z, y[self.row] * z, z], 1)


def register(
    library: Library,
    views: Sequence[View],
    some: Hypotheses,
    reaches: Sequence[float],
    count: int = POINTS,
    outline: Outline | None = None,
) -> Hypotheses:
    """Move hypotheses to where they fit best, from where they are.

    Args:
        library: the things.
        views: in which they are seen.
        some: M hypotheses.
        reaches: for each step, how far from a thing what is measured belongs to it, radii.
        count: number of points of each in a view.
        outline: of the segment that they explain, in the one view; None for none.

    Returns:
        The hypotheses in their new poses.
    """
    for reach in reaches:
        some = _step(library, views, some, reach, count, outline)
    return some


def camera_error(library: Library, view: View, some: Hypotheses) -> View:
    """Correct the pose of a camera by things that are known to stand where they are.

    Args:
        library: the things.
        view: the view.
        some: hypotheses that hold.

    Returns:
        The view with another ``camera``.
    """
    told = np.repeat(np.array(library.camera) ** -2.0, 3)
    moved = np.zeros(6)
    for reach in (0.15, 0.1, 0.06, 0.04, 0.03):
        left, right = normal_equations(library, view, some, reach)
        # a motion of each thing about its centre, as one of the world about the camera
        left, right = (each.sum(0) for each in _about_camera(view, some, left, right))
        # the things would have to move by this; so the camera moves the other way
        step = np.linalg.solve(
            POINT_INFORMATION * left + np.diag(told),
            POINT_INFORMATION * right + told * moved,
        )
        moved = moved - step
        camera = view.camera.copy()
        camera[:3, :3] = turned(-step[None, :3])[0] @ camera[:3, :3]
        camera[:3, 3] -= step[3:]
        view = view.seen_from(camera)
    return view


def seen_by_camera(library: Library, view: View, some: Hypotheses) -> Hypotheses:
    """Move each hypothesis to where the view shows it, as far as errors of its camera reach.

    Args:
        library: the things.
        view: the view.
        some: M hypotheses, of which one holds.
    """
    # the pose is from a view with an error of its own: their difference has twice the variance
    told = np.repeat(np.array(library.camera) ** -2.0, 3) / 2
    # an error of the camera looks like the opposite motion of the thing; some of it is corrected
    given = view.frame.camera_to_world
    turn = Rotation.from_matrix(given[:3, :3] @ view.camera[:3, :3].T).as_rotvec()
    known = np.concatenate([turn, given[:3, 3] - view.camera[:3, 3]])
    moved = np.tile(known, (len(some), 1))
    place = view.camera[:3, 3]
    away = np.linalg.norm(some.centres - place, axis=1)
    error = np.hypot(library.camera[1], library.camera[0] * away)
    radius = library.radii[some.things]
    for number, share in enumerate(CAMERA_ERRORS_LEFT):
        reach = np.maximum(share * error / radius, LEAST_CAMERA_REACH)
        left, right = normal_equations(library, view, some, reach, hidden=share <= 1)
        left, right = (POINT_INFORMATION * one for one in (left, right))
        if number:  # a contour is sought where its depth is known
            reach = CONTOUR_REACH * share * error
            edges = contour_equations(library, view, some, reach, alone=True)
            left, right = left + edges[0], right + edges[1]
        left, right = _about_camera(view, some, left, right)
        right = right - told * moved
        step = np.linalg.solve(left + np.diag(told), right[..., None])[..., 0]
        moved += step
        turn = turned(step[:, :3])
        arm = some.centres - place
        some = replace(
            some,
            rotations=turn @ some.rotations,
            centres=place + np.einsum("mij,mj->mi", turn, arm) + step[:, 3:],
        )
    # the contour has a bias; in the directions that points tell, they are more exact
    return register(library, [view], some, (0.03, 0.02))


def _about_camera(
    view: View, some: Hypotheses, left: Float, right: Float
) -> tuple[Float, Float]:
    """Return normal equations of hypotheses, (M, 6, 6) and (M, 6), for motions about the camera."""
    arm = some.centres - view.camera[:3, 3]
    about = np.tile(np.eye(6), (len(some), 1, 1))
    about[:, 3:, :3] = -skew(arm)
    return (
        np.einsum("mji,mjk,mkl->mil", about, left, about),
        np.einsum("mji,mj->mi", about, right),
    )


def _step(
    library: Library,
    views: Sequence[View],
    some: Hypotheses,
    reach: float,
    count: int,
    outline: Outline | None,
) -> Hypotheses:
    """Take one Gauss-Newton step."""
    left = np.zeros((len(some), 6, 6))
    right = np.zeros((len(some), 6))
    for view in views:
        of_view = normal_equations(library, view, some, reach, count, outline)
        left += of_view[0]
        right += of_view[1]

    # a step is short, and damped
    radius = library.radii[some.things][:, None]
    stays = np.concatenate([np.tile(radius**2, 3), np.ones((len(some), 3))], 1)
    left[:, range(6), range(6)] += stays * DAMPING * count * len(views)
    step = np.linalg.solve(left, right[..., None])[..., 0]
    turn = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
    shift = np.linalg.norm(step[:, 3:], axis=1, keepdims=True)
    step[:, :3] *= np.minimum(1, LARGEST_TURN / np.maximum(turn, 1e-9))
    step[:, 3:] *= np.minimum(1, LARGEST_SHIFT * radius / np.maximum(shift, 1e-9))
    return Hypotheses(
        some.things,
        turned(step[:, :3]) @ some.rotations,
        some.centres + step[:, 3:],
        some.sizes,
    )


def normal_equations(
    library: Library,
    view: View,
    some: Hypotheses,
    reach: float | Float,
    count: int = POINTS,
    outline: Outline | None = None,
    hidden: bool = False,
) -> tuple[Float, Float]:
    """Return the normal equations of one view for a small motion of each hypothesis.

    Args:
        library: the things.
        view: the view.
        some: M hypotheses.
        reach: how far from a thing what is measured belongs to it, radii.
        count: number of points of each.
        outline: of the segment that they explain; None for none.
        hidden: whether what is measured in front of a point hides it.

    Returns:
        Left side, (M, 6, 6), and right side, (M, 6), float64: rotation about the centre and shift,
        world axes, radians and metres.
    """
    seen = Projected.of(library, view, some, count)
    radius = library.radii[some.things]
    near = np.maximum(reach * radius, LEAST_REACH)[:, None].astype(np.float32)
    gap = seen.measured(view) - seen.points
    off = np.einsum("min,min->mn", seen.normals, gap)
    used = seen.inside & (seen.depth > 0) & (np.abs(gap[:, 2]) < 4 * near)
    used &= ~view.surface[seen.row, seen.column]
    if hidden:
        used &= gap[:, 2] > -near
    if outline is not None:
        down, aside, beyond = outline.at(seen.row, seen.column)
        # what is measured in front of a point beside the segment hides it
        used &= ~(beyond & (gap[:, 2] < -near))
    weight = np.where(used, 1 / (1 + (off / near) ** 2), 0)

    arm = seen.points - seen.middle[..., None]
    slope = np.concatenate([cross(arm, seen.normals), seen.normals], 1)
    weighted = slope * weight[:, None]
    left = weighted @ slope.swapaxes(1, 2)
    right = (weighted @ off[..., None])[..., 0]

    if outline is not None:
        ahead = seen.points[:, 2]
        through = seen.inside & (seen.depth > ahead + near) & beyond
        missing = seen.inside & (seen.depth == 0) & beyond
        far = np.hypot(down, aside) + np.float32(1e-6)
        towards = np.stack([aside / far, down / far, np.zeros_like(far)], 1)
        focal = view.frame.pinhole.fx
        off = np.minimum(far * ahead / focal, 2 * near)
        weight = np.float32(OUTLINE_WEIGHT) * (through + MISSING_WEIGHT * missing)
        slope = np.concatenate([cross(arm, towards), towards], 1)
        weighted = slope * weight[:, None]
        left = left + weighted @ slope.swapaxes(1, 2)
        right = right + (weighted @ off[..., None])[..., 0]

    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = view.camera[:3, :3]
    return turn @ left.astype(np.float64) @ turn.T, right.astype(np.float64) @ turn.T


def cross(one: Float32, other: Float32) -> Float32:
    """Return the cross products of vectors, (M, 3, N)."""
    x, y, z = one[:, 0], one[:, 1], one[:, 2]
    u, v, w = other[:, 0], other[:, 1], other[:, 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], 1)


def skew(vectors: Floats) -> Float:
    """Return the matrices of the cross products with vectors, (..., 3) to (..., 3, 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    none = np.zeros_like(x)
    rows = [[none, -z, y], [z, none, -x], [-y, x, none]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def turned(vectors: Floats) -> Float:
    """Return the rotations by rotation vectors, (M, 3) to (M, 3, 3), radians."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    cross = skew(vectors)
    small = angle < 1e-6
    safe = np.where(small, 1, angle)
    once = np.where(small, 1, np.sin(safe) / safe)
    twice = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    return np.eye(3) + once * cross + twice * cross @ cross
