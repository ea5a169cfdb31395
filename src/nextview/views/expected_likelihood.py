"""Expected log-likelihood ratios of two hypotheses in views that were not taken yet.

If a hypothesis is true, the measured depth is that of its surface with the noise of the sensor, and
with holes where the surface is seen at grazing incidence. ``things.score`` then compares this depth
with each other hypothesis. This module computes the mean of that result without sampling images.

Both directions of a difference count: a handle that only the rival has is missing surface, and a
handle that only the leading hypothesis has is surface that the rival does not explain.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from nextview.things.surface import SCAN_ERROR
from nextview.types import Float, Float32, Index, Mask
from nextview.views.expected_images import (
    LOWEST_COSINE,
    ExpectedSensor,
    HypothesisImages,
)
from nextview.views.expected_model import ExpectedModel

# stride of the pixels in the fit of one hypothesis to another
FITTED_EVERY = 3
FITTED_REACH = 0.004  # residual at which a pixel of this fit has half weight, metres
# cosine of incidence below which holes are frequent: see the simulated cameras
GRAZING_COSINE = 0.3
# deviation of a surface from its scan in this fit, metres
FITTED_SURFACE_ERROR = 0.001
# residual beyond which a pixel is an outlier, standard deviations
LARGEST_DEVIATION = 12.0
TABLE_STEPS = 20  # table entries per standard deviation


def _displaced(images: HypothesisImages, model: ExpectedModel) -> Float:
    """Standard deviation of the displacement that each camera's pose error causes, (V,), metres.

    It corresponds to the displacement for views that were taken.
    """
    away = np.linalg.norm(images.origins - images.centre, axis=1).astype(np.float64)
    return np.hypot(model.camera, model.aim * away)


def _pairs(count: int) -> tuple[Index, Index]:
    """Indices of all unordered pairs of hypotheses."""
    first, second = np.triu_indices(count, 1)
    return first, second


def depth_variance(
    images: HypothesisImages,
    sensor: ExpectedSensor,
    model: ExpectedModel,
) -> Float32:
    """Variance of the measured depth of each hypothesis.

    Args:
        images: the hypotheses as each view would show them.
        sensor: its expected noise.
        model: of the pixels and the cameras.

    Returns:
        (V, H, P) float32, square metres.
    """
    depth = np.where(np.isfinite(images.depth), images.depth, 1)
    steepness = np.sqrt(1 - images.cosine**2) / images.cosine
    noise = sensor.noise * depth**2
    sideways = model.steep * sensor.pitch * depth * steepness
    return (noise**2 + SCAN_ERROR**2 + sideways**2).astype(np.float32)


def gaps_after_alignment(
    images: HypothesisImages,
    sensor: ExpectedSensor,
    model: ExpectedModel,
) -> Float32:
    """Depth differences of all pairs of hypotheses that remain after registration.

    The registration of the new view will move all hypotheses and estimate the pose error of the
    camera. Differences that a small motion removes are therefore no information. One Gauss-Newton
    step with the prior of the registration approximates this.

    Args:
        images: renderings of the hypotheses in each view.
        sensor: expected noise of the camera.
        model: of the pixels and the cameras.

    Returns:
        Differences, (V, pairs, P) float32, metres; 0 where at least one of the two is not visible.
    """
    first, second = _pairs(images.depth.shape[1])
    depth_a = images.depth[:, first]
    depth_b = images.depth[:, second]
    both = np.isfinite(depth_a) & np.isfinite(depth_b)
    a = np.where(both, depth_a, 0)
    gap = a - np.where(both, depth_b, 0)
    if not len(first):
        return gap

    # Symmetric Jacobian: linearised at the surface halfway between the two.
    axes = [images.normals[..., k] for k in range(3)]
    normals = [axis[:, first] + axis[:, second] for axis in axes]
    scale = both / np.sqrt(normals[0] ** 2 + normals[1] ** 2 + normals[2] ** 2 + 1e-12)
    normals = [axis * scale for axis in normals]
    middle = a - gap / 2
    start = images.origins - images.centre
    rays = [images.rays[..., k] for k in range(3)]
    arms = [start[:, k, None, None] + rays[k][:, None] * middle for k in range(3)]

    columns = [
        arms[1] * normals[2] - arms[2] * normals[1],
        arms[2] * normals[0] - arms[0] * normals[2],
        arms[0] * normals[1] - arms[1] * normals[0],
        *normals,
    ]
    steepest = -LOWEST_COSINE * images.lengths[:, None]
    along = np.minimum(sum(normals[k] * rays[k][:, None] for k in range(3)), steepest)

    some = slice(None, None, FITTED_EVERY)
    distance = (gap * along)[..., some]
    noise = sensor.noise * middle[..., some] ** 2
    weights = both[..., some] / (FITTED_SURFACE_ERROR**2 + noise**2)
    weights = weights / (1 + (distance / FITTED_REACH) ** 2)
    used = np.maximum(both[..., some].sum(2, keepdims=True), 1)
    weights = (weights * np.minimum(1, model.pixels / used)).astype(np.float32)
    thinned = np.stack([column[..., some] for column in columns], 2)
    weighted = thinned * weights[:, :, None]

    held = np.zeros((len(images.origins), 1, 6))
    held[..., :3] = 1 / model.tilt**2
    held[..., 3:] = 1 / _displaced(images, model)[:, None, None] ** 2

    left = (weighted @ thinned.swapaxes(2, 3)).astype(np.float64)
    left += held[..., None] * np.eye(6)
    right = (weighted @ distance[..., None]).astype(np.float64)
    motion = np.linalg.solve(left, right)[..., 0].astype(np.float32)

    taken_away = sum(columns[k] * motion[:, :, k, None] for k in range(6)) / along
    return np.where(both, gap - taken_away, 0).astype(np.float32)


def divergences(
    images: HypothesisImages,
    gaps: Float32,
    sensor: ExpectedSensor,
    model: ExpectedModel,
) -> tuple[Float, Float]:
    """Expected differences of the mean log-likelihood of two hypotheses, and of their pixels.

    Args:
        images: renderings of the hypotheses in each view.
        gaps: depth differences, see ``gaps_after_alignment``.
        sensor: expected noise of the camera.
        model: of the pixels and the cameras.

    Returns:
        Mean of both directions, (V, H, H), and share of the pixels that differ, (V, H, H).
    """
    views, count = images.depth.shape[:2]
    first, second = _pairs(count)
    divergence = np.zeros((views, count, count))
    different = np.zeros((views, count, count))
    if not len(first):
        return divergence, different

    judged = _Judged.of(images, sensor, model)
    forth = judged.ratio(first, second, gaps)
    back = judged.ratio(second, first, gaps)
    both_ways = np.maximum((forth + back) / 2, 0)
    either = np.isfinite(images.depth[:, first]) | np.isfinite(images.depth[:, second])
    share = judged.different(first, second, gaps).sum(2) / np.maximum(either.sum(2), 1)
    for rows, columns in ((first, second), (second, first)):
        divergence[:, rows, columns] = both_ways
        different[:, rows, columns] = share
    return divergence, different


def different_pixels(
    images: HypothesisImages,
    sensor: ExpectedSensor,
    model: ExpectedModel,
) -> Mask:
    """Pixels in which two registered hypotheses differ by more than the noise.

    Args:
        images: renderings of two hypotheses.
        sensor: the camera.
        model: of the pixels and the cameras.

    Returns:
        Mask, (V, P) bool.
    """
    first, second = _pairs(2)
    gaps = gaps_after_alignment(images, sensor, model)
    judged = _Judged.of(images, sensor, model)
    return judged.different(first, second, gaps)[:, 0]


@dataclass(frozen=True, eq=False)
class _Judged:
    """Inputs of the pixel likelihoods, (V, H, P) each unless noted otherwise.

    Attributes:
        shows: pixels in which a hypothesis is visible, bool.
        lost: probability of a hole.
        deviation: standard deviation of the depth, metres.
        hole: log-likelihood of a hole.
        missing: log-likelihood of a thing pixel that another hypothesis does not cover.
        apart: weight of a pixel outside a hypothesis, by how clearly it remains outside after
            registration, 0 to 1.
        behind: whether a background is measured where a hypothesis is absent, (V, 1, P).
        clear: probability that no unobserved obstacle occludes a pixel, (V, 1, P).
        area: number of camera pixels in one rendered pixel, (V, 1).
        enough: number of camera pixels from which a view has full weight.
        outlier: log-likelihood of an outlier.
        matches: expected log-likelihood of a depth by its residual, see ``_match_table``.
    """

    shows: Mask
    lost: Float32
    deviation: Float32
    hole: Float32
    missing: Float32
    apart: Float32
    behind: Mask
    clear: Float32
    area: Float
    enough: float
    outlier: float
    matches: Float32

    @classmethod
    def of(
        cls,
        images: HypothesisImages,
        sensor: ExpectedSensor,
        model: ExpectedModel,
    ) -> "_Judged":
        """Prepare the likelihoods of the pixels of each view.

        Args:
            images: renderings of the hypotheses in each view.
            sensor: expected noise of the camera.
            model: of the pixels and the cameras.

        Returns:
            The inputs of the likelihoods.
        """
        shows = np.isfinite(images.depth)
        size = images.step / sensor.pitch  # size of a rendered pixel, camera pixels
        within, beside = _rings(shows, images.side)
        deep = np.clip(within * size.mean(1)[:, None, None] / model.edge, 0.1, 1)

        away = np.linalg.norm(images.origins - images.centre, axis=1)
        metres = images.step.mean(1) * away
        displaced = _displaced(images, model).astype(np.float32)
        beside = beside * (metres / displaced)[:, None, None]
        return cls(
            shows=shows,
            lost=np.where(shows, np.maximum(1 - images.cosine / GRAZING_COSINE, 0), 0),
            deviation=np.sqrt(depth_variance(images, sensor, model)),
            hole=(model.hole * images.cosine).astype(np.float32),
            missing=(model.outlier * deep).astype(np.float32),
            apart=1 - np.exp(-0.5 * beside**2),
            behind=images.behind[:, None],
            clear=images.clear[:, None],
            area=size.prod(1)[:, None].astype(np.float64),
            enough=model.pixels,
            outlier=model.outlier,
            matches=_match_table(model.outlier),
        )

    def ratio(self, true: Index, other: Index, gaps: Float32) -> Float:
        """Expected mean log-likelihood of true hypotheses minus that of their rivals.

        Args:
            true: the true hypotheses, (K,) int64.
            other: the rivals, (K,) int64.
            gaps: depth differences of the pairs, (V, K, P), metres.

        Returns:
            Differences, (V, K) float64.
        """
        shows = self.shows[:, true]
        rival = self.shows[:, other]
        lost = self.lost[:, true]
        kept = shows * (1 - lost)

        # Both are visible.
        off = np.abs(gaps) / self.deviation[:, other] * TABLE_STEPS
        match = self.matches[np.minimum(off, len(self.matches) - 1).astype(np.int32)]
        hole = self.hole[:, other]
        judged = np.where(rival, kept * match + lost * hole, 0)
        # Only the true one is visible: surface that the rival does not explain.
        alone = shows & ~rival
        judged += np.where(
            alone,
            kept * self.missing[:, true] * self.apart[:, other],
            0,
        )
        # Only the rival is visible: the camera measures the background instead, or nothing.
        through = rival & ~shows
        seen_through = self.outlier * self.apart[:, true]
        judged += np.where(through, np.where(self.behind, seen_through, hole), 0)
        counted = (self.clear * (kept + np.where(rival, lost, 0) + through)).sum(2)

        best = kept * self.matches[0] + lost * self.hole[:, true]
        own = (self.clear * shows).sum(2)
        judged = (self.clear * judged).sum(2) / np.maximum(counted, 1)
        mean = judged - (self.clear * best).sum(2) / np.maximum(own, 1)
        either = shows | rival
        union = either.sum(2)
        sight = (self.clear * either).sum(2) / np.maximum(union, 1)
        return (
            -mean.astype(np.float64)
            * sight
            * np.minimum(1, union * self.area / self.enough)
        )

    def different(self, first: Index, second: Index, gaps: Float32) -> Mask:
        """Pixels in which two hypotheses differ by more than the noise.

        Args:
            first: first hypothesis of each pair, (K,) int64.
            second: second hypothesis of each pair, (K,) int64.
            gaps: depth differences of the pairs, (V, K, P), metres.

        Returns:
            Mask, (V, K, P) bool.
        """
        shows = self.shows[:, first]
        rival = self.shows[:, second]
        off = np.abs(gaps) > 3 * self.deviation[:, second]
        alone = np.where(shows, self.apart[:, second], self.apart[:, first]) > 0.5
        return np.where(shows & rival, off, (shows ^ rival) & alone)


@lru_cache(maxsize=4)
def _match_table(outlier: float) -> Float32:
    """Expected log-likelihood of a depth by its residual in standard deviations.

    It is the expectation over Gaussian noise of the gain of a pixel in ``things.score``, less that
    of an exact match, by Gauss-Hermite quadrature, with one entry for every 1 / TABLE_STEPS.
    """
    nodes, shares = np.polynomial.hermite_e.hermegauss(40)
    deviations = np.arange(int(LARGEST_DEVIATION * TABLE_STEPS) + 1) / TABLE_STEPS
    squared = (deviations[:, None] + nodes) ** 2
    match = np.log(np.exp(-squared / 2) + np.exp(outlier)) - np.log1p(np.exp(outlier))
    return (match @ shares / shares.sum()).astype(np.float32)


def _rings(shows: Mask, side: int) -> tuple[Float32, Float32]:
    """Distance to the outline inside and outside it, (V, H, P) each, pixels; at most 2.5."""
    image = shows.reshape(*shows.shape[:2], side, side)
    within = np.full(image.shape, 0.5, np.float32)
    beside = np.full(image.shape, 0.5, np.float32)
    inner = image
    outer = image
    for _ in range(2):
        inner = inner & _neighbours(inner).all(0)
        outer = outer | _neighbours(outer).any(0)
        within += inner
        beside += ~outer
    return within.reshape(shows.shape), beside.reshape(shows.shape)


def _neighbours(image: Mask) -> Mask:
    """The four neighbours of each pixel of images, (4, V, H, rows, columns)."""
    padded = np.pad(image, ((0, 0), (0, 0), (1, 1), (1, 1)))
    up = padded[..., :-2, 1:-1]
    down = padded[..., 2:, 1:-1]
    left = padded[..., 1:-1, :-2]
    right = padded[..., 1:-1, 2:]
    return np.stack([up, down, left, right])
