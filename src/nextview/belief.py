"""What the views add up to: belief over classes, how far to trust it, and when to stop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.arguments import number, whole
from nextview.errors import ModelError, RiskError, UsageError
from nextview.json_file import Fields

Float = NDArray[np.float64]


def fuse(logits: NDArray[np.floating], temperature: float = 1.0) -> NDArray[np.float64]:
    """Belief after several views: softmax of the sum of their logits (thesis, section 4.4), over a temperature.

    Args:
        logits: (..., views, classes).
        temperature: for so many views, see ``Calibration``; 1 for the plain sum.

    Returns:
        (..., classes) float64, sums to 1.

    Raises:
        ModelError: a logit is not finite.
    """
    logits = np.asarray(logits, np.float64)
    if not np.isfinite(logits).all():
        raise ModelError("the recogniser gave a logit that is not a finite number")
    return _softmax(logits.sum(-2) / temperature)


def _softmax(logs: NDArray[np.floating]) -> Float:
    # As SciPy's; recognising an object imports no SciPy, which keeps its start short.
    values = np.exp(logs - logs.max(-1, keepdims=True))
    return values / values.sum(-1, keepdims=True)


def _pointing(total: NDArray[np.floating], classes: int) -> NDArray[np.floating]:
    """What sums say of the azimuths to which azimuth bin 0 points, (..., azimuth bins, classes)."""
    return total[..., classes:].reshape(*total.shape[:-1], -1, classes)


def reorient(azimuth_bins: NDArray[np.floating], azimuth: NDArray[np.floating]) -> NDArray[np.floating]:
    """Log-evidence of the bins seen from an azimuth as log-evidence of the azimuths to which bin 0 points; or back.

    From azimuth a, bin s is seen if bin 0 points to a - s: the same sum turns either into the other.

    Args:
        azimuth_bins: (..., classes, azimuth bins), in even steps of azimuth.
        azimuth: of the views, parts of a full turn, (...). Between two steps the likelihoods are interpolated, not
            their logarithms: over all azimuths they sum up to the same, so that one view alone says as much of the
            classes from wherever azimuths are counted.

    Returns:
        The same shape.
    """
    n = azimuth_bins.shape[-1]
    steps = np.asarray(azimuth, np.float64)[..., None, None] * n
    low = np.floor(steps + 1e-9)
    share = np.maximum(steps - low, 0)

    def turned(by: NDArray[np.float64]) -> NDArray[np.floating]:
        source = (by.astype(np.int64) - np.arange(n)) % n
        return np.take_along_axis(azimuth_bins, np.broadcast_to(source, azimuth_bins.shape), -1)

    before = turned(low)
    if not (share > 1e-9).any():
        return before
    after = turned(low + 1)
    top = np.maximum(before, after)
    mixed = top + np.log((1 - share) * np.exp(before - top) + share * np.exp(after - top))
    return np.where(share > 1e-9, mixed, before)


def log_evidence_of(
    logits: NDArray[np.floating], azimuth_bins: NDArray[np.floating] | None, azimuth: NDArray[np.floating]
) -> NDArray[np.floating]:
    """What views say of their object, written so that the views can be summed: see ``Calibration.belief``.

    Args:
        logits: (..., classes).
        azimuth_bins: log-likelihoods of the azimuth bins that are seen, (..., classes, azimuth bins); None if they are
            not told.
        azimuth: of the views, parts of a full turn, (...).

    Returns:
        The logits, then for each azimuth how likely it is that azimuth bin 0 points there, for each class: (..., (1 +
        azimuth bins) * classes). The logits alone if no azimuth bins are told.
    """
    if azimuth_bins is None:
        return logits
    pointing = reorient(azimuth_bins, np.broadcast_to(azimuth, logits.shape[:-1])).swapaxes(-1, -2)
    return np.concatenate([logits, pointing.reshape(*logits.shape[:-1], -1)], -1)


def of_true_class(logs: Float, labels: NDArray[np.int64]) -> Float:
    """Logarithm of the belief in the true class.

    Args:
        logs: of the belief in each class, up to a constant, (N, ..., C).
        labels: (N,).

    Returns:
        (N, ...) float64.
    """
    top = logs.max(-1)
    of_truth = logs[np.arange(len(labels)), ..., labels]
    return of_truth - top - np.log(np.exp(logs - top[..., None]).sum(-1))


@dataclass(frozen=True)
class RiskBounds:
    """How often those who stop at a threshold are wrong, at most, as far as validation objects can tell.

    Attributes:
        thresholds: of the belief, ascending, (T,).
        bounds: error rate that each threshold can promise among those who reach it, by how many views they may take
            (from 1 on), (views, T); 1 where it can promise nothing.
        delta: how often such a promise may fail.

    Raises:
        ModelError: thresholds that do not ascend, bounds that are no error rates or of another shape.
    """

    thresholds: tuple[float, ...]
    bounds: tuple[tuple[float, ...], ...]
    delta: float

    def __post_init__(self) -> None:
        ascending = all(a < b for a, b in zip(self.thresholds, self.thresholds[1:], strict=False))
        fits = self.thresholds and self.bounds and all(len(row) == len(self.thresholds) for row in self.bounds)
        rates = all(0 <= rate <= 1 for row in self.bounds for rate in row) and 0 < self.delta < 1
        if not (ascending and fits and rates):
            raise ModelError("error rates that cannot be promised: they do not fit their thresholds")

    def threshold(self, risk: float, max_views: int) -> float:
        """The lowest threshold that promises an error rate of at most ``risk``.

        Raises:
            RiskError: none does, or so many views were not calibrated.
        """
        if not 0 < number(risk, "the risk") < 1:
            raise RiskError(f"the risk is an error rate between 0 and 1, not {risk}")
        if max_views > len(self.bounds):
            raise RiskError(f"error rates were calibrated for at most {len(self.bounds)} views, not {max_views}")
        row = self.bounds[max_views - 1]
        for threshold, bound in zip(self.thresholds, row, strict=True):
            if bound <= risk:
                return threshold
        raise RiskError(f"this recogniser cannot promise an error rate of {risk}, only {min(row):.3f} and more")

    @classmethod
    def from_dict(cls, values: Any) -> RiskBounds:
        """From what a calibration says under "risk".

        Raises:
            ModelError: it makes no sense.
        """
        fields = Fields(values, "the calibration's risk")
        thresholds, bounds = fields.numbers("thresholds", 1).tolist(), fields.numbers("bounds", 2).tolist()
        found = cls(tuple(thresholds), tuple(map(tuple, bounds)), fields.number("delta"))
        fields.end()
        return found

    def to_dict(self) -> dict[str, Any]:
        """What ``from_dict`` reads, for JSON."""
        return {"delta": self.delta, "thresholds": list(self.thresholds), "bounds": [*map(list, self.bounds)]}


@dataclass(frozen=True)
class Calibration:
    """How far to trust a sum of logits. Looks at one object err together, so k of them are not k pieces of evidence.

    The sum over k views is divided by ``temperature * (1 + correlation * (k - 1))``: what the variance of a sum of k
    equally correlated terms grows by, beyond k. Correlation 0 trusts the sum, 1 the mean.

    What views say of the azimuth bins counts too, if the recogniser tells: an object stands still, so views from
    different azimuths that are to be of one class have to agree on where its azimuth bin 0 points. The belief in a
    class is multiplied by how likely it is that they would say what they say, over all azimuths to which it may point.
    Views err together about this as well, though less.

    Attributes:
        temperature: temperature of a single view.
        correlation: of the evidence of two views, 0 .. 1.
        risk: for stopping with a promise; None if not known.
        bin_correlation: of what two views say of the side, 0 .. 1; None where that shall not count for the class.
        visibility: a view in which only a share of the object shows counts as that share to this power of a view, see
            ``weights``; None where each counts as one.

    Raises:
        ModelError: a temperature that is not positive, or a negative correlation or power.
    """

    temperature: float = 1.0
    correlation: float = 0.0
    risk: RiskBounds | None = None
    bin_correlation: float | None = None
    visibility: float | None = None

    def __post_init__(self) -> None:
        numbers = (self.correlation, self.bin_correlation or 0.0, self.visibility or 0.0)
        if not 0 < self.temperature < np.inf or not all(0 <= x < np.inf for x in numbers):
            raise ModelError(
                f"no calibration: temperature {self.temperature}, correlation {self.correlation}, of azimuth bins "
                f"{self.bin_correlation}, visibility {self.visibility}"
            )

    def weights(self, shown: NDArray[np.floating] | None) -> NDArray[np.floating] | float:
        """As how much of a view each counts in the sum, by the share of the object that shows in it; 1 if not told."""
        if self.visibility is None or shown is None:
            return 1.0
        return np.clip(np.asarray(shown, np.float64), LEAST_SHOWN, 1) ** self.visibility

    def temperature_after(self, n_views: int) -> float:
        """What the sum of the logits of so many views is divided by."""
        return self.temperature * (1 + self.correlation * (n_views - 1))

    def log_belief(self, total: NDArray[np.floating], n_views: NDArray | int, classes: int) -> Float:
        """Logarithm of the belief in each class, up to a constant for all classes.

        Args:
            total: sum over views of what they say, see ``log_evidence_of``, (..., classes) or (..., (1 + azimuth bins)
                * classes).
            n_views: how many, one number or (...).
            classes: how many.

        Returns:
            (..., classes) float64.

        Raises:
            ModelError: something that was said is not finite.
        """
        if not np.isfinite(total).all():
            raise ModelError("the recogniser said something that is not a finite number")
        more = np.asarray(n_views)[..., None] - 1
        total = np.asarray(total, np.float64)
        logs = total[..., :classes] / (self.temperature * (1 + self.correlation * more))
        if self.bin_correlation is None or total.shape[-1] == classes:
            return logs
        pointing = _pointing(total, classes) / (1 + self.bin_correlation * more)[..., None]
        top = pointing.max(-2)
        pointing -= top[..., None, :]
        return logs + top + np.log(np.exp(pointing, out=pointing).sum(-2))

    def belief(self, total: NDArray[np.floating], n_views: NDArray | int, classes: int) -> Float:
        """Belief in each class, (..., classes) float64, sums to 1; arguments as for ``log_belief``."""
        return _softmax(self.log_belief(total, n_views, classes))

    def azimuth_bins(
        self, total: NDArray[np.floating], n_views: NDArray | int, classes: int, azimuth: NDArray[np.floating]
    ) -> Float | None:
        """Belief in the azimuth bin that is seen from an azimuth, if the object is of each class.

        Args:
            total: sum over views of what they say, see ``log_evidence_of``, (..., (1 + azimuth bins) * classes).
            n_views: how many, one number or (...).
            classes: how many.
            azimuth: parts of a full turn, (...).

        Returns:
            (..., classes, azimuth bins) float64, sums to 1 over the azimuth bins; None if no azimuth bins were told.
        """
        if total.shape[-1] == classes:
            return None
        correlation = self.correlation if self.bin_correlation is None else self.bin_correlation
        more = np.asarray(n_views)[..., None, None] - 1
        pointing = _pointing(np.asarray(total, np.float64), classes) / (1 + correlation * more)
        return _softmax(reorient(pointing.swapaxes(-1, -2), azimuth))

    def threshold(self, risk: float, max_views: int) -> float:
        """The lowest threshold of the belief that promises an error rate, see ``RiskBounds``.

        Raises:
            RiskError: it cannot be promised.
        """
        if self.risk is None:
            raise RiskError("this recogniser promises no error rate; calibrate it with nextview fit calibration")
        return self.risk.threshold(risk, max_views)

    @classmethod
    def from_dict(cls, values: Any) -> Calibration:
        """From what a recogniser's card says under "calibration".

        Raises:
            ModelError: it makes no sense.
        """
        fields = Fields(values, "the calibration")
        risk = fields.take("risk", None)
        found = cls(
            fields.number("temperature"),
            fields.number("correlation"),
            None if risk is None else RiskBounds.from_dict(risk),
            fields.number("bin_correlation", None),
            fields.number("visibility", None),
        )
        fields.end()
        return found

    def to_dict(self) -> dict[str, Any]:
        """What ``from_dict`` reads, for JSON."""
        values: dict[str, Any] = {"temperature": self.temperature, "correlation": self.correlation}
        if self.bin_correlation is not None:
            values["bin_correlation"] = self.bin_correlation
        if self.visibility is not None:
            values["visibility"] = self.visibility
        if self.risk is not None:
            values["risk"] = self.risk.to_dict()
        return values


LEAST_SHOWN = 0.02
"""Shares of an object below this are taken for it."""
PLAIN_SUM = Calibration()
"""Trusts the sum of the logits as it stands, as the thesis did."""


@dataclass(frozen=True)
class Stopping:
    """Stop when the belief's peak reaches a threshold, or after ``max_views`` views.

    The threshold is ``threshold`` at the first view. With a ``threshold_decay`` it comes down after that: its log-odds
    are divided by ``1 + threshold_decay * (views - 1)``, because what is unclear after several views is seldom cleared
    up by another one. The plain sum of logits does so unawares: a calibrated belief whose threshold decay is its
    correlation stops where the sum does.

    Attributes:
        threshold: of the belief.
        max_views: views at most.
        threshold_decay: how fast the threshold comes down; 0 keeps it.

    Raises:
        UsageError: a threshold outside 0 .. 1, fewer than one view, or a negative threshold decay.
    """

    threshold: float = 0.97
    max_views: int = 5
    threshold_decay: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= number(self.threshold, "the threshold") <= 1:
            raise UsageError(f"the threshold is a probability between 0 and 1, not {self.threshold}")
        if whole(self.max_views, "the number of views", -(2**31)) < 1:
            raise UsageError(f"at least one view has to be taken, not {self.max_views}")
        if not 0 <= number(self.threshold_decay, "the threshold decay") < np.inf:
            raise UsageError(f"the threshold decay is a number from 0 on, not {self.threshold_decay}")

    @classmethod
    def of(
        cls, calibration: Calibration, threshold: float = 0.97, risk: float | None = None, max_views: int = 5
    ) -> Stopping:
        """The rule that goes with a recogniser's calibration. Everything that stops an episode begins here.

        Args:
            calibration: the threshold decays with its correlation.
            threshold: of the belief, at the first view.
            risk: instead, the lowest threshold at which at most this share of those who stop early is wrong. That is
                promised for a threshold that does not decay.
            max_views: views at most.

        Raises:
            RiskError: the error rate cannot be promised.
            UsageError: see ``Stopping``.
        """
        if risk is not None:
            return cls(calibration.threshold(risk, max_views), max_views)
        return cls(threshold, max_views, calibration.correlation)

    def threshold_at(self, n_views: NDArray | int) -> NDArray[np.float64]:
        """The belief at which to stop after so many views, same shape."""
        if self.threshold_decay == 0 or self.threshold in (0, 1):
            return np.full(np.shape(n_views), float(self.threshold))
        odds = np.log(self.threshold / (1 - self.threshold)) / (1 + self.threshold_decay * (np.asarray(n_views) - 1))
        return 1 / (1 + np.exp(-odds))

    def __str__(self) -> str:
        """The thresholds in words: "threshold 0.97 at the first view, 0.86 at the second"."""
        if self.threshold_decay == 0 or self.max_views == 1:
            return f"threshold {self.threshold:.3g}"
        first, second = self.threshold_at(np.arange(1, 3))
        last = f", {float(self.threshold_at(self.max_views)):.2g} at view {self.max_views}" * (self.max_views > 2)
        return f"threshold {first:.3g} at the first view, {second:.2g} at the second{last}"


@dataclass(frozen=True)
class FixedLength(Stopping):
    """Stop after ``max_views`` views and never before, however sure the belief is; the threshold counts for nothing."""

    def threshold_at(self, n_views: NDArray | int) -> NDArray[np.float64]:
        """Infinity, which no belief reaches, same shape."""
        return np.full(np.shape(n_views), np.inf)

    def __str__(self) -> str:
        """In words."""
        return f"{self.max_views} views"
