"""What the looks add up to: belief over classes, how far to trust it, and when to stop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


def fuse(logits: NDArray[np.floating], temperature: float = 1.0) -> NDArray[np.float64]:
    """Belief after several looks: softmax of the sum of their logits (thesis, section 4.4), over a temperature.

    Args:
        logits: (..., looks, classes).
        temperature: for so many looks, see ``Calibration``; 1 for the plain sum.

    Returns:
        (..., classes) float64, sums to 1.

    Raises:
        ValueError: a logit is not finite.
    """
    logits = np.asarray(logits, np.float64)
    if not np.isfinite(logits).all():
        raise ValueError("the recogniser gave a logit that is not a finite number")
    total = logits.sum(-2)
    total = np.exp((total - total.max(-1, keepdims=True)) / temperature)
    return total / total.sum(-1, keepdims=True)


class RiskError(ValueError):
    """An error rate that cannot be promised; the message is one sentence."""


@dataclass(frozen=True)
class RiskBounds:
    """How often those who stop at a threshold are wrong, at most, as far as validation objects can tell.

    Attributes:
        thresholds: of the belief, ascending, (T,).
        bounds: error rate that each threshold can promise among those who reach it, by how many looks they may take
            (from 1 on), (looks, T); 1 where it can promise nothing.
        delta: how often such a promise may fail.
    """

    thresholds: tuple[float, ...]
    bounds: tuple[tuple[float, ...], ...]
    delta: float

    def threshold(self, risk: float, max_views: int) -> float:
        """The lowest threshold that promises an error rate of at most ``risk``.

        Raises:
            RiskError: none does, or so many looks were not calibrated.
        """
        if not 0 < risk < 1:
            raise RiskError(f"the risk is an error rate between 0 and 1, not {risk}")
        if max_views > len(self.bounds):
            raise RiskError(f"error rates were calibrated for at most {len(self.bounds)} views, not {max_views}")
        row = self.bounds[max_views - 1]
        for threshold, bound in zip(self.thresholds, row, strict=True):
            if bound <= risk:
                return threshold
        raise RiskError(f"this recogniser cannot promise an error rate of {risk}, only {min(row):.3f} and more")


@dataclass(frozen=True)
class Calibration:
    """How far to trust a sum of logits. Looks at one object err together, so k of them are not k pieces of evidence.

    The sum over k looks is divided by ``temperature * (1 + correlation * (k - 1))``: what the variance of a sum of k
    equally correlated terms grows by, beyond k. Correlation 0 trusts the sum, 1 the mean.

    Attributes:
        temperature_of_one: temperature of a single look.
        correlation: of the evidence of two looks, 0 .. 1.
        risk: for stopping with a promise; None if not known.

    Raises:
        ValueError: a temperature that is not positive, or a negative correlation.
    """

    temperature_of_one: float = 1.0
    correlation: float = 0.0
    risk: RiskBounds | None = None

    def __post_init__(self) -> None:
        if not 0 < self.temperature_of_one < np.inf or not 0 <= self.correlation < np.inf:
            raise ValueError(f"no calibration: temperature {self.temperature_of_one}, correlation {self.correlation}")

    def temperature(self, looks: int) -> float:
        """What the sum of the logits of so many looks is divided by."""
        return self.temperature_of_one * (1 + self.correlation * (looks - 1))

    def threshold(self, risk: float, max_views: int) -> float:
        """The lowest threshold of the belief that promises an error rate, see ``RiskBounds``.

        Raises:
            RiskError: it cannot be promised.
        """
        if self.risk is None:
            raise RiskError("this recogniser promises no error rate; calibrate it with nextview fit calibration")
        return self.risk.threshold(risk, max_views)

    @classmethod
    def of_facts(cls, facts: Mapping[str, Any] | None) -> Calibration:
        """From what a model's card says under "calibration"; the plain sum if it says nothing.

        Raises:
            ValueError: it makes no sense.
        """
        if not facts:
            return cls()
        try:
            risk = facts.get("risk")
            bounds = risk and RiskBounds(tuple(risk["thresholds"]), tuple(map(tuple, risk["bounds"])), risk["delta"])
            return cls(facts["temperature_of_one"], facts["correlation"], bounds)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"a calibration that cannot be read ({type(error).__name__}: {error})") from None

    def facts(self) -> dict[str, Any]:
        """What ``of_facts`` reads, for JSON."""
        facts: dict[str, Any] = {
            "temperature_of_one": self.temperature_of_one,
            "correlation": self.correlation,
        }
        if self.risk is not None:
            r = self.risk
            facts["risk"] = {"delta": r.delta, "thresholds": list(r.thresholds), "bounds": [*map(list, r.bounds)]}
        return facts


PLAIN_SUM = Calibration()
"""Trusts the sum of the logits as it stands, as the thesis did."""


@dataclass(frozen=True)
class Stopping:
    """Stop when the belief's peak reaches a bar, or after ``max_views`` looks.

    The bar is ``threshold`` at the first look. With a ``decline`` it comes down after that: its log-odds are divided by
    ``1 + decline * (looks - 1)``, because what is unclear after several looks is seldom cleared up by another one. The
    plain sum of logits does so unawares: a calibrated belief whose decline is its correlation stops where the sum does.

    Attributes:
        threshold: of the belief.
        max_views: looks at most.
        decline: how fast the bar comes down; 0 keeps it.

    Raises:
        ValueError: a threshold outside 0 .. 1, fewer than one view, or a negative decline.
    """

    threshold: float = 0.97
    max_views: int = 5
    decline: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.threshold <= 1:
            raise ValueError(f"the threshold is a probability between 0 and 1, not {self.threshold}")
        if self.max_views < 1:
            raise ValueError(f"at least one view has to be taken, not {self.max_views}")
        if not 0 <= self.decline < np.inf:
            raise ValueError(f"the decline is a number from 0 on, not {self.decline}")

    def bar(self, looks: NDArray[np.int64] | int) -> NDArray[np.float64]:
        """The belief at which to stop after so many looks, same shape."""
        if self.decline == 0 or self.threshold in (0, 1):
            return np.full(np.shape(looks), float(self.threshold))
        odds = np.log(self.threshold / (1 - self.threshold)) / (1 + self.decline * (np.asarray(looks) - 1))
        return 1 / (1 + np.exp(-odds))
