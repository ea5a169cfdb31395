"""Likelihood of a view, pixel by pixel, given a surface in a registered pose."""

from dataclasses import dataclass, fields

import numpy as np

from nextview.things.depth_view import ELSEWHERE, NOT_MEASURED, THING, DepthView
from nextview.things.registration import Rendered
from nextview.types import Float, Index


@dataclass(frozen=True)
class PixelModel:
    """Model of the pixels of a view if a hypothesis is true.

    Attributes:
        outlier: log-likelihood of a pixel that the hypothesis does not explain, relative to an
            exact match.
        hole: log-likelihood of a missing measurement on the surface at normal incidence; it costs
            less at grazing incidence.
        steep: lateral error on a steep surface, pixels.
        edge: distance to the outline within which deviations are usual, pixels.
        missing: weight in the misfit of the share of thing pixels without a surface.
        through: weight in the misfit of the share of a hypothesis that the camera sees through.
    """

    outlier: float = -4.0
    hole: float = -0.5
    steep: float = 1.0
    edge: float = 3.0
    missing: float = 0.06
    through: float = 0.12


@dataclass(frozen=True, eq=False)
class ViewLikelihood:
    """Likelihood of one view under H hypotheses.

    Attributes:
        total: sum of the log-likelihoods of all pixels relative to an exact match, (H,) float64, at
            most 0.
        pixels: number of these pixels: those of the thing and those of the hypothesis, (H,)
            float64.
        explained: share of the thing's pixels that the hypothesis explains, (H,) float64.
        misfit: absolute residual of the hypothesis, independent of its rivals, (H,) float64, 0 for
            an exact match: see ``likelihood``.
        noise_share: share of the camera noise in the variance of a depth on the hypothesis, as
            opposed to errors of its scan, (H,) float64.
        visible: pixels where the hypothesis should be visible and depth was measured, (H,) float64;
            those near the outline of the thing have less weight.
        seen_behind: those of them with a measurement behind the hypothesis, (H,) float64.
    """

    total: Float
    pixels: Float
    explained: Float
    misfit: Float
    noise_share: Float
    visible: Float
    seen_behind: Float

    def select(self, rows: Index) -> "ViewLikelihood":
        """Select hypotheses.

        Args:
            rows: indices, (N,).

        Returns:
            Likelihood under the selected hypotheses.
        """
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
    """Evaluate every pixel of a view under each hypothesis.

    The depth on the thing is compared with the surface under the noise of the sensor, which grows
    with the steepness of the surface. Thing pixels without a surface are outliers, as are pixels
    that measure the background of a surface that should be visible. Pixels within the noise of the
    ground are evaluated by their depth, whatever their segmentation. Occluders in front of the
    surface are neutral, as are pixels without thing and hypothesis. The share of the surface below
    the ground counts like the same share of see-through pixels, whether it is visible or not.

    Args:
        view: the view.
        rendered: rendering of the hypotheses in the view.
        model: model of the pixels.
        below: share of the surface of each hypothesis below the ground, (H,).

    Returns:
        Likelihood of the view under each hypothesis.
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
    # Mixture of sensor noise and outliers.
    match = np.log(np.exp(-squared / 2) + np.exp(model.outlier)) - np.log1p(
        np.exp(model.outlier)
    )

    # Mismatches near the outline cost less.
    inner = np.clip(np.abs(view.edge) / model.edge, 0.1, 1)
    deep = np.where(view.level, 0.1, inner)  # more likely ground pixels
    thing = view.kind == THING
    sunk = rendered.sunk(view)
    through = shows & (view.kind == ELSEWHERE) & (~rendered.hidden(view) | sunk)
    hole = shows & (view.kind == NOT_MEASURED)

    judged = np.zeros(shows.shape)
    judged = np.where(shows & thing, match, judged)
    judged = np.where(~shows & thing, model.outlier * deep, judged)
    # Pixels at ground level may show the thing or the ground: their depth decides.
    low = view.level & ~sunk
    judged = np.where(through, np.where(low, match, model.outlier) * inner, judged)
    judged = np.where(hole, model.hole * cosine, judged)

    counted = thing | through | hole
    explained = (shows & thing & (squared < 9)).sum(1) / max(1, int(thing.sum()))
    # The depth residual tells best whether a thing was taught. The outline depends on the
    # segmentation.

    missing = np.where(~shows & thing, deep, 0).sum(1) / max(1, int(thing.sum()))
    seen_through = np.where(through, judged / model.outlier, 0).sum(1)
    seen_through /= np.maximum(shows.sum(1), 1)
    impossible = np.minimum(seen_through + below, 1)
    # Real sensors round off edges, so edge pixels have less weight.
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
    """Share of the noise in the variance of a typical depth of the thing, (H,)."""
    noise = float(np.median(view.noise[view.kind == THING])) ** 2
    return np.asarray(noise / (noise + rendered.errors.astype(np.float64) ** 2))
