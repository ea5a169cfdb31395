"""Poses of a recognised object: those that it may have, and how sure they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ModelError
from nextview.geometry.camera import RIGID
from nextview.types import Float, Float32

ALIKE_TURN = 5.0  # degrees between poses that are taken for one
ALIKE_SHIFT = 0.005  # metres between the centres of poses that are taken for one
SAME_AXIS = 0.1  # sine of the angle between axes that are one
SAME_TURN = 0.05  # difference of the matrices of turns that are one: axes are found to some degrees
MOST_TURNS = 60  # of a symmetric thing: those of a dodecahedron


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """A pose that an object may have.

    Attributes:
        thing: name of the thing whose frame it is.
        label: number of its class.
        pose: from the frame of the scan file into the frame that the candidate is given in, (4, 4)
            float64, metres.
        probability: of this pose among all candidates, 0 to 1.
        degrees: standard deviation of the orientation, if this is the right candidate, all axes
            together.
        millimetres: standard deviation of the place of the centre, if this is the right candidate
            and the cameras stand where they are said to.
        centre: the centroid of the thing's surface in the scan file's frame, (3,) float64, metres.
        vertices: of its surface, in the scan file's frame, (V, 3) float32, metres; None if it has
            none.
        faces: triangles of the surface, indices of its vertices, (F, 3) int32.
        symmetry: axes through its centroid, in the scan file's frame, about which the thing looks
            the same after a turn, each with ``axis`` and ``order``, 0 for any turn; None if they
            are not known.
    """

    thing: str
    label: int
    pose: Float
    probability: float
    degrees: float = 0.0
    millimetres: float = 0.0
    centre: Float = field(default_factory=lambda: np.zeros(3))
    vertices: Float32 | None = None
    faces: NDArray[np.int32] | None = None
    symmetry: tuple[Any, ...] | None = None

    def moved(self, by: Float) -> PoseCandidate:
        """The same in another frame.

        Args:
            by: from the frame that it is given in into the other one, (4, 4), metres.
        """
        return replace(self, pose=by @ self.pose)

    @property
    def place(self) -> Float:
        """Where the centre of the thing is, (3,) float64, metres."""
        return self.pose[:3, :3] @ self.centre + self.pose[:3, 3]

    def __repr__(self) -> str:
        place = place_in_words(self.place)
        return f"PoseCandidate({self.thing} at {place}, probability {self.probability:.3f})"


@dataclass(frozen=True)
class PoseUncertainty:
    """How far off a pose may be: standard deviations.

    Attributes:
        degrees: of the orientation, all axes together.
        millimetres: of the place of the thing's centre, all axes together.
    """

    degrees: float
    millimetres: float

    def __str__(self) -> str:
        return f"± {_digits(self.degrees)}°, {_digits(self.millimetres)} mm"


def _digits(value: float) -> str:
    """A deviation with as many digits as make sense."""
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"


def place_in_words(place: Float) -> str:
    """A place, (3,), metres, to the millimetre: ``[0.412, -0.103, 0.050] m``."""
    rounded = np.round(place, 3) + 0.0  # no -0.000
    return "[{:.3f}, {:.3f}, {:.3f}] m".format(*rounded)


def distinct(candidates: Sequence[PoseCandidate]) -> list[int]:
    """Which candidates are not as good as the same as a likelier one.

    Several hypotheses often end in one pose. That is no more evidence for it, so their
    probabilities are not to be added up.

    Args:
        candidates: the likeliest first.

    Returns:
        Indices of those that differ from all before them in the thing, or by ALIKE_TURN or
        ALIKE_SHIFT. Turns about an axis of which any is a symmetry make no difference.
    """
    kept: list[int] = []
    for index, candidate in enumerate(candidates):
        if not any(_alike(candidate, candidates[other]) for other in kept):
            kept.append(index)
    return kept


def _alike(first: PoseCandidate, second: PoseCandidate) -> bool:
    if first.thing != second.thing:
        return False
    shift = float(np.linalg.norm(first.place - second.place))
    between = first.pose[:3, :3].T @ second.pose[:3, :3]
    return (
        shift < ALIKE_SHIFT and _least_turn(between, first.symmetry or ()) < ALIKE_TURN
    )


def uncertainty_of(
    candidates: Sequence[PoseCandidate],
    camera: float = 0.0,
) -> PoseUncertainty:
    """How far off the first of some poses of one thing may be.

    Args:
        candidates: of one thing; the first is the one that is asked about.
        camera: by how much errors of the cameras' places displace all of them, millimetres.

    Returns:
        Root mean squares over the candidates, by their probabilities, of their own deviation and
        their distance from the first. Turns that change nothing because of a symmetry do not count.
    """
    first = candidates[0]
    shares = np.array([candidate.probability for candidate in candidates])
    shares = shares / shares.sum()
    turns = np.array([turn_apart(first, other) for other in candidates])
    shifts = np.array(
        [1000 * np.linalg.norm(other.place - first.place) for other in candidates]
    )

    own_turns = np.array([candidate.degrees for candidate in candidates])
    own_shifts = np.array([candidate.millimetres for candidate in candidates])
    degrees = np.sqrt(shares @ (turns**2 + own_turns**2))
    millimetres = np.sqrt(shares @ (shifts**2 + own_shifts**2) + camera**2)
    return PoseUncertainty(float(degrees), float(millimetres))


def share_of_likeliest(candidates: Sequence[PoseCandidate]) -> float:
    """How sure the first of some poses is, given that it is the right thing.

    Args:
        candidates: of one or several things, the likeliest first.

    Returns:
        Probability of the poses of its thing that look the same as it, by a symmetry too, as a
        share of that of all poses of its thing.
    """
    first = candidates[0]
    own = [candidate for candidate in candidates if candidate.thing == first.thing]
    same = [
        candidate.probability
        for candidate in own
        if turn_apart(first, candidate) < ALIKE_TURN
        and float(np.linalg.norm(candidate.place - first.place)) < ALIKE_SHIFT
    ]
    return sum(same) / sum(candidate.probability for candidate in own)


def turn_apart(first: PoseCandidate, second: PoseCandidate) -> float:
    """Angle between two poses of one thing, degrees, but for its symmetries.

    Args:
        first: the one.
        second: the other.
    """
    symmetries = first.symmetry or ()
    between = first.pose[:3, :3].T @ second.pose[:3, :3]  # in the axes of the scan file
    turns = _turns_of(tuple(symmetries))
    return min(_least_turn(between @ turn, symmetries) for turn in turns)


def _least_turn(turn: Float, symmetries: Sequence[Any]) -> float:
    """The angle of a turn, degrees, but for symmetries of any angle."""
    axes = [np.array(one.axis) for one in symmetries if one.order == 0]
    if not axes:
        return float(np.degrees(_angle_of(turn)))
    if any(np.linalg.norm(np.cross(axis, axes[0])) > SAME_AXIS for axis in axes):
        return 0.0  # a ball
    return float(np.degrees(_angle_but_about(turn, axes[0])))


@lru_cache(maxsize=256)
def _turns_of(symmetries: tuple[Any, ...]) -> tuple[Float, ...]:
    """All turns that follow from symmetries of a finite order, one after the other."""
    steps = [
        _turn_about(one.axis, 2 * np.pi / one.order)
        for one in symmetries
        if one.order > 1
    ]
    turns = [np.eye(3)]
    for turn in turns:  # it grows
        for step in steps:
            new = step @ turn
            known = any(np.abs(new - other).max() < SAME_TURN for other in turns)
            if not known and len(turns) < MOST_TURNS:
                turns.append(new)
    return tuple(turns)


def _turn_about(axis: Sequence[float] | Float, angle: float) -> Float:
    """The turn about a unit vector by an angle, radians, (3, 3): Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _angle_of(turn: Float) -> float:
    """By how much a rotation matrix turns, radians."""
    return float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))


def _angle_but_about(turn: Float, axis: Float) -> float:
    """The least angle, radians, of a turn after any other about an axis."""
    # The trace of turn @ about(axis, angle) is a + b cos(angle) + c sin(angle).
    along = np.outer(axis, axis)
    cross = _turn_about(axis, np.pi / 2) - along
    a = np.trace(turn @ along)
    b = np.trace(turn @ (np.eye(3) - along))
    c = np.trace(turn @ cross)
    return float(np.arccos(np.clip((a + np.hypot(b, c) - 1) / 2, -1, 1)))


def check_candidate(candidate: Any, classes: int) -> PoseCandidate:
    """A pose candidate of somebody else's, checked.

    Args:
        candidate: what is given for one.
        classes: number of classes.

    Raises:
        ModelError: it is none, its pose is no rigid motion, or its class is none of them.
    """
    if not isinstance(candidate, PoseCandidate):
        raise ModelError(f"a pose is a PoseCandidate, not a {type(candidate).__name__}")
    pose = np.asarray(candidate.pose, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ModelError("a pose is a matrix of (4, 4) finite numbers")

    turned = pose[:3, :3]
    rigid = (
        np.abs(turned @ turned.T - np.eye(3)).max() < RIGID
        and np.linalg.det(turned) > 0
    )
    if not rigid or np.abs(pose[3] - (0, 0, 0, 1)).max() > RIGID:
        raise ModelError(
            "a pose is not a rigid motion: a rotation and a place, in metres"
        )
    if not 0 <= candidate.label < classes:
        raise ModelError(
            f"a pose is of class {candidate.label}, and there are {classes}"
        )
    if not 0 <= candidate.probability <= 1:
        raise ModelError(
            f"the probability of a pose is {candidate.probability}, not 0 to 1"
        )
    return candidate
