"""What one frame shows beside the object: surfaces that a camera must not touch, and the walls
of the room.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nextview.sensing.facets import Noise
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import ObjectFrame
from nextview.sensing.observed_object import Sighting
from nextview.sensing.segmentation import Plane

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

MOST_POINTS = 6000  # of a frame that are looked at
# parts of the depth between neighbouring pixels, at an edge, where a sensor makes up points
JUMP = 0.03
# metres above the support plane, beside the noise, up to which a point lies on it
NEAR_PLANE = 0.02
AROUND = 1.1  # object radii around the centre within which a surface counts as the object's own
FEWEST_POINTS = 3  # that are measured near a place before it counts as occupied
WINDOW = 2  # pixels to each side that tell what lies on the line of sight to a place

MOST_WALLS = 4
TRIALS = 100  # lines that are tried for each wall
LEAST_OF_FRAME = 0.05  # share of a frame's points that lie on a wall
WALL_WIDTH = 0.5  # metres that a frame shows of a wall, at least
WALL_HEIGHT = 0.1  # metres; a camera that looks down on a table sees a strip of the wall behind it
WALL_TOLERANCE = 0.02  # metres, beside the noise
BEHIND = 0.15  # metres behind a wall from which on a point does not belong to it
# share of a frame's points that may lie behind a wall: reflections, a door that stands open
MOST_BEHIND = 0.03


@dataclass(frozen=True)
class Surroundings:
    """What a frame shows beside the object.

    Attributes:
        frame: the frame itself.
        noise: of its depth.
        plane: the support plane, if it is known.
        points: some of what the frame shows, world, metres, (N, 3), edges left out.
        tolerance: how far each point may be off, metres, (N,).
        walls: upright planes behind which the frame shows next to nothing; their normals point to
            the camera.
    """

    frame: Frame
    noise: Noise
    plane: Plane | None
    points: Float
    tolerance: Float
    walls: tuple[Plane, ...]

    @classmethod
    def of(cls, sighting: Sighting, around: ObjectFrame) -> "Surroundings":
        """The surroundings of an object that a sighting shows.

        Args:
            sighting: the frame, its noise and the support plane.
            around: the object, whose own surface is no wall.
        """
        frame = sighting.frame
        rows, columns = _smooth_pixels(frame)
        points = frame.positions(rows, columns)
        depth = frame.depth[rows, columns].astype(np.float64)
        tolerance = _tolerance(sighting.noise, depth)
        high = _height(points, sighting.plane) > NEAR_PLANE + tolerance
        walls = _find_walls(points, tolerance, high, frame.camera_to_world[:3, 3], around)
        return cls(frame, sighting.noise, sighting.plane, points, tolerance, walls)

    def is_near(self, places: Float, around: ObjectFrame, clearance: float) -> Mask:
        """Whether a surface was measured near places, neither the object's own nor the support
        plane.

        Args:
            places: (V, 3), world, metres.
            around: the object.
            clearance: how near, metres.

        Returns:
            (V,) bool.
        """
        # Only what lies as far from the object as the places do can be near them.
        reach = np.linalg.norm(places - around.centre, axis=1)
        away = np.linalg.norm(self.points - around.centre, axis=1)
        kept = (away > reach.min() - clearance) & (away < reach.max() + clearance)
        kept &= away > AROUND * around.radius
        kept &= _height(self.points, self.plane) > NEAR_PLANE + self.tolerance

        apart = np.linalg.norm(places[:, None] - self.points[kept][None], axis=2)
        return (apart < clearance).sum(1) >= FEWEST_POINTS

    def shows_behind(self, wall: Plane) -> bool:
        """Whether the camera stood behind what another frame took for a wall, or sees something
        there.
        """
        if wall.height(self.frame.camera_to_world[:3, 3]) < 0:
            return True
        return _share_behind(wall.height(self.points), self.tolerance) > MOST_BEHIND

    def look_at(self, places: Float, around: ObjectFrame, margin: float) -> tuple[Mask, Mask]:
        """Which places the frame looks through, and which ones something else than the object hides
        from it.

        Args:
            places: (V, 3), world, metres.
            around: the object: what is behind it is not taken for hidden, as it has to be looked at
                from there.
            margin: metres in front of a place or behind it, within which a surface says neither.

        Returns:
            Free and hidden, (V,) bool each. Of places outside of the picture neither is said.
        """
        pose = self.frame.camera_to_world
        camera = pose[:3, 3]
        seen_at = (places - camera) @ pose[:3, :3]
        away = seen_at[:, 2]
        measured = self._depth_towards(seen_at)

        known = np.isfinite(measured)
        free = known & (measured > away + margin)
        blocked = known & (measured < away - margin)

        share = np.where(blocked, measured / np.where(blocked, away, 1), 0)
        surface = camera + (places - camera) * share[:, None]
        own = np.linalg.norm(surface - around.centre, axis=1) < AROUND * around.radius
        depth = np.where(blocked, measured, 1)
        on_plane = _height(surface, self.plane) < NEAR_PLANE + _tolerance(self.noise, depth)
        return free, blocked & ~own & ~on_plane

    def _depth_towards(self, seen_at: Float) -> Float:
        """Median depth around the pixels that points, (V, 3), camera frame, fall on; NaN where
        there is none.
        """
        height, width = self.frame.shape
        k = self.frame.intrinsics
        ahead = seen_at[:, 2] > 1e-6
        z = np.where(ahead, seen_at[:, 2], 1)
        column = np.floor(seen_at[:, 0] / z * k[0, 0] + k[0, 2])
        row = np.floor(seen_at[:, 1] / z * k[1, 1] + k[1, 2])
        inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)

        around = np.arange(-WINDOW, WINDOW + 1)
        rows = np.clip(row[inside, None, None].astype(int) + around[:, None], 0, height - 1)
        columns = np.clip(column[inside, None, None].astype(int) + around, 0, width - 1)
        windows = self.frame.depth[rows, columns].astype(np.float64)
        depth = windows.reshape(len(windows), len(around) ** 2)

        # The middle of what is measured in each window: zeros, which mean nothing, are sorted to
        # the front.
        depth = np.sort(depth, axis=1)
        measured = (depth > 0).sum(1)
        middle = depth.shape[1] - (measured + 1) // 2
        found = np.full(len(seen_at), np.nan)
        median = depth[np.arange(len(depth)), np.minimum(middle, depth.shape[1] - 1)]
        found[inside] = np.where(measured > 0, median, np.nan)
        return found


def _height(points: Float, plane: Plane | None) -> Float:
    """Of points above the support plane, metres, (N,); infinity where no plane is known."""
    return np.full(len(points), np.inf) if plane is None else plane.height(points)


def _tolerance(noise: Noise, depth: Float) -> Float:
    """How far what is measured at some depths, metres, may be off, metres."""
    return 3 * noise.at(depth) * depth**2 + 0.003 * depth


def _smooth_pixels(frame: Frame) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of a grid of pixels with a depth, but for those at an edge."""
    height, width = frame.shape
    step = max(1, int(np.sqrt(height * width / MOST_POINTS)))
    rows, columns = np.nonzero(frame.depth[step // 2 :: step, step // 2 :: step])
    rows = step // 2 + step * rows
    columns = step // 2 + step * columns

    depth = frame.depth[rows, columns]
    smooth = np.ones(len(rows), bool)
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        beside = frame.depth[
            np.clip(rows + down, 0, height - 1), np.clip(columns + right, 0, width - 1)
        ]
        smooth &= (beside > 0) & (np.abs(beside - depth) < JUMP * depth)
    return rows[smooth], columns[smooth]


def _find_walls(
    points: Float, tolerance: Float, high: Mask, camera: Float, around: ObjectFrame
) -> tuple[Plane, ...]:
    """Upright planes that end the room, as lines in the view from above, by RANSAC.

    Args:
        points: what a frame shows, world, (N, 3).
        tolerance: how far each may be off, (N,).
        high: which ones are above the support plane, (N,) bool.
        camera: where it stands, world, (3,).
        around: the object, whose own surface is no wall.
    """
    upright = (points - camera) @ around.axes.T
    others = high & (np.linalg.norm(points - around.centre, axis=1) > AROUND * around.radius)
    slack = WALL_TOLERANCE + tolerance
    rng = np.random.default_rng(0)
    walls: list[Plane] = []
    for _ in range(MOST_WALLS):
        if others.sum() < max(10, LEAST_OF_FRAME * len(points)):
            break
        line = _best_line(upright[others, :2], slack[others], rng)
        if line is None:
            break
        normal, offset = line
        # the camera is at 0, on the side where this is positive
        away = upright[:, :2] @ normal + offset
        on = others & (np.abs(away) < slack)
        behind = _share_behind(away, tolerance)
        if on.mean() >= LEAST_OF_FRAME and behind <= MOST_BEHIND and _is_large(upright[on], normal):
            world = normal @ around.axes[:2]
            wall = Plane(world, float(offset - world @ camera))
            if wall.height(around.centre) > 0:
                walls.append(wall)
        others = others & ~on
    return tuple(walls)


def _best_line(ground: Float, slack: Float, rng: np.random.Generator) -> tuple[Float, float] | None:
    """The line near most points, (N, 2): a normal that points to the origin, and an offset; or
    None.
    """
    first, second = ground[rng.integers(len(ground), size=(2, TRIALS))]
    along = second - first
    length = np.linalg.norm(along, axis=1)
    far_apart = length > WALL_WIDTH / 4
    if not far_apart.any():
        return None
    along = along[far_apart] / length[far_apart, None]
    normals = np.stack([-along[:, 1], along[:, 0]], 1)
    offsets = -(normals * first[far_apart]).sum(1)
    count = (np.abs(ground @ normals.T + offsets) < slack[:, None]).sum(0)
    best = int(count.argmax())

    normal = normals[best]
    offset = float(offsets[best])
    on = np.abs(ground @ normal + offset) < slack
    middle = ground[on].mean(0)
    spread = ground[on] - middle
    normal = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    offset = float(-normal @ middle)
    return (normal, offset) if offset >= 0 else (-normal, -offset)


def _share_behind(away: Float, tolerance: Float) -> float:
    """Share of points, at distances before a wall, (N,), and off by so much, that lie behind it."""
    return float((away < -(BEHIND + WALL_TOLERANCE + tolerance)).mean()) if len(away) else 0.0


def _is_large(upright: Float, normal: Float) -> bool:
    """Whether points on an upright plane, (N, 3), z up, spread as wide and as high as a wall."""
    along = upright[:, :2] @ np.array([-normal[1], normal[0]])
    low, high = np.quantile(along, [0.02, 0.98])
    bottom, top = np.quantile(upright[:, 2], [0.02, 0.98])
    return bool(high - low > WALL_WIDTH and top - bottom > WALL_HEIGHT)
