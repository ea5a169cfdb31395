"""Surroundings of objects in a frame: obstacles to keep clear of, and walls of the room."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nextview.sensing.frame import Frame
from nextview.sensing.noise import Noise
from nextview.sensing.object_frame import ObjectFrame
from nextview.sensing.planes import Plane, sample
from nextview.sensing.registration import tolerance_of
from nextview.sensing.sighting import Sighting
from nextview.sensing.tabletop import TableTop
from nextview.sensing.walls import find_walls
from nextview.types import Float, Index, Mask

# metres, tolerance for points on the support plane, in addition to the noise
NEAR_SUPPORT = 0.02
OWN_RADIUS = 1.1  # object radii; surfaces within this distance of the centre are the object's own
# half the window of pixels around the line of sight to a position
SIGHT_WINDOW = 2
BEHIND = 0.15  # metres; points farther behind a wall do not belong to it


@dataclass(frozen=True)
class Surroundings:
    """Everything in a frame except the object.

    Attributes:
        frame: the frame itself.
        noise: of its depth.
        plane: the support plane, if it is known.
        points: sampled points of the frame without edges, world, metres, (N, 3).
        tolerance: uncertainty of each point, metres, (N,).
        walls: vertical planes with almost no points behind them; their normals point to the camera.
    """

    frame: Frame
    noise: Noise
    plane: Plane | None
    points: Float
    tolerance: Float
    walls: tuple[Plane, ...]

    @classmethod
    def of(cls, seen: Sighting | TableTop, around: ObjectFrame) -> "Surroundings":
        """Compute the surroundings of an object, or of all objects of a scene, in a frame.

        Args:
            seen: the frame, its noise and the support plane.
            around: frame of the object or of the scene, whose own surface is not a wall.
        """
        frame = seen.frame
        rows, columns = _smooth_pixels(frame)
        points = frame.positions(rows, columns)
        depth = frame.depth[rows, columns].astype(np.float64)
        tolerance = tolerance_of(depth, seen.noise)
        walls = _walls(seen, around)
        return cls(frame, seen.noise, seen.plane, points, tolerance, walls)

    @classmethod
    def in_frames(
        cls,
        frames: Sequence[Sighting | TableTop],
        around: ObjectFrame,
        known: Sequence["Surroundings"] = (),
    ) -> tuple["Surroundings", ...]:
        """Return the surroundings in each of some frames.

        Args:
            frames: what is seen in each of them.
            around: frame of the object or of the scene.
            known: surroundings in earlier frames, which are not computed again.
        """
        before = {id(shown.frame): shown for shown in known}
        return tuple(
            before.get(id(seen.frame)) or cls.of(seen, around) for seen in frames
        )

    def is_near(self, places: Float, around: ObjectFrame, clearance: float) -> Mask:
        """Return which positions are near a measured surface.

        The surfaces of the object and of the support plane are ignored.

        Args:
            places: positions, (V, 3), world, metres.
            around: the object frame.
            clearance: largest distance that counts as near, metres.

        Returns:
            (V,) bool.
        """
        # Only points about as far from the object as the positions can be near them.
        reach = np.linalg.norm(places - around.centre, axis=1)
        away = np.linalg.norm(self.points - around.centre, axis=1)
        kept = (away > reach.min() - clearance) & (away < reach.max() + clearance)
        kept &= away > OWN_RADIUS * around.radius
        kept &= _height(self.points, self.plane) > NEAR_SUPPORT + self.tolerance

        apart = np.linalg.norm(places[:, None] - self.points[kept][None], axis=2)
        # three points: an occupied position
        return (apart < clearance).sum(1) >= 3

    def shows_behind(self, wall: Plane) -> bool:
        """Return True if the camera was behind another frame's wall, or sees something there."""
        if wall.height(self.frame.camera_to_world[:3, 3]) < 0:
            return True
        behind = wall.height(self.points) < -(BEHIND + 0.02 + self.tolerance)
        # some are, because of reflections or an open door
        return int(behind.sum()) > 0.03 * len(behind)

    def look_at(
        self,
        places: Float,
        around: ObjectFrame,
        margin: float,
    ) -> tuple[Mask, Mask]:
        """Return which positions the frame shows to be free, and which are occluded.

        Args:
            places: positions, (V, 3), world, metres.
            around: the object frame. Positions behind the object are not reported as occluded,
                since the object must be viewed from there.
            margin: distance between position and surface below which the position is neither,
                metres.

        Returns:
            Free and occluded, (V,) bool each. Positions outside the image are neither.
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
        on_plane = _height(surface, self.plane) < NEAR_SUPPORT + tolerance_of(
            depth, self.noise
        )
        return free, blocked & ~own & ~on_plane

    def _depth_towards(self, seen_at: Float) -> Float:
        """Return the median depth around the projections of points, (V, 3), camera frame.

        NaN if no depth is measured there.
        """
        height, width = self.frame.shape
        ahead = seen_at[:, 2] > 1e-6
        z = np.where(ahead, seen_at[:, 2], 1)
        at = self.frame.pinhole.project(np.column_stack([seen_at[:, :2], z]))
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

        # Median of the valid depths in each window; invalid zeros are sorted to the front.
        depth = np.sort(depth, axis=1)
        measured = (depth > 0).sum(1)
        middle = depth.shape[1] - (measured + 1) // 2
        found = np.full(len(seen_at), np.nan)
        median = depth[np.arange(len(depth)), np.minimum(middle, depth.shape[1] - 1)]
        found[inside] = np.where(measured > 0, median, np.nan)
        return found


def _height(points: Float, plane: Plane | None) -> Float:
    """Return the height of points above the support plane, metres, (N,); infinity without one."""
    return np.full(len(points), np.inf) if plane is None else plane.height(points)


def _smooth_pixels(frame: Frame) -> tuple[Index, Index]:
    """Return rows and columns of a grid of pixels with valid depth, without edges."""
    height, width = frame.shape
    step = max(1, int(np.sqrt(height * width / 6000)))
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
        # at larger steps sensors measure points between the surfaces
        smooth &= (beside > 0) & (np.abs(beside - depth) < 0.03 * depth)
    return rows[smooth], columns[smooth]


def _walls(seen: Sighting | TableTop, around: ObjectFrame) -> tuple[Plane, ...]:
    """Return the walls of the room in a frame that do not pass through the object."""
    frame = seen.frame
    samples = sample(frame, frame.depth > 0, seen.noise)
    away = np.linalg.norm(samples.points - around.centre, axis=1)
    others = samples.some(away > OWN_RADIUS * around.radius)
    plane = seen.plane
    if plane is None:  # without a plane all points count as above it
        up = around.axes[2]
        plane = Plane(up, -float((samples.points @ up).min(initial=0.0)) + 1.0)
    rng = np.random.default_rng(0)
    return tuple(find_walls(others, plane, rng, around.centre))
