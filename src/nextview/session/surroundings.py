"""What a frame shows beside the object: surfaces to keep clear of, and walls of the room."""

from dataclasses import dataclass

import numpy as np

from nextview.sensing.facets import Noise
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import ObjectFrame
from nextview.sensing.planes import Plane, sample
from nextview.sensing.sighting import Sighting
from nextview.sensing.walls import find_walls
from nextview.types import Float, Index, Mask

MOST_SURROUNDING_POINTS = 6000  # of a frame that are looked at
# parts of the depth between neighbouring pixels, at an edge, where a sensor makes up points
JUMP = 0.03
# metres above the support plane, beside the noise, up to which a point lies on it
NEAR_SUPPORT = 0.02
OWN_RADIUS = 1.1  # object radii around the centre within which a surface counts as the object's own
FEWEST_NEAR_POINTS = 3  # that are measured near a place before it counts as occupied
# pixels to each side that tell what lies on the line of sight to a place
SIGHT_WINDOW = 2
NARROWEST_WALL = 0.5  # metres that a frame shows of a wall, at least
WALL_TOLERANCE = 0.02  # metres, beside the noise
BEHIND = 0.15  # metres behind a wall from which on a point does not belong to it
# share of a frame's points that may lie behind a wall: reflections, a door that stands open
MOST_POINTS_BEHIND = 0.03


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
        walls = _walls(sighting, around)
        return cls(frame, sighting.noise, sighting.plane, points, tolerance, walls)

    def is_near(self, places: Float, around: ObjectFrame, clearance: float) -> Mask:
        """Whether a measured surface is near each place.

        The surfaces of the object and of the support plane do not count.

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
        kept &= away > OWN_RADIUS * around.radius
        kept &= _height(self.points, self.plane) > NEAR_SUPPORT + self.tolerance

        apart = np.linalg.norm(places[:, None] - self.points[kept][None], axis=2)
        return (apart < clearance).sum(1) >= FEWEST_NEAR_POINTS

    def shows_behind(self, wall: Plane) -> bool:
        """Whether the camera stood behind the wall of another frame, or sees something there."""
        if wall.height(self.frame.camera_to_world[:3, 3]) < 0:
            return True
        return (
            _share_behind(wall.height(self.points), self.tolerance) > MOST_POINTS_BEHIND
        )

    def look_at(
        self,
        places: Float,
        around: ObjectFrame,
        margin: float,
    ) -> tuple[Mask, Mask]:
        """Which places the frame looks through, and which are hidden by other things.

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
        own = (
            np.linalg.norm(surface - around.centre, axis=1) < OWN_RADIUS * around.radius
        )
        depth = np.where(blocked, measured, 1)
        on_plane = _height(surface, self.plane) < NEAR_SUPPORT + _tolerance(
            self.noise,
            depth,
        )
        return free, blocked & ~own & ~on_plane

    def _depth_towards(self, seen_at: Float) -> Float:
        """Median depth around the pixels that points, (V, 3), camera frame, project to.

        NaN where nothing is measured.
        """
        height, width = self.frame.shape
        ahead = seen_at[:, 2] > 1e-6
        z = np.where(ahead, seen_at[:, 2], 1)
        at = self.frame.camera.project(np.column_stack([seen_at[:, :2], z]))
        column, row = np.floor(at).T
        inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)

        around = np.arange(-SIGHT_WINDOW, SIGHT_WINDOW + 1)
        rows = np.clip(
            row[inside, None, None].astype(int) + around[:, None],
            0,
            height - 1,
        )
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


def _smooth_pixels(frame: Frame) -> tuple[Index, Index]:
    """Rows and columns of a grid of pixels with a depth, but for those at an edge."""
    height, width = frame.shape
    step = max(1, int(np.sqrt(height * width / MOST_SURROUNDING_POINTS)))
    rows, columns = np.nonzero(frame.depth[step // 2 :: step, step // 2 :: step])
    rows = step // 2 + step * rows
    columns = step // 2 + step * columns

    depth = frame.depth[rows, columns]
    smooth = np.ones(len(rows), bool)
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        beside = frame.depth[
            np.clip(rows + down, 0, height - 1),
            np.clip(columns + right, 0, width - 1),
        ]
        smooth &= (beside > 0) & (np.abs(beside - depth) < JUMP * depth)
    return rows[smooth], columns[smooth]


def _walls(sighting: Sighting, around: ObjectFrame) -> tuple[Plane, ...]:
    """The walls of the room that a sighting shows, beside the object and before none of it."""
    frame = sighting.frame
    samples = sample(frame, frame.depth > 0, sighting.noise)
    away = np.linalg.norm(samples.points - around.centre, axis=1)
    others = samples.some(away > OWN_RADIUS * around.radius)
    plane = sighting.plane
    if plane is None:  # all that is seen is above
        up = around.axes[2]
        plane = Plane(up, -float((samples.points @ up).min(initial=0.0)) + 1.0)
    rng = np.random.default_rng(0)
    return tuple(find_walls(others, plane, rng, around.centre, NARROWEST_WALL))


def _share_behind(away: Float, tolerance: Float) -> float:
    """Share of points, at distances before a wall, (N,), and off by so much, that lie behind it."""
    return (
        float((away < -(BEHIND + WALL_TOLERANCE + tolerance)).mean())
        if len(away)
        else 0.0
    )
