"""Registration of a followed thing with the pixels of a frame around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nextview.scene.body import Body
from nextview.scene.motion import BodyState
from nextview.scene.placing import DEPTH_RANGE, SEEN_THROUGH, log_density
from nextview.sensing.facets import Noise
from nextview.sensing.frame import Frame
from nextview.sensing.planes import Plane
from nextview.things.depth_view import (
    ELSEWHERE,
    NOT_MEASURED,
    THING,
    DepthView,
    outline,
)
from nextview.things.expected_images import LOWEST_COSINE
from nextview.things.ground import Ground
from nextview.things.registration import (
    POSE,
    SUNK,
    Alignment,
    RegistrationPrior,
    Rendered,
    inverses,
    normal_equations,
    pulls_of,
    pulls_of_outline,
    render,
)
from nextview.types import Float, Float32, Index, Mask

SURPRISE = 6.9  # nats that make a move as likely as none: one thing in a thousand moves
TRACKED_SIDE = 44  # rows and columns of pixels around a thing
FEWEST_LINES = 8  # rows or columns of the image in which a thing is registered
AROUND_OUTLINE = 0.15  # margin around the outline, relative to its size, at least
AROUND_DEVIATIONS = 2.0  # the same in standard deviations of the expected place
# error of the expected pose that is left before each step, as a share
ERRORS_LEFT = (1.0, 0.5, 0.25, 0.1, 0.1)
CHOSEN_AGAIN = 2  # step before which the pixels of the thing are chosen again
# share of the outline of a thing at which another surface continues its own
TOUCHING_SHARE = 0.2
SMOOTH_SHARE = 0.9  # share of neighbouring pixels that show one surface
GOES_ON_DEVIATIONS = 3.0  # of the depth, within which a surface goes on
STEEPEST = 3.0  # tangent of the slope of surfaces across the line of sight
LONGEST_STEP = 0.5  # radians, or radii
MOST_INDEPENDENT = RegistrationPrior().pixels


@dataclass(frozen=True, eq=False)
class BodyPixels:
    """Pixels of a frame around a thing, in the world.

    Attributes:
        view: the pixels; none shows the thing yet.
        points: measured, (P, 3) float32, metres.
        without: log-density of their depths if none shows the thing, (P,).
        grain: distance within which the errors of pixels are correlated, pixels of the image.
    """

    view: DepthView
    points: Float32
    without: Float
    grain: int

    @classmethod
    def around(
        cls,
        body: Body,
        others: Sequence[Body],
        frame: Frame,
        noise: Noise,
        ground: Plane | None,
    ) -> BodyPixels | None:
        """Cut out the pixels around a thing; None if it is out of view.

        Args:
            body: the thing in its expected pose.
            others: other followed things.
            frame: the frame.
            noise: of its depth.
            ground: on which things stand; None if it is not known.
        """
        lines = _lines_around(body, frame)
        if lines is None:
            return None
        rows, columns = lines

        view = _view_of(frame, rows, columns, noise)
        points = view.origin.astype(np.float32) + view.rays * view.depth[:, None]
        without = np.full(len(points), np.log(0.5 / DEPTH_RANGE))
        seen = view.kind != NOT_MEASURED

        if ground is not None and seen.any():
            heights = ground.height(points)
            slope = np.abs(view.rays @ ground.normal).clip(LOWEST_COSINE)
            off = np.abs(heights) / slope
            on = log_density(off, np.hypot(view.noise, SUNK / 2), SEEN_THROUGH)
            sigma = float(noise.at(float(np.median(view.depth[seen]))))
            view = replace(
                view,
                ground=Ground(ground.normal, ground.offset, sigma),
                level=seen & (on > without),
            )
            without = np.logaddexp(without, on)

        for other in others:
            apart = np.linalg.norm(points - other.state.centre, axis=1)
            near = seen & (apart < other.surface.radius + other.displaced)
            if near.any():
                on = other.log_density(points[near], view.noise[near])
                without[near] = np.logaddexp(without[near], on)
        return cls(view, points, without, noise.grain)

    def showing(self, body: Body) -> DepthView:
        """Decide which pixels show the thing.

        Args:
            body: the thing in its expected pose.

        Returns:
            The view with these pixels.
        """
        view = self.view
        seen = view.kind != NOT_MEASURED
        thing = np.zeros(len(seen), bool)
        if seen.any():
            likely = body.log_density(self.points[seen], view.noise[seen])
            thing[seen] = likely > self.without[seen]
        edge, towards = outline(thing.reshape(view.shape), view.step)
        return replace(
            view,
            kind=np.where(thing, THING, view.kind),
            edge=edge.ravel(),
            towards=towards.reshape(-1, 2),
            whole=int(thing.sum()),
        )

    def prior(self, count: int) -> RegistrationPrior:
        """Return a registration's prior with the number of independent pixels.

        Args:
            count: number of pixels of the grid that show the thing.
        """
        whole = count * float(self.view.step.prod())
        return RegistrationPrior(
            pixels=min(max(whole / self.grain**2, 1.0), MOST_INDEPENDENT)
        )


@dataclass(frozen=True, eq=False)
class RegisteredBody:
    """A thing that is registered with a frame.

    Attributes:
        state: of its motion.
        errors: covariance of the measured pose without the prediction, (6, 6); None if no pixel
            shows the thing.
        evidence: log-likelihood of the pixels over all motions, against that without the thing
            (Laplace's approximation, see ``MotionFit.evidence``).
        visible: share of the pixels on it that nothing in front hides.
    """

    state: BodyState
    errors: Float | None
    evidence: float
    visible: float


def registered(body: Body, pixels: BodyPixels) -> RegisteredBody:
    """Register a thing with the pixels around it.

    Args:
        body: the thing in its expected pose.
        pixels: of the frame.
    """
    expected = body.state
    state = expected
    information = expected.information
    view = pixels.showing(body)
    if not view.whole:
        gain, visible = _gain(view, _rendered(body, state, view), pixels)
        return RegisteredBody(expected, None, gain, visible)

    prior = pixels.prior(view.whole)
    motion = np.zeros(POSE)
    for step, share in enumerate(ERRORS_LEFT):
        if step == CHOSEN_AGAIN:
            surer = replace(state, covariance=share**2 * expected.covariance)
            again = pixels.showing(replace(body, state=surer))
            view = again if again.whole else view
        rendered = _rendered(body, state, view)
        reach = np.array([share * body.displaced], np.float32)
        pulls = pulls_of(view, rendered, state.centre[None], reach)
        left, right = normal_equations(pulls, prior)
        change = np.linalg.solve(left[0] + information, right[0] - information @ motion)
        longest = np.abs(change / np.repeat([1.0, body.surface.radius], 3)).max()
        change *= min(1.0, LONGEST_STEP / max(longest, LONGEST_STEP))
        state = state.displaced(change)
        motion = expected.motion_to(state)

    rendered = _rendered(body, state, view)
    held = pulls_of_outline(view, rendered, state.centre[None])
    told = left[0] + normal_equations(held, prior)[0][0]
    gain, visible = _gain(view, rendered, pixels)
    _, volume = np.linalg.slogdet(np.eye(POSE) + expected.pose_covariance @ told)
    evidence = gain - 0.5 * motion @ information @ motion - 0.5 * volume
    covariance = inverses((told + information)[None])[0]
    anywhere = np.diag(np.repeat([1.0, 1 / body.surface.radius**2], 3))
    return RegisteredBody(
        expected.measured(motion, covariance),
        inverses((told + anywhere)[None])[0],
        float(evidence),
        visible,
    )


def _lines_around(body: Body, frame: Frame) -> tuple[Index, Index] | None:
    """Rows and columns, ascending, spread over a thing; None if it is out of view."""
    pose = np.linalg.inv(frame.camera_to_world) @ body.pose
    corners = body.surface.hull @ pose[:3, :3].T + pose[:3, 3]
    nearest = corners[:, 2].min()
    if nearest <= 0:
        return None

    at = frame.pinhole.project(corners)
    low = at.min(0)
    high = at.max(0)
    wide = AROUND_DEVIATIONS * body.displaced * frame.intrinsics[0, 0] / nearest
    margin = max(wide, AROUND_OUTLINE * (high - low).max())

    height, width = frame.shape
    first = np.clip(low - margin, 0, [width - 1, height - 1]).astype(int)
    last = np.clip(high + margin, 0, [width - 1, height - 1]).astype(int)
    if (last - first).min() < FEWEST_LINES:
        return None
    columns, rows = (
        np.unique(np.linspace(start, end, TRACKED_SIDE).astype(np.int64))
        for start, end in zip(first, last, strict=True)
    )
    return rows, columns


def _view_of(frame: Frame, rows: Index, columns: Index, noise: Noise) -> DepthView:
    """Pixels of some rows and columns in the world, none of which shows the thing yet."""
    depth = frame.depth[np.ix_(rows, columns)].ravel()
    axes = frame.camera_to_world[:3, :3]
    rays = np.ones((len(rows), len(columns), 3), np.float32)
    rays[..., 0] = frame.rays[0][columns]
    rays[..., 1] = frame.rays[1][rows][:, None]

    return DepthView(
        origin=frame.camera_to_world[:3, 3],
        camera_axes=axes,
        rays=rays.reshape(-1, 3) @ axes.T.astype(np.float32),
        depth=depth,
        kind=np.where(depth > 0, ELSEWHERE, NOT_MEASURED).astype(np.uint8),
        noise=(noise.at(depth) * depth**2).astype(np.float32),
        edge=np.zeros(len(depth), np.float32),
        towards=np.zeros((len(depth), 2), np.float32),
        ground=None,
        floor=None,
        level=np.zeros(len(depth), bool),
        shape=(len(rows), len(columns)),
        step=np.array(
            [np.ptp(rows) / (len(rows) - 1), np.ptp(columns) / (len(columns) - 1)]
        ),
        pitch=float(1 / frame.intrinsics[[0, 1], [0, 1]].mean()),
        whole=0,
    )


def _rendered(body: Body, state: BodyState, view: DepthView) -> Rendered:
    """Render a thing in some state."""
    alignment = Alignment(
        things=np.zeros(1, np.int64),
        rotations=state.rotation[None],
        centres=state.centre[None],
        cameras=np.zeros((1, 1, 3)),
    )
    return render(body.caster, alignment, view, 0)


def _gain(
    view: DepthView, rendered: Rendered, pixels: BodyPixels
) -> tuple[float, float]:
    """Log-likelihood of the pixels on a thing against that without it, and its visible share."""
    shows = np.isfinite(rendered.depth[0])
    count = int(np.count_nonzero(shows))
    if not count:
        return 0.0, 0.0
    measured = shows & (view.kind != NOT_MEASURED)
    depth = rendered.depth[0, measured]
    seen = view.depth[measured]
    without = pixels.without[measured]
    rays = view.rays[measured]
    cosine = np.abs(np.einsum("ni,ni->n", rendered.normals[0, measured], rays))
    cosine = np.clip(cosine / np.linalg.norm(rays, axis=1), LOWEST_COSINE, 1)
    sideways = depth * view.pitch * np.sqrt(1 - cosine**2) / cosine
    sigma = np.sqrt(view.noise[measured] ** 2 + rendered.errors[0] ** 2 + sideways**2)

    front = seen < depth
    on = log_density(np.abs(seen - depth), sigma, SEEN_THROUGH)
    # what is known, and anything unknown, may hide the surface: then the pixel tells nothing of it
    gains = np.where(front, np.maximum(on, without), on) - without
    visible = ~front | (gains > 0)
    independent = min(1.0, pixels.prior(count).pixels / count)
    explained = np.zeros(len(shows), bool)
    explained[measured] = gains > 0
    gain = gains.sum() + _gain_of_edges(view, explained, pixels)
    return float(independent * gain), float(np.count_nonzero(visible) / count)


def _gain_of_edges(view: DepthView, explained: Mask, pixels: BodyPixels) -> float:
    """Log-likelihood of the edges of what a thing explains against that without the thing.

    Where the surface goes on beyond the pixels that a thing explains, it is likely to be that of
    something else. Neighbours that something known explains, or that are in front, tell nothing.

    Args:
        view: the pixels.
        explained: those that the thing explains, (P,) bool.
        pixels: with the explanations without the thing.
    """
    unknown = pixels.without < np.log(1 / DEPTH_RANGE)
    told = (~explained & unknown & (view.kind != NOT_MEASURED)).reshape(view.shape)
    inside = explained.reshape(view.shape)
    depth = view.depth.reshape(view.shape)
    noise = view.noise.reshape(view.shape)

    goes_on = 0
    ends = 0
    for axis in (0, 1):
        first, last = (
            (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        )
        for one, other in ((first, last), (last, first)):
            pairs = inside[one] & told[other]
            behind = (depth[other] - depth[one])[pairs]
            near = GOES_ON_DEVIATIONS * np.hypot(noise[one], noise[other])[pairs]
            near += STEEPEST * view.step[axis] * view.pitch * depth[one][pairs]
            goes_on += int((np.abs(behind) < near).sum())
            ends += int((behind >= near).sum())

    return float(
        goes_on * np.log(TOUCHING_SHARE / SMOOTH_SHARE)
        + ends * np.log((1 - TOUCHING_SHARE) / (1 - SMOOTH_SHARE))
    )
