"""Recognition of things by their geometry: proposals, registration, pixel likelihoods, belief."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ObservationError
from nextview.geometry.observation import Observation
from nextview.geometry.pinhole import PinholeCamera
from nextview.recognition.model_card import Symmetry
from nextview.things.depth_view import NOT_MEASURED, THING, DepthView, MetricImage
from nextview.things.ground import levelling
from nextview.things.registration import (
    COARSE_LEVELS,
    FINE,
    FIRST,
    Alignment,
    Level,
    RegistrationPrior,
    align,
    camera_cost,
    different_poses,
    joined,
    render,
    rotations_of,
    start,
)
from nextview.things.stability import Stability, carried, standing
from nextview.things.stranger import Comparison, log_odds_of_stranger
from nextview.things.surface import Surface, SurfaceCaster
from nextview.things.verification import PixelModel, ViewLikelihood, likelihood
from nextview.things.view_templates import (
    SeenOutline,
    ViewTemplates,
    rank_within,
    templates_of,
)
from nextview.things.weighing import EvidenceWeights, JudgedEpisode
from nextview.types import Float, Index, Mask

# share of things that do not stand on the ground: others support them, or they hang
UNUSUAL = 0.1
THINGS_ALIGNED = 8  # likeliest things whose proposed orientations are all registered
LIKELY_THINGS = 4  # the same by outline
RIVAL_STEPS = 24  # rotations that are tried for a continuous near symmetry
RIVAL_THINGS = 2  # likeliest things whose near symmetries are tried


@dataclass(frozen=True)
class Stage:
    """One stage of a coarse-to-fine registration: few pixels first, more for the survivors.

    Attributes:
        side: rows and columns of pixels.
        levels: steps of the registration.
        most: largest number of survivors, at most half of them of one thing; SHARE_KEPT of the
            hypotheses if these are more.
        hopeless: log-likelihood below the best hypothesis at which a hypothesis is rejected.
        rivals: whether the likeliest hypotheses of RIVAL_THINGS things are also tried in the poses
            of their near symmetries.
    """

    side: int
    levels: tuple[Level, ...]
    most: int
    hopeless: float
    rivals: bool = False


SHARE_KEPT = 0.12  # share of many hypotheses that survive each stage
FINE_SIDE = 40  # rows and columns of pixels in the last stage
STAGES = (
    Stage(16, FIRST, 32, 100.0, rivals=True),
    Stage(24, COARSE_LEVELS, 12, 25.0),
    Stage(FINE_SIDE, FINE, 12, np.inf),
)


@dataclass(frozen=True, eq=False)
class Verified:
    """Result of the verification of some views.

    Attributes:
        belief: belief in each thing, (T,) float64, sums to 1.
        things: thing of each hypothesis, the likeliest hypothesis first, (M,) int64.
        probabilities: probability of each hypothesis, (M,) float64, sums to 1.
        poses: poses of the scan files' frames in the object frame, (M, 4, 4) float64, metres.
        cameras: displacement of each hypothesis in each view, (M, V, 3) float64, metres, object
            frame.
        mean: mean log-likelihood of the pixels of each view, (M, V) float64.
        camera_costs: half the squared normalised errors of each camera's position, (M, V) float64.
        log_belief: log-belief in the thing of each hypothesis by outline and size, (M,) float64.
        by_outline: belief in each thing by outline and size alone, (T,) float64.
        explained: share of the thing's pixels in each view that each hypothesis explains, (M, V)
            float64.
        misfit: residual of each hypothesis in each view, (M, V) float64; 0 for an exact match.
        noise_share: see ``ViewLikelihood``, of each hypothesis in each view, (M, V) float64.
        seen_behind: share of the visible pixels of each hypothesis with a measurement behind it,
            over all views, (M,) float64.
        below: depth of each hypothesis below the ground, (M,) float64, metres; 0 if noise, tilt and
            errors of the scan explain it.
        stands: whether each hypothesis touches the ground and does not topple, (M,) bool; True if
            no view shows the ground.
        carried: whether others support each hypothesis that does not stand on the ground, (M,)
            bool.
    """

    belief: Float
    things: Index
    probabilities: Float
    poses: Float
    cameras: Float
    mean: Float
    camera_costs: Float
    log_belief: Float
    by_outline: Float
    explained: Float
    misfit: Float
    noise_share: Float
    seen_behind: Float
    below: Float
    stands: Mask
    carried: Mask

    def select(self, rows: NDArray) -> "Verified":
        """Select hypotheses.

        Args:
            rows: indices or mask.

        Returns:
            The selected hypotheses, with probabilities that sum to 1.
        """
        kept = (*OF_HYPOTHESES, "probabilities", "log_belief")
        some = replace(self, **{name: getattr(self, name)[rows] for name in kept})
        return replace(
            some, probabilities=some.probabilities / some.probabilities.sum()
        )

    def judged(self, truth: int) -> JudgedEpisode:
        """Convert the result to an example for the fit of the weights.

        Args:
            truth: number of the true thing.

        Returns:
            The example.
        """
        return JudgedEpisode(
            truth,
            self.things,
            self.mean,
            self.camera_costs,
            self.log_belief,
            self.by_outline,
        )

    def alignment(self, rows: Index, verifier: "Verifier") -> Alignment:
        """The alignment of some hypotheses.

        Args:
            rows: indices of the hypotheses, (N,).
            verifier: the verifier that found them.

        Returns:
            Their alignment in the object frame.
        """
        things = self.things[rows]
        rotations = self.poses[rows, :3, :3]
        own_centres = verifier.caster.centres[things].astype(np.float64)
        return Alignment(
            things=things,
            rotations=rotations,
            centres=np.einsum("hij,hj->hi", rotations, own_centres)
            + self.poses[rows, :3, 3],
            cameras=self.cameras[rows],
        )

    @property
    def residual(self) -> float:
        """Mean residual of the likeliest hypothesis over the views; 0 for an exact match."""
        return float(self.misfit[0].mean())


OF_HYPOTHESES = (
    "things",
    "poses",
    "cameras",
    "mean",
    "camera_costs",
    "explained",
    "misfit",
    "noise_share",
    "seen_behind",
    "below",
    "stands",
    "carried",
)
"""Fields of ``Verified`` for each hypothesis, besides its probability and prior belief."""


@dataclass(frozen=True, eq=False)
class _Proposed:
    """M hypotheses before the registration.

    Attributes:
        things: number of the surface of each, (M,) int64.
        rotations: from the axes of the scan files to the object frame, (M, 3, 3) float64.
        centres: centres of the surfaces in the object frame, (M, 3) float64, metres.
        log_belief: log-belief before the verification, (M,) float64.
        by_outline: belief in each thing before the verification, (T,) float64, sums to 1.
    """

    things: Index
    rotations: Float
    centres: Float
    log_belief: Float
    by_outline: Float

    def select(self, rows: NDArray) -> "_Proposed":
        """Select hypotheses by index or mask."""
        return replace(
            self,
            things=self.things[rows],
            rotations=self.rotations[rows],
            centres=self.centres[rows],
            log_belief=self.log_belief[rows],
        )

    def followed_by(self, others: "_Proposed") -> "_Proposed":
        """Append other hypotheses."""
        return replace(
            self,
            things=np.concatenate([self.things, others.things]),
            rotations=np.concatenate([self.rotations, others.rotations]),
            centres=np.concatenate([self.centres, others.centres]),
            log_belief=np.concatenate([self.log_belief, others.log_belief]),
        )


@dataclass(frozen=True, eq=False)
class _Judged:
    """Likelihood of M hypotheses.

    Attributes:
        scores: log-likelihoods, up to a constant, (M,) float64.
        costs: costs of the camera errors, (M, V) float64.
        views: likelihoods of each of V views.
        ground: stability on the ground.
        carried: whether others support them, (M,) bool.
    """

    scores: Float
    costs: Float
    views: Sequence[ViewLikelihood]
    ground: Stability
    carried: Mask

    def select(self, rows: Index) -> "_Judged":
        """Select hypotheses by index."""
        return _Judged(
            self.scores[rows],
            self.costs[rows],
            [view.select(rows) for view in self.views],
            self.ground.select(rows),
            self.carried[rows],
        )


def _outline(image: MetricImage) -> SeenOutline | None:
    """Return the outline of the thing in a view; None if too little of it is visible."""
    return SeenOutline.of(
        image.depth,
        image.kind == THING,
        image.kind == NOT_MEASURED,
        image.hiding,
        PinholeCamera.of(image.intrinsics, image.depth.shape),
        image.pose,
    )


class Verifier:
    """Recognises things of known geometry and estimates their poses.

    Attributes:
        caster: surfaces of the things.
        weights: weights of the evidence.
        pixels: model of the pixels.
        prior: prior of the cameras and the vertical.
        rivals: rotations of each thing about its centroid that hardly change its appearance, (N, 3,
            3) float64; () if unknown.
        among: things that an object may be, (T,) bool; None for all.
    """

    def __init__(
        self,
        surfaces: Sequence[Surface],
        weights: EvidenceWeights = EvidenceWeights(),
        pixels: PixelModel = PixelModel(),
        prior: RegistrationPrior = RegistrationPrior(),
    ) -> None:
        """Prepare the surfaces for ray casting.

        Args:
            surfaces: surfaces of the things.
            weights: weights of the evidence.
            pixels: model of the pixels.
            prior: prior of the cameras and the vertical.
        """
        self.caster = SurfaceCaster(surfaces)
        self.weights = weights
        self.pixels = pixels
        self.prior = prior
        self.rivals: tuple[Float, ...] = ()
        self.among: Mask | None = None

    def __call__(
        self,
        observations: Sequence[Observation],
        any_orientation: bool = False,
        prior: Float | None = None,
    ) -> Verified:
        """Search all things in all orientations, register the likely ones, and verify them.

        Args:
            observations: views of one thing in one object frame.
            any_orientation: whether all orientations are equally likely and the ground is ignored,
                because the thing is in a gripper or in the air.
            prior: prior log-belief in each thing, (T,); None for a uniform one.

        Returns:
            The belief by outline, size and geometry, and the poses.

        Raises:
            ObservationError: no view shows enough of the thing, or its scale is not known.
        """
        if any_orientation:
            images, level = _held(observations)
        else:
            images, level = _levelled(observations)

        outlines = [one for one in map(_outline, images) if one is not None]
        among = np.ones(len(self.caster.surfaces), bool)
        among = among if self.among is None else self.among
        found = [self.templates.propose(one, among) for one in outlines]
        things = np.concatenate([np.zeros(0, np.int64), *(one.things for one in found)])
        if not len(things):
            raise ObservationError(
                "no view shows enough of the thing to compare it with the scans"
            )
        by_outline = -np.mean([one.of_things for one in found], axis=0)
        by_outline = np.where(among, by_outline + (0 if prior is None else prior), -np.inf)
        by_outline -= by_outline.max()
        belief = np.exp(by_outline)
        proposed = _Proposed(
            things=things,
            rotations=np.concatenate([one.rotations for one in found]),
            centres=np.concatenate([one.centres for one in found]),
            log_belief=by_outline[things],
            by_outline=belief / belief.sum(),
        )
        ranks = np.concatenate([one.ranks for one in found])
        hidden = all(one.hidden for one in outlines)
        return self._settled(
            *self._started(proposed, ranks, hidden, images), images, level
        )

    def log_odds_of_stranger(
        self,
        observations: Sequence[Observation],
        found: Verified,
        resting: bool,
    ) -> float:
        """Log-odds of a stranger of the same shape against the likeliest hypothesis.

        Args:
            observations: the views.
            found: their verification.
            resting: whether the ground counts if it is visible.

        Returns:
            Log-odds, nats: see ``stranger.log_odds_of_stranger``.
        """
        images, level = _levelled(observations) if resting else _held(observations)
        views = [image.view(FINE_SIDE) for image in images]
        comparison = Comparison(
            self.caster,
            views,
            self.prior,
            self.weights,
            self.pixels,
        )
        likeliest = found.alignment(np.zeros(1, np.int64), self).turned(level)
        return log_odds_of_stranger(comparison, likeliest)

    @cached_property
    def templates(self) -> ViewTemplates:
        """Templates of the things from all directions, which propose orientations."""
        return templates_of(self.caster)

    def prepare(self, threads: int = 0) -> None:
        """Render the templates now, so that they do not delay the first frame.

        Args:
            threads: number of threads; 0 for one on each core.
        """
        if "templates" not in vars(self):
            self.templates = templates_of(self.caster, threads)

    def _started(
        self,
        proposed: _Proposed,
        ranks: Index,
        hidden: bool,
        images: Sequence[MetricImage],
    ) -> tuple[_Proposed, Alignment]:
        """Register the first orientation of each thing, and add the others of the likeliest things.

        The likeliest things are those with the best scores after registration, and those with the
        likeliest outlines. If a part of the outline is hidden, the others of all things are added.

        Args:
            proposed: orientations of things.
            ranks: number of earlier orientations of the same thing, (M,).
            hidden: whether every view shows only a part of the outline.
            images: the views.

        Returns:
            Hypotheses to be registered, and their initial poses.
        """
        stage = STAGES[0]
        views = [image.view(stage.side) for image in images]
        first = proposed.select(ranks == 0)
        tried = start(first.things, first.rotations, first.centres, len(views))
        tried = align(self.caster, tried, views, stage.levels, self.prior)
        judged = self._judged(first, tried, views)
        order = np.argsort(-judged.scores, kind="stable")

        best = list(dict.fromkeys(first.things[order].tolist()))
        best = best if hidden else best[:THINGS_ALIGNED]
        best += np.argsort(-proposed.by_outline)[:LIKELY_THINGS].tolist()
        others = proposed.select((ranks > 0) & np.isin(proposed.things, best))
        alignment = start(others.things, others.rotations, others.centres, len(views))
        return first.followed_by(others), joined(tried, alignment)

    def _settled(
        self,
        proposed: _Proposed,
        alignment: Alignment,
        images: Sequence[MetricImage],
        level: Float,
    ) -> Verified:
        """Register and verify the proposals, coarse to fine, in a level frame."""
        for stage in STAGES:
            views = [image.view(stage.side) for image in images]
            alignment = align(self.caster, alignment, views, stage.levels, self.prior)
            judged = self._judged(proposed, alignment, views, stage is STAGES[-1])

            scores = judged.scores
            order = np.argsort(-scores, kind="stable")
            order = order[scores[order] >= scores[order[0]] - stage.hopeless]
            rows = order[different_poses(self.caster, alignment.select(order))]
            most = max(stage.most, int(SHARE_KEPT * len(alignment)))
            # a thing with many similar poses, such as a round one, does not displace all others
            rows = rows[rank_within(alignment.things[rows]) < most // 2][:most]
            alignment = alignment.select(rows)
            proposed = proposed.select(rows)

            if stage.rivals and self.rivals:
                turned, source = self._rivals(alignment)
                alignment = joined(alignment, turned)
                proposed = proposed.select(np.r_[np.arange(len(rows)), source])

        return self._verified(proposed, alignment, judged.select(rows), level)

    def _judged(
        self,
        proposed: _Proposed,
        alignment: Alignment,
        views: Sequence[DepthView],
        others_carry: bool = False,
    ) -> _Judged:
        """Score hypotheses by the pixels of all views and by their stability.

        ``others_carry`` enables the search for supports other than the ground.
        """
        ground = standing(self.caster, alignment, views, self.prior.tilt)
        rendered = [
            render(self.caster, alignment, view, number)
            for number, view in enumerate(views)
        ]
        judged = [
            likelihood(view, shown, self.pixels, ground.below)
            for view, shown in zip(views, rendered, strict=True)
        ]
        by_others = np.zeros(len(alignment), bool)
        if others_carry:
            rows = np.flatnonzero(~ground.stands & (ground.below == 0))
            by_others = carried(self.caster, alignment, views, rendered, rows)

        mean = np.stack([view.mean for view in judged], 1)
        costs = camera_cost(alignment, views, self.prior)
        scores = self.weights.scores(mean, costs, proposed.log_belief)
        scores = scores + np.where(ground.stands, 0, np.log(UNUSUAL))
        return _Judged(scores, costs, judged, ground, by_others)

    def _rivals(self, alignment: Alignment) -> tuple[Alignment, Index]:
        """The likeliest hypotheses in the poses of their near symmetries.

        Returns:
            The alignment, and the index of the original hypothesis of each, (N,).
        """
        first = np.sort(np.unique(alignment.things, return_index=True)[1])
        some = [
            (row, self.rivals[alignment.things[row]]) for row in first[:RIVAL_THINGS]
        ]
        source = np.concatenate([np.full(len(turns), row) for row, turns in some])
        turned = alignment.select(source)
        surfaces = [self.caster.surfaces[thing] for thing in turned.things]
        arms = np.array([one.centroid - one.centre for one in surfaces]).reshape(-1, 3)
        rotations = turned.rotations @ np.concatenate([turns for _, turns in some])
        fixed = turned.centres + np.einsum("nij,nj->ni", turned.rotations, arms)
        centres = fixed - np.einsum("nij,nj->ni", rotations, arms)
        return replace(turned, rotations=rotations, centres=centres), source

    def _verified(
        self,
        proposed: _Proposed,
        alignment: Alignment,
        judged: _Judged,
        level: Float,
    ) -> Verified:
        """Assemble the result from the surviving proposals, sorted by their scores.

        ``alignment`` is in the level frame.
        """
        visible = np.sum([view.visible for view in judged.views], axis=0)
        behind = np.sum([view.seen_behind for view in judged.views], axis=0)
        aligned = alignment.turned(level.T)
        scores = judged.scores
        shares = np.exp(scores - scores.max())

        return Verified(
            belief=self.weights.belief(scores, alignment.things, proposed.by_outline),
            things=alignment.things,
            probabilities=shares / shares.sum(),
            poses=aligned.poses(self.caster),
            cameras=aligned.cameras,
            mean=np.stack([view.mean for view in judged.views], 1),
            camera_costs=judged.costs,
            log_belief=proposed.log_belief,
            by_outline=proposed.by_outline,
            explained=np.stack([view.explained for view in judged.views], 1),
            misfit=np.stack([view.misfit for view in judged.views], 1),
            noise_share=np.stack([view.noise_share for view in judged.views], 1),
            seen_behind=behind / np.maximum(visible, 1),
            below=judged.ground.depth,
            stands=judged.ground.stands,
            carried=judged.carried,
        )


def rival_turns(symmetries: Sequence[Symmetry]) -> Float:
    """Rotations that near symmetries generate, without the identity.

    Args:
        symmetries: near symmetries of a thing.

    Returns:
        Rotation matrices, (N, 3, 3).
    """
    vectors = [
        2 * np.pi * step / steps * np.array(one.axis)
        for one in symmetries
        for steps in [one.order or RIVAL_STEPS]
        for step in range(1, steps)
    ]
    return rotations_of(np.array(vectors)) if vectors else np.zeros((0, 3, 3))


def _levelled(
    observations: Sequence[Observation],
) -> tuple[list[MetricImage], Float]:
    """Images that show the thing, rotated so that the ground is level, and that rotation."""
    images = images_of(observations)
    floors = [image.floor for image in images if image.floor is not None]
    level = levelling(floors)
    return [image.turned(level) for image in images], level


def _held(observations: Sequence[Observation]) -> tuple[list[MetricImage], Float]:
    """Images that show the thing, without a ground, and the identity rotation."""
    images = [
        replace(image, ground=None, floor=None) for image in images_of(observations)
    ]
    return images, np.eye(3)


def images_of(observations: Sequence[Observation]) -> list[MetricImage]:
    """Convert the observations that show the thing to metres.

    Args:
        observations: views of one thing.

    Returns:
        Images of the views that show it.

    Raises:
        ObservationError: no view shows the thing, or its scale is not known.
    """
    found = (MetricImage.of(observation) for observation in observations)
    images = [image for image in found if image is not None]
    if not images:
        raise ObservationError("no view shows the thing, so nothing can be aligned")
    return images
