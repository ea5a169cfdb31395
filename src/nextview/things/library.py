"""Taught things as the explanation of a picture needs them: surfaces and visible points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nextview.recognition.model_card import Symmetry
from nextview.things.surface import Surface, SurfaceCaster
from nextview.things.visible_points import ALL_AROUND, VisiblePoints, visible_points
from nextview.types import Float, Float32, Index, Mask

# errors of the pose of a camera, radians and metres: a robot's, calibrated by hand
CAMERA_ERROR = 0.006, 0.004
LEAST_CAMERA_ERROR = 1e-4  # metres: a more accurate camera counts as exact
OTHER_SIZE = 1.12  # factor by which what looks alike differs in size, at least
AS_LARGE = 1.3  # factor of the extents, within which two things may look alike
TURNS = 24  # rotations that are tried of what is nearly round
# none, and half turns about each axis
HALF_TURNS = np.array(
    [np.diag(one) for one in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
)
SAME_TURN = 2.97  # trace of the rotation between two that are one: 10 degrees
PARALLEL = 0.99  # cosine of the angle between two axes that are one


@dataclass(frozen=True, eq=False)
class Principal:
    """Principal axes of T things.

    Attributes:
        middles: mean of the visible points of each, relative to its centre, (T, 3), metres.
        axes: of each, the shortest first, as rows of a rotation, (T, 3, 3).
        extents: of each along these axes, (T, 3), metres.
    """

    middles: Float
    axes: Float
    extents: Float

    def alike(self, thing: int) -> Index:
        """Return the things that are about as large as one along each axis, itself among them."""
        factors = self.extents / self.extents[thing]
        return np.flatnonzero((np.abs(np.log(factors)) < np.log(AS_LARGE)).all(1))


class Library:
    """Surfaces of taught things, ready to be searched for.

    Attributes:
        names: of the things, in their order.
        symmetries: of each thing, by its name.
        near: rotations about the centroid after which each thing looks nearly the same, by its
            name, (N, 3, 3) float64.
        turns: the same, with those of exact symmetries, and products of them, (N, 3, 3) float64.
        caster: casts rays at their surfaces.
        visible: what cameras in all directions see of them.
        centres: centre of each in the frame of its scan file, (T, 3) float64, metres.
        radii: radius of each, (T,) float64, metres.
        corners: points of each that reach farthest, relative to its centre, (T, N, 3) float64,
            metres.
        camera: standard deviations of the pose of a camera: radians and metres.
    """

    def __init__(
        self,
        surfaces: Sequence[Surface],
        symmetries: Mapping[str, Any] = MappingProxyType({}),
        near: Mapping[str, Float] = MappingProxyType({}),
        turns: Mapping[str, Float] = MappingProxyType({}),
        threads: int = 1,
        directions: Float | None = None,
    ) -> None:
        """Render what can be seen of the things.

        Args:
            surfaces: of the things, with their names.
            symmetries: of each thing, by its name.
            near: rotations of each thing, by its name.
            turns: rotations of each thing, exact ones and products among them, by its name.
            threads: number of threads; 0 for one on each core.
            directions: from a thing to the cameras that see it, unit vectors, (D, 3); None for all
                around.
        """
        self.names = tuple(surface.name for surface in surfaces)
        self.symmetries = symmetries
        self.near = near
        self.turns = turns
        self.caster = SurfaceCaster(surfaces)
        self.camera = CAMERA_ERROR

        self.visible: VisiblePoints = (
            visible_points(self.caster, threads)
            if directions is None
            else VisiblePoints(self.caster, threads, directions)
        )
        self.centres = self.caster.centres.astype(np.float64)
        self.radii = self.caster.radii.astype(np.float64)
        self.corners = np.stack(
            [
                vertices[(vertices @ ALL_AROUND.T).argmax(0)]
                for vertices in (one.vertices - one.centre for one in surfaces)
            ]
        )

    @cached_property
    def principal(self) -> Principal:
        """Principal axes of the things."""
        points = self.visible.points.reshape(len(self), -1, 3).astype(np.float64)
        middles = points.mean(1)
        points -= middles[:, None]
        axes = np.linalg.eigh(points.swapaxes(1, 2) @ points)[1].swapaxes(1, 2)
        axes[:, 2] *= np.linalg.det(axes)[:, None]
        along = np.einsum("tij,tnj->tin", axes, self.corners - middles[:, None])
        return Principal(middles, axes, np.ptp(along, axis=2))

    def for_cameras(self, place: float, aim: float) -> Library:
        """Return the library for cameras with another accuracy of their poses.

        Args:
            place: standard deviation of the position, metres.
            aim: standard deviation of the orientation, radians.
        """
        other = copy(self)
        other.camera = aim, max(place, LEAST_CAMERA_ERROR)
        return other

    def __len__(self) -> int:
        """Number of things."""
        return len(self.names)

    def __deepcopy__(self, memo: dict[int, object]) -> Library:
        """The same object: it is immutable."""
        return self

    def seen_from(
        self, things: Index, towards: Float, count: int
    ) -> tuple[Float32, Float32, Float32]:
        """Return points of things that cameras in some directions see.

        Args:
            things: number of each thing, (M,) int64.
            towards: direction from its centre to the camera, in the axes of its scan, (M, 3).
            count: number of points, at most POINTS.

        Returns:
            The points relative to the centre of each thing, (M, count, 3) float32, metres; their
            unit normals, (M, count, 3) float32; and the area of the outline over that of a square
            around the sphere of the thing, (M,) float32.
        """
        nearest = (towards @ self.visible.directions.T).argmax(1)
        points = self.visible.points[things, nearest, :count]
        normals = self.visible.normals[things, nearest, :count]
        return points, normals, self.visible.fill[things, nearest]


def near_turns(near: Sequence[Symmetry], exact: Sequence[Symmetry]) -> Float:
    """Return rotations after which a thing looks nearly the same, but not quite, (N, 3, 3).

    Args:
        near: near symmetries, the exact ones among them.
        exact: symmetries.
    """
    vectors = [
        2 * np.pi * step / steps * np.array(one.axis)
        for one in near
        if not any(
            abs(np.dot(one.axis, other.axis)) > PARALLEL and one.order == other.order
            for other in exact
        )
        for steps in [one.order or TURNS]
        for step in range(1, steps)
    ]
    if not vectors:
        return np.zeros((0, 3, 3))
    return np.asarray(Rotation.from_rotvec(np.array(vectors)).as_matrix())


def closed(turns: Float) -> Float:
    """Return rotations and their products, none twice and not the identity, (N, 3, 3)."""
    if len(turns) > TURNS:  # a ball
        return turns
    kept = [np.eye(3)]
    for one in np.concatenate([turns, (turns[:, None] @ turns).reshape(-1, 3, 3)]):
        if max(np.trace(one.T @ other) for other in kept) < SAME_TURN:
            kept.append(one)
    return np.array(kept[1:]).reshape(-1, 3, 3)


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """M hypotheses, each that a thing lies in a pose.

    Attributes:
        things: number of the thing, (M,) int64.
        rotations: from the axes of its scan file to the world, (M, 3, 3) float64.
        centres: centre of its bounding box in the world, (M, 3) float64, metres.
        sizes: factors along the axes of its scan by which it is larger, (M, 3) float64; 1 for the
            taught thing itself.
    """

    things: Index
    rotations: Float
    centres: Float
    sizes: Float

    @classmethod
    def of(cls, things: Index, rotations: Float, centres: Float) -> Hypotheses:
        """Return hypotheses of the things in the sizes that were taught."""
        return cls(things, rotations, centres, np.ones((len(things), 3)))

    @classmethod
    def none(cls) -> Hypotheses:
        """Return no hypotheses."""
        return cls.of(np.zeros(0, np.int64), np.zeros((0, 3, 3)), np.zeros((0, 3)))

    @classmethod
    def joined(cls, several: Sequence[Hypotheses]) -> Hypotheses:
        """Return all of several sets of hypotheses."""
        return cls(
            np.concatenate([one.things for one in several]),
            np.concatenate([one.rotations for one in several]),
            np.concatenate([one.centres for one in several]),
            np.concatenate([one.sizes for one in several]),
        )

    def __len__(self) -> int:
        """Number of hypotheses."""
        return len(self.things)

    def __getitem__(self, rows: Index | slice) -> Hypotheses:
        """Return some of them, by indices, mask or slice."""
        return Hypotheses(
            self.things[rows],
            self.rotations[rows],
            self.centres[rows],
            self.sizes[rows],
        )

    @property
    def taught(self) -> Mask:
        """Those in the size that was taught, (M,) bool."""
        return np.asarray(np.isclose(self.sizes, 1).all(1))

    def turned(self, angle: float) -> Hypotheses:
        """Return six of each: turned about each axis of the world, both ways, radians."""
        vectors = angle * np.concatenate([np.eye(3), -np.eye(3)])
        turns = Rotation.from_rotvec(vectors).as_matrix()
        rotations = turns @ self.rotations[:, None]
        each = self[np.repeat(np.arange(len(self)), len(turns))]
        return replace(each, rotations=rotations.reshape(-1, 3, 3))

    def turned_alike(self, library: Library) -> tuple[Hypotheses, Index]:
        """Return these after turns of their things, and the row of each that it is made of."""
        turns = [
            library.turns.get(library.names[thing], np.zeros((0, 3, 3)))
            for thing in self.things
        ]
        row = np.repeat(np.arange(len(self)), list(map(len, turns)))
        each = self[row]
        rotations = each.rotations @ np.concatenate(turns)
        # the middles stay where they are
        middles = library.principal.middles[each.things][..., None]
        moved = ((each.rotations - rotations) @ middles)[..., 0]
        return replace(each, rotations=rotations, centres=each.centres + moved), row

    def in_other_sizes(self) -> Hypotheses:
        """Return eight of each: larger and smaller, as a whole and along each axis."""
        along = np.concatenate([np.eye(3), np.ones((1, 3))])
        factors = OTHER_SIZE ** np.concatenate([along, -along])
        rows = np.repeat(np.arange(len(self)), len(factors))
        sizes = self.sizes[:, None] * factors
        return replace(self[rows], sizes=sizes.reshape(-1, 3))

    def lookalikes(self, library: Library, among: Mask) -> list[Hypotheses]:
        """Return for each of these what may look nearly the same in its place.

        That is the thing after turns of near symmetries, and all things that are about as large,
        with their principal axes along its own.

        Args:
            library: the things.
            among: things that they may be, (T,) bool; all of these among them.
        """
        own = library.principal
        found = []
        for thing, rotation, centre in zip(
            self.things, self.rotations, self.centres, strict=True
        ):
            near = library.near.get(library.names[thing], np.zeros((0, 3, 3)))
            others = own.alike(thing)
            others = others[among[others]]

            # the axes of the other on its own; not the thing itself as it lies
            turned = own.axes[thing].T @ HALF_TURNS @ own.axes[others][:, None]
            things = np.append(np.repeat(others, 4), np.full(len(near), thing))
            rotations = rotation @ np.concatenate([turned.reshape(-1, 3, 3), near])
            itself = 4 * np.searchsorted(others, thing)
            things, rotations = (
                np.delete(each, itself, 0) for each in (things, rotations)
            )

            # the middles stay where they are
            arms = np.einsum("nij,nj->ni", rotations, own.middles[things])
            centres = centre + rotation @ own.middles[thing] - arms
            found.append(Hypotheses.of(things, rotations, centres))
        return found

    def pose(self, row: int, library: Library) -> Float:
        """Return the pose of the scan of one, scan-to-world, (4, 4) float64, metres."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotations[row]
        own = library.centres[self.things[row]]
        pose[:3, 3] = self.centres[row] - self.rotations[row] @ own
        return pose
