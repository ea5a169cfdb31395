"""Filters of the pose of a rigid body that rests or moves.

A moving body has a Kalman filter of pose and velocity, a resting one of its pose alone. The
probability of rest follows from how well each predicts the measured poses (interacting multiple
models; Blom and Bar-Shalom, IEEE TAC 33, 1988, without their mixing of the states).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import expit

from nextview.types import Float

POSE_PART = slice(0, 6)
VELOCITY_PART = slice(6, 12)
# errors of a measured pose that frames share, radians and metres: a resting pose is not surer
REST_DRIFT = np.repeat([np.radians(0.1), 0.0002], 3)
SPIN_ERROR = 1e-4  # radians, standard deviation of turns that change nothing


@dataclass(frozen=True)
class MotionModel:
    """Random motion whose velocity is an Ornstein-Uhlenbeck process (Uhlenbeck and Ornstein, 1930).

    Attributes:
        speed: standard deviation of the velocity along each axis, metres a second.
        turning: standard deviation of the angular velocity about each axis, radians a second.
        memory: time in which the velocity loses all but 1/e of its correlation, seconds.
        starting: expected number of times a second that a resting body begins to move.
        stopping: expected number of times a second that a moving body comes to rest.
    """

    speed: float = 0.2
    turning: float = 1.0
    memory: float = 1.0
    starting: float = 0.1
    stopping: float = 1.0

    @property
    def variances(self) -> Float:
        """Variances of angular velocity and velocity, (6,)."""
        return np.repeat([self.turning**2, self.speed**2], 3)


@dataclass(frozen=True, eq=False)
class BodyState:
    """Estimated pose and velocity of a body, in the world.

    Attributes:
        rotation: from the body's axes to the world's, (3, 3).
        centre: about which the body turns, (3,), metres.
        velocity: angular, radians a second, and of the centre, metres a second, (6,).
        covariance: of the errors of rotation, centre and velocity, (12, 12).
        spins: axes in the body's frame about which it looks the same after any turn, (K, 3); its
            rotation about them is kept as it is.
    """

    rotation: Float
    centre: Float
    velocity: Float
    covariance: Float
    spins: Float

    @classmethod
    def at_rest(
        cls,
        rotation: Float,
        centre: Float,
        deviations: Float,
        model: MotionModel,
        spins: Float,
    ) -> BodyState:
        """Return a body of which the pose is known and not whether it moves.

        Args:
            rotation: from the body's axes to the world's, (3, 3).
            centre: (3,), metres.
            deviations: standard deviations of rotation, radians, and centre, metres, (6,).
            model: of its motion.
            spins: axes of continuous symmetry in the body's frame, (K, 3).
        """
        covariance = np.diag(np.concatenate([deviations**2, model.variances]))
        return cls(rotation, centre, np.zeros(6), covariance, spins)

    @property
    def pose_covariance(self) -> Float:
        """Covariance of rotation and centre, (6, 6)."""
        return self.covariance[POSE_PART, POSE_PART]

    @property
    def information(self) -> Float:
        """Inverse of ``pose_covariance``, (6, 6); turns about ``spins`` are as good as excluded."""
        information = np.linalg.inv(self.pose_covariance)
        axes = self.spins @ self.rotation.T
        information[:3, :3] += axes.T @ axes / SPIN_ERROR**2
        return np.asarray(information, np.float64)

    def after(self, seconds: float, model: MotionModel) -> BodyState:
        """Predict the state.

        Args:
            seconds: from now, at least 0.
            model: of the motion.
        """
        kept = np.exp(-seconds / model.memory)
        path = model.memory * (1 - kept)
        step = np.eye(12)
        step[POSE_PART, VELOCITY_PART] = path * np.eye(6)
        step[VELOCITY_PART, VELOCITY_PART] = kept * np.eye(6)

        # integrals of the process, e.g. Gillespie, Physical Review E 54, 1996
        of_velocity = 1 - kept**2
        of_both = path**2 / model.memory
        of_pose = 2 * model.memory * (seconds - path) - path**2
        noise = np.block(
            [
                [
                    of_pose * np.diag(model.variances),
                    of_both * np.diag(model.variances),
                ],
                [
                    of_both * np.diag(model.variances),
                    of_velocity * np.diag(model.variances),
                ],
            ]
        )
        moved = self.displaced(path * self.velocity)
        return replace(
            moved,
            velocity=kept * self.velocity,
            covariance=step @ self.covariance @ step.T + noise,
        )

    def motion_to(self, other: BodyState) -> Float:
        """Return rotation about the centre and shift, (6,), to the pose of another state.

        The rotation is the smallest after which the body looks as in the other state: turns about
        ``spins`` are left out.
        """
        if not len(self.spins):
            turn = Rotation.from_matrix(other.rotation @ self.rotation.T).as_rotvec()
        elif len(self.spins) > 1:  # a ball
            turn = np.zeros(3)
        else:
            axis = self.rotation @ self.spins[0]
            there = other.rotation @ self.spins[0]
            across = np.cross(axis, there)
            sine = np.linalg.norm(across)
            turn = across / max(sine, 1e-12) * np.arctan2(sine, axis @ there)
        return np.concatenate([turn, other.centre - self.centre])

    def displaced(self, motion: Float) -> BodyState:
        """Return the body after a rotation about its centre and a shift, (6,)."""
        turn = Rotation.from_rotvec(motion[:3]).as_matrix()
        return replace(
            self, rotation=turn @ self.rotation, centre=self.centre + motion[3:]
        )

    def measured(self, motion: Float, covariance: Float) -> BodyState:
        """Return the state after a measurement of the pose.

        Args:
            motion: of the predicted pose to the most probable one, (6,).
            covariance: of that pose, given prediction and measurement, (6, 6).
        """
        gain = self.covariance[:, POSE_PART] @ np.linalg.inv(self.pose_covariance)
        change = gain @ motion
        return replace(
            self.displaced(motion),
            velocity=self.velocity + change[VELOCITY_PART],
            covariance=self.covariance
            + gain @ (covariance - self.pose_covariance) @ gain.T,
        )


@dataclass(frozen=True, eq=False)
class Rest:
    """The pose of a body in case that it rests.

    Attributes:
        pose: estimated pose; its velocity is zero.
        covariance: of the error of the pose, (6, 6).
        probability: that the body rests.
    """

    pose: BodyState
    covariance: Float
    probability: float = 0.5

    @classmethod
    def at(cls, state: BodyState, probability: float = 0.5) -> Rest:
        """Return a body that rests where it is.

        Args:
            state: in which it would be if it moved.
            probability: that it rests.
        """
        still = replace(state, velocity=np.zeros(6))
        return cls(still, state.pose_covariance, probability)

    def after(self, seconds: float, model: MotionModel) -> Rest:
        """Predict whether the body rests.

        Args:
            seconds: from now, at least 0.
            model: of the motion.
        """
        starts = 1 - np.exp(-model.starting * seconds)
        stops = 1 - np.exp(-model.stopping * seconds)
        probability = self.probability * (1 - starts) + (1 - self.probability) * stops
        return replace(self, probability=float(probability))

    def state_of(self, moving: BodyState, covariance: Float) -> BodyState:
        """Return the state of the body at rest.

        Args:
            moving: its state in case that it moves, whose variances of the velocity are kept.
            covariance: of rotation and centre, (6, 6).
        """
        return replace(self.pose, covariance=_with_pose(moving, covariance))

    def measured(self, moving: BodyState, pose: BodyState, errors: Float) -> Rest:
        """Return the state after a measurement of the pose.

        Args:
            moving: prediction in case that the body moves.
            pose: measured.
            errors: covariance of the measured pose, (6, 6).
        """
        off = self.pose.motion_to(pose)
        spread = self.covariance + errors
        other = _log_density(moving.motion_to(pose), moving.pose_covariance + errors)
        odds = _log_density(off, spread) - other
        odds += np.log(self.probability) - np.log1p(-self.probability)
        probability = float(expit(odds))
        if probability < 0.5:
            return Rest.at(
                replace(pose, covariance=_with_pose(moving, errors)), probability
            )

        gain = self.covariance @ np.linalg.inv(spread)
        covariance = self.covariance - gain @ self.covariance
        covariance = (covariance + covariance.T) / 2 + np.diag(REST_DRIFT**2)
        return Rest(self.pose.displaced(gain @ off), covariance, probability)


def _with_pose(state: BodyState, errors: Float) -> Float:
    """Covariance of a state, (12, 12), with another one of its pose, (6, 6)."""
    covariance = state.covariance.copy()
    covariance[POSE_PART, POSE_PART] = errors
    return covariance


def _log_density(off: Float, covariance: Float) -> float:
    """Log-density of a normal variable up to a constant."""
    _, volume = np.linalg.slogdet(covariance)
    return float(-0.5 * (off @ np.linalg.solve(covariance, off) + volume))
