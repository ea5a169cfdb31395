"""Policies by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from nextview.policies.base import Policy
from nextview.policies.baselines import Furthest, Random, Unidirectional
from nextview.policies.maps import MapPeak
from nextview.viewsphere import ViewSphere

POLICIES: dict[str, Callable[[ViewSphere, tuple[int, ...]], Policy]] = {
    "random": lambda sphere, valleys: Random(sphere),
    "furthest": lambda sphere, valleys: Furthest(sphere),
    "unidirectional": lambda sphere, valleys: Unidirectional(sphere),
    "lem": lambda sphere, valleys: MapPeak(sphere, "lem", valleys),
    "lem-peak": lambda sphere, valleys: MapPeak(sphere, "lem"),
}


def make_policy(name: str, sphere: ViewSphere, valley_classes: Sequence[int] = ()) -> Policy:
    """A policy by name.

    Args:
        name: one of POLICIES.
        sphere: the viewpoints.
        valley_classes: classes (indices) whose believers go to the map's valley; only "lem" uses it.

    Raises:
        ValueError: there is no such policy.
    """
    if name not in POLICIES:
        raise ValueError(f"no policy is called {name!r}; there are {', '.join(POLICIES)}")
    return POLICIES[name](sphere, tuple(valley_classes))
