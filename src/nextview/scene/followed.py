"""Register a followed thing with a frame, by the score and the steps of scenes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logit

from nextview.scene.body import WIDEST, Body
from nextview.scene.motion import BodyState
from nextview.sensing.frame import Frame
from nextview.sensing.noise import Noise
from nextview.sensing.planes import Plane
from nextview.sensing.view import LEVEL, View
from nextview.things.contour import contour_equations
from nextview.things.library import Hypotheses, Library
from nextview.things.naming import CONFIDENT, PIXELS_ALIKE, score_error
from nextview.things.propose import COARSEST, RESTART
from nextview.things.register import POINTS, normal_equations, register
from nextview.things.score import score, total_scores
from nextview.things.surface import SCAN_ERROR
from nextview.types import Float

SURPRISE = 6.9  # nats that make a move as likely as none: one thing in a thousand moves
INDEPENDENT_POINTS = 60.0  # of them, whose errors are not alike
# error of the expected pose that is left before each step, as a share
ERRORS_LEFT = (1.0, 0.5, 0.25, 0.1, 0.1)
# of the contour in each step, which is less accurate than points
CONTOUR_WEIGHTS = (1.0, 1.0, 0.5, 0.25, 0.15)
HIDDEN_FROM = 0.5  # share of the error from which on what is in front hides a point
LONGEST_STEP = 0.5  # radians, or radii
# radii within which measured points belong to a thing, in each step before its name is compared
NAME_REACHES = 0.2, 0.1, 0.06, 0.03
MOST_LOOKALIKES = 64  # poses of other things that are registered to compare a name


@dataclass(frozen=True, eq=False)
class Followed:
    """A thing that is registered with a frame.

    Attributes:
        state: of its motion.
        errors: covariance of the measured pose without the prediction, (6, 6); None if no pixel
            shows the thing.
        evidence: log-likelihood of the pixels over all motions, against that without the thing
            (Laplace's approximation).
        visible: share of the pixels on it that nothing in front hides.
    """

    state: BodyState
    errors: Float | None
    evidence: float
    visible: float


def view_to_follow(frame: Frame, noise: Noise, ground: Plane | None) -> View:
    """Return the view of a frame without a segmentation.

    Args:
        frame: with a pose.
        noise: of its depth.
        ground: on which things stand; None if it is not known.
    """
    surface = np.zeros(frame.shape, bool)
    if ground is not None:
        height = np.abs(frame.along(ground.normal, ground.offset))
        surface = (
            height < LEVEL * noise.at(np.maximum(frame.depth, 0.1)) * frame.depth**2
        )
    none = np.zeros(frame.shape, np.int32)
    # it may be lifted
    unknown = np.full(frame.shape, np.inf, np.float32)
    return View(
        frame,
        frame.camera_to_world,
        noise,
        none,
        none,
        none,
        surface,
        frame.depth > 0,
        unknown,
        np.array([0.0, 0.0, 1.0]),
    )


def followed(library: Library, view: View, body: Body) -> Followed:
    """Register a thing with the pixels around it.

    Args:
        library: with the thing.
        view: of the frame.
        body: the thing in its expected pose.
    """
    expected = state = body.state
    information = expected.information
    radius = float(library.radii[body.thing])
    away = float(np.linalg.norm(state.centre - view.camera[:3, 3]))
    error = np.hypot(view.noise.at(away) * away**2, SCAN_ERROR)
    weight = INDEPENDENT_POINTS / POINTS / error**2
    motion = np.zeros(6)
    told = np.zeros((6, 6))
    for share, of_contour in zip(ERRORS_LEFT, CONTOUR_WEIGHTS, strict=True):
        some = _pose(body, state)
        left_over = share * body.displaced
        reach = min(float(np.hypot(left_over, error)) / radius, WIDEST)
        left, right = normal_equations(
            library, view, some, reach, hidden=share < HIDDEN_FROM
        )
        edges = contour_equations(
            library, view, some, np.array([2 * np.hypot(left_over, error)])
        )
        told = weight * left[0] + of_contour * edges[0][0]
        shown = weight * right[0] + of_contour * edges[1][0]
        change = np.linalg.solve(told + information, shown - information @ motion)
        longest = np.abs(change / np.repeat([1.0, radius], 3)).max()
        state = state.displaced(
            change * min(1.0, LONGEST_STEP / max(longest, LONGEST_STEP))
        )
        motion = expected.motion_to(state)

    (found,) = score(library, view, _pose(body, state))
    if found is None or found.seen + found.hidden == 0:
        return Followed(expected, None, 0.0, 0.0)
    visible = found.seen / (found.seen + found.hidden)
    if found.seen == 0:
        return Followed(expected, None, 0.0, visible)
    _, volume = np.linalg.slogdet(np.eye(6) + expected.pose_covariance @ told)
    evidence = found.total / PIXELS_ALIKE
    evidence -= 0.5 * float(motion @ information @ motion) + 0.5 * float(volume)
    anywhere = np.diag(np.repeat([1.0, 1 / radius**2], 3))
    return Followed(
        expected.measured(
            motion, np.asarray(np.linalg.inv(told + information), np.float64)
        ),
        np.asarray(np.linalg.inv(told + anywhere), np.float64),
        evidence,
        visible,
    )


def name_probability(library: Library, view: View, body: Body) -> float:
    """Compare a thing with all that looks nearly the same in its place.

    Args:
        library: with the thing.
        view: of a frame that shows it.
        body: the thing in the pose that was found.

    Returns:
        Probability of its name, which was confident before the frame.
    """
    itself = _pose(body, body.state)
    (others,) = itself.lookalikes(library, np.ones(len(library), bool))
    # in a large library, those that explain most as they lie
    totals = total_scores(library, view, others, COARSEST)
    others = others[np.argsort(-totals)[:MOST_LOOKALIKES]]

    # a pose that is some degrees off does not tell against the name
    some = Hypotheses.joined([itself, itself.turned(RESTART), others])
    some = register(library, (view,), some, NAME_REACHES)
    totals = np.maximum(total_scores(library, view, some, 1), 0)

    mine = some.things == body.thing
    lead = totals[mine].max() - totals[~mine].max(initial=0)
    odds = logit(CONFIDENT) + lead / score_error(float(totals.max()))
    return float(expit(odds))


def _pose(body: Body, state: BodyState) -> Hypotheses:
    """Return a thing in some state."""
    return Hypotheses.of(
        np.array([body.thing]), state.rotation[None], state.centre[None]
    )
