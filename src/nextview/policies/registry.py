"""Create policies by name, or by the import path of a user's own class."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from nextview.checks import did_you_mean, one_line, plugin, plugin_errors, plugins
from nextview.errors import OtherUseError, PolicyError
from nextview.geometry.viewsphere import Viewpoints, ViewSphere
from nextview.policies.base import Policy
from nextview.policies.baselines import (
    Furthest,
    MostVisible,
    Random,
    RandomAll,
    Spread,
    Unidirectional,
)
from nextview.policies.discriminate_geometry import DiscriminateGeometry
from nextview.policies.gain import Gain, VisibleGain
from nextview.policies.maps import MapPeak, SpherePeak
from nextview.policies.policy_card import (
    bundled_policies,
    read_policy,
    read_policy_card,
)
from nextview.recognition.map_names import SPHERE_SUFFIX, in_order
from nextview.recognition.model_card import DISCRIMINATE, MAPS, is_memory
from nextview.things.memory import open_memory

# policies without a map; for maps see ``map_policy``
POLICIES: dict[str, Callable[[Any], Policy]] = {
    "random": Random,
    "random-all": RandomAll,
    "furthest": Furthest,
    "unidirectional": Unidirectional,
    "spread": Spread,
    "spread-local": lambda sphere: Spread(sphere, "local"),
    "visibility": MostVisible,
}
# entry points with which other packages add policies
POLICY_ENTRY_POINTS = "nextview.policies"
ANYWHERE = ("random-all", "spread", "visibility")  # policies that need no grid
# prefix of a gain policy whose values are multiplied by the expected visible share
VISIBLE = "visible-"
DEFAULT_POLICY = "gain"


def make_policy(
    name: str,
    sphere: Viewpoints,
    valley_classes: Sequence[int] = (),
    classes: Sequence[str] | None = None,
    maps: Collection[str] = (),
) -> Policy:
    """Create a policy by name.

    The name is one of POLICIES; the name of a map ("lem", "lem-peak", "lem-sphere-peak", see
    ``map_policy``); a bundled learned policy; the path of a learned policy's card (.json); a gain
    policy with the prefix "visible-"; a policy of an installed package; or "MODULE:CLASS" for your
    own class, which is called with the viewpoints only. NAME@WEIGHT sets the travel weight.

    Args:
        name: of the policy.
        sphere: the candidate views; a ``ViewSphere`` except for policies in ANYWHERE and your own.
        valley_classes: indices of the classes for which a map policy goes to the valley.
        classes: names of the recogniser's classes; a learned policy for other classes is rejected.
            None to skip the check.
        maps: names of maps that are predicted in addition to those of the bundled networks.

    Returns:
        The policy.

    Raises:
        PolicyError: there is no such policy, or it cannot be created.

    Example:

        >>> make_policy("random-all", ViewSphere.named("40")).needs
        ()
    """
    if "@" in name and ":" not in name:
        plain, _, travel_weight = name.partition("@")
        return _at_travel_weight(
            make_policy(plain, sphere, valley_classes, classes, maps),
            name,
            travel_weight,
        )

    if _on_grid(name, maps) and not isinstance(sphere, ViewSphere):
        raise PolicyError(f"policy {name} needs viewpoints on rings")
    if name in POLICIES:
        return POLICIES[name](sphere)

    by_map = map_policy(name, sphere, valley_classes, maps)
    if by_map is not None:
        return by_map

    card = _card(name)
    if card is not None and is_memory(card):
        return _of_memory(card, sphere, None if classes is None else tuple(classes))
    if card is not None:
        policy = read_policy(card, sphere, classes)
        if not name.startswith(VISIBLE):
            return policy
        if not isinstance(policy, Gain):
            raise PolicyError(
                f"{name}: this policy does not value views, so their visibility cannot be weighed"
            )
        return VisibleGain(policy, policy.travel_weight)

    path = plugins(POLICY_ENTRY_POINTS).get(name, name)
    if ":" in path:
        return _import_policy(path, sphere)

    if name == DISCRIMINATE:
        raise PolicyError(
            "the policy discriminate is for taught things: models ycb, or those of nextview learn"
        )
    if name.startswith(("true-", "oracle-", "best-", "worst-")) or name.endswith(
        "-oracle-valley"
    ):
        raise PolicyError(
            f"{name} uses information that no robot has, so it runs only in nextview-lab benchmark"
        )

    known = [
        *policy_names(),
        *map_policy_names(maps),
        *bundled_policies(),
        f"{VISIBLE}{DEFAULT_POLICY}",
    ]
    raise PolicyError(
        "no policy is called"
        f" {name!r}{did_you_mean(name, known) or '; there are ' + ', '.join(known)}"
    )


def make_policy_anywhere(
    name: str,
    viewpoints: Viewpoints,
    valley_classes: Sequence[int] = (),
    classes: Sequence[str] | None = None,
    maps: Collection[str] = (),
) -> Policy:
    """Create a policy by name for live use with any viewpoints; see ``policies.off_grid``.

    Args:
        name: of the policy, as for ``make_policy``.
        viewpoints: the candidate views.
        valley_classes: indices of the classes for which a map policy goes to the valley.
        classes: names of the recogniser's classes; None to skip the check.
        maps: names of maps that are predicted in addition to those of the bundled networks.

    Returns:
        The policy.

    Raises:
        PolicyError: there is no such policy, or it cannot be created.
    """
    card = _card(name.partition("@")[0])
    if card is not None and not is_memory(card):
        about = read_policy_card(card)
        viewpoints = ViewSphere(about.elevations, about.azimuths)
    elif _on_grid(name, maps) and not isinstance(viewpoints, ViewSphere):
        viewpoints = ViewSphere.named("40")
    return make_policy(name, viewpoints, valley_classes, classes, maps)


def policy_names() -> list[str]:
    """Return POLICIES and the policies of installed packages."""
    return [*POLICIES, *plugins(POLICY_ENTRY_POINTS)]


def _card(name: str) -> Path | None:
    """Return the card of a learned policy, with or without "visible-"; None if there is none."""
    card = name.removeprefix(VISIBLE)
    return Path(card) if card.endswith(".json") else bundled_policies().get(card)


def _on_grid(name: str, maps: Collection[str]) -> bool:
    """Return True if a policy needs rings and neighbours."""
    return (name in POLICIES and name not in ANYWHERE) or map_policy(
        name,
        None,
        (),
        maps,
    ) is not None


def map_policy(
    name: str,
    sphere: Any,
    valley_classes: Sequence[int],
    maps: Collection[str],
) -> Policy | None:
    """Create the policy that climbs a predicted map.

    Args:
        name: "MAP", "MAP-peak" or "MAP-sphere-peak".
        sphere: the candidate views.
        valley_classes: indices of the classes for which it goes to the valley.
        maps: names of maps that are predicted in addition to those of the bundled networks.

    Returns:
        The policy; None if the name is not that of a map policy.
    """
    of = name.removesuffix("-peak")
    window = of.removesuffix(SPHERE_SUFFIX)
    always = of != name
    if window not in (*MAPS, *maps) or (of != window and not always):
        return None
    return (
        MapPeak(sphere, of, () if always else tuple(valley_classes))
        if of == window
        else SpherePeak(sphere, of)
    )


def map_policy_names(maps: Collection[str]) -> list[str]:
    """Return the policies that climb these maps and those of the bundled networks."""
    windows = dict.fromkeys(
        name.removesuffix(SPHERE_SUFFIX) for name in in_order((*MAPS, *maps))
    )
    return [
        f"{name}{how}"
        for name in windows
        for how in ("", "-peak", f"{SPHERE_SUFFIX}-peak")
    ]


def with_cards(name: str, cards: Mapping[str, Path]) -> str:
    """Replace the name of a policy by the path of its card.

    The name may have the prefix "visible-" and the suffix "@WEIGHT".

    Args:
        name: of a policy.
        cards: paths of cards by the name of their policy.

    Returns:
        The name with the path in it; the name itself if it is not among the cards.
    """
    policy, weighted, travel_weight = name.partition("@")
    if policy in cards:
        return f"{cards[policy]}{weighted}{travel_weight}"
    card = (
        cards.get(policy.removeprefix(VISIBLE)) if policy.startswith(VISIBLE) else None
    )
    return name if card is None else f"{VISIBLE}{card}{weighted}{travel_weight}"


def _of_memory(
    card: Path,
    sphere: Viewpoints,
    classes: tuple[str, ...] | None,
) -> Policy:
    """Return the policy for a memory."""
    about, _ = open_memory(card)
    if classes is not None and about.classes != classes:
        known = ", ".join(about.classes[:10])
        raise OtherUseError(f"{card}: discriminates other things ({known})")
    return DiscriminateGeometry(sphere)


def _at_travel_weight(policy: Policy, name: str, travel_weight: str) -> Policy:
    if not isinstance(
        policy,
        DiscriminateGeometry | Gain | MostVisible | VisibleGain,
    ):
        raise PolicyError(f"{name}: this policy does not weigh travel")
    try:
        return replace(policy, travel_weight=float(travel_weight))
    except ValueError:
        raise PolicyError(
            f"{name}: a travel weight is a number of at least 0"
        ) from None


def _import_policy(path: str, sphere: Viewpoints) -> Policy:
    with plugin_errors(
        lambda said: PolicyError(f"policy {path} cannot be made ({said})")
    ):
        policy = plugin(path)(sphere)

    for part in ("next_views", "needs"):
        if not hasattr(policy, part):
            raise PolicyError(
                f"policy {path} has no {part}; see nextview.policies.base.Policy"
            )

    if not isinstance(policy.needs, tuple | list) or not all(
        isinstance(need, str) for need in policy.needs
    ):
        raise PolicyError(
            f"policy {path}: its needs are a tuple of names, not {one_line(repr(policy.needs))}"
        )

    return policy
