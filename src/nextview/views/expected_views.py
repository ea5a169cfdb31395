"""Expected information of candidate views about the leading hypotheses.

The value of a view is its expected information about the thing, or about thing and pose (Denzler
and Brown, "Information theoretic sensor data selection", IEEE TPAMI 2002), under the likelihood of
their pixels. ``expected_images`` renders the hypotheses, and ``expected_likelihood`` predicts their
log-likelihood ratios.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nextview.geometry.viewsphere import azimuth_of, elevation_of, look_at_origin
from nextview.recognition.poses import PoseCandidate
from nextview.things.surface import SurfaceCaster
from nextview.things.world import Thing, World
from nextview.types import Float, Index, Mask
from nextview.views.expected_images import (
    ExpectedSensor,
    SeenSurroundings,
    rendered_images,
)
from nextview.views.expected_likelihood import (
    different_pixels,
    divergences,
    gaps_after_alignment,
)
from nextview.views.expected_model import ExpectedModel, Leading
from nextview.views.expected_pose import sharper_poses

Goal = Literal["thing", "pose"]

RENDERED_SIDE = 18  # rows and columns of the rendered images
PICTURE_SIDE = 64  # rows and columns of the pictures for display
# Bhattacharyya distance of two Gaussians of equal variance, as a share of their divergence
BHATTACHARYYA = 0.25
# thing pixels at which half of the information counts
HALF_FOUND = 1000.0


@dataclass(frozen=True, eq=False)
class ExpectedViews:
    """Expected information of V candidate views.

    Attributes:
        hypotheses: the rendered hypotheses.
        divergence: expected log-likelihood ratio of two hypotheses after each view if one of them
            is true, mean of both directions, (V, H, H) float64, 0 or more.
        different: share of the pixels of two hypotheses in which they differ by more than the
            noise, (V, H, H) float64.
        found: share of the information that each view is trusted to give, (V,) float64, 0 to 1. A
            view with few pixels of the thing is more likely to miss it.
        pixels: of the thing that each view is expected to show, (V,) float64.
        sharper: reduction of the pose error, see ``expected_pose.sharper_poses``, (V,) float64;
            zeros if it was not requested.
    """

    hypotheses: Leading
    divergence: Float
    different: Float
    found: Float
    pixels: Float
    sharper: Float

    def information(self, goal: Goal = "thing") -> Float:
        """Expected information of each view, nats.

        The expected entropy of the belief after a view is the entropy of a mixture of Gaussians.
        Pairwise Bhattacharyya distances bound it (Kolchinsky and Tracey, "Estimating mixture
        entropy with pairwise distances", Entropy 2017).

        Args:
            goal: "thing" for the information about the thing; "pose" for that about thing and pose.

        Returns:
            Information, (V,) float64, nats.
        """
        belief = self.hypotheses.belief
        possible = np.flatnonzero(belief)
        gains = np.stack([self.gain(int(row), goal) for row in possible], 1)
        return self.found * np.maximum(gains @ belief[possible], 0)

    def worth(self, goal: Goal = "thing") -> Float:
        """Value of each view, nats.

        For the goal "pose", it is the information about thing and pose plus the expected reduction
        of the pose error of the likeliest hypothesis.

        Args:
            goal: "thing" or "pose".

        Returns:
            Values, (V,) float64, nats.
        """
        information = self.information(goal)
        return (
            information if goal == "thing" else information + self.found * self.sharper
        )

    def gain(self, truth: int, goal: Goal = "thing") -> Float:
        """Increase of the log-belief in the true answer by each view.

        Args:
            truth: index of the true hypothesis; the belief in it is not zero.
            goal: whether the answer is a thing, or a thing and its pose.

        Returns:
            Gains, (V,) float64, nats.
        """
        belief = self.hypotheses.belief
        kept = belief * np.exp(-BHATTACHARYYA * self.divergence[:, truth])
        same = np.arange(len(belief)) == truth
        if goal == "thing":
            same = self.hypotheses.things == self.hypotheses.things[truth]
        return np.log((kept[:, same].sum(1) / kept.sum(1)) / belief[same].sum())

    def entropy(self, goal: Goal = "thing") -> float:
        """Entropy of the present belief: an upper bound of the information of a view.

        Args:
            goal: "thing" or "pose".

        Returns:
            Entropy, nats.
        """
        belief = self.hypotheses.belief
        if goal == "thing":
            belief = np.bincount(self.hypotheses.things, belief).astype(np.float64)
        some = belief[belief > 0]
        return float(-(some * np.log(some)).sum())

    def told_apart(self, view: int) -> tuple[int, int] | None:
        """The two hypotheses of different things that a view separates best.

        Args:
            view: index of the candidate view.

        Returns:
            Their indices, the likelier one first; None if there is only one thing.
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
        """Describe in a phrase which question a view is expected to settle.

        Args:
            view: index of the candidate view.
            names: names of the things.
            goal: "thing" or "pose".

        Returns:
            The phrase.
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
    hypotheses: Leading,
    cameras: Float,
    sensor: ExpectedSensor,
    surroundings: SeenSurroundings | None = None,
    taken: int = 1,
    model: ExpectedModel = ExpectedModel(),
    covariance: Float | None = None,
) -> ExpectedViews:
    """Predict the information of candidate views.

    Args:
        caster: surfaces of the things.
        hypotheses: the leading hypotheses.
        cameras: candidate camera poses, camera-to-world, (V, 4, 4), object frame, metres, OpenCV
            axes.
        sensor: the camera.
        surroundings: occluders and background; none by default.
        taken: number of views so far. Further views have less weight, see
            ``ExpectedModel.correlation``.
        model: of the pixels and the cameras.
        covariance: covariance of rotation and translation of the first hypothesis, (6, 6), if the
            reduction of its pose error is requested.

    Returns:
        Expected information of each view.
    """
    cameras = np.asarray(cameras, np.float64)
    scene = SeenSurroundings.nothing() if surroundings is None else surroundings
    rendered = rendered_images(caster, hypotheses, cameras, scene, RENDERED_SIDE)
    weight = model.geometry / (1 + model.correlation * taken)
    moved = gaps_after_alignment(rendered, sensor, model)
    divergence, different = divergences(rendered, moved, sensor, model)
    shown = rendered.pixels_shown(sensor.pitch) @ hypotheses.belief
    pixels = rendered.sight * shown
    found = pixels / (shown + HALF_FOUND)
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
            model,
            taken,
        )

    return ExpectedViews(
        hypotheses, weight * divergence, different, found, pixels, sharper
    )


@dataclass(frozen=True, eq=False)
class RivalPictures:
    """Renderings of the two leading hypotheses from one camera.

    Attributes:
        things: number of the surface of each, (2,) int64.
        pictures: rendering of each with a headlight, (2, S, S) uint8, 0 for background.
        different: pixels in which they differ by more than the noise, (S, S) bool.
    """

    things: Index
    pictures: NDArray[np.uint8]
    different: Mask

    @property
    def share(self) -> float:
        """Share of the pixels of the two hypotheses in which they differ."""
        return float(self.different.sum() / max(1, self.pictures.any(0).sum()))


@dataclass(frozen=True, eq=False)
class Outlook:
    """The state from which the next view of a thing is chosen.

    Attributes:
        caster: surfaces of the things.
        hypotheses: the leading hypotheses.
        sensor: the camera.
        surroundings: measured surroundings of the thing.
        place: position of the last camera, (3,) float64, object frame, metres.
        taken: number of views so far.
        covariance: of rotation and translation of the first hypothesis, (6, 6) float64.
        unknown: belief that the thing is none of the hypotheses.
        model: of the pixels and the cameras.
    """

    caster: SurfaceCaster
    hypotheses: Leading
    sensor: ExpectedSensor
    surroundings: SeenSurroundings
    place: Float
    taken: int
    covariance: Float
    unknown: float = 0.0
    model: ExpectedModel = field(default_factory=ExpectedModel)

    @classmethod
    def of(
        cls,
        world: World,
        thing: Thing,
        poses: Sequence[PoseCandidate],
        beliefs: Mapping[str, float],
        to_object: Float,
    ) -> "Outlook":
        """Collect the state after some views.

        Args:
            world: what explains the views.
            thing: the one that is looked at.
            poses: that it may have, the likeliest first.
            beliefs: in the names of the library.
            to_object: from the world to the object frame, whose z is up, (4, 4).
        """
        view = world.views[-1]
        depth = view.grid().depth
        sensor = ExpectedSensor(
            float(1 / view.frame.intrinsics[0, 0]),
            float(np.median(view.noise.at(depth[depth > 0]))),
        )
        owners = [owner == thing.number for owner in world.owners]
        points = [
            one.points(np.flatnonzero(mine))
            for one, mine in zip(world.views, owners, strict=True)
        ]
        own = np.concatenate(points) @ to_object[:3, :3].T + to_object[:3, 3]
        leading = Leading.of(world.library, poses, beliefs, to_object)
        variances = [1.0] * 6
        if leading is None:
            leading = Leading.as_large_as(own, world.library)
        else:
            variances[:3] = [np.radians(poses[0].degrees) ** 2 / 3] * 3
            variances[3:] = [(poses[0].millimetres / 1000) ** 2 / 3] * 3
        return cls(
            world.library.caster,
            leading,
            sensor,
            SeenSurroundings.of(world.views, owners, own, to_object),
            (to_object @ view.camera)[:3, 3],
            sum(bool(mine.any()) for mine in owners),
            np.diag(variances),
            float(np.clip(1 - sum(beliefs.values()), 0, 1)),
        )

    @property
    def distance(self) -> float:
        """Distance of the last camera from the origin of the object frame, metres."""
        return float(np.linalg.norm(self.place))

    @property
    def towards(self) -> Float:
        """Unit vector from the origin of the object frame towards the last camera, (3,)."""
        return self.place / self.distance

    def cameras(self, directions: Float) -> Float:
        """Level cameras in the given directions, at the distance of the last camera.

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

    def rivals(self, camera: Float) -> RivalPictures | None:
        """Render the two leading hypotheses, of different things if there are any, and their
        difference.

        Args:
            camera: camera-to-world pose, (4, 4), object frame, metres.

        Returns:
            The pictures; None if there is only one hypothesis.
        """
        things = self.hypotheses.things
        order = np.argsort(-self.hypotheses.belief, kind="stable")
        others = [*order[things[order] != things[order[0]]], *order[1:]]
        if not others:
            return None
        rows = np.array([order[0], others[0]])
        two = Leading(things[rows], self.hypotheses.poses[rows], np.full(2, 0.5))
        images = rendered_images(
            self.caster,
            two,
            camera[None],
            self.surroundings,
            PICTURE_SIDE,
        )

        shows = np.isfinite(images.depth[0])
        pictures = np.where(shows, 255 * images.cosine[0], 0).astype(np.uint8)
        different = different_pixels(images, self.sensor, self.model)[0]
        return RivalPictures(
            two.things,
            pictures.reshape(2, PICTURE_SIDE, PICTURE_SIDE),
            different.reshape(PICTURE_SIDE, PICTURE_SIDE),
        )

    def expect(self, cameras: Float, goal: Goal = "thing") -> ExpectedViews:
        """Predict the information of views from some cameras.

        Args:
            cameras: camera-to-world poses, (V, 4, 4), object frame, metres.
            goal: "pose" also predicts the reduction of the pose error.

        Returns:
            Expected information of each view.
        """
        return expected_views(
            self.caster,
            self.hypotheses,
            cameras,
            self.sensor,
            self.surroundings,
            self.taken,
            self.model,
            covariance=self.covariance if goal == "pose" else None,
        )
