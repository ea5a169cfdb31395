"""Who can take part in the benchmark, by name: policies, oracles, fixed views, and a user's own."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_softmax

from nextview.benchmark.stored import stored_rows
from nextview.benchmark.true_maps import TRUE, known_maps, true_measure
from nextview.data.predictions import Predictions
from nextview.data.world_sight import WorldSight
from nextview.errors import EntryError, OtherUseError
from nextview.measures.map_names import LCM, LEM, SPHERE, in_order
from nextview.policies.base import Policy, Scope
from nextview.policies.fixed import ViewList, orbit, ranked
from nextview.policies.maps import MapPeak
from nextview.policies.oracle import OracleGain, OracleMeasure, OracleValley
from nextview.policies.policy_card import bundled_policies
from nextview.policies.registry import DEFAULT, POLICIES, VISIBLE, make_policy, map_policy, map_policy_names


@dataclass(frozen=True)
class EpisodeSpecs:
    """The E episodes that every entry has to go through: the same objects from the same first views.

    Attributes:
        predictions: what the models say, and the truth.
        objects: row of each episode's object, (E,) int64.
        starts: first view of each, (E,) int64.
        valleys: classes (indices) for which the valley of a map is taken to be the better view, of every map; None for
            those that each map's card names.
        worlds: that the objects stand in; None if they stand alone.
    """

    predictions: Predictions
    objects: NDArray[np.int64]
    starts: NDArray[np.int64]
    valleys: tuple[int, ...] | None = None
    worlds: WorldSight | None = None

    @property
    def labels(self) -> NDArray[np.int64]:
        """True class of each episode's object, (E,) int64."""
        return self.predictions.labels[self.objects]

    def valley_classes(self, map_name: str) -> tuple[int, ...]:
        """Classes (indices) for which the valley of a map is taken to be the better view."""
        if self.valleys is not None:
            return self.valleys
        named, classes = self.predictions.valley_classes.get(map_name, ()), self.predictions.classes
        return tuple(classes.index(name) for name in named if name in classes)


ORACLES: dict[str, Callable[[EpisodeSpecs], Policy]] = {
    "oracle-valley": lambda t: _oracle(t, "", LEM, "-oracle-valley"),
    f"{TRUE}{LEM}": lambda t: _oracle(t, TRUE, LEM, ""),
    f"{TRUE}{LEM}-peak": lambda t: _oracle(t, TRUE, LEM, "-peak"),
    f"{TRUE}oracle-valley": lambda t: _oracle(t, TRUE, LEM, "-oracle-valley"),
    f"{LCM}-oracle-valley": lambda t: _oracle(t, "", LCM, "-oracle-valley"),
    f"{TRUE}{LCM}": lambda t: _oracle(t, TRUE, LCM, "-peak"),
    "oracle-gain": lambda t: _gain(t, "local"),
    "oracle-gain-all": lambda t: _gain(t, "global"),
}
"""Policies that are told the truth, or climb the true map, and are always compared: the thesis's, under its names, and
the ceiling. Every map has such, see ``MAP_ORACLE``."""

MAP_ORACLE = re.compile(r"(true-)?(.+?)(-peak|-oracle-valley)?")
"""Oracles by a map. "true-MAP" climbs the true one: to its peaks, or to its valleys for some classes, by the belief;
"true-MAP-peak" always to its peaks. With "-oracle-valley" the true class decides, of the predicted map too."""

MORE = f"{LEM}{SPHERE}-peak"
"""A rival from the literature, by Parisotto et al., see ``maps.SpherePeak``: the only one by a map of the whole sphere
that is always compared."""

FIXED = {
    "best": "the views in which the true class has the most confidence",
    "worst": "those in which it has the least",
    "high-entropy": "the views with the highest true depth-entropy",
    "low-entropy": "those with the lowest",
    "random-fixed": "any views",
    "orbit": "round the ring of the first view, then the next ring",
}
"""Fixed views by name, to be followed by how many: "best-5", "orbit-8". They go on to the end whatever is believed."""
TRUE_MEASURE = re.compile(r"true-([a-z0-9_]+)-all(-peak)?")
"""Oracles by the true value of any measure in the view store, over all views: "true-NAME-all" goes to the highest
unvisited view, "true-NAME-all-peak" to the peaks of its map first. "true-NAME-K" are fixed views: the K highest."""


def is_oracle(policy: str) -> bool:
    """Whether a policy takes what a robot cannot know."""
    return policy in ORACLES or policy.startswith(TRUE) or policy.endswith("-oracle-valley")


def _gain(t: EpisodeSpecs, scope: Scope) -> Policy:
    p, said = t.predictions, t.predictions.log_evidence
    if t.worlds is not None and p.calibration.visibility is not None:
        said = said * np.asarray(p.calibration.weights(t.worlds.all_shown()))[..., None]
    return OracleGain(p.sphere, said, len(p.classes), p.labels, t.objects, scope, p.calibration)


IN_WORLDS = ("visibility", f"{VISIBLE}{DEFAULT}", "true-visible_share-all")
"""Entries that make a difference only where things hide an object."""


def default_entries(specs: EpisodeSpecs) -> list[str]:
    """All that these predictions allow. Fixed views do not ask what can be reached, so worlds have none."""
    sphere = specs.predictions.sphere
    n, v = sphere.azimuths, len(sphere)
    maps = [name for name in in_order(specs.predictions.maps) if not name.endswith(SPHERE)]
    names = [*POLICIES, *(each for name in maps for each in (name, f"{name}-peak")), MORE]
    names = [*names, *(name for name in bundled_policies() if _fits(name, specs)), *ORACLES]
    among = [name for name in IN_WORLDS if not name.startswith(VISIBLE) or _fits(name, specs)]
    names = [*(name for name in names if name not in IN_WORLDS), *(among if specs.worlds is not None else [])]
    names = [name for name in names if _ready(name, specs)]
    if specs.worlds is not None:
        return names
    names += [f"{kind}-{min(5, v)}" for kind in FIXED if kind != "orbit"]
    return names + [f"orbit-{k}" for k in sorted({n, v})]


def entry_policy(name: str, specs: EpisodeSpecs) -> Policy:
    """The policy of that name.

    Raises:
        EntryError: there is none, it cannot be made, or it needs a map that the predictions lack, or a measure or a
            plan that the view store lacks.
    """
    policy = _make(name, specs)
    if "observations" in policy.needs:  # predictions hold no depth; where it leads to is planned
        return ViewList(stored_rows(specs.predictions, f"plans/{name}")[specs.objects, specs.starts].astype(np.int64))
    lacking = _lacking(policy, specs)
    if lacking:
        what = (
            "what the recogniser says of the azimuth bins"
            if lacking[0] == "azimuth_bins"
            else f"the map {lacking[0]!r}"
        )
        raise EntryError(f"policy {name} needs {what}, which these predictions lack")
    return policy


def _make(name: str, specs: EpisodeSpecs) -> Policy:
    if name in ORACLES:
        return ORACLES[name](specs)
    if true := TRUE_MEASURE.fullmatch(name):
        values = true_measure(specs.predictions, true[1])[specs.objects].astype(np.float64)
        return OracleMeasure(specs.predictions.sphere, values, true[2] == "-peak")
    p, plain = specs.predictions, name.partition("@")[0]
    by_map = _map_oracle(name, specs)
    if by_map is not None:
        return by_map
    known = plain in POLICIES or map_policy(plain, p.sphere, (), p.maps) is not None
    card = plain.removeprefix(VISIBLE)
    if known or card in bundled_policies() or card.endswith(".json") or ":" in name:
        return make_policy(name, p.sphere, specs.valley_classes(plain), p.classes, p.maps)
    names = [*POLICIES, *map_policy_names(p.maps), *bundled_policies(), *ORACLES]
    names += ["true-MEASURE-all", *(f"{kind}-K" for kind in FIXED)]
    raise EntryError(f"no policy is called {name!r}; there are {', '.join(names)}")


def _map_oracle(name: str, specs: EpisodeSpecs) -> Policy | None:
    """The oracle of that name, see ``MAP_ORACLE``; None if it is none, or its map is not known."""
    match, p = MAP_ORACLE.fullmatch(name), specs.predictions
    true, of, how = match.groups("") if match else ("", "", "")
    predicted = [name for name in p.maps if how == "-oracle-valley" and not name.endswith(SPHERE)]
    return _oracle(specs, true, of, how) if of in (known_maps(p) if true else predicted) else None


def _oracle(t: EpisodeSpecs, true: str, of: str, how: str) -> Policy:
    """The oracle by a map, the true one where ``true`` is TRUE; ``how`` ends its name."""
    sphere, valleys = t.predictions.sphere, t.valley_classes(of)
    if how == "-oracle-valley":
        return OracleValley(sphere, t.labels, valleys, true + of)
    return MapPeak(sphere, true + of, () if how == "-peak" else valleys)


def _ready(name: str, specs: EpisodeSpecs) -> bool:
    """Whether the predictions, and the view store behind them, hold what an entry needs."""
    try:
        entry_policy(name, specs)
    except EntryError:
        return False
    return True


def _fits(name: str, specs: EpisodeSpecs) -> bool:
    """Whether a bundled policy was learned for these viewpoints and classes."""
    try:
        _make(name, specs)
    except OtherUseError:
        return False
    return True


def _lacking(policy: Policy, specs: EpisodeSpecs) -> list[str]:
    p = specs.predictions
    there = {
        *p.maps,
        *(TRUE + name for name in known_maps(p)),
        *(["azimuth_bins"] if p.azimuth_bins is not None else []),
        "visibility",
    }
    return [wanted for wanted in policy.needs if wanted not in there]


def fixed_views(name: str, specs: EpisodeSpecs, rng: np.random.Generator) -> NDArray[np.int64] | None:
    """The views of each episode in order, (E, k) int64; None if the name is not one of fixed views."""
    match = re.fullmatch(rf"({'|'.join([*FIXED, 'true-[a-z0-9_]+'])})-(\d+)", name)
    if not match:
        return None
    p, objects, kind, k = specs.predictions, specs.objects, match[1], int(match[2])
    if not 1 <= k <= len(p.sphere):
        raise EntryError(f"{name}: the sphere has {len(p.sphere)} views, so between 1 and {len(p.sphere)} can be taken")
    if kind == "orbit":
        return orbit(p.sphere, specs.starts, k)
    if kind == "random-fixed":
        return ranked(rng.random((len(objects), len(p.sphere))), k)
    if kind.startswith("true-"):
        return ranked(true_measure(p, kind.removeprefix(TRUE)).astype(np.float64), k)[objects]
    if kind in ("high-entropy", "low-entropy"):
        values = p.depth_entropy.astype(np.float64)
    else:
        values = log_softmax(p.logits.astype(np.float64), axis=2)[np.arange(len(p)), :, p.labels]
    return ranked(values if kind in ("high-entropy", "best") else -values, k)[objects]
