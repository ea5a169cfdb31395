"""Fuse the evidence of several views: belief over classes, calibration, size, and when to stop."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from nextview.checks import number, whole
from nextview.errors import ModelError, RiskError, UsageError
from nextview.types import Float, Float32, Floats, Mask


def fuse(logits: Floats, temperature: float = 1.0) -> Float:
    """Fuse the logits of several views by a plain sum (thesis, section 4.4).

    Args:
        logits: (..., views, classes).
        temperature: by which the sum is divided.

    Returns:
        Belief, (..., classes) float64: the softmax of the sum.

    Raises:
        ModelError: a logit is not finite.
    """
    logits = np.asarray(logits, np.float64)
    if not np.isfinite(logits).all():
        raise ModelError("the recogniser returned a logit that is not a finite number")
    return _softmax(logits.sum(-2) / temperature)


def _softmax(logs: Floats) -> Float:
    values = np.exp(logs - logs.max(-1, keepdims=True))
    return values / values.sum(-1, keepdims=True)


def reorient(azimuth_bins: Floats, azimuth: Floats) -> Floats:
    """Convert log-evidence of seen azimuth bins to log-evidence of directions of bin 0, or back.

    From azimuth a, bin s is seen if bin 0 points to a - s, so the same sum converts either into the
    other. Between two steps the likelihoods are interpolated, not their logarithms, so that their
    sum over all azimuths stays the same.

    Args:
        azimuth_bins: log-evidence, (..., classes, azimuth bins), in even steps of azimuth.
        azimuth: of the views, radians, (...).

    Returns:
        Log-evidence, (..., classes, azimuth bins).
    """
    n = azimuth_bins.shape[-1]
    steps = np.asarray(azimuth, np.float64)[..., None, None] / (2 * np.pi) * n
    low = np.floor(steps + 1e-9)
    share = np.maximum(steps - low, 0)

    def turned(by: Float) -> Floats:
        source = (by.astype(np.int64) - np.arange(n)) % n
        return np.take_along_axis(
            azimuth_bins,
            np.broadcast_to(source, azimuth_bins.shape),
            -1,
        )

    before = turned(low)
    if not (share > 1e-9).any():
        return before
    after = turned(low + 1)
    top = np.maximum(before, after)
    mixed = top + np.log(
        (1 - share) * np.exp(before - top) + share * np.exp(after - top)
    )
    return np.where(share > 1e-9, mixed, before)


def log_evidence_of(
    logits: Floats,
    azimuth_bins: Floats | None,
    azimuth: Floats,
) -> Floats:
    """Combine the outputs for views into log-evidence that can be summed over views.

    ``Calibration.belief`` takes the sum.

    Args:
        logits: (..., classes).
        azimuth_bins: log-likelihoods of the azimuth bins seen, (..., classes, azimuth bins); None
            without azimuth bins.
        azimuth: of the views, radians, (...).

    Returns:
        (..., classes + azimuth bins * classes): the logits, then for each azimuth the
        log-evidence that bin 0 points there, given each class. Without azimuth bins the logits
        alone.
    """
    if azimuth_bins is None:
        return logits
    pointing = reorient(
        azimuth_bins,
        np.broadcast_to(azimuth, logits.shape[:-1]),
    ).swapaxes(-1, -2)
    return np.concatenate([logits, pointing.reshape(*logits.shape[:-1], -1)], -1)


class RiskBounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Upper bounds of the error rate of episodes that stop at a threshold.

    They are computed from validation objects.

    Attributes:
        thresholds: ascending, (T,).
        bounds: upper bound of the error rate, by the number of views that may be taken (1, 2, ...),
            (views, T).
        delta: probability that a bound is exceeded.
    """

    thresholds: tuple[float, ...]
    bounds: tuple[tuple[float, ...], ...]
    delta: float

    def __post_init__(self) -> None:
        ascending = all(
            a < b for a, b in zip(self.thresholds, self.thresholds[1:], strict=False)
        )
        fits = (
            self.thresholds
            and self.bounds
            and all(len(row) == len(self.thresholds) for row in self.bounds)
        )
        rates = (
            all(0 <= rate <= 1 for row in self.bounds for rate in row)
            and 0 < self.delta < 1
        )

        if not (ascending and fits and rates):
            raise ModelError(
                "error rates that cannot be promised: they do not fit their thresholds"
            )

    def threshold(self, risk: float, max_views: int) -> float:
        """Return the lowest threshold that guarantees an error rate.

        Args:
            risk: largest share of wrong answers among the episodes that stop early, 0 to 1.
            max_views: largest number of views of an episode.

        Returns:
            Threshold of the belief.

        Raises:
            RiskError: the risk is not between 0 and 1, or cannot be guaranteed for so many views.
        """
        if not 0 < risk < 1:
            raise RiskError(f"the risk is an error rate between 0 and 1, not {risk}")
        if max_views > len(self.bounds):
            raise RiskError(
                f"error rates were calibrated for at most {len(self.bounds)} views, not {max_views}"
            )
        row = self.bounds[max_views - 1]
        for threshold, bound in zip(self.thresholds, row, strict=True):
            if bound <= risk:
                return threshold
        raise RiskError(
            f"this recogniser cannot promise an error rate of {risk}, only {min(row):.3f} and more"
        )


LARGEST_CALIBRATION = (
    # of a calibration, and the reciprocal of its least temperature; what is fitted is within 0.01
    # to 100
    1e4
)


class Calibration(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    omit_defaults=True,
):
    """How far the sum of the logits of several views can be trusted.

    Views of one object share their errors, so k views are not k independent pieces of evidence. The
    sum over k views is divided by ``temperature * (1 + correlation * (k - 1))``: the factor by
    which the variance of a sum of k equally correlated terms grows beyond k. Correlation 0 trusts
    the sum, 1 the mean.

    Azimuth bins count as evidence too, if the recogniser predicts them. The object stands still, so
    views from different azimuths must agree on the direction of its azimuth bin 0. The belief in a
    class is multiplied by the likelihood of that agreement, summed over all azimuths.

    ModelError is raised for a temperature that is not positive, a negative number, or hypotheses
    that do not cover every class.

    Attributes:
        temperature: of a single view.
        correlation: of the evidence of two views, 0 to 1.
        risk: error bounds that ``--risk`` uses; None if they are not known.
        bin_correlation: of the azimuth bins of two views, 0 to 1; None if azimuth bins do not count
            as evidence of the class.
        hypotheses: class of each taught thing, ascending; () for a network of classes.
    """

    temperature: float = 1.0
    correlation: float = 0.0
    risk: RiskBounds | None = None
    bin_correlation: float | None = None
    hypotheses: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.correlation, self.bin_correlation or 0.0)
        sound = LARGEST_CALIBRATION**-1 <= self.temperature <= LARGEST_CALIBRATION
        if not sound or not all(0 <= x <= LARGEST_CALIBRATION for x in numbers):
            given = f"temperature {self.temperature}, correlation {self.correlation}"
            raise ModelError(
                f"no calibration: {given}, of azimuth bins {self.bin_correlation}"
            )
        if self.hypotheses and not (
            set(np.diff((-1, *self.hypotheses)).tolist()) <= {0, 1}
        ):
            raise ModelError(
                "no calibration: the hypotheses are not of every class in order"
            )

    @property
    def threshold_decay(self) -> float:
        """Decay of the stopping threshold, see ``Stopping``; 0 for things."""
        return 0.0 if self.hypotheses else self.correlation

    def temperature_after(self, n_views: NDArray | int) -> Any:
        """What the sum of the logits of so many views is divided by, same shape."""
        return self.temperature * (1 + self.correlation * (n_views - 1))

    def log_belief(self, total: Floats, n_views: NDArray | int, classes: int) -> Float:
        """Return the log-belief in each class, up to a constant.

        Args:
            total: sum of ``log_evidence_of`` over the views, (..., D).
            n_views: number of views in the sum, (...).
            classes: number of classes.

        Returns:
            Log-belief, (..., classes) float64.

        Raises:
            ModelError: the evidence is not finite.
        """
        if not np.isfinite(total).all():
            raise ModelError(
                "the recogniser returned a value that is not a finite number"
            )
        total = np.asarray(total, np.float64)
        logs = total[..., :classes] / self.temperature_after(
            np.asarray(n_views)[..., None]
        )
        if self.bin_correlation is None or total.shape[-1] == classes:
            return logs
        pointing = self._pointing(total, n_views, classes)
        top = pointing.max(-2)
        pointing -= top[..., None, :]
        agreement = top + np.log(np.exp(pointing, out=pointing).sum(-2))
        return logs + agreement

    def _pointing(self, total: Floats, n_views: NDArray | int, classes: int) -> Float:
        """Log-evidence of the directions of azimuth bin 0, (..., azimuth bins, classes)."""
        correlation = (
            self.correlation if self.bin_correlation is None else self.bin_correlation
        )
        sums = np.asarray(total, np.float64)[..., classes:]
        pointing = sums.reshape(*sums.shape[:-1], -1, classes)
        return pointing / (1 + correlation * (np.asarray(n_views)[..., None, None] - 1))

    def belief(self, total: Floats, n_views: NDArray | int, classes: int) -> Float:
        """Return the belief in each class.

        Args:
            total: sum of ``log_evidence_of`` over the views, (..., D).
            n_views: number of views in the sum, (...).
            classes: number of classes.

        Returns:
            Belief, (..., classes) float64; sums to 1.

        Raises:
            ModelError: the evidence is not finite.
        """
        return _softmax(self.log_belief(total, n_views, classes))

    def azimuth_bins(
        self,
        total: Floats,
        n_views: NDArray | int,
        classes: int,
        azimuth: Floats,
    ) -> Float | None:
        """Return the belief in the azimuth bin seen from an azimuth, given each class.

        Args:
            total: sum of ``log_evidence_of`` over the views, (..., D).
            n_views: number of views in the sum, (...).
            classes: number of classes.
            azimuth: from which the object is seen, radians, (...).

        Returns:
            Belief, (..., classes, azimuth bins) float64; sums to 1 over the bins. None without
            bins.
        """
        if total.shape[-1] == classes:
            return None
        return _softmax(
            reorient(self._pointing(total, n_views, classes).swapaxes(-1, -2), azimuth)
        )

    def threshold(self, risk: float, max_views: int) -> float:
        """Return the lowest threshold that guarantees an error rate.

        Args:
            risk: largest share of wrong answers among the episodes that stop early, 0 to 1.
            max_views: largest number of views of an episode.

        Returns:
            Threshold of the belief.

        Raises:
            RiskError: the recogniser guarantees no error rate, or not this one.
        """
        if self.risk is None:
            raise RiskError(
                "this recogniser promises no error rate; calibrate it with nextview-lab"
                " fit calibration"
            )
        return self.risk.threshold(risk, max_views)


# share of a class that is smaller than usual, and larger; times beyond that which none has
RARE = 0.05
MUCH = 2.0
# trusts the sum of the logits as it stands, as the thesis did
PLAIN_SUM = Calibration()


class SizeEvidence(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """How likely each size is for each class; added to the logits if the scale is known.

    Attributes:
        radii_m: object radii, metres, ascending, (R,).
        log_density: log density of the logarithm of the radius, (C, R).
        weight: of the log density when it is added to the logits.
    """

    radii_m: tuple[float, ...]
    log_density: tuple[tuple[float, ...], ...]
    weight: float

    def __post_init__(self) -> None:
        radii = np.array(self.radii_m)
        fits = {len(row) for row in self.log_density} == {len(self.radii_m)}
        if (
            not fits
            or not len(radii)
            or radii[0] <= 0
            or not (np.diff(radii) > 0).all()
            or not self.weight >= 0
        ):
            raise ModelError("sizes that do not fit together")

    @classmethod
    def from_arrays(
        cls,
        radii: Float,
        log_density: Float,
        weight: float,
    ) -> "SizeEvidence":
        """Create it from arrays.

        Args:
            radii: object radii, metres, ascending, (R,).
            log_density: log-density of each class at these radii, (C, R).
            weight: of the log-density beside the logits.

        Returns:
            The evidence from size.
        """
        return cls(
            tuple(radii.tolist()),
            tuple(map(tuple, log_density.tolist())),
            float(weight),
        )

    @cached_property
    def _table(self) -> tuple[Float, Float]:
        return np.log(np.array(self.radii_m)), np.array(self.log_density)

    @cached_property
    def _usual(self) -> tuple[Float, Float]:
        """Logarithms of the radii between which nearly all objects of each class are, (C,) each."""
        grid, table = self._table
        share = np.cumsum(np.exp(table) * np.gradient(grid), axis=1)
        low, high = (
            np.array([np.interp(at * row[-1], row, grid) for row in share])
            for at in (RARE, 1 - RARE)
        )
        return low, high

    @property
    def smallest(self) -> float:
        """Radius of the smallest objects of any class, but for rare ones, metres."""
        return float(np.exp(self._usual[0].min()))

    def impossible(self, radius: float, much: float = MUCH) -> Mask:
        """Return the classes of which an object of this radius is far too small or too large.

        Args:
            radius: of the object, metres.
            much: factor beyond the usual sizes of a class.

        Returns:
            Whether the size rules each class out, (C,) bool.
        """
        low, high = self._usual
        return (np.log(radius) < low - np.log(much)) | (
            np.log(radius) > high + np.log(much)
        )

    def logits(self, radii: Floats) -> Float32:
        """Return what is added to the logits, (B, C) float32; zero for NaN radii.

        The radii are in metres, (B,).
        """
        at = np.log(np.where(np.isfinite(radii), radii, 1.0))
        grid, table = self._table
        densities = np.stack([np.interp(at, grid, row) for row in table], 1)
        return np.where(np.isfinite(radii)[:, None], self.weight * densities, 0).astype(
            np.float32
        )


@dataclass(frozen=True)
class Stopping:
    """Stop when the belief's peak reaches a threshold, or after ``max_views`` views.

    The threshold is ``threshold`` at the first view. With a ``threshold_decay`` its log-odds are
    then divided by ``1 + threshold_decay * (views - 1)``: what is unclear after several views is
    seldom cleared up by another one. A calibrated belief whose threshold decay is its correlation
    stops where the plain sum of logits does.

    Attributes:
        threshold: belief at which an episode stops after one view, 0 to 1.
        max_views: largest number of views.
        threshold_decay: how fast the threshold decreases with the number of views; 0 keeps it
            constant.

    Raises:
        UsageError: a threshold outside of 0 to 1, fewer than one view, or a negative threshold
            decay.

    Example:
        >>> Stopping(0.97).reached(np.array([0.99, 0.01]), n_views=1)
        np.True_
    """

    threshold: float = 0.97
    max_views: int = 5
    threshold_decay: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= number(self.threshold, "the threshold") <= 1:
            raise UsageError(
                f"the threshold is a probability between 0 and 1, not {self.threshold}"
            )
        if whole(self.max_views, "the number of views", -(2**31)) < 1:
            raise UsageError(f"at least one view has to be taken, not {self.max_views}")
        number(self.threshold_decay, "the threshold decay", 0)

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        threshold: float = 0.97,
        risk: float | None = None,
        max_views: int = 5,
    ) -> "Stopping":
        """Create the rule that goes with a recogniser's calibration.

        The threshold decays with the correlation of the views. With a ``risk`` it is the lowest
        threshold that guarantees this error rate, and does not decay.

        Args:
            calibration: of the recogniser.
            threshold: of the belief, for the first view.
            risk: largest share of wrong answers among the episodes that stop early; None for a
                threshold.
            max_views: largest number of views of an episode.

        Returns:
            The stopping rule.

        Raises:
            RiskError: the error rate cannot be guaranteed.
        """
        if risk is not None:
            return cls(calibration.threshold(risk, max_views), max_views)
        return cls(threshold, max_views, calibration.threshold_decay)

    def reached(self, belief: Floats, n_views: NDArray | int) -> Mask:
        """Return whether beliefs are high enough to stop.

        Args:
            belief: (..., classes).
            n_views: number of views that each is based on, (...).

        Returns:
            Whether to stop, (...) bool.
        """
        return belief.max(-1) >= self.threshold_at(n_views)

    def reached_along(self, beliefs: Floats, n_views: NDArray) -> Mask:
        """Return at which steps of episodes to stop.

        A rule that compares the belief with earlier ones overrides this instead of ``reached``. A
        step may depend on those before it, never on later ones. Nothing is stored between calls:
        live episodes and the benchmark pass the whole path each time.

        Args:
            beliefs: after each step, (..., steps, classes).
            n_views: number of views that each is based on, (..., steps).

        Returns:
            Whether to stop, (..., steps) bool.
        """
        return self.reached(beliefs, n_views)

    def threshold_at(self, n_views: NDArray | int) -> Float:
        """The belief at which to stop after so many views, same shape."""
        if self.threshold_decay == 0 or self.threshold in (0, 1):
            return np.full(np.shape(n_views), float(self.threshold))
        odds = np.log(self.threshold / (1 - self.threshold)) / (
            1 + self.threshold_decay * (np.asarray(n_views) - 1)
        )
        return 1 / (1 + np.exp(-odds))

    def __str__(self) -> str:
        """The thresholds in words: "threshold 0.97 at the first view, 0.86 at the second"."""
        if self.threshold_decay == 0 or self.max_views == 1:
            return f"threshold {self.threshold:.3g}"
        first, second = self.threshold_at(np.arange(1, 3))
        words = f"threshold {first:.3g} at the first view, {second:.2g} at the second"
        if self.max_views > 2:
            words += f", {float(self.threshold_at(self.max_views)):.2g} at view {self.max_views}"
        return words


@dataclass(frozen=True)
class FixedLength(Stopping):
    """Stop after ``max_views`` views and never before.

    Belief and threshold do not matter.
    """

    def threshold_at(self, n_views: NDArray | int) -> Float:
        """Infinity, which no belief reaches, same shape."""
        return np.full(np.shape(n_views), np.inf)

    def __str__(self) -> str:
        """In words."""
        return f"{self.max_views} views"
