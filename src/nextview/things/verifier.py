"""Recognise taught things by their geometry: propose, align, judge every pixel, believe."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ObservationError
from nextview.geometry.observation import Observation
from nextview.recognition.model_card import Symmetry
from nextview.things.depth_view import DepthView, MetricImage
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
from nextview.things.view_templates import ViewTemplates, rank_within
from nextview.things.weighing import EvidenceWeights, JudgedEpisode
from nextview.types import Float, Index, Mask

# share of things that do not stand on the ground: others carry them, or they hang
UNUSUAL = 0.1
THINGS_ALIGNED = 8  # likeliest things of which all proposed orientations are aligned
LIKELY_THINGS = 4  # the same of the likeliest by outline
RIVAL_STEPS = 24  # in which a thing of which any turn is nearly a symmetry is turned
RIVAL_THINGS = 2  # likeliest things that are turned


@dataclass(frozen=True)
class Stage:
    """Hypotheses are aligned with few pixels first, and those that survive with more.

    Attributes:
        side: rows and columns of pixels.
        levels: steps of the alignment.
        most: how many hypotheses survive at most, half of them of one thing.
        hopeless: a hypothesis that is by so much less likely than the best one, as a logarithm, is
            given up.
        rivals: whether the likeliest hypotheses of RIVAL_THINGS things are also tried in the poses
            that a near symmetry leads to.
    """

    side: int
    levels: tuple[Level, ...]
    most: int
    hopeless: float
    rivals: bool = False


FINE_SIDE = 40  # rows and columns of pixels that survivors are judged by
STAGES = (
    Stage(16, FIRST, 32, 100.0, rivals=True),
    Stage(24, COARSE_LEVELS, 12, 25.0),
    Stage(FINE_SIDE, FINE, 12, np.inf),
)


@dataclass(frozen=True, eq=False)
class Verified:
    """What the geometry of some views says.

    Attributes:
        belief: in each thing, (T,) float64, sums to 1.
        things: thing of each hypothesis that was judged, the likeliest hypothesis first, (M,)
            int64.
        probabilities: of these hypotheses, (M,) float64, their sum is 1.
        poses: of the scan files' frames in the object frame, (M, 4, 4) float64, metres.
        cameras: by how much each view sees them displaced, (M, V, 3) float64, metres, object frame.
        mean: mean log-likelihood of the pixels of each view, (M, V) float64.
        camera_costs: half the squared deviations of each camera's place, (M, V) float64.
        log_belief: log-belief in the thing of each hypothesis by outline and size, (M,) float64.
        by_outline: belief in each thing by outline and size alone, (T,) float64.
        explained: share of the thing's pixels in each view that each hypothesis explains, (M, V)
            float64.
        misfit: how badly each hypothesis explains each view, (M, V) float64; 0 for exactly.
        noise_share: see ``ViewLikelihood``, of each hypothesis in each view, (M, V) float64.
        seen_behind: share of what should be visible of each hypothesis that the cameras see past,
            of all views together, (M,) float64.
        below: by how much each hypothesis reaches below the ground, (M,) float64, metres; 0 where
            noise, tilt and errors of the scan explain it.
        stands: whether each hypothesis touches the ground, and would not fall over, (M,) bool;
            True where no view shows the ground.
        carried: whether others carry each hypothesis that does not stand on the ground, (M,) bool.
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
        """Some of the hypotheses, by index or mask."""
        kept = (*OF_HYPOTHESES, "probabilities", "log_belief")
        some = replace(self, **{name: getattr(self, name)[rows] for name in kept})
        return replace(
            some, probabilities=some.probabilities / some.probabilities.sum()
        )

    def judged(self, truth: int) -> JudgedEpisode:
        """The same as an example of the thing of this number, to fit weights to."""
        return JudgedEpisode(
            truth,
            self.things,
            self.mean,
            self.camera_costs,
            self.log_belief,
            self.by_outline,
        )

    def alignment(self, rows: Index, verifier: "Verifier") -> Alignment:
        """Some of the hypotheses, as they were aligned.

        Args:
            rows: which, (N,).
            verifier: that found them.
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
        """How badly the likeliest hypothesis explains the views, in the mean; 0 for exactly."""
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
"""What ``Verified`` holds of each hypothesis, beside its probability and prior belief."""


@dataclass(frozen=True, eq=False)
class _Proposed:
    """What is aligned, M hypotheses.

    Attributes:
        things: number of the surface of each, (M,) int64.
        rotations: from the axes of the scan files to the object frame, (M, 3, 3) float64.
        centres: of the surfaces in the object frame, (M, 3) float64, metres.
        log_belief: before the geometry is looked at, (M,) float64.
        by_outline: belief in each thing before that, (T,) float64, sums to 1.
    """

    things: Index
    rotations: Float
    centres: Float
    log_belief: Float
    by_outline: Float

    def select(self, rows: NDArray) -> "_Proposed":
        """Some of the hypotheses, by index or mask."""
        return replace(
            self,
            things=self.things[rows],
            rotations=self.rotations[rows],
            centres=self.centres[rows],
            log_belief=self.log_belief[rows],
        )

    def followed_by(self, others: "_Proposed") -> "_Proposed":
        """These hypotheses, and others after them."""
        return replace(
            self,
            things=np.concatenate([self.things, others.things]),
            rotations=np.concatenate([self.rotations, others.rotations]),
            centres=np.concatenate([self.centres, others.centres]),
            log_belief=np.concatenate([self.log_belief, others.log_belief]),
        )


@dataclass(frozen=True, eq=False)
class _Judged:
    """How likely M hypotheses are.

    Attributes:
        scores: their logarithms, up to a constant, (M,) float64.
        costs: of the cameras' errors, (M, V) float64.
        views: how well they explain the pixels of each of V views.
        ground: how they stand on the ground.
        carried: whether others carry them, (M,) bool.
    """

    scores: Float
    costs: Float
    views: Sequence[ViewLikelihood]
    ground: Stability
    carried: Mask

    def select(self, rows: Index) -> "_Judged":
        """Some of the hypotheses, by index."""
        return _Judged(
            self.scores[rows],
            self.costs[rows],
            [view.select(rows) for view in self.views],
            self.ground.select(rows),
            self.carried[rows],
        )


class Verifier:
    """Recognises things of known geometry, and tells their poses.

    Attributes:
        caster: the surfaces of the things.
        weights: how much each kind of evidence counts.
        rivals: of each thing the turns about its centroid after which it hardly looks different,
            (N, 3, 3) float64; () where none are known.
    """

    def __init__(
        self,
        surfaces: Sequence[Surface],
        weights: EvidenceWeights = EvidenceWeights(),
        pixels: PixelModel = PixelModel(),
        prior: RegistrationPrior = RegistrationPrior(),
    ) -> None:
        """Make the surfaces ready for casting.

        Args:
            surfaces: of the things.
            weights: how much each kind of evidence counts.
            pixels: what pixels are like if a hypothesis is true.
            prior: how far off cameras and the vertical may be.
        """
        self.caster = SurfaceCaster(surfaces)
        self.weights = weights
        self.pixels = pixels
        self.prior = prior
        self.rivals: tuple[Float, ...] = ()

    def __call__(
        self,
        observations: Sequence[Observation],
        any_orientation: bool = False,
        prior: Float | None = None,
    ) -> Verified:
        """Search all things in all orientations, align what is likely with all views, judge it.

        Args:
            observations: views of one thing, all in one object frame.
            any_orientation: whether all orientations are equally likely, and the ground does not
                count: the thing is held, or flies.
            prior: log-belief in each thing beforehand, (T,); None for none.

        Returns:
            The belief by outline, size and geometry, and the poses.

        Raises:
            ObservationError: no view shows enough of the thing, or its scale is not known.
        """
        if any_orientation:
            images, level = _held(observations)
        else:
            images, level = _levelled(observations)

        found = self.templates.propose(images)
        if not len(found.things):
            raise ObservationError(
                "no view shows enough of the thing to be compared with others"
            )
        by_outline = found.log_belief + (0 if prior is None else prior)
        by_outline -= by_outline.max()
        belief = np.exp(by_outline)
        proposed = _Proposed(
            things=found.things,
            rotations=found.rotations,
            centres=found.centres,
            log_belief=by_outline[found.things],
            by_outline=belief / belief.sum(),
        )
        return self._settled(
            *self._started(proposed, found.ranks, found.hidden, images), images, level
        )

    def log_odds_of_stranger(
        self,
        observations: Sequence[Observation],
        found: Verified,
        resting: bool,
    ) -> float:
        """How much likelier a stranger of its shape is than the likeliest hypothesis.

        Args:
            observations: the views that it was found in.
            found: what was found of them.
            resting: whether the ground counts, if it is seen.

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
        """Pictures of the things from all around, which propose orientations."""
        return ViewTemplates(self.caster)

    def prepare(self, threads: int = 0) -> None:
        """Render the pictures now, so that the first frame takes as long as all others.

        Args:
            threads: that work side by side; 0 for one on each core.
        """
        if "templates" not in vars(self):
            self.templates = ViewTemplates(self.caster, threads)

    def _started(
        self,
        proposed: _Proposed,
        ranks: Index,
        hidden: bool,
        images: Sequence[MetricImage],
    ) -> tuple[_Proposed, Alignment]:
        """Align the first orientation of each thing, and add all others of the likeliest things.

        The likeliest are those that fit best after alignment, and those of the likeliest outlines;
        all of them where a part of the outline is hidden: its first orientation may be any.

        Args:
            proposed: orientations of things.
            ranks: how many orientations of the same thing come before each, (M,).
            hidden: whether every view shows only a part of the outline.
            images: the views.

        Returns:
            Hypotheses to be aligned, and their poses so far.
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
        """The proposals aligned and judged, coarse to fine, in a frame that was turned to be
        level.
        """
        for stage in STAGES:
            views = [image.view(stage.side) for image in images]
            alignment = align(self.caster, alignment, views, stage.levels, self.prior)
            judged = self._judged(proposed, alignment, views, stage is STAGES[-1])

            scores = judged.scores
            order = np.argsort(-scores, kind="stable")
            order = order[scores[order] >= scores[order[0]] - stage.hopeless]
            rows = order[different_poses(self.caster, alignment.select(order))]
            # no thing crowds out all others, as a round one would
            rows = rows[rank_within(alignment.things[rows]) < stage.most // 2]
            rows = rows[: stage.most]
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
        """Score hypotheses by the pixels of all views and by how they stand.

        ``others_carry`` says whether it is looked up what else than the ground carries them.
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
        """The likeliest hypotheses in the poses in which their things hardly look different.

        Returns:
            These, and the row of the hypothesis from which each was turned, (N,).
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
        """The answer of the proposals that survived, sorted by their scores.

        ``alignment`` is in the frame that was turned to be level.
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
    """Turns that near symmetries lead to, without that by nothing, (N, 3, 3)."""
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
    """The observations that show the thing, turned so that the ground is level, and that turn."""
    images = images_of(observations)
    grounds = [image.ground for image in images if image.ground is not None]
    level = levelling(grounds)
    return [image.turned(level) for image in images], level


def _held(observations: Sequence[Observation]) -> tuple[list[MetricImage], Float]:
    """The observations that show the thing, without a ground to stand on, and no turn."""
    images = [replace(image, ground=None) for image in images_of(observations)]
    return images, np.eye(3)


def images_of(observations: Sequence[Observation]) -> list[MetricImage]:
    """Take over the observations that show the thing.

    Args:
        observations: of one thing.

    Raises:
        ObservationError: none of them shows it, or its scale is not known.
    """
    found = (MetricImage.of(observation) for observation in observations)
    images = [image for image in found if image is not None]
    if not images:
        raise ObservationError("no view shows the thing, so nothing can be aligned")
    return images
