"""What candidate views are expected to tell of the leading hypotheses, and which tells most.

A view is worth the information that it is expected to give about the thing, or about thing and pose
(Denzler and Brown, "Information theoretic sensor data selection", IEEE TPAMI 2002), under the
verifier's own likelihood: ``expected_images`` renders the hypotheses, ``expected_likelihood`` says
how far apart the verifier will find them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nextview.geometry.observation import Observation
from nextview.geometry.viewsphere import azimuth_of, elevation_of, look_at_origin
from nextview.things.depth_view import DepthView, depth_view
from nextview.things.expected_images import (
    ExpectedSensor,
    SeenSurroundings,
    rendered_images,
)
from nextview.things.expected_likelihood import (
    different_pixels,
    divergences,
    gaps_after_alignment,
)
from nextview.things.expected_pose import sharper_poses
from nextview.things.leading import Hypotheses
from nextview.things.registration import (
    Alignment,
    RegistrationPrior,
    pose_covariances,
)
from nextview.things.surface import SurfaceCaster
from nextview.things.verification import PixelModel
from nextview.things.verifier import Verified, Verifier
from nextview.things.weighing import EvidenceWeights
from nextview.types import Float, Index, Mask

Goal = Literal["thing", "pose"]

SENSOR_SIDE = 24  # rows and columns of a view by which the camera's noise is judged
RENDERED_SIDE = 18  # rows and columns of the rendered images
PICTURE_SIDE = 64  # rows and columns of pictures to look at
BHATTACHARYYA = 0.25  # of two equally wide Gaussians, as a share of their divergence
# pixels of the camera that show the thing, at which half of what they tell counts
HALF_FOUND = 1000.0


@dataclass(frozen=True, eq=False)
class ExpectedViews:
    """What candidate views are expected to tell.

    Attributes:
        hypotheses: what was rendered.
        divergence: expected log-likelihood ratio of two hypotheses after each view if one of them
            is true, the mean of both directions, (V, H, H) float64, 0 or more.
        different: share of the pixels that show either of two hypotheses in which they differ by
            more than the noise, (V, H, H) float64.
        found: share of the information that each view is trusted to give, (V,) float64, 0 to 1. The
            fewer pixels show the thing, the sooner it is missed.
        sharper: see ``expected_pose.sharper_poses``, (V,) float64; zeros where it was not asked
            for.
    """

    hypotheses: Hypotheses
    divergence: Float
    different: Float
    found: Float
    sharper: Float

    def information(self, goal: Goal = "thing") -> Float:
        """Expected information of each view, (V,) float64, natural units (nats).

        The expected entropy of the belief after a view is that of a mixture of Gaussians, which is
        bounded by the distances of Bhattacharyya between its parts (Kolchinsky and Tracey,
        "Estimating mixture entropy with pairwise distances", Entropy 2017).

        Args:
            goal: "thing" values what is told of which thing it is; "pose" what is told of thing and
                pose.
        """
        belief = self.hypotheses.belief
        possible = np.flatnonzero(belief)
        gains = np.stack([self.gain(int(row), goal) for row in possible], 1)
        return self.found * np.maximum(gains @ belief[possible], 0)

    def worth(self, goal: Goal = "thing") -> Float:
        """What each view is worth, (V,) float64, natural units.

        For the pose it is the information about thing and pose, and how much better the pose of the
        likeliest hypothesis will be known.

        Args:
            goal: what is to be told.
        """
        information = self.information(goal)
        return (
            information if goal == "thing" else information + self.found * self.sharper
        )

    def gain(self, truth: int, goal: Goal = "thing") -> Float:
        """Gain of the log-belief in the right answer with each view, (V,) float64.

        Args:
            truth: which hypothesis is true; the belief in it is not zero.
            goal: whether the answer is a thing, or a thing and its pose.
        """
        belief = self.hypotheses.belief
        kept = belief * np.exp(-BHATTACHARYYA * self.divergence[:, truth])
        same = np.arange(len(belief)) == truth
        if goal == "thing":
            same = self.hypotheses.things == self.hypotheses.things[truth]
        return np.log((kept[:, same].sum(1) / kept.sum(1)) / belief[same].sum())

    def entropy(self, goal: Goal = "thing") -> float:
        """Entropy of the present belief, nats: the most that a view can tell."""
        belief = self.hypotheses.belief
        if goal == "thing":
            belief = np.bincount(self.hypotheses.things, belief).astype(np.float64)
        some = belief[belief > 0]
        return float(-(some * np.log(some)).sum())

    def told_apart(self, view: int) -> tuple[int, int] | None:
        """The two hypotheses of different things that a view is expected to tell apart most.

        Returns:
            Their rows, the likelier one first; None if there is only one thing.
        """
        belief = self.hypotheses.belief
        things = self.hypotheses.things
        kept = np.exp(-BHATTACHARYYA * self.divergence[view])
        worth = belief[:, None] * belief * (1 - kept)
        worth[things[:, None] == things] = -1
        first, second = np.unravel_index(worth.argmax(), worth.shape)
        if worth[first, second] < 0:
            return None
        pair = (int(first), int(second))
        return pair if belief[first] >= belief[second] else pair[::-1]

    def words(self, view: int, names: Sequence[str], goal: Goal = "thing") -> str:
        """What a view is expected to settle, as a phrase.

        Args:
            view: which candidate.
            names: of the things.
            goal: what is to be told.
        """
        entropy = self.entropy(goal)
        share = (
            min(1.0, float(self.information(goal)[view]) / entropy)
            if entropy > 0
            else 0.0
        )
        verb = "would settle" if share >= 0.5 else "would tell little of"
        doubt = f"{100 * share:.0f} % of the doubt"
        pair = self.told_apart(view)
        if goal == "pose":
            return f"{verb} the pose of {names[self.hypotheses.things[0]]}: {doubt}"
        if pair is None or entropy == 0:
            return f"there is no rival of {names[self.hypotheses.things[0]]}"

        first, second = (names[self.hypotheses.things[row]] for row in pair)
        differs = (
            f"they differ in {100 * self.different[view][pair]:.0f} % of the pixels"
        )
        return f"{verb} {first} or {second}: {differs}, {doubt}"


def expected_views(
    caster: SurfaceCaster,
    hypotheses: Hypotheses,
    cameras: Float,
    sensor: ExpectedSensor,
    surroundings: SeenSurroundings | None = None,
    taken: int = 1,
    weights: EvidenceWeights = EvidenceWeights(),
    pixels: PixelModel = PixelModel(),
    prior: RegistrationPrior = RegistrationPrior(),
    side: int = RENDERED_SIDE,
    covariance: Float | None = None,
) -> ExpectedViews:
    """Expect what candidate views would tell, with the verifier's own weights.

    Args:
        caster: the surfaces.
        hypotheses: the leading hypotheses.
        cameras: candidate camera poses, camera-to-world, (V, 4, 4), object frame, metres, OpenCV
            axes.
        sensor: the camera.
        surroundings: what may stand before the thing and behind it; nothing by default.
        taken: how many views there are already. More views count less each, see
            ``EvidenceWeights.correlation``.
        weights: how much geometry counts.
        pixels: how a pixel is judged.
        prior: by how much a hypothesis and a camera may still be moved when the view is there.
        side: rows and columns of the rendered images.
        covariance: of turn and place of the first hypothesis, (6, 6), where it is asked how much
            better its pose will be known.

    Returns:
        What each view would tell of each pair of hypotheses.
    """
    cameras = np.asarray(cameras, np.float64)
    scene = SeenSurroundings.nothing() if surroundings is None else surroundings
    rendered = rendered_images(caster, hypotheses, cameras, scene, side)
    weight = weights.geometry / (1 + weights.correlation * taken)
    moved = gaps_after_alignment(rendered, sensor, prior)
    divergence, different = divergences(rendered, moved, sensor, pixels, prior)
    pixels_shown = rendered.pixels_shown(sensor.pitch) @ hypotheses.belief
    found = pixels_shown / (pixels_shown + HALF_FOUND)
    sharper = np.zeros(len(cameras))

    if covariance is not None:
        surface = caster.surfaces[hypotheses.things[0]]
        pose = hypotheses.poses[0]
        sharper = sharper_poses(
            rendered,
            surface,
            pose,
            covariance,
            sensor,
            prior,
            taken,
        )

    return ExpectedViews(hypotheses, weight * divergence, different, found, sharper)


@dataclass(frozen=True, eq=False)
class RivalPictures:
    """The two leading hypotheses as one camera would see them.

    Attributes:
        things: number of the surface of each, (2,) int64.
        pictures: of each, as a headlight would show it, (2, S, S) uint8, 0 where it does not show.
        different: pixels in which they differ by more than the noise, (S, S) bool.
    """

    things: Index
    pictures: NDArray[np.uint8]
    different: Mask

    @property
    def share(self) -> float:
        """Share of the pixels that show either of them in which they differ."""
        return float(self.different.sum() / max(1, self.pictures.any(0).sum()))


@dataclass(frozen=True, eq=False)
class Outlook:
    """All that is known when the next view of a thing is to be chosen.

    Attributes:
        caster: the surfaces.
        hypotheses: the leading hypotheses.
        sensor: the camera.
        surroundings: what is known of the scene.
        place: of the last camera, (3,) float64, object frame, metres.
        taken: how many views there are.
        weights: how much geometry counts.
        pixels: how a pixel is judged.
        prior: by how much a hypothesis and a camera may still be moved.
        likeliest: the first hypothesis, as it was aligned.
        views: those so far, as it was aligned with them.
    """

    caster: SurfaceCaster
    hypotheses: Hypotheses
    sensor: ExpectedSensor
    surroundings: SeenSurroundings
    place: Float
    taken: int
    weights: EvidenceWeights
    pixels: PixelModel
    prior: RegistrationPrior
    likeliest: Alignment
    views: tuple[DepthView, ...]

    @classmethod
    def of(
        cls,
        verifier: Verifier,
        verified: Verified,
        observations: Sequence[Observation],
    ) -> "Outlook":
        """Gather what some views have shown.

        Args:
            verifier: of the surfaces.
            verified: what it found in the views.
            observations: the views, the last one last; those that do not show the thing are left
                out.

        Raises:
            ObservationError: no view shows the thing, or its scale is not known.
        """
        found = (
            (each, depth_view(each, SENSOR_SIDE)) for each in observations if each.seen
        )
        seen = [(each, view) for each, view in found if view is not None]
        sensor = ExpectedSensor.of([view for _, view in seen])
        hypotheses = Hypotheses.leading(verified)
        used = [each for each, _ in seen]
        row = np.flatnonzero(verified.things == hypotheses.things[0])[:1]

        return cls(
            caster=verifier.caster,
            hypotheses=hypotheses,
            sensor=sensor,
            surroundings=SeenSurroundings.of(used, verifier.caster, hypotheses),
            place=seen[-1][1].origin,
            taken=len(used),
            weights=verifier.weights,
            pixels=verifier.pixels,
            prior=verifier.prior,
            likeliest=verified.alignment(row, verifier),
            views=tuple(view for _, view in seen),
        )

    @cached_property
    def covariance(self) -> Float:
        """Of turn and place of the first hypothesis by the views so far, (6, 6) float64."""
        found = pose_covariances(self.caster, self.likeliest, self.views, self.prior)
        return found[0]

    @property
    def distance(self) -> float:
        """Of the last camera from the origin of the object frame, metres."""
        return float(np.linalg.norm(self.place))

    @property
    def towards(self) -> Float:
        """Unit vector from the origin of the object frame towards the last camera, (3,)."""
        return self.place / self.distance

    def cameras(self, directions: Float) -> Float:
        """Level cameras in some directions, as far away as the last one.

        Args:
            directions: unit vectors from the object, (V, 3).

        Returns:
            Camera-to-world poses, (V, 4, 4) float64, object frame, metres.
        """
        return look_at_origin(
            elevation_of(directions),
            azimuth_of(directions),
            self.distance,
        )

    def rivals(self, camera: Float, side: int = PICTURE_SIDE) -> RivalPictures | None:
        """Draw the two leading hypotheses, of two things if there are two, and their difference.

        Args:
            camera: camera-to-world pose, (4, 4), object frame, metres.
            side: rows and columns of the pictures.

        Returns:
            The pictures; None if there is only one hypothesis.
        """
        things = self.hypotheses.things
        order = np.argsort(-self.hypotheses.belief, kind="stable")
        others = [*order[things[order] != things[order[0]]], *order[1:]]
        if not others:
            return None
        rows = np.array([order[0], others[0]])
        two = Hypotheses(things[rows], self.hypotheses.poses[rows], np.full(2, 0.5))
        images = rendered_images(
            self.caster,
            two,
            camera[None],
            self.surroundings,
            side,
        )

        shows = np.isfinite(images.depth[0])
        pictures = np.where(shows, 255 * images.cosine[0], 0).astype(np.uint8)
        different = different_pixels(images, self.sensor, self.pixels, self.prior)[0]
        return RivalPictures(
            two.things,
            pictures.reshape(2, side, side),
            different.reshape(side, side),
        )

    def expect(self, cameras: Float, goal: Goal = "thing") -> ExpectedViews:
        """Expect what views from some cameras would tell.

        Args:
            cameras: camera-to-world poses, (V, 4, 4), object frame, metres.
            goal: for the pose it is also asked how much better it will be known.
        """
        return expected_views(
            self.caster,
            self.hypotheses,
            cameras,
            self.sensor,
            self.surroundings,
            self.taken,
            self.weights,
            self.pixels,
            self.prior,
            covariance=self.covariance if goal == "pose" else None,
        )
