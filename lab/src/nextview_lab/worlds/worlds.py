"""Random worlds for a depth camera: tables, floors, bins, shelves, belts and rooms with objects.

Objects are dropped onto a height map: they stand side by side, lie on each other, and fill bins.
The surfaces below them, containers and background are labelled, too. The worlds are used to train a
segmentation (``training/segmentation_training.py``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator
from scipy import ndimage
from scipy.spatial import QhullError
from scipy.spatial.transform import Rotation

from nextview.geometry.pinhole import PinholeCamera
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.viewsphere import look_at_origin
from nextview.simulation.boxes import upright_boxes
from nextview.simulation.sensor import SENSORS, Sensor
from nextview.types import Float, Float32, Index, Mask
from nextview_lab.worlds.solids import (
    Solid,
    extruded,
    joined,
    lump,
    moved,
    random_solid,
    ring_points,
    tube,
)

# label of support surfaces: table tops, floors, boards, the bottoms of bins
SURFACE = -1
# label of everything else that is not an object: walls, sides of bins, people, grippers
BACKGROUND = -2
HOLE = -3  # label of a pixel without depth

MAP_CELLS = 160  # cells on each side of a height map
DROPS_TRIED = 25
# rays from each side that measure how far a solid can be pushed
CONTACT_RAYS = 1500
STACKED = 0.5  # share of piled objects that are placed on the last one
# share of worlds with groceries or flat objects alone; of cameras aimed beside the objects; of bins
# that are seen at a corner; of objects that lean, and their steepest lean, degrees
ONE_FAMILY = 0.6
ASIDE = 0.25
CORNERS = 0.25
LEANING = 0.15
MOST_LEAN = 55.0
FIXTURE_SCALE = 5.0  # of fixtures relative to objects: only their size tells them apart
SENSORS_DRAWN = ("none", "kinect", "kinect", "stereo", "stereo", "tof", "scanner")
# share of depth images that are smeared, by at most this share of the depth
SMEARED = 0.25
MOST_SMEARED = 0.3
# share of levels whose objects are rotated by quarter turns, so that their sides are parallel
ALIGNED = 0.4
STEPS_OUTWARDS = 60
SMALL_FURNITURE = 0.8  # metres, size of a monitor or a night stand
RAISED = 0.7  # share of small furniture placed on other furniture, if there is any
LEAST_STABLE = 0.03  # least probability of a resting pose
LARGEST_SHAPE = 20_000  # triangles


@dataclass(frozen=True, eq=False)
class Shape:
    """A solid with its resting poses.

    Attributes:
        family: one of ``solids.FAMILIES``, or "meshes".
        solid: vertices, (V, 3), metres, and triangles, (F, 3).
        resting: rotations to its stable poses, (P, 3, 3), at least one; the smallest rectangles
            around their outlines are parallel to x and y.
    """

    family: str
    solid: Solid
    resting: Float

    @classmethod
    def of(cls, family: str, solid: Solid) -> Shape:
        """Find the stable poses of a solid on a plane."""
        from trimesh import Trimesh
        from trimesh.poses import compute_stable_poses

        try:
            hull = Trimesh(*solid).convex_hull
            poses, shares = compute_stable_poses(hull, n_samples=1)
        except (QhullError, ValueError):  # flat or degenerate: original orientation
            return cls(family, solid, np.eye(3)[None])
        likely = poses[shares > LEAST_STABLE][:, :3, :3]
        if not len(likely):
            return cls(family, solid, np.eye(3)[None])
        corners = np.asarray(hull.vertices)
        return cls(
            family, solid, np.stack([_squared(turn, corners) for turn in likely])
        )


def _squared(turn: Float, corners: Float) -> Float:
    """Rotate about z so that the smallest rectangle around the outline is parallel to x and y.

    Args:
        turn: rotation, (3, 3).
        corners: of a solid, (N, 3).
    """
    from trimesh.bounds import oriented_bounds_2D

    on = np.eye(3)
    on[:2, :2] = oriented_bounds_2D((corners @ turn.T)[:, :2])[0][:2, :2]
    return on @ turn


@dataclass(eq=False)
class World:
    """Solids in their poses, each with its label.

    Attributes:
        solids: in the world, metres, z up.
        labels: of each: the number of an object, SURFACE or BACKGROUND.
        focus: point at which the camera is aimed, (3,).
        scale: typical size of an object, metres.
        elevations: of the camera, degrees, least and greatest.
        yaw: viewing direction of the camera, radians; None for any.
    """

    focus: Float
    scale: float
    elevations: tuple[float, float]
    yaw: float | None = None
    solids: list[Solid] = field(default_factory=list)
    labels: list[int] = field(default_factory=list)

    def add(self, solid: Solid, label: int) -> None:
        """Add a solid.

        Args:
            solid: in its pose, metres.
            label: the number of an object, SURFACE or BACKGROUND.
        """
        self.solids.append(solid)
        self.labels.append(label)

    @property
    def things(self) -> int:
        """Number of objects."""
        return max([0, *(label + 1 for label in self.labels)])


class HeightMap:
    """The heights of a level and of the objects on it, on a grid of square cells."""

    def __init__(
        self, side: float, centre: Float, level: float, inside: float | None = None
    ) -> None:
        """Create an empty level.

        Args:
            side: of the square, metres.
            centre: of the square, (2,).
            level: its height, metres.
            inside: half the width of the area for objects; None for all.
        """
        self.cell = side / MAP_CELLS
        self.low = np.asarray(centre, float) - side / 2
        self.centre = np.asarray(centre, float)
        self.level = level
        self.reach = side / 2 if inside is None else inside
        self.heights = np.full((MAP_CELLS, MAP_CELLS), level)
        self.last = self.centre

    def drop(
        self,
        shape: Solid,
        rng: Generator,
        piled: bool,
        gap: float,
        spread: float,
        ceiling: float = np.inf,
        beside: Sequence[Solid] = (),
        axes: Float | None = None,
    ) -> Solid | None:
        """Lower a solid until it touches something.

        Args:
            shape: in its orientation; it is translated to a free position.
            rng: for the position.
            piled: whether it may lie on others.
            gap: distance from others if it may not lie on them, metres.
            spread: largest distance from the centre, metres.
            ceiling: height limit, metres.
            beside: others on the level, against one of which it is pushed until they touch; not
                used if it may lie on them.
            axes: horizontal directions along which it is pushed, (A, 3); None for any.

        Returns:
            The solid in its pose; None if there is no room.
        """
        vertices, faces = shape
        low = vertices.min(0)
        high = vertices.max(0)
        half = (high - low)[:2] / 2
        if half.max() > self.reach:
            return None

        bottom, top = self._profiles(shape)
        there = np.isfinite(bottom)
        if not there.any():
            return None

        margin = 0 if piled else int(np.ceil(gap / self.cell))
        around = _widened(there, margin)
        for middle in self._places(rng, piled, spread):
            if (np.abs(middle - self.centre) + half > self.reach).any():
                continue
            at = np.floor((middle - half - self.low) / self.cell).astype(int)
            here = self._cells(at, there.shape)
            if here is None or not (piled or self._is_free(at - margin, around)):
                continue

            rise = float((here[there] - bottom[there]).max())
            if rise + high[2] > ceiling:
                continue
            corner = self.low + at * self.cell
            placed = vertices + np.append(corner - low[:2], rise), faces
            if beside and not piled:
                pushed = _pushed(placed, beside, axes)
                moved_by = np.rint((pushed[0] - placed[0])[0, :2] / self.cell)
                below = self._cells(at + moved_by.astype(int), there.shape)
                if below is not None:
                    here = below
                    placed = pushed
            here[there] = np.maximum(here, rise + top)[there]
            self.last = placed[0].mean(0)[:2]
            return placed
        return None

    def stands(self, solid: Solid, gap: float) -> bool:
        """Add a solid where it is, and return True, if nothing on the level is nearer than a gap.

        Args:
            solid: in its pose, standing on the level.
            gap: least distance from others, metres.
        """
        _, top = self._profiles(solid)
        there = np.isfinite(top)
        at = np.floor((solid[0].min(0)[:2] - self.low) / self.cell).astype(int)
        here = self._cells(at, there.shape)
        margin = int(np.ceil(gap / self.cell))
        if here is None or not self._is_free(at - margin, _widened(there, margin)):
            return False
        here[there] = np.maximum(here, top)[there]
        return True

    def _places(self, rng: Generator, piled: bool, spread: float) -> Iterator[Float]:
        """Iterate over positions, (2,) each: random ones, or from near the centre outwards."""
        angle = rng.uniform(0, 2 * np.pi)
        start = self.centre + rng.normal(0, spread / 2, 2)
        if piled:
            if rng.random() < STACKED:
                yield self.last + rng.normal(0, 0.06, 2) * spread
            for _ in range(DROPS_TRIED):
                yield self.centre + rng.uniform(-1, 1, 2) * spread
            return

        way = np.array([np.cos(angle), np.sin(angle)])
        for step in range(DROPS_TRIED + STEPS_OUTWARDS):
            yield start + step * 1.5 * self.cell * way

    def _cells(self, at: Index, shape: tuple[int, ...]) -> Float | None:
        """Return a view of a block of cells; None if it leaves the map."""
        if (at < 0).any() or (at + shape > MAP_CELLS).any():
            return None
        return self.heights[at[0] : at[0] + shape[0], at[1] : at[1] + shape[1]]

    def _is_free(self, at: Index, outline: Mask) -> bool:
        """Return True if an outline, (h, w) bool, whose first cell is ``at``, is free."""
        here = self._cells(at, outline.shape)
        return here is not None and not (here[outline] > self.level + 1e-9).any()

    def _profiles(self, solid: Solid) -> tuple[Float, Float]:
        """Return the lower and the upper height over the cells of a solid's outline."""
        vertices, _ = solid
        low = vertices.min(0)
        high = vertices.max(0)
        count = np.maximum(np.ceil((high - low)[:2] / self.cell).astype(int), 1)
        x = low[0] + (np.arange(count[0]) + 0.5) * self.cell
        y = low[1] + (np.arange(count[1]) + 0.5) * self.cell
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
        caster = RayCaster([solid])
        below = np.c_[grid, np.full(len(grid), low[2] - 1)]
        above = np.c_[grid, np.full(len(grid), high[2] + 1)]
        up = np.tile([0.0, 0.0, 1.0], (len(grid), 1))
        lower = low[2] - 1 + caster.cast(below, up)[0]
        upper = high[2] + 1 - caster.cast(above, -up)[0]
        return lower.reshape(count), upper.reshape(count)


def _widened(outline: Mask, margin: int) -> Mask:
    """Return an outline with a margin of some cells, larger by them on each side."""
    around = np.pad(outline, margin)
    return ndimage.binary_dilation(around, iterations=margin) if margin else around


def _pushed(solid: Solid, others: Sequence[Solid], axes: Float | None) -> Solid:
    """Push a solid horizontally until it touches one of some others.

    Args:
        solid: in its pose, apart from the others.
        others: in their poses.
        axes: directions of the push, (A, 3); None for any.
    """
    vertices, faces = solid
    middles = np.array([other[0].mean(0) for other in others])
    ways = (middles - vertices.mean(0)) * [1, 1, 0]
    way = ways[int(np.linalg.norm(ways, axis=1).argmin())]
    if axes is not None:
        way = axes[int((axes @ way).argmax())]
    length = np.linalg.norm(way)
    if length < 1e-6:
        return solid

    way = way / length
    ends = vertices[:: max(1, len(vertices) // CONTACT_RAYS)]
    back = np.concatenate([other[0] for other in others])
    back = back[:: max(1, len(back) // CONTACT_RAYS)]
    free = min(
        float(RayCaster(others).cast(ends, np.tile(way, (len(ends), 1)))[0].min()),
        float(RayCaster([solid]).cast(back, np.tile(-way, (len(back), 1)))[0].min()),
    )
    return (vertices + free * way, faces) if np.isfinite(free) else solid


def slab(
    size: Sequence[float], centre: Sequence[float] | Float, top: float, yaw: float = 0.0
) -> Solid:
    """Return a box with its top at a given height.

    Args:
        size: its sides, metres, (3,).
        centre: x and y of its centre.
        top: height of its top.
        yaw: rotation about z, radians.
    """
    box = upright_boxes(
        np.asarray(size, float)[None],
        np.array([yaw]),
        np.asarray(centre, float)[None, :2],
        top - size[2],
    )
    return box.vertices, box.faces


def draw_shapes(
    rng: Generator, count: int, others: Sequence[Solid] = ()
) -> list[Shape]:
    """Draw solids of unit size, and find their resting poses.

    Args:
        rng: source of all random numbers.
        count: number of solids.
        others: solids of any size that provide a quarter of them, such as meshes of toys.
    """
    shapes = []
    for _ in range(count):
        if len(others) and rng.random() < 0.25:
            vertices, faces = others[int(rng.integers(len(others)))]
            stretch = rng.uniform(0.6, 1.4, 3) if rng.random() < 0.5 else np.ones(3)
            extent = np.ptp(vertices, axis=0).max()
            family = "meshes"
            solid = vertices / extent * stretch, faces
        else:
            family, solid = random_solid(rng, 1.0)
        shapes.append(Shape.of(family, solid))
    return shapes


KINDS = {
    "table": 0.36,
    "bin": 0.16,
    "floor": 0.08,
    "shelf": 0.08,
    "room": 0.27,
    "belt": 0.05,
}
"""Kinds of worlds, and the share of each."""


def draw_world(
    shapes: Sequence[Shape],
    furniture: Sequence[Solid],
    rng: Generator,
    kind: str | None = None,
) -> World:
    """Draw a world.

    Args:
        shapes: of objects, of unit size.
        furniture: life-size, metres, z up, standing on z = 0; if it is empty, there are no rooms.
        rng: source of all random numbers.
        kind: one of ``KINDS``; None for any.
    """
    drawn = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    kind = drawn if kind is None else kind
    if kind == "room" and len(furniture):
        return _room(shapes, furniture, rng)
    if rng.random() < ONE_FAMILY:
        family = rng.choice(["groceries", "groceries", "flat"])
        shapes = [one for one in shapes if one.family == family] or shapes
    scale = float(np.exp(rng.uniform(np.log(0.03), np.log(0.17))))
    if kind == "bin":
        return _bin(shapes, furniture, rng, scale)
    if kind == "shelf":
        return _shelf(shapes, rng, scale)
    return _level(shapes, furniture, rng, scale, kind)


def _level(
    shapes: Sequence[Shape],
    furniture: Sequence[Solid],
    rng: Generator,
    scale: float,
    kind: str,
) -> World:
    """Draw objects on a table, a floor or a belt, side by side and on each other."""
    world = World(np.array([0, 0, scale / 3]), scale, (12.0, 88.0))
    yaw = rng.uniform(0, np.pi)
    if kind == "floor":
        world.add(slab((12, 12, 0.1), (0, 0), 0), SURFACE)
        reach = 20 * scale
    else:
        reach = _table_top(world, rng, yaw, kind == "belt", scale)
    _behind(world, furniture, rng, kind != "floor", scale)

    ground = HeightMap(
        2 * min(reach, 14 * scale), np.zeros(2), 0.0, min(reach, 10 * scale)
    )
    gap = scale * float(rng.choice([0.0, 0.0, 0.0, 0.1, 0.3, 1.0]))
    _fill(
        world,
        ground,
        shapes,
        rng,
        int(rng.choice([1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 24])),
        gap,
        float(rng.choice([0, 0.2, 0.4, 0.7, 1.0])),
    )
    _beside(world, rng, min(7 * scale, reach))
    _hands(world, rng)
    return world


def _beside(world: World, rng: Generator, reach: float) -> None:
    """Add fixtures where they touch no object.

    Args:
        world: to which they are added.
        rng: source of all random numbers.
        reach: largest distance of one from the centre, metres.
    """
    size = max(0.3, FIXTURE_SCALE * world.scale)
    objects = [
        s for s, label in zip(world.solids, world.labels, strict=True) if label >= 0
    ]
    for _ in range(int(rng.choice([0, 0, 0, 1, 2]))):
        angle = rng.uniform(0, 2 * np.pi)
        at = rng.uniform(0.3, 1) * reach * np.array([np.cos(angle), np.sin(angle)])
        apart = [np.linalg.norm(s[0][:, :2] - at, axis=1).min() for s in objects]
        if min(apart, default=size) > size / 2:
            turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
            world.add(moved(_fixture(rng, size), turn, (*at, 0)), BACKGROUND)


def _fixture(rng: Generator, size: float) -> Solid:
    """Return a monitor, a robot, a lamp or a post on its foot, on z = 0.

    Args:
        rng: source of all random numbers.
        size: of the foot, metres.
    """
    sides = int(rng.choice([4, 6, 32]))
    thick = rng.uniform(0.004, 0.03)
    foot = extruded([ring_points(size / 2, sides)], thick)
    lean, tall = rng.normal(0, 0.1), rng.uniform(0.3, 2.5)
    stem = size * np.linspace([0, 0, 0], [lean, 0, tall], 6)
    parts = [foot, tube(stem, np.full(6, size * rng.uniform(0.04, 0.3)))]
    if rng.random() < 0.4:  # a screen
        wide, high = size * rng.uniform(1.5, 3), size * rng.uniform(1, 2)
        parts.append(slab((0.03, wide, high), stem[-1], stem[-1, 2] + high / 2))
    if rng.random() < 0.4:  # an arm
        arm = stem[-1] + size * np.linspace([0, 0, 0], rng.normal(0, 1.5, 3), 6)
        parts.append(tube(np.abs(arm), np.full(6, size * rng.uniform(0.1, 0.25))))
    return joined(parts)


def _table_top(
    world: World, rng: Generator, yaw: float, belt: bool, scale: float
) -> float:
    """Add a table, or a belt with rails, over a floor; return its extent, metres."""
    height = rng.uniform(0.35, 1.0)
    length = max(rng.uniform(0.35, 1.8), 5 * scale)
    width = max(length * rng.uniform(0.5, 1.0), 4 * scale)
    if belt:
        length = 3.0
        width = max(rng.uniform(0.25, 0.7), 5 * scale)
        for side in (-1, 1):
            rail = rng.uniform(0.01, 0.06)
            at = side * (width / 2 + 0.02) * np.array([-np.sin(yaw), np.cos(yaw)])
            world.add(slab((length, 0.04, 0.08), at, rail, yaw), BACKGROUND)
    if not belt and rng.random() < 0.25:
        disc = extruded([ring_points(max(length, width) / 2, 40)], 0.03)
        world.add(moved(disc, by=(0, 0, -0.03)), SURFACE)
        width = length = max(length, width)
    else:
        world.add(
            slab((length, width, rng.uniform(0.015, 0.08)), (0, 0), 0, yaw), SURFACE
        )

    if rng.random() < 0.8:
        world.add(slab((12, 12, 0.1), (0, 0), -height), SURFACE)
    if rng.random() < 0.5:
        for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            corner = np.array([x * (length / 2 - 0.04), y * (width / 2 - 0.04)])
            corner = Rotation.from_euler("z", yaw).apply([*corner, 0])[:2]
            world.add(slab((0.05, 0.05, height), corner, -0.03, yaw), BACKGROUND)
    return width / 2


def _behind(
    world: World,
    furniture: Sequence[Solid],
    rng: Generator,
    raised: bool,
    scale: float,
) -> None:
    """Add walls, furniture and people behind a workplace."""
    floor = -rng.uniform(0.5, 0.9) if raised else 0.0
    for _ in range(int(rng.choice([0, 0, 1, 1, 2]))):
        angle = rng.uniform(0, 2 * np.pi)
        away = rng.uniform(0.5, 2.5) + 6 * scale
        at = away * np.array([np.cos(angle), np.sin(angle)])
        world.add(slab((0.1, 10, 4), at, 3.0, angle), BACKGROUND)

    for _ in range(int(rng.choice([0, 0, 0, 1, 2, 4]))):
        angle = rng.uniform(0, 2 * np.pi)
        away = rng.uniform(0.8, 2.0) + 5 * scale
        at = away * np.array([np.cos(angle), np.sin(angle)])
        if rng.random() < 0.4 or not len(furniture):
            world.add(moved(_person(rng), by=(*at, floor)), BACKGROUND)
        else:
            solid = furniture[int(rng.integers(len(furniture)))]
            turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
            world.add(moved(solid, turn, (*at, floor)), BACKGROUND)


def _person(rng: Generator) -> Solid:
    """Return a standing or sitting figure made of capsules, on z = 0, metres."""
    tall = rng.uniform(1.2, 1.9)
    head = lump(rng)
    parts = [
        (head[0] * 0.25 / np.ptp(head[0], axis=0).max() + [0, 0, tall - 0.12], head[1])
    ]
    hip = 0.5 * tall
    neck = tall - 0.28
    spine = np.linspace(
        [0, 0, hip], [rng.normal(0, 0.05), rng.normal(0, 0.05), neck], 8
    )
    parts.append(tube(spine, np.full(8, rng.uniform(0.11, 0.2)), 16))
    for side in (-1, 1):
        shoulder = np.array([0, side * 0.2, neck - 0.05])
        elbow = shoulder + rng.normal(0, 0.12, 3) + [0.05, side * 0.08, -0.25]
        hand = elbow + rng.normal(0, 0.12, 3) + [0.15, 0, -0.1]
        parts.append(tube(np.linspace(shoulder, elbow, 5), np.full(5, 0.05)))
        parts.append(tube(np.linspace(elbow, hand, 5), np.full(5, 0.04)))
        foot = np.array([rng.normal(0, 0.1), side * 0.12, 0])
        parts.append(tube(np.linspace([0, side * 0.1, hip], foot, 6), np.full(6, 0.08)))
    return joined(parts)


def _hands(world: World, rng: Generator) -> None:
    """Sometimes add a hand or a gripper from above, with or without an object."""
    if rng.random() > 0.12:
        return
    size = max(world.scale, 0.04)
    beside = rng.normal(0, 1.5 * size, 2)
    tip = world.focus + np.append(beside, rng.uniform(0.5, 2.5) * size)
    out = rng.normal(0, 1, 3)
    out[2] = abs(out[2]) + 0.5
    out /= np.linalg.norm(out)
    aside = np.cross(out, [1.0, 0, 0])
    aside /= np.linalg.norm(aside)

    palm = tip + 0.09 * out
    for side in (-1, 1):
        finger = np.linspace(
            palm + side * 0.04 * aside, tip + side * rng.uniform(0.01, 0.04) * aside, 5
        )
        world.add(tube(finger, np.full(5, rng.uniform(0.008, 0.014))), BACKGROUND)
    arm = np.linspace(palm, palm + 0.8 * out, 6)
    world.add(tube(arm, np.full(6, rng.uniform(0.03, 0.06))), BACKGROUND)


def _fill(
    world: World,
    ground: HeightMap,
    shapes: Sequence[Shape],
    rng: Generator,
    count: int,
    gap: float,
    piled: float,
    ceiling: float = np.inf,
) -> None:
    """Drop objects onto a level.

    Args:
        world: to which they are added.
        ground: the level.
        shapes: of unit size.
        rng: source of all random numbers.
        count: number of attempts.
        gap: metres between neighbours.
        piled: share of them that may lie on others.
        ceiling: height limit.
    """
    alike = (
        rng.random() < 0.2
    )  # copies of one shape, such as rows of boxes or a bin of one part
    base = rng.uniform(0, 2 * np.pi)
    aligned = rng.random() < ALIGNED
    quarters = base + np.arange(4) * np.pi / 2
    axes = np.c_[np.cos(quarters), np.sin(quarters), np.zeros(4)]

    beside: list[Solid] = []
    chosen = int(rng.integers(len(shapes)))
    size = world.scale
    free = rng.random() < 0.3

    for _ in range(count):
        if not alike:
            chosen = int(rng.integers(len(shapes)))
            size = world.scale * float(np.exp(np.clip(rng.normal(0, 0.45), -1.1, 0.9)))
        shape = shapes[chosen]
        turn = Rotation.from_matrix(
            shape.resting[int(rng.integers(len(shape.resting)))]
        )
        if free and rng.random() < 0.5:
            turn = Rotation.random(random_state=rng)
        yaw = rng.choice(quarters) if aligned else rng.uniform(0, 2 * np.pi)
        on_others = bool(rng.random() < piled)
        near = () if gap or rng.random() < 0.3 else beside
        ways = axes if aligned else None
        if near and not on_others and rng.random() < LEANING:
            lean = rng.uniform(8, MOST_LEAN)
            turn = Rotation.from_euler("y", lean, degrees=True) * turn
            ways = np.array([[np.cos(yaw), np.sin(yaw), 0.0]])
        turn = Rotation.from_euler("z", yaw) * turn
        solid = turn.apply(shape.solid[0] * size), shape.solid[1]

        spread = min(ground.reach, world.scale * rng.uniform(0.3, 2.0) * np.sqrt(count))
        dropped = ground.drop(solid, rng, on_others, gap, spread, ceiling, near, ways)
        if dropped is not None:
            world.add(dropped, world.things)
            if not on_others:
                beside.append(dropped)


def _bin(
    shapes: Sequence[Shape],
    furniture: Sequence[Solid],
    rng: Generator,
    scale: float,
) -> World:
    """Draw objects poured into a bin or a tray on a table or a floor."""
    world = World(np.array([0, 0, scale / 2]), scale, (35.0, 88.0))
    half = scale * rng.uniform(1.6, 5.0, 2)
    if rng.random() < 0.4:
        half = scale * rng.uniform(3.0, 7.0, 2)
    wall = float(np.clip(0.06 * scale, 0.002, 0.015)) * rng.uniform(0.5, 2)
    tall = scale * rng.uniform(0.3, 2.0)
    bottom = wall
    yaw = rng.uniform(0, 2 * np.pi)
    table = max(2.2 * float(half.max()), rng.uniform(0.4, 1.5))
    world.add(
        slab((2 * table, 2 * table, 0.05), (0, 0), 0, rng.uniform(0, np.pi)), SURFACE
    )
    world.add(slab((2 * half[0], 2 * half[1], bottom), (0, 0), bottom, yaw), SURFACE)
    for axis in (0, 1):
        for side in (-1, 1):
            size = [0.0, 0.0, tall]
            size[axis] = wall
            size[1 - axis] = 2 * half[1 - axis] + 2 * wall
            at = np.zeros(3)
            at[axis] = side * (half[axis] + wall / 2)
            at = Rotation.from_euler("z", yaw).apply(at)
            world.add(slab(size, at[:2], tall, yaw), BACKGROUND)
    _behind(world, furniture, rng, True, scale)
    if rng.random() < CORNERS:
        corner = Rotation.from_euler("z", yaw).apply([*half, 0.0])
        world.focus = world.focus + 0.8 * corner

    inner = HeightMap(2 * float(half.max()) * 1.5, np.zeros(2), bottom)
    x, y = np.meshgrid(
        *(inner.low[k] + (np.arange(MAP_CELLS) + 0.5) * inner.cell for k in (0, 1)),
        indexing="ij",
    )
    own = Rotation.from_euler("z", -yaw).apply(
        np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    )
    outside = (np.abs(own[:, :2]) > half - inner.cell).any(1).reshape(x.shape)
    inner.heights[outside] = max(tall, 6 * scale)  # keeps objects within the walls
    count = int(rng.choice([1, 2, 3, 5, 5, 8, 12, 20, 30]))
    _fill(
        world, inner, shapes, rng, count, 0.0, float(rng.choice([0.2, 1.0])), 5 * scale
    )
    _hands(world, rng)
    return world


def _shelf(shapes: Sequence[Shape], rng: Generator, scale: float) -> World:
    """Draw objects on the boards of a shelf, seen from the front."""
    clear = scale * rng.uniform(1.6, 3.5)
    width = scale * rng.uniform(6, 14)
    deep = scale * rng.uniform(2.5, 5)
    world = World(np.array([0.0, 0.0, clear / 2]), scale, (-8.0, 40.0), yaw=0.0)
    levels = int(rng.integers(1, 4))
    thick = 0.15 * scale
    for level in range(-levels, levels + 1):
        world.add(slab((deep, width, thick), (0, 0), level * clear), SURFACE)

    tall = (2 * levels + 1) * clear
    if rng.random() < 0.7:
        world.add(slab((thick, width, tall), (-deep / 2, 0), tall / 2), BACKGROUND)
    for side in (-1, 1):
        if rng.random() < 0.7:
            at = (0, side * width / 2)
            world.add(slab((deep, thick, tall), at, tall / 2), BACKGROUND)

    for level in range(-levels, levels):
        if level not in (-1, 0) and rng.random() < 0.5:
            continue
        for column in np.linspace(-1, 1, 3) * width / 3:
            ground = HeightMap(deep, np.array([0.0, column]), level * clear)
            count = int(rng.integers(0, 5))
            gap = scale * float(rng.choice([0.0, 0.05, 0.3]))
            ceiling = (level + 1) * clear - thick
            _fill(world, ground, shapes, rng, count, gap, 0.15, ceiling)
    return world


def _room(shapes: Sequence[Shape], furniture: Sequence[Solid], rng: Generator) -> World:
    """Draw life-size furniture on a floor, in front of walls, with or without objects on it."""
    world = World(np.array([0, 0, 0.4]), 1.0, (5.0, 55.0))
    world.add(slab((14, 14, 0.1), (0, 0), 0), SURFACE)
    for angle in rng.uniform(0, 2 * np.pi, int(rng.integers(0, 3))):
        away = rng.uniform(1.5, 4)
        at = away * np.array([np.cos(angle), np.sin(angle)])
        world.add(slab((0.1, 14, 6), at, 3.0, float(angle)), BACKGROUND)

    ground = HeightMap(8.0, np.zeros(2), 0.0)
    gap = float(rng.choice([0.02, 0.1, 0.4]))
    for _ in range(int(rng.integers(1, 5))):
        solid = furniture[int(rng.integers(len(furniture)))]
        solid = moved(solid, Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)))
        small = np.ptp(solid[0], axis=0).max() < SMALL_FURNITURE
        raised = bool(small and world.things and rng.random() < RAISED)
        dropped = ground.drop(solid, rng, raised, gap, 1.0)
        if dropped is not None:
            world.add(dropped, world.things)

    for _ in range(int(rng.choice([0, 0, 1, 3]))):
        shape = shapes[int(rng.integers(len(shapes)))]
        pose = shape.resting[int(rng.integers(len(shape.resting)))]
        turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
        size = rng.uniform(0.1, 0.4)
        vertices = (turn * Rotation.from_matrix(pose)).apply(shape.solid[0] * size)
        dropped = ground.drop((vertices, shape.solid[1]), rng, True, 0.0, 0.6)
        if dropped is not None:
            world.add(dropped, world.things)
    return world


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """A simulated depth image of a world with labels.

    Attributes:
        depth: (H, W) float32, metres; 0 without valid depth.
        labels: object of each pixel, SURFACE, BACKGROUND or HOLE, (H, W) int16.
        intrinsics: pinhole matrix, (3, 3); the first pixel's centre is at 0.5.
        pose: of the camera in the world, (4, 4).
    """

    depth: Float32
    labels: Index
    intrinsics: Float
    pose: Float

    @property
    def up(self) -> Float:
        """Direction against gravity in camera axes, (3,)."""
        return self.pose[2, :3]


def photograph(
    world: World, rng: Generator, shape: tuple[int, int], views: int
) -> list[LabelledFrame]:
    """Capture a world from several poses, each time with another sensor.

    Args:
        world: the world.
        rng: source of all random numbers.
        shape: rows and columns of the images.
        views: number of images.
    """
    caster = RayCaster(world.solids)
    label_of = np.array([*world.labels, HOLE])
    frames: list[LabelledFrame] = []
    while len(frames) < views:
        sensor = _sensor(rng, shape)
        pose = _camera_pose(world, rng)
        rays = PinholeCamera.of(sensor.intrinsics, shape).rays.reshape(-1, 3)

        depth, owner = caster.cast(pose[:3, 3], rays @ pose[:3, :3].T)
        clean = np.where(np.isfinite(depth), depth, 0).reshape(shape).astype(np.float32)
        if (clean > 0).mean() < 0.2 or np.median(clean[clean > 0]) < 0.12:
            views -= 1  # the camera is behind or inside something
            continue

        labels = label_of[owner]
        clean = _smeared(clean * _warp(rng, shape), rng)
        measured, source = sensor.measure(clean, rng)
        labels = np.where(source >= 0, labels[np.maximum(source, 0)], BACKGROUND)
        measured = _blind_spots(measured, labels, rng)
        labels = np.where(measured > 0, labels, HOLE)
        frames.append(LabelledFrame(measured, labels, sensor.intrinsics, pose))
    return frames


def _camera_pose(world: World, rng: Generator) -> Float:
    """Draw a camera-to-world pose, (4, 4), aimed at the centre of a world."""
    elevation = np.radians(rng.uniform(*world.elevations))
    azimuth = rng.uniform(0, 2 * np.pi)
    if world.yaw is not None:
        azimuth = world.yaw + rng.uniform(-0.9, 0.9)
    near = 3.0 if world.scale < 0.5 else 1.8
    distance = float(np.clip(world.scale * near * 4.5 ** rng.random(), 0.22, 5.5))
    pose = look_at_origin(np.array([elevation]), np.array([azimuth]), distance)[0]
    aside = world.scale * np.array([1.2, 1.2, 0.3]) * rng.normal(0, 1, 3)
    if world.scale > 0.5:
        aside /= 3
    elif rng.random() < ASIDE:
        aside *= 1.8
    pose[:3, 3] += world.focus + aside

    roll = rng.normal(0, 4) if rng.random() < 0.9 else rng.uniform(0, 360)
    pose[:3, :3] = (
        pose[:3, :3] @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
    )
    return pose


def _sensor(rng: Generator, shape: tuple[int, int]) -> Sensor:
    """Draw a sensor whose images are downscaled to this shape, with its errors at that size."""
    known = SENSORS[str(rng.choice(SENSORS_DRAWN))]
    focal = known.focal / known.width * shape[1] * rng.uniform(0.8, 1.6)
    smaller = shape[1] / known.width

    strength = rng.uniform(0.3, 1.3)
    return replace(
        known.scaled(strength),
        height=shape[0],
        width=shape[1],
        focal=float(focal),
        disparity=known.disparity * strength * smaller,
        step=known.step * smaller,
        lateral=known.lateral * strength * smaller,
        flying=known.flying * strength * 0.4,
        grain=float(rng.uniform(0.0, 1.5)) if known.grain else 0.0,
        bent=known.bent * strength * smaller,
        holes=known.holes * strength * 0.5,
        nearest=0.0,
        farthest=SENSORS["stereo"].farthest,
    )


def _warp(rng: Generator, shape: tuple[int, int]) -> Float32:
    """Draw smooth scale errors of the depth, as in a badly calibrated camera."""
    if rng.random() < 0.5:
        return np.ones(shape, np.float32)
    coarse = rng.normal(rng.normal(0, 0.006), rng.uniform(0, 0.004), (4, 5))
    return (1 + ndimage.zoom(coarse, np.divide(shape, coarse.shape), order=3)).astype(
        np.float32
    )


def _smeared(depth: Float32, rng: Generator) -> Float32:
    """Smear depth across outlines, as stereo does."""
    if rng.random() > SMEARED:
        return depth
    width = rng.uniform(0.4, 1.6)
    seen = ndimage.gaussian_filter((depth > 0).astype(np.float32), width)
    smooth = ndimage.gaussian_filter(depth, width) / np.maximum(seen, 1e-6)
    most = MOST_SMEARED * depth
    return np.where(depth > 0, depth + np.clip(smooth - depth, -most, most), 0)


def _blind_spots(depth: Float32, labels: Index, rng: Generator) -> Float32:
    """Remove depth from dark or shiny objects, and from random patches."""
    depth = depth.copy()
    for thing in np.unique(labels[labels >= 0]):
        if rng.random() < 0.1:
            lost = ndimage.gaussian_filter(rng.normal(size=depth.shape), 3.0)
            depth[(labels == thing) & (lost > rng.normal(0, 0.06))] = 0
    if rng.random() < 0.15:
        lost = ndimage.gaussian_filter(rng.normal(size=depth.shape), 4.0)
        depth[lost > np.quantile(lost, rng.uniform(0.9, 0.99))] = 0
    return depth
