"""A tree of moving coordinate frames, as recorded by tf, with interpolation in time.

Foote, "tf: The transform library", TePRA 2013.
"""

from bisect import bisect_left
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from nextview.captured.messages import matrix_of
from nextview.errors import DatasetError
from nextview.types import Float

# seconds, largest gap between two transforms that is interpolated
LONGEST_GAP = 0.5
# largest depth of the tree; a robot with two arms and hands has about forty
LONGEST_CHAIN = 200
NAMED_IN_CIRCLE = 8  # frames of a cycle that are named in a message
BEYOND = 0.02  # seconds, extrapolation before the first and after the last transform


class TransformError(DatasetError):
    """Frames that do not form a tree."""


class NoTransformError(DatasetError):
    """The pose of a frame in another one is not known at some time."""


@dataclass
class _Link:
    """Transforms of a frame to its parent.

    Attributes:
        parent: name of the parent frame.
        stamps: seconds, N.
        positions: (3,) each, metres.
        quaternions: x, y, z, w each.
        fixed: static: then there is only one transform, and its stamp is ignored.
        ordered: whether the stamps increase.
    """

    parent: str
    fixed: bool
    stamps: list[float] = field(default_factory=list)
    positions: list[tuple[float, ...]] = field(default_factory=list)
    quaternions: list[tuple[float, ...]] = field(default_factory=list)
    ordered: bool = True

    def sorted(self) -> "_Link":
        """Return the link sorted by time; of several transforms at one time the last is kept."""
        if self.ordered:
            return self
        stamps, last = np.unique(np.array(self.stamps)[::-1], return_index=True)
        order = len(self.stamps) - 1 - last
        return _Link(
            self.parent,
            self.fixed,
            stamps.tolist(),
            [self.positions[i] for i in order],
            [self.quaternions[i] for i in order],
        )

    def at(self, time: float) -> Float | None:
        """Return the transform to the parent at a time, (4, 4); None if it is not known."""
        if self.fixed:
            return matrix_of(self.positions[-1], self.quaternions[-1])
        after = bisect_left(self.stamps, time)
        before = after - 1
        inside = 0 < after < len(self.stamps)
        if not inside or self.stamps[after] - self.stamps[before] > LONGEST_GAP:
            beside = range(max(before, 0), min(after + 1, len(self.stamps)))
            nearest = min(beside, key=lambda row: abs(self.stamps[row] - time))
            if abs(self.stamps[nearest] - time) > BEYOND:
                return None
            return matrix_of(self.positions[nearest], self.quaternions[nearest])

        gap = self.stamps[after] - self.stamps[before]
        share = (time - self.stamps[before]) / gap
        ends = [
            matrix_of(self.positions[i], self.quaternions[i]) for i in (before, after)
        ]
        pose = np.eye(4)
        turn = Rotation.from_matrix(ends[1][:3, :3] @ ends[0][:3, :3].T).as_rotvec()
        pose[:3, :3] = Rotation.from_rotvec(share * turn).as_matrix() @ ends[0][:3, :3]
        pose[:3, 3] = (1 - share) * ends[0][:3, 3] + share * ends[1][:3, 3]
        return pose


class TransformTree:
    """Tree of coordinate frames that move over time.

    Args:
        kept: least number of latest transforms that are kept for each frame; None for all.
    """

    def __init__(self, kept: int | None = None) -> None:
        self._kept = kept
        self._links: dict[str, _Link] = {}

    def add(
        self,
        child: str,
        parent: str,
        stamp: float,
        position: tuple[float, ...],
        quaternion: tuple[float, ...],
        fixed: bool = False,
    ) -> None:
        """Add a transform of a frame to its parent.

        Args:
            child: the frame.
            parent: its parent frame.
            stamp: seconds.
            position: of its origin in the parent's frame, (3,), metres.
            quaternion: of its axes there, x, y, z, w.
            fixed: whether it is static.

        Raises:
            TransformError: the frame had another parent before.
        """
        link = self._links.setdefault(child, _Link(parent, fixed))
        if link.parent != parent:
            raise TransformError(
                f"tf frame {child!r} has two parents, {link.parent!r} and {parent!r}"
            )
        link.ordered &= not link.stamps or stamp > link.stamps[-1]
        link.stamps.append(stamp)
        link.positions.append(position)
        link.quaternions.append(quaternion)
        if self._kept is not None and len(link.stamps) > 2 * self._kept:
            for values in (link.stamps, link.positions, link.quaternions):
                del values[: -self._kept]

    def sort(self) -> None:
        """Sort all transforms by time, after all of them were added.

        Raises:
            TransformError: frames form a cycle, or a chain that is too long.
        """
        self._links = {child: link.sorted() for child, link in self._links.items()}
        for child in self._links:
            self._above(child)

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames."""
        parents = {link.parent for link in self._links.values()}
        return tuple(sorted(parents | set(self._links)))

    def root(self, frame: str) -> str:
        """Return the root above a frame."""
        return self._above(frame)[-1]

    def moves(self, frame: str, world: str) -> bool:
        """Return True if a frame moves relative to another one according to the transforms.

        Args:
            frame: name of the frame that may move.
            world: name of the reference frame.
        """
        links = self._between(frame, world)
        return any(not self._links[child].fixed for child in links)

    def pose(self, frame: str, world: str, time: float) -> Float:
        """Return the pose of one frame in another at a time, (4, 4).

        Args:
            frame: name of the frame.
            world: name of the frame in which the pose is expressed.
            time: seconds, of the clock of the transforms.

        Raises:
            NoTransformError: the frames are not connected, or not at that time.
            ObservationError: a quaternion does not have unit length.
        """
        root = self.root(frame)
        if self.root(world) != root:
            raise NoTransformError(f"tf does not join {frame!r} with {world!r}")

        ways = []
        for each in (frame, world):
            pose = np.eye(4)
            for child in self._above(each)[:-1]:
                step = self._links[child].at(time)
                if step is None:
                    parent = self._links[child].parent
                    raise NoTransformError(
                        f"tf has nothing of {child!r} in {parent!r} at {time:.3f} s"
                    )
                pose = step @ pose
            ways.append(pose)

        return np.asarray(np.linalg.inv(ways[1]) @ ways[0])

    def _above(self, frame: str) -> list[str]:
        """Return a frame and its ancestors up to the root."""
        chain = [frame]
        met = {frame}
        while chain[-1] in self._links:
            parent = self._links[chain[-1]].parent
            if parent in met:
                circle = [*chain[chain.index(parent) :], parent]
                named = " in ".join(circle[:NAMED_IN_CIRCLE])
                more = " in ..." if len(circle) > NAMED_IN_CIRCLE else ""
                raise TransformError(f"tf goes round in a circle: {named}{more}")
            if len(chain) > LONGEST_CHAIN:
                raise TransformError(
                    f"tf hangs {frame!r} on a chain of more than {LONGEST_CHAIN} frames"
                )
            chain.append(parent)
            met.add(parent)
        return chain

    def _between(self, frame: str, world: str) -> set[str]:
        """Return the frames whose links connect a frame to another."""
        return set(self._above(frame)[:-1]) ^ set(self._above(world)[:-1])
