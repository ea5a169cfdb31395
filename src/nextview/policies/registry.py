"""Policies by name, or by the import path of a user's own."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nextview.arguments import as_line, of_kind
from nextview.errors import PolicyError
from nextview.measures.map_names import SPHERE, in_order
from nextview.models.inference import MAPS
from nextview.occupancy import new_surface, new_volume
from nextview.own_code import import_own, own_code
from nextview.policies.base import Policy
from nextview.policies.baselines import Furthest, Random, RandomAll, Unidirectional
from nextview.policies.gain import Gain
from nextview.policies.maps import MapPeak, SpherePeak
from nextview.policies.policy_card import bundled_policies, read_policy, read_policy_card
from nextview.policies.spread import Spread
from nextview.policies.visibility import Visibility, VisibleGain
from nextview.policies.volumetric import Volumetric
from nextview.viewsphere import Viewpoints, ViewSphere

POLICIES: dict[str, Callable[[Any], Policy]] = {
    "random": Random,
    "random-all": RandomAll,
    "furthest": Furthest,
    "unidirectional": Unidirectional,
    "spread": Spread,
    "spread-local": lambda sphere: Spread(sphere, "local"),
    "volumetric": lambda sphere: Volumetric(sphere, new_volume),
    "coverage": lambda sphere: Volumetric(sphere, new_surface),
    "visibility": Visibility,
}
"""Those that follow no map; every predicted map has its own, see ``map_policy``."""

ANYWHERE = ("random-all", "spread", "volumetric", "coverage", "visibility")
"""Those that ask for no grid."""

VISIBLE = "visible-"
"""Before the name of a learned policy: its values times the share of the object that is expected to show."""

DEFAULT = "gain"
"""The policy where none is named."""


def make_policy(
    name: str,
    sphere: Viewpoints,
    valley_classes: Sequence[int] = (),
    classes: Sequence[str] | None = None,
    maps: Collection[str] = (),
) -> Policy:
    """A policy by name.

    Args:
        name: one of POLICIES, one by a map ("view_area", "view_area-peak", "view_area-sphere-peak", see
            ``map_policy``), a learned one that is bundled, the path of a learned one's card (.json), the same with
            "visible-" before it (a gain policy, times what shows), or "module:Class" for one of your own, which is
            called with the sphere alone. One that weighs travel takes another travel weight as NAME@WEIGHT.
        sphere: the viewpoints; a ``ViewSphere`` but for those of ANYWHERE and your own.
        valley_classes: classes (indices) whose believers go to the map's valley.
        classes: names of the recogniser's classes; a learned policy for others is refused.
        maps: names of the maps that are predicted, beside those of the bundled networks.

    Raises:
        PolicyError: there is no such policy, or it cannot be made.
    """
    of_kind(name, str, "a policy is a name", PolicyError)
    of_kind(sphere, Viewpoints, "the viewpoints of a policy are a ViewSphere or Directions", PolicyError)
    if not np.iterable(valley_classes) or not (classes is None or np.iterable(classes)):
        raise PolicyError(f"classes are a list of them, not {as_line(valley_classes)} and {as_line(classes)}")
    if "@" in name and ":" not in name:
        card, _, travel_weight = name.partition("@")
        return _at_travel_weight(make_policy(card, sphere, valley_classes, classes, maps), name, travel_weight)
    learned = bundled_policies()
    if name.startswith(VISIBLE):
        card = name.removeprefix(VISIBLE)
        if card in learned or card.endswith(".json"):
            return _visible(read_policy(learned.get(card, Path(card)), sphere, classes), name)
    if name in POLICIES:
        if name not in ANYWHERE and not isinstance(sphere, ViewSphere):
            raise PolicyError(f"policy {name} needs viewpoints on rings")
        return POLICIES[name](sphere)
    by_map = map_policy(name, sphere, valley_classes, maps)
    if by_map is not None:
        if not isinstance(sphere, ViewSphere):
            raise PolicyError(f"policy {name} needs viewpoints on rings")
        return by_map
    if name in learned or name.endswith(".json"):
        return read_policy(learned.get(name, Path(name)), sphere, classes)
    if ":" in name:
        return _import_policy(name, sphere)
    known = [*POLICIES, *map_policy_names(maps), *learned, f"{VISIBLE}{DEFAULT}"]
    raise PolicyError(f"no policy is called {name!r}; there are {', '.join(known)}")


def map_policy(name: str, sphere: Any, valley_classes: Sequence[int], maps: Collection[str]) -> Policy | None:
    """The policy that climbs a predicted map; None if the name is not that of one.

    MAP goes to the peaks of the local window, and to its valleys for the valley classes; MAP-peak always to the peaks;
    MAP-sphere-peak to those of the whole sphere. Arguments as for ``make_policy``.
    """
    of = name.removesuffix("-peak")
    window, always = of.removesuffix(SPHERE), of != name
    if window not in (*MAPS, *maps) or (of != window and not always):
        return None
    return MapPeak(sphere, of, () if always else tuple(valley_classes)) if of == window else SpherePeak(sphere, of)


def map_policy_names(maps: Collection[str]) -> list[str]:
    """Names of the policies that climb these maps and those of the bundled networks."""
    windows = dict.fromkeys(name.removesuffix(SPHERE) for name in in_order((*MAPS, *maps)))
    return [f"{name}{how}" for name in windows for how in ("", "-peak", f"{SPHERE}-peak")]


def with_cards(name: str, cards: Mapping[str, Path]) -> str:
    """The name, or what it means where it is that of one of these cards: also after "visible-" and before "@WEIGHT"."""
    policy, weighted, travel_weight = name.partition("@")
    if policy in cards:
        return f"{cards[policy]}{weighted}{travel_weight}"
    card = cards.get(policy.removeprefix(VISIBLE)) if policy.startswith(VISIBLE) else None
    return name if card is None else f"{VISIBLE}{card}{weighted}{travel_weight}"


def make_policy_anywhere(
    name: str,
    viewpoints: Viewpoints,
    valley_classes: Sequence[int] = (),
    classes: Sequence[str] | None = None,
    maps: Collection[str] = (),
) -> Policy:
    """A policy by name for live use, whatever the viewpoints: see ``policies.off_grid``.

    One that was learned on a grid is made for that, the baselines that know neighbours for the 40 views where the
    viewpoints are on no grid, and all others for the viewpoints. Arguments and errors as for ``make_policy``.
    """
    card = name.partition("@")[0].removeprefix(VISIBLE)
    path = bundled_policies().get(card, Path(card) if card.endswith(".json") else None)
    if path is not None:
        about = read_policy_card(path)
        return make_policy(name, ViewSphere(about.elevations, about.azimuths), valley_classes, classes)
    on_grid = (name in POLICIES and name not in ANYWHERE) or map_policy(name, viewpoints, (), maps) is not None
    if on_grid and not isinstance(viewpoints, ViewSphere):
        return make_policy(name, ViewSphere.named("40"), valley_classes, classes, maps)
    return make_policy(name, viewpoints, valley_classes, classes, maps)


def _visible(policy: Policy, name: str) -> Policy:
    if not isinstance(policy, Gain):
        raise PolicyError(f"{name}: this policy values no views that could be weighed by what shows")
    return VisibleGain(policy, policy.travel_weight)


def _at_travel_weight(policy: Policy, name: str, travel_weight: str) -> Policy:
    if not isinstance(policy, Gain | Visibility | VisibleGain):
        raise PolicyError(f"{name}: this policy does not weigh travel")
    try:
        return replace(policy, travel_weight=float(travel_weight))
    except ValueError:
        raise PolicyError(f"{name}: a travel weight is a number of at least 0") from None


def _import_policy(path: str, sphere: Viewpoints) -> Policy:
    with own_code(lambda said: PolicyError(f"policy {path} cannot be made ({said})")):
        policy = import_own(path)(sphere)
        getattr(policy, "needs", None)  # may be code, too
    for part in ("next_views", "needs"):
        if not hasattr(policy, part):
            raise PolicyError(f"policy {path} has no {part}; see nextview.policies.base.Policy")
    if not isinstance(policy.needs, tuple | list) or not all(isinstance(need, str) for need in policy.needs):
        raise PolicyError(f"policy {path}: its needs are a tuple of names, not {as_line(policy.needs)}")
    return policy
