"""A thing that a tracker follows: its surface, and the filters of its pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, logit

from nextview.recognition.poses import PoseUncertainty
from nextview.scene.motion import BodyState, MotionModel, Rest
from nextview.scene.objects import SceneObject
from nextview.things.library import Library
from nextview.things.naming import CONFIDENT
from nextview.things.surface import Surface
from nextview.types import Float

LOSSES = 0.1  # expected number of losses a second
RETURNS = 1.0  # expected number of times a second that a lost thing is in view again
# error of the expected pose, radii, up to which a registration finds the thing and nothing else
WIDEST = 0.5
MOST_ODDS = 30.0  # log-odds that a pose is right
LEAST_DEGREES = (
    0.5  # standard deviation of the orientation with which a thing is taken over
)
LEAST_MILLIMETRES = 1.0  # the same of its place


@dataclass(frozen=True, eq=False)
class Tracked:
    """A thing in the last frame of a tracker.

    Attributes:
        number: of the object in the scene.
        name: of the thing.
        pose: from the frame of its scan to the world, (4, 4) float64, metres; predicted if it is
            hidden.
        velocity: angular, radians a second, and of the middle of the scan, metres a second, in the
            world, (6,); zero if it rests.
        uncertainty: of the pose, standard deviations.
        visible: share of the pixels on it that nothing in front hides, 0 to 1.
        probability: that the pose is right, and the thing is not lost.
        lost: whether it is probably not where it is expected, or may be anywhere.
        name_probability: that its name is right, against all that looks nearly the same, in the
            last frame in which they were compared: about once a second while it is visible.
    """

    number: int
    name: str
    pose: Float
    velocity: Float
    uncertainty: PoseUncertainty
    visible: float
    probability: float
    lost: bool
    name_probability: float


@dataclass(frozen=True, eq=False)
class Body:
    """A followed thing.

    Attributes:
        number: of the object in the scene.
        name: of the thing.
        surface: in the frame of its scan.
        thing: its number in the library.
        seen: state of its motion in the last frame that shows it.
        unseen: time since that frame, seconds.
        rest: its pose in case that it rests.
        state: expected in the next frame, or found in the last one.
        visible: share of the pixels on it that nothing in front hides.
        probability: that the pose is right.
        adrift: whether it may be anywhere: it moved, and was hidden too long to be registered from
            where it is expected. It is then expected where it was seen last.
        name_probability: that its name is right, in the last frame in which it was compared.
        uncompared: time since then, seconds.
    """

    number: int
    name: str
    surface: Surface
    thing: int
    seen: BodyState
    unseen: float
    rest: Rest
    state: BodyState
    visible: float = 1.0
    probability: float = 1.0
    adrift: bool = False
    name_probability: float = CONFIDENT
    uncompared: float = 0.0

    @classmethod
    def of(
        cls,
        one: SceneObject,
        library: Library,
        model: MotionModel,
        motion: Float | None = None,
    ) -> Body | None:
        """Start with an object of a scene; None if it has no confident name and pose.

        Args:
            one: the object.
            library: with its thing.
            model: of its motion.
            motion: of the object since the scene has seen it, (4, 4), in the world; None for none.
        """
        if not one.confident or one.pose is None:
            return None
        posed = one.candidates[0]
        pose = posed.pose if motion is None else motion @ posed.pose
        thing = library.names.index(posed.thing)
        surface = library.caster.surfaces[thing]

        rotation = pose[:3, :3]
        deviations = [
            np.radians(max(posed.degrees, LEAST_DEGREES)),
            max(posed.millimetres, LEAST_MILLIMETRES) / 1000,
        ]

        spins = [each.axis for each in posed.symmetry or () if each.order == 0]
        state = BodyState.at_rest(
            rotation,
            rotation @ surface.centre + pose[:3, 3],
            np.repeat(deviations, 3),
            model,
            np.reshape(np.array(spins, np.float64), (-1, 3)),
        )

        return cls(
            one.number, posed.thing, surface, thing, state, 0.0, Rest.at(state), state
        )

    @property
    def rests(self) -> bool:
        """True if it probably rests."""
        return self.rest.probability >= 0.5

    @property
    def lost(self) -> bool:
        """True if it is probably not where it is expected, or may be anywhere."""
        return self.probability < 0.5 or self.adrift

    @property
    def pose(self) -> Float:
        """Pose of the scan in the world, (4, 4) float64, metres."""
        pose = np.eye(4)
        pose[:3, :3] = self.state.rotation
        pose[:3, 3] = self.state.centre - self.state.rotation @ self.surface.centre
        return pose

    @property
    def displaced(self) -> float:
        """Standard deviation of the displacement of its surface, metres."""
        return _displaced(self.state, self.surface.radius)

    @property
    def tracked(self) -> Tracked:
        """What users see of it."""
        turn, shift = _deviations(self.state)
        return Tracked(
            self.number,
            self.name,
            self.pose,
            self.state.velocity,
            PoseUncertainty(float(np.degrees(turn)), float(1000 * shift)),
            self.visible,
            self.probability,
            self.lost,
            self.name_probability,
        )

    def after(self, seconds: float, model: MotionModel) -> Body:
        """Predict it for the next frame.

        Args:
            seconds: since the last frame.
            model: of its motion.
        """
        unseen = self.unseen + seconds
        body = replace(
            self,
            rest=self.rest.after(seconds, model),
            unseen=unseen,
            uncompared=self.uncompared + seconds,
        )
        if body.rests and body.probability >= 0.5:
            # it may begin to move now, whenever it was seen last
            begins = self.seen.after(seconds, model)
            state = body.rest.state_of(begins, begins.pose_covariance)
            return replace(body, state=state, adrift=False)
        state = self.seen.after(unseen, model)
        adrift = _displaced(state, self.surface.radius) > WIDEST * self.surface.radius
        if adrift:
            state = self.seen.after(seconds, model)
            state = replace(state, rotation=self.seen.rotation, centre=self.seen.centre)
        return replace(body, state=state, adrift=adrift)

    def judged(self, seconds: float, evidence: float, visible: float) -> Body:
        """Update the probability that the pose is right.

        Where something hides the thing or its empty place, it is not known to be lost or back.

        Args:
            seconds: since the last frame.
            evidence: log-likelihood of a frame with the thing, against that without it.
            visible: share of the pixels on it that nothing in front hides.
        """
        seconds *= visible
        kept = self.probability * float(np.exp(-LOSSES * seconds))
        back = (1 - self.probability) * float(1 - np.exp(-RETURNS * seconds))
        odds = np.clip(logit(kept + back) + evidence, -MOST_ODDS, MOST_ODDS)
        return replace(self, visible=visible, probability=float(expit(odds)))

    def measured(self, state: BodyState, errors: Float) -> Body:
        """Take in a measured pose.

        Args:
            state: filtered in case that it moves.
            errors: covariance of the measured pose without the prediction, (6, 6).
        """
        rest = self.rest.measured(self.state, state, errors)
        body = replace(self, rest=rest, state=state)
        if body.probability >= 0.5:
            body = replace(body, seen=state, unseen=0.0, adrift=False)
        if body.rests:
            body = replace(body, state=rest.state_of(state, rest.covariance))
        return body


def _displaced(state: BodyState, radius: float) -> float:
    """Standard deviation of the displacement of a surface of some radius, metres."""
    turn, shift = _deviations(state)
    return float(np.hypot(turn * radius, shift) / np.sqrt(3))


def _deviations(state: BodyState) -> tuple[float, float]:
    """Standard deviations of rotation, radians, and place, metres, all axes together."""
    variances = np.diag(state.pose_covariance)
    return float(np.sqrt(variances[:3].sum())), float(np.sqrt(variances[3:].sum()))
