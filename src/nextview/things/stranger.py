"""Comparison of a taught thing with a stranger: a thing of the same shape in another size.

The rival of a hypothesis is its own scan, stretched along the axes of the scan: a box with other
sides, a can of another height, a bottle with a wider belly. Steps of the registration with three
further unknowns estimate the stretch together with the pose. Two priors are compared at this
estimate: a taught thing has no stretch except for the errors of its scan and the scale error of the
camera; a stranger has a stretch of any usual amount. The ratio of the two probabilities is a Bayes
factor (MacKay 2003, "Information theory, inference, and learning algorithms", chapter 28), with a
Laplace approximation of the posterior.

Noise makes the estimate less certain and weakens the evidence for both. Unlike a residual, a
systematic offset of an outline or a depth over a whole side has no explanation by noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nextview.things.depth_view import DepthView
from nextview.things.registration import (
    FINE,
    POSE,
    SHIFT_LIMIT,
    TURN,
    TURN_LIMIT,
    Alignment,
    CameraStands,
    Level,
    Pulls,
    RegistrationPrior,
    Rendered,
    camera_cost,
    priors_of,
    pulls_of,
    pulls_of_outline,
    rotations_of,
    scan_errors,
)
from nextview.things.stability import lowest_planes
from nextview.things.surface import SurfaceCaster
from nextview.things.verification import PixelModel, likelihood
from nextview.things.weighing import EvidenceWeights
from nextview.types import Float

# prior probability that the best matching scan belongs to another thing of its shape
STRANGERS = 1 / 3
# standard deviation of a stranger's log-stretch along each axis
UNLIKE = 0.2
# relative scale error of a camera
CAMERA_SCALE = 0.015
# standard deviation of the height of a standing thing above the ground, metres
BOTTOM_NOISE = 0.004
ON_OTHERS = 0.1  # share of the things that stand on other things
# typical height of such a support, metres: other things, books, trays
OTHERS_HEIGHT = 0.1
# pixels over which cameras mix the depths of both sides of an outline, with window matching
BLUR = 8.0
LEAST_INSIDE = 0.1  # square root of the weight of a depth at the outline

STRETCH = slice(POSE, POSE + 3)
UNKNOWNS = POSE + 3
"""Unknowns of a step: rotation, translation and stretch of the hypothesis, then camera errors."""

STRETCH_LEVELS = (Level(5, 0.05, 0.5), Level(5, 0.02, 0.1))
# largest log-stretch of a step, and scale of its damping
STRETCH_STEP = 0.1
UNTOLD = 1.0  # standard deviation of a stretch that the views do not determine


@dataclass(frozen=True, eq=False)
class Comparison:
    """Inputs of a comparison.

    Attributes:
        caster: all surfaces.
        views: views of the thing, in a level frame.
        prior: prior of the cameras and the vertical.
        weights: weights of pixels and camera errors.
        pixels: model of the pixels.
    """

    caster: SurfaceCaster
    views: Sequence[DepthView]
    prior: RegistrationPrior
    weights: EvidenceWeights
    pixels: PixelModel


@dataclass(frozen=True, eq=False)
class Stretched:
    """A hypothesis whose scan is stretched about the centre of its surface.

    Attributes:
        alignment: the hypothesis.
        factors: stretch along the axes of the scan file, (3,) float64.
    """

    alignment: Alignment
    factors: Float

    def render(self, comparison: Comparison, number: int) -> Rendered:
        """Render it in a view.

        Args:
            comparison: the views and surfaces.
            number: index of the view.

        Returns:
            Depth and normals of the hypothesis.
        """
        view = comparison.views[number]
        aligned = self.alignment
        rotation = aligned.rotations[0]
        centre = aligned.centres[0] + aligned.cameras[0, number]
        origin = (view.origin - centre) @ rotation / self.factors
        rays = view.rays @ rotation / self.factors

        origin = origin + comparison.caster.centres[aligned.things[0]]
        depth, normals = comparison.caster.cast(
            aligned.things,
            origin[None].astype(np.float32),
            rays[None].astype(np.float32),
        )

        across = normals / self.factors
        lengths = np.linalg.norm(across, axis=2, keepdims=True)
        across = across / np.maximum(lengths, 1e-12) @ rotation.T
        radii = comparison.caster.radii[aligned.things]
        return Rendered(depth, across.astype(np.float32), radii)

    def bottom(self, comparison: Comparison) -> tuple[float, Float] | None:
        """Height of its lowest point above the nearest ground, and its derivatives by the unknowns.

        Args:
            comparison: the views and surfaces.

        Returns:
            Height, metres, and derivatives, (UNKNOWNS,); None if no view shows the ground.
        """
        planes = lowest_planes(comparison.views)
        if not planes:
            return None
        aligned = self.alignment
        surface = comparison.caster.surfaces[aligned.things[0]]
        up = aligned.rotations[0, 2]  # up in the axes of the scan
        points = (surface.vertices - surface.centre) * self.factors
        heights = points @ up
        lowest = int(heights.argmin())
        change = np.zeros(UNKNOWNS)
        change[POSE - 1] = 1
        change[STRETCH] = points[lowest] * up
        bottom = float(heights[lowest] + aligned.centres[0, 2])
        above = min((bottom - plane.height for plane in planes), key=abs)
        return above, change


def log_odds_of_stranger(comparison: Comparison, alignment: Alignment) -> float:
    """Log-odds of a stranger of a thing's shape against the thing.

    Args:
        comparison: the views.
        alignment: the likeliest hypothesis, registered with them.

    Returns:
        Log-odds, nats: positive if a stranger is likelier than the thing.
    """
    itself = Stretched(alignment, np.ones(3))
    rivals = [_fitted(comparison, itself, False)]
    if itself.bottom(comparison) is not None:
        rivals.append(_fitted(comparison, itself, True))
    best = _best(comparison, itself, rivals)
    found, covariance = _estimate(comparison, best)

    surface = comparison.caster.surfaces[alignment.things[0]]
    half_sides = np.maximum(np.ptp(surface.vertices, axis=0) / 2, 1e-4)
    taught = np.diag((scan_errors(surface.radius) / half_sides) ** 2) + CAMERA_SCALE**2
    strange = taught + UNLIKE**2 * np.eye(3)
    factor = _log_density(found, covariance, strange)
    factor -= _log_density(found, covariance, taught)
    return factor + float(np.log(STRANGERS / (1 - STRANGERS)))


def _fitted(comparison: Comparison, rival: Stretched, standing: bool) -> Stretched:
    """Register and stretch a rival, with or without a pull to the ground."""
    for level in STRETCH_LEVELS:
        for _ in range(level.steps):
            rival = _step(comparison, rival, level, standing)
    return rival


def _step(
    comparison: Comparison,
    rival: Stretched,
    level: Level,
    standing: bool,
) -> Stretched:
    """One Gauss-Newton step, damped as in the registration."""
    left, right = _equations(comparison, rival, level)
    aligned = rival.alignment
    right[STRETCH] -= np.log(rival.factors) / UNLIKE**2
    radii = comparison.caster.radii[aligned.things]
    farthest = level.reach(radii, comparison.prior.displaced(comparison.views).max())[0]

    damped = np.zeros(len(left))
    damped[TURN] = 1 / level.off**2
    damped[3:POSE] = 1 / farthest**2
    damped[STRETCH] = 1 / STRETCH_STEP**2 + 1 / UNLIKE**2
    left[np.diag_indices(len(left))] += damped

    ends = rival.bottom(comparison) if standing else None
    if ends is not None:
        height, change = ends
        weight = 1 / (
            BOTTOM_NOISE**2 + (height / 3) ** 2
        )  # a robust weight: a thing on other things is not pulled to the ground
        left[:UNKNOWNS, :UNKNOWNS] += weight * np.outer(change, change)
        right[:UNKNOWNS] -= weight * height * change

    moved = np.linalg.solve(left, right)
    turn = np.clip(moved[TURN], -TURN_LIMIT, TURN_LIMIT)
    limit = SHIFT_LIMIT * float(radii[0])
    cameras = aligned.cameras
    if len(moved) > UNKNOWNS:
        numbers = CameraStands.of(comparison.views).numbers
        cameras = cameras + moved[UNKNOWNS:].reshape(-1, 3)[numbers]
    grown = np.clip(moved[STRETCH], -STRETCH_STEP, STRETCH_STEP)
    aligned = replace(
        aligned,
        rotations=rotations_of(turn[None]) @ aligned.rotations,
        centres=aligned.centres + np.clip(moved[3:POSE], -limit, limit),
        cameras=cameras,
    )
    return Stretched(aligned, rival.factors * np.exp(grown))


def _equations(
    comparison: Comparison,
    rival: Stretched,
    level: Level,
    outlines: bool = False,
) -> tuple[Float, Float]:
    """Matrix, (U, U), and right-hand side, (U,), without a prior of the stretch.

    ``outlines`` adds the information of outlines that fit, which have no residual.
    """
    views = comparison.views
    aligned = rival.alignment
    displaced = comparison.prior.displaced(views)
    stands = CameraStands.of(views)
    of_cameras = 3 * len(stands.first) if stands.several else 0
    left = np.zeros((UNKNOWNS + of_cameras, UNKNOWNS + of_cameras))
    right = np.zeros(len(left))

    for number, view in enumerate(views):
        rendered = rival.render(comparison, number)
        centres = aligned.centres + aligned.cameras[:, number]
        reach = level.reach(rendered.radii, displaced[number])
        # Within one view, a displacement by the camera error equals a translation of the thing.
        own = np.arange(UNKNOWNS)
        if of_cameras:
            own = np.append(own, np.r_[stands.unknowns(number, UNKNOWNS)])
        drawn = [pulls_of(view, rendered, centres, reach)]
        if outlines:
            drawn.append(pulls_of_outline(view, rendered, centres))
        for pulls in drawn:
            square, towards = _normal_equations(pulls, aligned, comparison.prior)
            left[np.ix_(own, own)] += square[: len(own), : len(own)]
            right[own] += towards[: len(own)]

    weights, so_far = priors_of(
        comparison.caster,
        aligned,
        stands if of_cameras else None,
        displaced,
        comparison.prior,
    )
    held = np.append(np.arange(POSE), np.arange(UNKNOWNS, len(left)))
    left[held, held] += weights[0]
    right[held] -= weights[0] * so_far[0]
    return left, right


def _normal_equations(
    pulls: Pulls,
    aligned: Alignment,
    prior: RegistrationPrior,
) -> tuple[Float, Float]:
    """Normal equations of one view for rotation, translation, stretch and camera error.

    Returns:
        Matrix, (UNKNOWNS + 3, UNKNOWNS + 3), and right-hand side, (UNKNOWNS + 3,).
    """
    rotation = aligned.rotations[0]
    along_axes = (pulls.directions @ rotation) * (pulls.arms @ rotation)
    turning = np.cross(pulls.arms, pulls.directions)
    columns = [turning, pulls.directions, along_axes, pulls.directions]
    jacobian = np.concatenate(columns, axis=1).astype(np.float64)
    # The errors of neighbouring pixels are correlated, and depths beside an outline mix both sides.
    share = min(1, prior.pixels / max(len(jacobian), 1))
    clear = np.clip(pulls.inside / BLUR, LEAST_INSIDE, 1) ** 2
    weighted = jacobian * (share * pulls.weights * clear)[:, None]
    return weighted.T @ jacobian, weighted.T @ pulls.distances


def _best(
    comparison: Comparison,
    itself: Stretched,
    rivals: Sequence[Stretched],
) -> Stretched:
    """The most probable rival among those that explain the views better than the thing.

    The result is the unstretched thing if there is none: a thing on other things is not pulled to
    the ground, and fits that ended in a worse optimum are discarded.
    """
    explained = [_explains(comparison, rival) for rival in (itself, *rivals)]
    best, highest = itself, -np.inf
    for rival, score in zip(rivals, explained[1:], strict=True):
        prior = -0.5 * float((np.log(rival.factors) ** 2).sum()) / UNLIKE**2
        ends = rival.bottom(comparison)
        if ends is not None:
            height = np.array(ends[:1])
            prior += _log_density(height, np.zeros((1, 1)), np.zeros((0, 0)))
        if score > explained[0] and score + prior > highest:
            best, highest = rival, score + prior
    return best


def _explains(comparison: Comparison, rival: Stretched) -> float:
    """Log-likelihood of the views under a rival, weighted as in the belief, up to a constant."""
    judged = [
        likelihood(view, rival.render(comparison, number), comparison.pixels)
        for number, view in enumerate(comparison.views)
    ]
    mean = np.stack([one.mean for one in judged], 1)
    costs = camera_cost(rival.alignment, comparison.views, comparison.prior)
    return float(comparison.weights.scores(mean, costs, np.zeros(1))[0])


def _estimate(comparison: Comparison, rival: Stretched) -> tuple[Float, Float]:
    """Estimate of the stretch, and of the height above the ground, from the views alone.

    Returns:
        Mean, (3,) or (4,), and covariance of the log-stretch along three axes and, if the ground is
        visible, of the height, metres.
    """
    left, right = _equations(comparison, rival, FINE[-1], outlines=True)
    left[STRETCH, STRETCH] += np.eye(3) / UNTOLD**2
    right[STRETCH] -= np.log(rival.factors) / UNTOLD**2
    inverse = np.linalg.inv(left)
    wanted = np.zeros((3, len(left)))
    wanted[:, STRETCH] = np.eye(3)
    so_far = np.log(rival.factors)
    ends = rival.bottom(comparison)
    if ends is not None:
        height, change = ends
        row = np.append(change, np.zeros(len(left) - UNKNOWNS))
        wanted = np.vstack([wanted, row])
        so_far = np.append(so_far, height)
    return so_far + wanted @ inverse @ right, wanted @ inverse @ wanted.T


def _log_density(found: Float, covariance: Float, stretch: Float) -> float:
    """Log-density of an estimate if the stretch is normal with some covariance, (S, S).

    A further component is the height of the bottom: most things stand on the ground, some stand on
    other things.
    """
    size = len(stretch)
    if len(found) == size:
        return _log_normal(found, covariance + stretch)
    parts = []
    for share, height in ((1 - ON_OTHERS, BOTTOM_NOISE), (ON_OTHERS, OTHERS_HEIGHT)):
        prior = np.zeros_like(covariance)
        prior[:size, :size] = stretch
        prior[size, size] = height**2
        parts.append(np.log(share) + _log_normal(found, covariance + prior))
    return float(np.logaddexp(*parts))


def _log_normal(values: Float, covariance: Float) -> float:
    """Log-density of values, (N,), under a zero-mean normal distribution."""
    scaled = values @ np.linalg.solve(covariance, values)
    volume = np.linalg.slogdet(2 * np.pi * covariance)[1]
    return float(-0.5 * (scaled + volume))
