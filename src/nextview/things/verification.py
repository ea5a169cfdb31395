"""How likely a view is, pixel by pixel, if a surface stands where it was aligned."""

from dataclasses import dataclass, fields

import numpy as np

from nextview.things.depth_view import ELSEWHERE, NOT_MEASURED, THING, DepthView
from nextview.things.registration import Rendered
from nextview.types import Float, Index


@dataclass(frozen=True)
class PixelModel:
    """What the pixels of a view are like if a hypothesis is true.

    Attributes:
        outlier: log-likelihood of a pixel that the hypothesis does not explain, against one that it
            explains exactly.
        hole: that of a pixel where the surface was not measured, seen face on. A grazing one costs
            less.
        steep: how many pixels a steep surface may be off sideways.
        edge: pixels of the outline within which a deviation is usual.
        missing: weight of the share of the thing's pixels that show no surface in the misfit.
        through: weight of the share of a hypothesis that is seen through.
    """

    outlier: float = -4.0
    hole: float = -0.5
    steep: float = 1.0
    edge: float = 3.0
    missing: float = 0.06
    through: float = 0.12


@dataclass(frozen=True, eq=False)
class ViewLikelihood:
    """How well H hypotheses explain one view.

    Attributes:
        total: sum of the log-likelihoods of all pixels against an exact match, (H,) float64, 0 at
            most.
        pixels: pixels that it is a sum over: those of the thing and those where the hypothesis
            shows, (H,) float64.
        explained: share of the thing's pixels that the hypothesis explains, (H,) float64.
        misfit: how badly the hypothesis explains the view if nothing is known of others, (H,)
            float64, 0 for exactly: see ``likelihood``.
        noise_share: part of the noise of the camera in the variance of a depth that is measured on
            the hypothesis, beside the errors of its scan, (H,) float64.
        visible: pixels where the hypothesis should show and depth was measured, (H,) float64; those
            near the outline of the thing count less.
        seen_behind: those of them in which something behind it was measured, (H,) float64.
    """

    total: Float
    pixels: Float
    explained: Float
    misfit: Float
    noise_share: Float
    visible: Float
    seen_behind: Float

    def select(self, rows: Index) -> "ViewLikelihood":
        """Some of the hypotheses, by index."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        return ViewLikelihood(**{name: part[rows] for name, part in parts.items()})

    @property
    def mean(self) -> Float:
        """Mean log-likelihood of a pixel, (H,) float64."""
        return self.total / np.maximum(self.pixels, 1)


def likelihood(
    view: DepthView,
    rendered: Rendered,
    model: PixelModel = PixelModel(),
    below: Float | float = 0.0,
) -> ViewLikelihood:
    """Judge every pixel of a view, given what it would show under each hypothesis.

    The depth on the thing is compared with the surface under the noise of the sensor, which grows
    where the surface is steep. Pixels of the thing without a surface are outliers; so are pixels
    where the surface should be visible and what is behind it was measured. Pixels as low as the
    noise of the ground are judged by their depth, however they were segmented. What stands in front
    of the surface is neutral, as are pixels where neither shows. What lies below the ground counts
    like as large a share of the pixels that is seen through, whether it is visible or not.

    Args:
        view: the view.
        rendered: the hypotheses as the view would show them.
        model: of the pixels.
        below: share of the surface of each hypothesis that lies below the ground, (H,).

    Returns:
        How well each hypothesis explains the view.
    """
    shows = np.isfinite(rendered.depth)
    depth = np.where(shows, rendered.depth, 1)
    lengths = np.linalg.norm(view.rays, axis=1)
    cosine = -np.einsum("hpi,pi->hp", rendered.normals, view.rays) / lengths
    cosine = np.clip(cosine, 0.15, 1)
    steepness = np.sqrt(1 - cosine**2) / cosine

    measured = np.isfinite(view.depth)
    observed = np.where(measured, view.depth, 0)
    sideways = model.steep * view.pitch * depth * steepness
    variance = view.noise**2 + rendered.errors[:, None] ** 2 + sideways**2
    squared = (observed - depth) ** 2 / variance
    # A mixture of the sensor's noise and of outliers.
    match = np.log(np.exp(-squared / 2) + np.exp(model.outlier)) - np.log1p(
        np.exp(model.outlier)
    )

    # Mismatches at an outline cost less, the nearer to it they are.
    inner = np.clip(np.abs(view.edge) / model.edge, 0.1, 1)
    deep = np.where(view.level, 0.1, inner)  # of the ground, more likely
    thing = view.kind == THING
    sunk = rendered.sunk(view)
    through = shows & (view.kind == ELSEWHERE) & (~rendered.hidden(view) | sunk)
    hole = shows & (view.kind == NOT_MEASURED)

    judged = np.zeros(shows.shape)
    judged = np.where(shows & thing, match, judged)
    judged = np.where(~shows & thing, model.outlier * deep, judged)
    # Low pixels may show the thing or the ground: their depth decides.
    low = view.level & ~sunk
    judged = np.where(through, np.where(low, match, model.outlier) * inner, judged)
    judged = np.where(hole, model.hole * cosine, judged)

    counted = thing | through | hole
    explained = (shows & thing & (squared < 9)).sum(1) / max(1, int(thing.sum()))
    # Depths tell best whether a thing was taught. Outlines depend on how well it was segmented.
    missing = np.where(~shows & thing, deep, 0).sum(1) / max(1, int(thing.sum()))
    seen_through = np.where(through, judged / model.outlier, 0).sum(1)
    seen_through /= np.maximum(shows.sum(1), 1)
    impossible = np.minimum(seen_through + below, 1)
    # Real sensors round off edges.
    both = np.where(shows & thing, inner, 0)
    mismatch = -(both * match).sum(1) / np.maximum(both.sum(1), 1e-9)
    mismatch = np.where(both.any(1), mismatch, -model.outlier)
    misfit = mismatch - model.outlier * (
        model.missing * missing + model.through * impossible
    )
    pixels = counted.sum(1).astype(np.float64)
    visible = shows & ~hole & ~rendered.hidden(view)
    return ViewLikelihood(
        total=judged.sum(1) + model.outlier * below * pixels,
        pixels=pixels,
        explained=explained,
        misfit=misfit,
        noise_share=_noise_share(view, rendered),
        visible=np.where(visible, deep, 0).sum(1),
        seen_behind=np.where(rendered.seen_behind(view), deep, 0).sum(1),
    )


def _noise_share(view: DepthView, rendered: Rendered) -> Float:
    """Part of the noise in the variance of a typical depth of the thing, (H,)."""
    noise = float(np.median(view.noise[view.kind == THING])) ** 2
    return np.asarray(noise / (noise + rendered.errors.astype(np.float64) ** 2))
