"""Compare policies by ratios of sums over objects: numbers, without tables of pandas."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from nextview.types import Float, Index
from nextview_lab.benchmark import statistics as st

# significance level of differences after Holm's correction
SIGNIFICANT = 0.05


class Key(NamedTuple):
    """Identifies a number.

    Attributes:
        policy: its name.
        threshold: of the belief, at which episodes stop; None without a threshold.
        views: number of views; 0 for whole episodes.
        measure: its name.
    """

    policy: str
    threshold: float | None
    views: int
    measure: str


class Difference(NamedTuple):
    """The difference of a policy to a reference policy in one measure.

    Attributes:
        key: the policy and the measure.
        value: of the difference.
        low: end of its 95 % bootstrap interval.
        high: end of its 95 % bootstrap interval.
        p: p-value of a sign-flip test over families.
    """

    key: Key
    value: float
    low: float
    high: float
    p: float


@dataclass(frozen=True, eq=False)
class Sums:
    """M measures of policies on N objects, each a ratio of sums over the objects.

    Attributes:
        keys: of the measures.
        top: numerators, (N, M) float64.
        bottom: denominators, (N, M) float64.
        families: family index of each object, (N,) int64; families are resampled as a whole.
    """

    keys: tuple[Key, ...]
    top: Float
    bottom: Float
    families: Index

    @classmethod
    def of(
        cls,
        sums: Mapping[Key, tuple[Float, Float]],
        families: Index,
    ) -> Self:
        """Combine numerators and denominators, (N,) each, as columns.

        Args:
            sums: of each measure.
            families: family index of each object, (N,).
        """
        tops, bottoms = zip(*sums.values(), strict=True)
        return cls(tuple(sums), np.stack(tops, 1), np.stack(bottoms, 1), families)

    def only(self, measures: Sequence[str]) -> Self:
        """Select measures by name."""
        kept = [i for i, key in enumerate(self.keys) if key.measure in measures]
        keys = tuple(self.keys[i] for i in kept)
        return replace(
            self, keys=keys, top=self.top[:, kept], bottom=self.bottom[:, kept]
        )

    @property
    def family_count(self) -> int:
        """Number of families of objects."""
        return int(self.families.max()) + 1

    def estimates(
        self, weights: Float, labels: Index | None = None
    ) -> dict[Key, tuple[float, float, float]]:
        """Return each measure with the limits of its interval.

        Args:
            weights: bootstrap weight of each object in each sample, (S, N).
            labels: class of each object, (N,), for means over classes; None for sums over objects.
        """
        value, drawn = st.estimate(self.top, self.bottom, weights, labels)
        numbers = np.stack([value, *st.interval(drawn)], 1).tolist()
        return dict(zip(self.keys, map(tuple, numbers), strict=True))

    def differences(
        self, weights: Float, reference: str, tested: Callable[[Key], bool]
    ) -> list[Difference]:
        """Return the differences to a reference policy.

        Args:
            weights: bootstrap weight of each object in each sample, (S, N).
            reference: the policy; its measures have the same denominators.
            tested: selects the measures to compare.
        """
        place = {key: i for i, key in enumerate(self.keys)}
        pairs = [
            (place[key], place[rival])
            for key in self.keys
            if key.policy != reference and tested(key)
            if (rival := key._replace(policy=reference)) in place
        ]
        if not pairs:
            return []

        own, theirs = np.array(pairs).T
        apart = self.top[:, own] - self.top[:, theirs]
        value, drawn = st.estimate(apart, self.bottom[:, own], weights)
        p = st.sign_flip_p(st.by_family(apart, self.families))
        numbers = np.stack([value, *st.interval(drawn), p], 1).tolist()
        return [
            Difference(self.keys[i], *number)
            for i, number in zip(own, numbers, strict=True)
        ]


def too_few_families(families: int, tests: int) -> str | None:
    """Return a warning if no difference could be significant; None if one could.

    Args:
        families: number of families of objects.
        tests: that are corrected together.
    """
    # two-sided sign flips of n families have p-values of 2^(1 - n) and more
    wanted = families
    while wanted < st.EXACT_FAMILIES and tests * 2.0 ** (1 - wanted) >= SIGNIFICANT:
        wanted += 1
    if wanted == families:
        return None
    return (
        f"Too few to tell: no p-value of {families} is below {2.0 ** (1 - families):.2g},"
        f" and {tests} tests are corrected together, so that no difference can be"
        f" significant; it takes {wanted} or more."
    )
