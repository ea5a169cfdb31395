"""Rank camera poses by the expected information of their views."""

from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from nextview.checks import one_line
from nextview.errors import ObservationError, UsageError
from nextview.geometry.camera import checked_pose
from nextview.geometry.viewsphere import angle_between, direction_of
from nextview.policies.base import nearer_first
from nextview.types import Float, Index
from nextview.views.expected_views import Goal, Outlook


@dataclass(frozen=True, eq=False)
class RankedView:
    """A candidate view with its expected information.

    Attributes:
        index: of the pose in the ranked list, or of the candidate in ``Session.sphere``.
        pose: camera-to-world, (4, 4), as it was passed in.
        information: expected information, nats.
        settles: the same as a share of the remaining uncertainty, 0 to 1.
        words: description of the things that the view would distinguish.
    """

    index: int
    pose: Float
    information: float
    settles: float
    words: str

    def __repr__(self) -> str:
        return f"RankedView({self.index}: {self.words})"


def camera_poses(given: ArrayLike) -> Float:
    """Check camera poses passed in by a user.

    Args:
        given: camera-to-world, (V, 4, 4).

    Returns:
        The same as float64.

    Raises:
        UsageError: the shape is wrong, or a matrix is not a rigid transformation.
    """
    try:
        poses = np.asarray(given, np.float64)
    except (TypeError, ValueError):
        raise UsageError(
            "poses to rank are camera-to-world matrices, (V, 4, 4)"
        ) from None

    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise UsageError(
            f"poses to rank are camera-to-world matrices, (V, 4, 4), not {poses.shape}"
        )

    for number, pose in enumerate(poses):
        turned = np.eye(4)
        turned[:3, :3] = pose[:3, :3]
        turned[3] = pose[3]
        try:
            checked_pose(turned)
        except ObservationError as error:
            raise UsageError(f"pose {number} of those to rank: {error}") from None
        if not np.isfinite(pose[:3, 3]).all():
            raise UsageError(f"pose {number} of those to rank: its place is not finite")
    return poses


def rank_views(
    outlook: Outlook,
    cameras: Float,
    given: Float,
    index: Index,
    goal: Goal,
) -> tuple[RankedView, ...]:
    """Rank candidate poses.

    Args:
        outlook: prediction of further views.
        cameras: the poses in the object frame, metres, (V, 4, 4).
        given: the poses to report, (V, 4, 4).
        index: the indices to report, (V,).
        goal: what the views shall determine.

    Returns:
        The views, the best first.

    Raises:
        UsageError: the goal is not known.
    """
    if goal not in get_args(Goal):
        raise UsageError(
            f"the goal is {' or '.join(get_args(Goal))}, not {one_line(repr(goal))}"
        )
    if not len(cameras):
        return ()

    expected = outlook.expect(cameras, goal)
    worth = expected.worth(goal)
    information = expected.information(goal)
    most = expected.entropy(goal)
    names = [surface.name for surface in outlook.caster.surfaces]

    towards = np.stack([direction_of(pose) for pose in cameras])
    way = angle_between(towards, outlook.towards)
    values = nearer_first(worth, way, float(worth.max()))
    ranked = []
    for row in np.argsort(-values, kind="stable"):
        told = float(information[row])
        settles = min(1.0, told / most) if most > 0 else 0.0
        words = expected.words(int(row), names, goal)
        ranked.append(RankedView(int(index[row]), given[row], told, settles, words))
    return tuple(ranked)
