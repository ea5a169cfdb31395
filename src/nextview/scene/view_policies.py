"""The policies of a scene: choose the next view of a whole table, by name or by a rule of your own.

A policy is a function of a ``SceneChoice``: what may be looked at next, and what is known now. The
rules of the package are such functions, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from nextview.checks import did_you_mean, one_line, plugin, plugin_errors
from nextview.errors import PolicyError
from nextview.policies.base import nearer_first
from nextview.scene.next_view import (
    Candidates,
    TableGround,
    elsewhere_value,
    ground_value,
    object_value,
)
from nextview.scene.objects import SceneObject
from nextview.scene.state import SceneState
from nextview.sensing.frame import Frame
from nextview.session.system import System
from nextview.types import Float

# of random views, degrees: from there a table is neither seen flat nor straight from above
VIEW_ELEVATIONS = (30.0, 60.0)
QUARTER_TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # about the vertical
UNNAMED_POLICY = "a policy of your own"


@dataclass(frozen=True, eq=False)
class SceneChoice:
    """What a policy of a scene chooses from, and what is known when it chooses.

    There is at least one frame, and at least one view is free.

    Attributes:
        views: the V candidate views: poses, which of them are free, and the way to each.
        state: of the scene after its last frame.
        system: with the taught things.
    """

    views: Candidates
    state: SceneState
    system: System

    @property
    def objects(self) -> tuple[SceneObject, ...]:
        """Objects that were found: names, beliefs, poses, and whether they are settled."""
        return self.state.objects

    @property
    def frames(self) -> tuple[Frame, ...]:
        """Frames so far, with depth and pose, the last one last."""
        return tuple(top.frame for top in self.state.tops)

    @property
    def ground(self) -> TableGround | None:
        """Cells of the table, which of them no frame has shown, and the height of what is on them.

        None if no object was found.
        """
        return self.state.ground

    @cached_property
    def by_object(self) -> dict[int, Float]:
        """Expected information of each view about each object, nats, (V,), by its number.

        Values of views that are not free have no meaning.
        """
        ground = self.ground
        if ground is None:
            return {}
        return {
            one.number: object_value(
                self.state.world,
                one,
                self.state.tops,
                ground,
                self.views,
            )
            for one in self.objects
        }

    @cached_property
    def by_ground(self) -> Float:
        """Expected information of each view about what the hidden ground may hold, nats, (V,)."""
        if self.ground is None:
            return np.zeros(len(self.views.poses))
        return ground_value(
            self.ground,
            len(self.objects),
            len(self.system.classes),
            self.views,
        )

    @cached_property
    def information(self) -> Float:
        """Expected information of each view about the whole scene, nats, (V,).

        The sum of ``by_object`` and ``by_ground``. Without an object it is the distance of a view
        from the earlier views.
        """
        if not self.objects:
            return elsewhere_value(self.state.tops, self.views)
        return np.sum([*self.by_object.values(), self.by_ground], axis=0)


class ScenePolicy(Protocol):
    """Chooses the next view of a scene: a function, or an object with ``__call__``."""

    def __call__(self, choice: SceneChoice, rng: np.random.Generator) -> ArrayLike:
        """Value the candidate views, or choose one.

        Args:
            choice: the candidate views, and what is known now.
            rng: source of all random numbers.

        Returns:
            One value for each view, (V,): the free view with the highest is chosen, the first one
            among equals, and none with the value NaN. Or the row of a free view, an integer.
        """


def most_information(choice: SceneChoice, rng: np.random.Generator) -> Float:
    """Value views by their expected information; of two similar ones, the nearer is better.

    Args:
        choice: the candidate views, and what is known now.
        rng: not used.

    Returns:
        Values, nats, (V,).
    """
    views = choice.views
    best = float(choice.information[views.free].max())
    return nearer_first(choice.information, views.travel, best)


def random_view(choice: SceneChoice, rng: np.random.Generator) -> int:
    """Choose any free view at 30 to 60 degrees elevation; any free one if there is none.

    Args:
        choice: the candidate views.
        rng: source of the choice.

    Returns:
        The row of the view.
    """
    views = choice.views
    low, high = np.sin(np.radians(VIEW_ELEVATIONS))
    usual = (views.directions[:, 2] >= low) & (views.directions[:, 2] <= high)
    some = views.free & usual if (views.free & usual).any() else views.free
    return int(rng.choice(np.flatnonzero(some)))


def quarter_turn(choice: SceneChoice, rng: np.random.Generator) -> Float:
    """Value views by how near they are to a quarter turn ahead, at the same elevation.

    Args:
        choice: the candidate views.
        rng: not used.

    Returns:
        Cosine of the angle to that direction, (V,).
    """
    return choice.views.directions @ QUARTER_TURN @ choice.views.current


INFORMATION_POLICY = "target"  # of Scene.target by default
SCENE_POLICIES: dict[str, ScenePolicy] = {
    INFORMATION_POLICY: most_information,
    "random": random_view,
    "fixed": quarter_turn,
}


@dataclass(frozen=True)
class NamedPolicy:
    """A policy of a scene with its name, for error messages.

    Attributes:
        name: of SCENE_POLICIES, MODULE:NAME, or that of the function or class.
        values: the policy.
    """

    name: str
    values: ScenePolicy

    @classmethod
    def of(cls, policy: str | ScenePolicy | type) -> NamedPolicy:
        """Find a policy by its name, or take one of your own.

        Args:
            policy: a name of SCENE_POLICIES; a function of a ``SceneChoice`` and a random
                generator, or a class whose instances are called like it; or MODULE:NAME of either.
                A class is instantiated without arguments.

        Raises:
            PolicyError: there is no such policy, or it cannot be made or called.
        """
        if isinstance(policy, str) and policy in SCENE_POLICIES:
            return cls(policy, SCENE_POLICIES[policy])
        found: Any = policy
        name = policy if isinstance(policy, str) else _name_of(policy)
        if isinstance(policy, str) and ":" not in policy:
            raise PolicyError(
                f"no policy of a scene is called {policy!r}"
                f"{did_you_mean(policy, SCENE_POLICIES)}; there are"
                f" {', '.join(SCENE_POLICIES)}, and MODULE:NAME for your own"
            )

        with plugin_errors(_cannot_be_made(name)):
            if isinstance(policy, str):
                found = plugin(policy)
            if isinstance(found, type) and not hasattr(found, "next_views"):
                found = found()
        if hasattr(found, "next_views"):
            raise PolicyError(
                f"policy {name} chooses views of a single object (next_views); a policy of a scene"
                " is a function of a SceneChoice"
            )
        if not callable(found):
            raise PolicyError(f"policy {name} is no function, nor a class of such")
        return cls(name, found)

    def ranked(self, choice: SceneChoice, rng: np.random.Generator) -> list[int]:
        """Return the rows of the views, the best first: of the free ones that have a value.

        A policy that chooses a view gives this row alone.

        Args:
            choice: the candidate views, at least one of them free, and what is known now.
            rng: source of the policy's random numbers.

        Raises:
            PolicyError: the policy raises, returns anything but one value for each view or a row,
                or chooses a view that is not free.
        """
        if self.values in SCENE_POLICIES.values():
            said = np.asarray(self.values(choice, rng))
        else:
            with plugin_errors(
                lambda raised: PolicyError(f"policy {self.name} raised {raised}")
            ):
                said = np.asarray(self.values(choice, rng))

        free = choice.views.free
        if said.ndim == 0 and np.issubdtype(said.dtype, np.integer):
            return [self._row(said.item(), free)]
        if said.shape != free.shape or said.dtype.kind not in "fiu":
            raise PolicyError(
                f"policy {self.name} has to return {len(free)} numbers, one for each view, or the"
                f" row of a view, not {said.dtype} of the shape {said.shape}"
            )

        valued = free & ~np.isnan(said)
        if not valued.any():
            raise PolicyError(f"policy {self.name} values every free view as NaN")
        rows = np.flatnonzero(valued)
        order = np.argsort(-said[rows].astype(np.float64), kind="stable")
        return [int(row) for row in rows[order]]

    def _row(self, row: int, free: Any) -> int:
        """Return a row that a policy chose, checked."""
        if not 0 <= row < len(free):
            raise PolicyError(
                f"policy {self.name} chose view {row}; there are {len(free)}"
            )
        if not free[row]:
            raise PolicyError(f"policy {self.name} chose view {row}, which is not free")
        return row


def _name_of(policy: Any) -> str:
    """Return what a function, a class or an object is called in messages."""
    named = getattr(policy, "__name__", None) or type(policy).__name__
    return one_line(str(named)) or UNNAMED_POLICY


def _cannot_be_made(name: str) -> Callable[[str], PolicyError]:
    """Return what makes the error of a policy that cannot be imported or instantiated."""
    return lambda said: PolicyError(f"policy {name} cannot be made ({said})")
