"""Recognise taught things by their geometry: propose, align, judge every pixel, believe."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nextview.errors import ModelError, ObservationError
from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import rotation_z
from nextview.recognition.model_card import Symmetry
from nextview.things.below_ground import BelowGround, below_ground
from nextview.things.depth_view import DepthView, MetricImage
from nextview.things.ground import levelling
from nextview.things.proposals import propose
from nextview.things.registration import (
    COARSE_LEVELS,
    FINE,
    FIRST,
    Alignment,
    Level,
    RegistrationPrior,
    align,
    camera_cost,
    centred,
    different_poses,
    joined,
    render,
    rotations_of,
    start,
)
from nextview.things.stranger import Comparison, log_odds_of_stranger
from nextview.things.surface import Surface, SurfaceCaster
from nextview.things.verification import PixelModel, ViewLikelihood, likelihood
from nextview.things.view_templates import MOST_ORIENTATIONS, ViewTemplates
from nextview.things.weighing import EvidenceWeights, JudgedEpisode
from nextview.types import Float, Floats, Index

# radians by which a thing in any orientation is off its proposal: hardly held
ANY_TILT = 0.3
TILTED_PROPOSALS = 120  # of things in any orientation, of all views together
# misfit for each unit of log-belief that features hold against a thing
AGAINST_FEATURES = 0.1
TINY = 1e-300  # belief that has a logarithm
LEAST_BY_FEATURES = 0.01  # belief by features below which it does not matter
AROUND_LEVELS = (
    Level(1, 0.05, 0.5, False),
)  # steps of the alignment at azimuths all around
AROUND_THINGS = 2  # likeliest things that are also judged at azimuths all around
AROUND_STEPS = 24  # azimuths: a small part of a round body shows at one of them
AROUND_PEAKS = 2  # of these azimuths that are aligned, for each thing


RIVAL_STEPS = 24  # in which a thing of which any turn is nearly a symmetry is turned

UNUSUAL = 0.01  # as likely beforehand as a known resting pose is any other orientation


@dataclass(frozen=True)
class Stage:
    """Hypotheses are aligned with few pixels first, and those that survive with more.

    Attributes:
        side: rows and columns of pixels.
        levels: steps of the alignment.
        most: how many hypotheses survive at most.
        hopeless: a hypothesis that is by so much less likely than the best one, as a logarithm, is
            given up.
        around: whether the likeliest things are also tried at azimuths all around afterwards.
        rivals: whether the likeliest hypothesis is also tried in the poses that a near symmetry
            leads to.
    """

    side: int
    levels: tuple[Level, ...]
    most: int
    hopeless: float
    around: bool = False
    rivals: bool = False


FINE_SIDE = 40  # rows and columns of pixels that survivors are judged by
VERIFICATION_STAGES = (
    Stage(16, FIRST, 24, 50.0, around=True),
    Stage(24, COARSE_LEVELS, 12, 25.0, rivals=True),
    Stage(FINE_SIDE, FINE, 12, np.inf),
)
TILTED_STAGES = tuple(
    replace(
        stage,
        levels=tuple(replace(level, turned=True) for level in stage.levels),
        most=most,
        around=False,
    )
    for stage, most in zip(VERIFICATION_STAGES, (32, 12, 12), strict=True)
)
"""The same for things in any orientation, which are turned about all axes from the beginning."""


@dataclass(frozen=True, eq=False)
class Verified:
    """What the geometry of some views says.

    Attributes:
        belief: in each thing, (T,) float64, sums to 1.
        things: thing of each hypothesis that was judged, the likeliest hypothesis first, (M,)
            int64.
        ups: direction in the scan file's axes that points up where each hypothesis rests or, if it
            was proposed in any orientation, as it was proposed, (M, 3) float64.
        probabilities: of these hypotheses, (M,) float64, their sum is 1.
        poses: of the scan files' frames in the object frame, (M, 4, 4) float64, metres.
        cameras: by how much each view sees them displaced, (M, V, 3) float64, metres, object frame.
        mean: mean log-likelihood of the pixels of each view, (M, V) float64.
        camera_costs: half the squared deviations of each camera's place, (M, V) float64.
        log_belief: log-belief in each hypothesis by features and size, (M,) float64.
        by_features: belief in each thing by features and size alone, (T,) float64.
        explained: share of the thing's pixels in each view that each hypothesis explains, (M, V)
            float64.
        misfit: how badly each hypothesis explains each view, (M, V) float64; 0 for exactly.
        noise_share: see ``ViewLikelihood``, of each hypothesis in each view, (M, V) float64.
        against: what features hold against each thing, nats, (T,) float64; 0 for things in any
            orientation, whose outlines are judged by the geometry anyway.
        seen_behind: share of what should be visible of each hypothesis that the cameras see past,
            of all views together, (M,) float64.
        below: by how much each hypothesis reaches below the ground, (M,) float64, metres; 0 where
            noise, tilt and errors of the scan explain it.
    """

    belief: Float
    things: Index
    ups: Float
    probabilities: Float
    poses: Float
    cameras: Float
    mean: Float
    camera_costs: Float
    log_belief: Float
    by_features: Float
    explained: Float
    misfit: Float
    noise_share: Float
    against: Float
    seen_behind: Float
    below: Float

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
            self.by_features,
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
            ups=self.ups[rows],
            rotations=rotations,
            centres=np.einsum("hij,hj->hi", rotations, own_centres)
            + self.poses[rows, :3, 3],
            cameras=self.cameras[rows],
        )

    @property
    def residual(self) -> float:
        """How badly the likeliest hypothesis explains the views, in the mean; 0 for exactly.

        Features that speak against it add a little.
        """
        against = min(self.against[self.things[0]], -np.log(LEAST_BY_FEATURES))
        return float(self.misfit[0].mean() + AGAINST_FEATURES * against)


OF_HYPOTHESES = (
    "things",
    "ups",
    "poses",
    "cameras",
    "mean",
    "camera_costs",
    "explained",
    "misfit",
    "noise_share",
    "seen_behind",
    "below",
)
"""What ``Verified`` holds of each hypothesis, beside its probability and prior belief."""


@dataclass(frozen=True, eq=False)
class _Proposed:
    """What is aligned, M hypotheses.

    Attributes:
        things: number of the surface of each, (M,) int64.
        rotations: from the axes of the scan files to the object frame, (M, 3, 3) float64.
        log_belief: before the geometry is looked at, (M,) float64.
        by_features: belief in each thing before that, (T,) float64, sums to 1.
        against: see ``Verified``.
    """

    things: Index
    rotations: Float
    log_belief: Float
    by_features: Float
    against: Float

    def select(self, rows: NDArray) -> "_Proposed":
        """Some of the hypotheses, by index."""
        return replace(
            self,
            things=self.things[rows],
            rotations=self.rotations[rows],
            log_belief=self.log_belief[rows],
        )


class Verifier:
    """Recognises things of known geometry, and tells their poses.

    Attributes:
        caster: the surfaces of the things.
        owners: thing of each hypothesis, (H,) int64. A hypothesis is a thing in a resting pose.
        rotations: from the axes of the scan file into the resting pose, (H, 3, 3) float64.
        weights: how much each kind of evidence counts.
        rivals: of each thing the turns about its centroid after which it hardly looks different,
            (N, 3, 3) float64; () where none are known.
    """

    def __init__(
        self,
        surfaces: Sequence[Surface],
        owners: NDArray[np.integer],
        rotations: Floats,
        weights: EvidenceWeights = EvidenceWeights(),
        pixels: PixelModel = PixelModel(),
        prior: RegistrationPrior = RegistrationPrior(),
    ) -> None:
        """Make the surfaces ready for casting.

        Args:
            surfaces: of the things.
            owners: thing of each hypothesis, (H,).
            rotations: into the resting pose of each hypothesis, (H, 3, 3).
            weights: how much each kind of evidence counts.
            pixels: what pixels are like if a hypothesis is true.
            prior: how far off cameras and the vertical may be.

        Raises:
            ModelError: owners that are none of the things, or rotations of other hypotheses.
        """
        self.owners = np.asarray(owners, np.int64)
        self.rotations = np.asarray(rotations, np.float64)
        unknown = set(self.owners.tolist()) - set(range(len(surfaces)))
        if unknown or self.rotations.shape != (len(self.owners), 3, 3):
            raise ModelError(
                f"{len(surfaces)} surfaces do not fit {len(self.owners)} resting poses of things"
            )

        self.caster = SurfaceCaster(surfaces)
        self.weights = weights
        self.pixels = pixels
        self.prior = prior
        self.rivals: tuple[Float, ...] = ()

    def __call__(self, observations: Sequence[Observation], joint: Float) -> Verified:
        """Align what is likely with all views, and judge it.

        Args:
            observations: views of one thing, all in one object frame.
            joint: belief in each hypothesis and azimuth bin by features and size, (H, bins): see
                ``propose``.

        Returns:
            The belief by features, size and geometry, and the poses.

        Raises:
            ObservationError: no view shows the thing, or its scale is not known.
        """
        if joint.shape[0] != len(self.owners):
            raise ModelError(
                f"a belief in {joint.shape[0]} hypotheses, and there are {len(self.owners)}"
            )

        proposals = propose(joint)
        turns = rotation_z(proposals.azimuths) @ self.rotations[proposals.hypotheses]
        by_features = np.zeros(len(self.caster.surfaces))
        np.add.at(by_features, self.owners, joint.sum(1))
        by_features /= by_features.sum()
        proposed = _Proposed(
            things=self.owners[proposals.hypotheses],
            rotations=turns,
            log_belief=proposals.log_belief,
            by_features=by_features,
            against=-np.log(by_features + TINY),
        )

        images, level = _levelled(observations)
        return self._settled(proposed, images, VERIFICATION_STAGES, self.prior, level)

    def in_any_orientation(
        self,
        observations: Sequence[Observation],
    ) -> Verified:
        """The same for a thing that need not rest on anything: held, leaning or thrown.

        Args:
            observations: views of one thing, all in one object frame.

        Returns:
            The belief by size, outline and geometry, and the poses.

        Raises:
            ObservationError: no view shows the thing, or its scale is not known.
        """
        return self._tilted(*_held(observations))

    def whole_search(
        self,
        observations: Sequence[Observation],
        resting: Verified,
    ) -> Verified:
        """Search on, in all orientations, where no thing in a known resting pose was found.

        A thing may rest in a rare pose, lean, or stand as somebody put it. Such hypotheses compete
        with those that rest, each ``UNUSUAL`` times as likely beforehand; the ground counts.

        Args:
            observations: views of one thing, all in one object frame.
            resting: what was found of resting things.

        Returns:
            What is found of both kinds of hypotheses together.
        """
        images, level = _levelled(observations)
        try:
            unusual = self._tilted(images, level)
        except ObservationError:  # too little is seen to be compared
            return resting
        return self._joined(resting, unusual)

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

    def _tilted(self, images: Sequence[MetricImage], level: Float) -> Verified:
        """What is found in any orientation, in a frame that was turned to be level."""
        each = max(1, TILTED_PROPOSALS // len(images))
        of_one = max(1, MOST_ORIENTATIONS // len(images))
        found = [self.templates.propose(image, each, of_one) for image in images]
        things = np.concatenate([one.things for one in found])
        if not len(things):
            raise ObservationError(
                "no view shows enough of the thing to be compared with others"
            )

        by_outline = np.mean([one.log_belief for one in found], axis=0)
        belief = np.exp(by_outline - by_outline.max())
        proposed = _Proposed(
            things=things,
            rotations=np.concatenate([one.rotations for one in found]),
            log_belief=by_outline[things] - by_outline.max(),
            by_features=belief / belief.sum(),
            against=np.zeros(len(belief)),
        )
        prior = replace(self.prior, tilt=ANY_TILT)
        return self._settled(proposed, images, TILTED_STAGES, prior, level)

    def _joined(self, resting: Verified, unusual: Verified) -> Verified:
        """Hypotheses of resting things and of others, the likeliest first."""
        logs = [resting.log_belief, unusual.log_belief + np.log(UNUSUAL)]
        log_belief = np.concatenate(logs)
        both = {
            name: np.concatenate([getattr(resting, name), getattr(unusual, name)])
            for name in OF_HYPOTHESES
        }
        scores = self.weights.scores(both["mean"], both["camera_costs"], log_belief)

        order = np.argsort(-scores, kind="stable")
        shares = np.exp(scores - scores.max())
        whole = replace(
            resting,
            belief=self.weights.belief(scores, both["things"], resting.by_features),
            probabilities=(shares / shares.sum())[order],
            log_belief=log_belief[order],
            **{name: values[order] for name, values in both.items()},
        )
        alike = different_poses(
            self.caster, whole.alignment(np.arange(len(order)), self)
        )
        return whole.select(alike)

    def _settled(
        self,
        proposed: _Proposed,
        images: Sequence[MetricImage],
        stages: Sequence[Stage],
        prior: RegistrationPrior,
        level: Float,
    ) -> Verified:
        """The proposals aligned and judged, coarse to fine, in a frame that was turned to be
        level.
        """
        views = [image.view(stages[0].side) for image in images]
        alignment = start(proposed.things, proposed.rotations, len(views))
        alignment = centred(self.caster, alignment, views)

        for stage in stages:
            views = [image.view(stage.side) for image in images]
            alignment = align(self.caster, alignment, views, stage.levels, prior)
            judged = self._judge(alignment, views)
            mean = np.stack([view.mean for view in judged], 1)
            costs = camera_cost(alignment, views, prior)
            scores = self.weights.scores(mean, costs, proposed.log_belief)

            order = np.argsort(-scores, kind="stable")
            order = order[scores[order] >= scores[order[0]] - stage.hopeless]
            rows = order[different_poses(self.caster, alignment.select(order))][
                : stage.most
            ]
            alignment = alignment.select(rows)
            proposed = proposed.select(rows)
            if stage.around:
                turned, source = self._around(alignment, proposed, views, prior)
                alignment = joined(alignment, turned)
                proposed = proposed.select(
                    np.concatenate([np.arange(len(rows)), source])
                )
            if stage.rivals and self.rivals:
                turned = self._rivals(alignment)
                alignment = joined(alignment, turned)
                proposed = proposed.select(
                    np.r_[np.arange(len(rows)), np.zeros(len(turned), int)]
                )

        return self._verified(
            proposed,
            alignment,
            views,
            scores[rows],
            costs[rows],
            [view.select(rows) for view in judged],
            level,
        )

    def _around(
        self,
        alignment: Alignment,
        proposed: _Proposed,
        views: Sequence[DepthView],
        prior: RegistrationPrior,
    ) -> tuple[Alignment, Index]:
        """The likeliest things, turned about the vertical to where they explain the views best.

        A small part of a round body draws a hypothesis only from near its own azimuth.

        Args:
            alignment: hypotheses, the best ones first.
            proposed: the same.
            views: of the thing.
            prior: how far off cameras may be.

        Returns:
            Hypotheses at the best azimuths, and the rows from which each was turned, (N,).
        """
        first = np.sort(np.unique(alignment.things, return_index=True)[1])[
            :AROUND_THINGS
        ]
        source = np.repeat(first, AROUND_STEPS)
        azimuths = 2 * np.pi * np.arange(AROUND_STEPS) / AROUND_STEPS
        turns = np.tile(rotation_z(azimuths), (len(first), 1, 1))
        some = alignment.select(source)
        # About an axis that a round body shares, however far a part of it stands out.
        surfaces = [self.caster.surfaces[thing] for thing in some.things]
        arms = np.stack([surface.centroid - surface.centre for surface in surfaces])
        axes = some.centres + np.einsum("hij,hj->hi", some.rotations, arms)
        rotations = turns @ some.rotations
        centres = axes - np.einsum("hij,hj->hi", rotations, arms)
        some = replace(some, rotations=rotations, centres=centres)
        some = align(self.caster, some, views, AROUND_LEVELS, prior)

        mean = np.stack([view.mean for view in self._judge(some, views)], 1)
        costs = camera_cost(some, views, prior)
        scores = self.weights.scores(mean, costs, proposed.log_belief[source])
        circles = scores.reshape(len(first), AROUND_STEPS)
        peak = (circles >= np.roll(circles, 1, 1)) & (circles > np.roll(circles, -1, 1))
        peak[:, 0] = False  # as they are
        best = np.argsort(-np.where(peak, circles, -np.inf), axis=1, kind="stable")[
            :,
            :AROUND_PEAKS,
        ]
        rows = (best + AROUND_STEPS * np.arange(len(first))[:, None])[
            np.take_along_axis(peak, best, 1)
        ]
        return some.select(rows), source[rows]

    def _rivals(self, alignment: Alignment) -> Alignment:
        """The first hypothesis in the poses in which its thing hardly looks different."""
        thing = int(alignment.things[0])
        turns = self.rivals[thing]
        some = alignment.select(np.zeros(len(turns), np.int64))
        surface = self.caster.surfaces[thing]
        arm = surface.centroid - surface.centre
        rotations = some.rotations @ turns
        fixed = some.centres + some.rotations @ arm
        ups = np.einsum("nji,nj->ni", turns, some.ups)
        return replace(
            some, ups=ups, rotations=rotations, centres=fixed - rotations @ arm
        )

    def _judge(
        self,
        alignment: Alignment,
        views: Sequence[DepthView],
    ) -> list[ViewLikelihood]:
        below = self._below(alignment, views).share
        return [
            likelihood(
                view,
                render(self.caster, alignment, view, number),
                self.pixels,
                below,
            )
            for number, view in enumerate(views)
        ]

    def _below(self, alignment: Alignment, views: Sequence[DepthView]) -> BelowGround:
        return below_ground(self.caster, alignment, views, self.prior.tilt)

    def _verified(
        self,
        proposed: _Proposed,
        alignment: Alignment,
        views: Sequence[DepthView],
        scores: Float,
        costs: Float,
        judged: Sequence[ViewLikelihood],
        level: Float,
    ) -> Verified:
        """The answer of the proposals that survived, sorted by their scores.

        ``alignment`` and ``views`` are in the frame that was turned to be level.
        """
        visible = np.sum([view.visible for view in judged], axis=0)
        behind = np.sum([view.seen_behind for view in judged], axis=0)
        aligned = alignment.turned(level.T)
        shares = np.exp(scores - scores.max())
        return Verified(
            belief=self.weights.belief(scores, alignment.things, proposed.by_features),
            things=alignment.things,
            ups=alignment.ups,
            probabilities=shares / shares.sum(),
            poses=aligned.poses(self.caster),
            cameras=aligned.cameras,
            mean=np.stack([view.mean for view in judged], 1),
            camera_costs=costs,
            log_belief=proposed.log_belief,
            by_features=proposed.by_features,
            explained=np.stack([view.explained for view in judged], 1),
            misfit=np.stack([view.misfit for view in judged], 1),
            noise_share=np.stack([view.noise_share for view in judged], 1),
            against=proposed.against,
            seen_behind=behind / np.maximum(visible, 1),
            below=self._below(alignment, views).depth,
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
    images = _images(observations)
    grounds = [image.ground for image in images if image.ground is not None]
    level = levelling(grounds)
    return [image.turned(level) for image in images], level


def _held(observations: Sequence[Observation]) -> tuple[list[MetricImage], Float]:
    """The observations that show the thing, without a ground to stand on, and no turn."""
    images = [replace(image, ground=None) for image in _images(observations)]
    return images, np.eye(3)


def _images(observations: Sequence[Observation]) -> list[MetricImage]:
    """The observations that show the thing; ObservationError if none does."""
    found = (MetricImage.of(observation) for observation in observations)
    images = [image for image in found if image is not None]
    if not images:
        raise ObservationError("no view shows the thing, so nothing can be aligned")
    return images
