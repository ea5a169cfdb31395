"""A stopping rule of your own: a function of what is believed, in live use and in the benchmark."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nextview.checks import one_line, plugin, plugin_errors
from nextview.errors import UsageError
from nextview.recognition.belief import Stopping
from nextview.types import Float, Floats, Mask


@dataclass(frozen=True)
class Believed:
    """Beliefs of episodes, (...): the input of a stopping rule.

    Attributes:
        belief: in each class, (..., classes).
        n_views: so far, in which anything was seen, (...).
        earlier: beliefs after the views before, the previous one first, each like ``belief``; NaN
            before the first view.
    """

    belief: Floats
    n_views: NDArray | int
    earlier: tuple[Floats, ...] = ()

    def before(self, views: int = 1) -> Floats:
        """The belief so many views ago, (..., classes); NaN before the first view."""
        if 1 <= views <= len(self.earlier):
            return self.earlier[views - 1]
        return np.full(self.belief.shape, np.nan)

    def change(self, views: int = 1) -> Float:
        """Largest change of the belief in a class over the last views, (...); NaN if unknown."""
        return np.asarray(np.abs(self.belief - self.before(views)).max(-1), np.float64)

    @property
    def highest(self) -> Float:
        """The belief in the class believed most, (...)."""
        return np.asarray(self.belief.max(-1), np.float64)

    @property
    def margin(self) -> Float:
        """Its lead over the class believed second most, (...)."""
        if self.belief.shape[-1] == 1:
            return self.highest
        top = np.sort(self.belief, -1)
        return np.asarray(top[..., -1] - top[..., -2], np.float64)

    @property
    def entropy(self) -> Float:
        """Entropy of the belief, bits, (...)."""
        return -np.asarray(
            (self.belief * np.log2(np.maximum(self.belief, 1e-300))).sum(-1),
            np.float64,
        )


Rule = Callable[[Believed, float], Mask]  # whether to stop, (...), by a threshold


@dataclass(frozen=True)
class OwnStopping(Stopping):
    """Stop when a rule of the user says so, or after ``max_views`` views.

    UsageError is raised where the rule fails.

    Attributes:
        rule: decides from the belief whether to stop.
        name: of the rule, for messages.
        threshold: passed to the rule.
        max_views: largest number of views.
        threshold_decay: see ``Stopping``; not used.
    """

    rule: Rule | None = None
    name: str = "a rule of your own"

    def reached(self, belief: Floats, n_views: NDArray | int) -> Mask:
        """Return what the rule decides.

        Args:
            belief: (..., classes).
            n_views: number of views that each is based on, (...).

        Returns:
            Whether to stop, (...) bool.

        Raises:
            UsageError: the rule raises, or returns another type or shape.
        """
        return self._said(Believed(belief, n_views))

    def reached_along(self, beliefs: Floats, n_views: NDArray) -> Mask:
        """Return what the rule decides at each step, with the beliefs before it.

        Args:
            beliefs: after each step, (..., steps, classes).
            n_views: number of views that each is based on, (..., steps).

        Returns:
            Whether to stop, (..., steps) bool.

        Raises:
            UsageError: the rule raises, or returns another type or shape.
        """
        earlier = []
        for k in range(1, beliefs.shape[-2]):
            shifted = np.full(beliefs.shape, np.nan)
            shifted[..., k:, :] = beliefs[..., :-k, :]
            earlier.append(shifted)
        return self._said(Believed(beliefs, n_views, tuple(earlier)))

    def _said(self, believed: Believed) -> Mask:
        """What the rule decides, checked."""
        assert self.rule is not None
        belief = believed.belief
        with plugin_errors(
            lambda said: UsageError(f"the stopping rule {self.name} raised {said}")
        ):
            said = np.asarray(self.rule(believed, self.threshold))
        if said.dtype != bool or said.shape != belief.shape[:-1]:
            wanted = f"bool of the shape {belief.shape[:-1]}, not {said.dtype} of {said.shape}"
            raise UsageError(f"the stopping rule {self.name} has to return {wanted}")
        return said

    def threshold_at(self, n_views: NDArray | int) -> Float:
        """Infinity, same shape: what the rule makes of its threshold is not known."""
        return np.full(np.shape(n_views), np.inf)

    def __str__(self) -> str:
        return f"{self.name} at {self.threshold:.3g}"


def own_stopping(rule: Rule | str, threshold: float, max_views: int) -> Stopping:
    """Create a stopping rule from a function of your own.

    Args:
        rule: a function of ``Believed`` and the threshold, or MODULE:NAME of a function or of a
            kind of ``Stopping``.
        threshold: that the rule is called with.
        max_views: largest number of views of an episode.

    Returns:
        The stopping rule.

    Raises:
        UsageError: the rule cannot be imported, or is not a function.
    """
    found: Any = rule
    name = (
        rule
        if isinstance(rule, str)
        else getattr(rule, "__name__", "a rule of your own")
    )

    if isinstance(rule, str):
        if ":" not in rule:
            raise UsageError(
                f"a stopping rule of your own is named MODULE:NAME, not {one_line(repr(rule))}"
            )
        with plugin_errors(
            lambda said: UsageError(f"the stopping rule {rule} cannot be made ({said})")
        ):
            found = plugin(rule)

    if isinstance(found, type) and issubclass(found, Stopping):
        return found(threshold, max_views)
    if not callable(found):
        raise UsageError(f"the stopping rule {name} is no function")
    return OwnStopping(threshold, max_views, rule=found, name=name)
