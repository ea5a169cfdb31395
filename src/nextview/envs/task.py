"""What is to be recognised in an environment, and by which rules."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nextview.arguments import as_line, number, of_kind, whole
from nextview.belief import Calibration, FixedLength, Stopping
from nextview.calibration.rollout import OBJECTIVES
from nextview.errors import UsageError
from nextview.policies.base import Evidence
from nextview.policies.gain import INPUTS, Frame, maps_of, mirrored_features, ordered
from nextview.viewsphere import ViewSphere

Split = Literal["train", "test"]
"""Objects to learn from, or objects to judge by."""

FAR = 100.0
"""Bound of the observation space for what a map network says; the networks of this project stay far below."""


@dataclass(frozen=True)
class Rules:
    """What the agent sees, what it is paid for, and when an episode ends.

    Attributes:
        inputs: what an observation is made of, some of ``policies.gain.INPUTS``: "belief" over all views, "view", what
            the last one alone says, "place", the ring and which views are visited, "azimuth_bin"; and predicted maps by
            name ("lem", "view_area-sphere"). None of it depends on the absolute azimuth.
        frame: from where the azimuths of actions and observations are counted: the camera's, or that at which the
            object is believed to show its azimuth bin 0.
        objective: what is paid: by how much a view changes "right", 1 where the most believed class is the true one, 0
            where not; or the "belief" in the true class, or its "log-belief". The differences of an episode add up to
            the change from the first view to the last (Ng, Harada and Russell, ICML 1999).
        max_views: views at most, the first included, which is not the agent's; at least 2.
        threshold: end an episode when the belief's peak reaches it after the second view or later, and less after more
            (see ``belief.Stopping``); None always takes ``max_views``.
        view_price: taken from the reward for each view.
        travel_price: taken from it for each grid cell of travel.

    Raises:
        UsageError: one of them makes no sense.
    """

    inputs: tuple[str, ...] = ("belief", "view", "place")
    frame: Frame = "camera"
    objective: str = "right"
    max_views: int = 5
    threshold: float | None = None
    view_price: float = 0.0
    travel_price: float = 0.0

    def __post_init__(self) -> None:
        if isinstance(self.inputs, str) or not np.iterable(self.inputs):
            raise UsageError(f"the inputs are a tuple of names, not {as_line(self.inputs)}")
        for word in (*self.inputs, self.frame, self.objective):
            of_kind(word, str, "inputs, frame and objective are names")
        for given, known, what in (
            (self.inputs, (*INPUTS, *self.maps), "an observation"),
            ((self.frame,), get_args(Frame), "the frame"),
            ((self.objective,), OBJECTIVES, "the objective"),
        ):
            unknown = [name for name in given if name not in known]
            if unknown or not len(given):
                other = repr(unknown[0]) if unknown else "nothing"
                raise UsageError(f"{what} is of {', '.join(known)}, not {other}")
        if whole(self.max_views, "the number of views") < 2:
            raise UsageError(
                f"an episode takes at least two views, of which the agent chooses one, not {self.max_views}"
            )
        for name in ("view_price", "travel_price"):
            if not 0 <= number(getattr(self, name), f"the {name}") < np.inf:
                raise UsageError(f"the {name} is a number from 0 on, not {getattr(self, name)}")
        Stopping(0.5 if self.threshold is None else self.threshold)  # says what is wrong with it

    @property
    def maps(self) -> tuple[str, ...]:
        """The maps among the inputs."""
        return maps_of(self.inputs)

    def stopping(self, calibration: Calibration) -> Stopping:
        """The rule that ends episodes, with the decay that the calibration asks for."""
        if self.threshold is None:
            return FixedLength(max_views=self.max_views)
        return AfterAction(self.threshold, self.max_views, calibration.correlation)


def rows(values: Any, n: int, below: int, what: str) -> NDArray[np.int64]:
    """What an agent or a user chose.

    Args:
        values: (n,), or one number for one.
        n: how many.
        below: 0 is the least, this minus 1 the highest.
        what: they are, for the sentence.

    Raises:
        UsageError: they are something else.
    """
    try:
        found = np.atleast_1d(np.asarray(values))
    except ValueError:  # lists of unequal length
        found = np.zeros(0)
    if found.shape != (n,) or found.dtype.kind not in "iu" or not ((found >= 0) & (found < below)).all():
        many = "a whole number" if n == 1 else f"{n} whole numbers"
        raise UsageError(f"{what}: {many} from 0 to {below - 1}, not {as_line(values)}")
    return found.astype(np.int64)


@dataclass(frozen=True)
class AfterAction(Stopping):
    """As ``Stopping``, but never at the first view: an environment has no episode without an action."""

    def threshold_at(self, n_views: NDArray[np.int64] | int) -> NDArray[np.float64]:
        """See ``Stopping``; infinity for one view."""
        return np.where(np.asarray(n_views) < 2, np.inf, super().threshold_at(n_views))


@dataclass(frozen=True)
class Task:
    """N objects, what is seen of them, and the rules.

    Attributes:
        names: of the objects.
        labels: true class of each, (N,) int64.
        classes: their names.
        sphere: the viewpoints.
        calibration: how far what the recogniser says is to be trusted.
        observe: evidence of looking at some objects, (A,), from some views, (A,).
        rules: see ``Rules``.
        balanced: draw every class equally often, whatever its share of the objects.
    """

    names: tuple[str, ...]
    labels: NDArray[np.int64]
    classes: tuple[str, ...]
    sphere: ViewSphere
    calibration: Calibration
    observe: Callable[[NDArray[np.int64], NDArray[np.int64]], Evidence] = field(repr=False)
    rules: Rules = Rules()
    balanced: bool = False

    def __post_init__(self) -> None:
        if self.rules.max_views > len(self.sphere):
            raise UsageError(f"there are {len(self.sphere)} views to take, not {self.rules.max_views}")

    @cached_property
    def _chance(self) -> NDArray[np.float64] | None:
        if not self.balanced:
            return None
        weight = 1 / np.bincount(self.labels)[self.labels]
        return weight / weight.sum()

    def draw(self, n: int, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Objects and first views of ``n`` episodes, each (n,) int64."""
        return rng.choice(len(self.labels), n, p=self._chance), rng.integers(len(self.sphere), size=n)

    def begin(self, options: Any, n: int, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Objects and first views of ``n`` episodes, each (n,) int64: those of the options of ``reset``, else drawn.

        Raises:
            UsageError: there is no such object or view.
        """
        of_kind(options, dict | None, "the options of reset are a dict")
        objects, starts = self.draw(n, rng)
        given = {"object": objects, "start": starts} | (options or {})
        return rows(given["object"], n, len(self.labels), "object"), rows(given["start"], n, len(self.sphere), "start")

    @property
    def observation_space(self) -> gymnasium.spaces.Box:
        """Of the numbers that ``policies.gain.features`` makes, (D,) float32; all but the maps from 0 to 1."""
        c, rules = len(self.classes), self.rules
        widths = {name: len(mirrored_features(self.sphere, c, (name,), rules.frame)) for name in ordered(rules.inputs)}
        high = np.concatenate([np.full(wide, FAR if name in rules.maps else 1.0) for name, wide in widths.items()])
        return gymnasium.spaces.Box(np.where(high > 1, -FAR, 0).astype(np.float32), high.astype(np.float32))

    @property
    def action_space(self) -> gymnasium.spaces.Discrete:
        """Where to go: a ring, and how many azimuth steps ahead: ``ring * azimuths + steps``, V of them."""
        return gymnasium.spaces.Discrete(len(self.sphere))
