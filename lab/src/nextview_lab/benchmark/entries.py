"""Entries of the benchmark by name: policies, oracles, fixed views, and custom policies."""

import re
from dataclasses import dataclass

import numpy as np

from nextview.checks import did_you_mean
from nextview.errors import OtherUseError
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import (
    EpisodeState,
    Policy,
    Scope,
    best_in_window,
    best_view,
)
from nextview.policies.baselines import ranked
from nextview.policies.maps import MapPeak, peaks_first
from nextview.policies.policy_card import bundled_policies
from nextview.policies.registry import (
    VISIBLE,
    make_policy,
    map_policy,
    map_policy_names,
    policy_names,
)
from nextview.recognition.belief import PLAIN_SUM, Calibration
from nextview.recognition.map_names import LCM, LEM, SPHERE_SUFFIX, in_order, map_name
from nextview.recognition.model_card import DISCRIMINATE
from nextview.types import Float, Floats, Index
from nextview_lab.benchmark.thing_policies import OF_MEMORIES
from nextview_lab.benchmark.true_maps import TRUE, known_maps, true_measure
from nextview_lab.data.predictions import Predictions, of_true_class
from nextview_lab.errors import EntryError


@dataclass(frozen=True)
class EpisodeSpecs:
    """The E episodes of every entry: the same objects from the same first views.

    Attributes:
        predictions: of all objects from every view.
        objects: object of each episode, (E,).
        starts: first view of each, (E,).
    """

    predictions: Predictions
    objects: Index
    starts: Index

    @property
    def labels(self) -> Index:
        """True class of each episode's object, (E,) int64."""
        return self.predictions.labels[self.objects]

    def valley_classes(self, map_name: str) -> tuple[int, ...]:
        """Return the classes (indices) for which a map's valley is the better view."""
        named = self.predictions.valley_classes.get(map_name, ())
        classes = self.predictions.classes
        return tuple(classes.index(name) for name in named if name in classes)


MAP_ORACLES = {  # oracles of the thesis, by their published names
    "oracle-valley": ("", LEM, "-oracle-valley"),
    f"{TRUE}{LEM}": (TRUE, LEM, ""),
    f"{TRUE}{LEM}-peak": (TRUE, LEM, "-peak"),
    f"{TRUE}oracle-valley": (TRUE, LEM, "-oracle-valley"),
    f"{LCM}-oracle-valley": ("", LCM, "-oracle-valley"),
    f"{TRUE}{LCM}": (TRUE, LCM, "-peak"),
}
# upper bound: one-step lookahead with the true outcomes
GAINS: dict[str, Scope] = {"oracle-gain": "local", "oracle-gain-all": "global"}
# policies with access to the ground truth, always compared; more for each map, see MAP_ORACLE
ORACLES = (*MAP_ORACLES, *GAINS)
MAP_ORACLE = re.compile(r"(true-)?(.+?)(-peak|-oracle-valley)?")
"""Oracles that use a map. "true-MAP" climbs the true map: to its peaks, or to its valleys if the
most likely class uses them; "true-MAP-peak" always to its peaks. With "-oracle-valley" the true
class decides, also on the predicted map."""
MORE = f"{LEM}{SPHERE_SUFFIX}-peak"  # by Parisotto et al., see ``maps.SpherePeak``; always compared
FIXED_ENTRIES = (
    "best",
    "worst",
    "high-entropy",
    "low-entropy",
    "random-fixed",
    "orbit",
)
"""Fixed views by name, followed by their number: "best-5", "orbit-8". They do not stop early.

"best" and "worst" refer to the confidence in the true class; "orbit" moves around the ring of the
first view, then around the next ring.
"""
TRUE_MEASURE = re.compile(r"true-([\w.:]+)-all")
"""Oracles that use the true value of any measure in the view store, over all views: "true-NAME-all"
chooses the highest unvisited view. "true-NAME-K" are fixed views: the K highest."""


def is_oracle(policy: str) -> bool:
    """Return True if a policy uses information that a robot does not have."""
    return (
        policy in ORACLES
        or policy.startswith(TRUE)
        or policy.endswith("-oracle-valley")
    )


def knows_truth(entry: str) -> bool:
    """Return True if a policy or fixed views use information that a robot does not have."""
    return is_oracle(entry) or entry.split("-")[0] in ("best", "worst", "high", "low")


def default_entries(specs: EpisodeSpecs) -> list[str]:
    """Return all entries that these predictions allow."""
    sphere = specs.predictions.sphere
    n = sphere.azimuths
    v = len(sphere)
    maps = [
        name
        for name in in_order(specs.predictions.maps)
        if not name.endswith(SPHERE_SUFFIX)
    ]

    names = [
        *policy_names(),
        *(each for name in maps for each in (name, f"{name}-peak")),
        MORE,
    ]
    names += [*bundled_policies(), *ORACLES]
    names = [name for name in names if _ready(name, specs)]
    names += [f"{kind}-{min(5, v)}" for kind in FIXED_ENTRIES if kind != "orbit"]
    return names + [f"orbit-{k}" for k in sorted({n, v})]


def check_entry(name: str, specs: EpisodeSpecs) -> None:
    """Refuse an entry that cannot be made, before any is run.

    Args:
        name: of the entry.
        specs: the episodes.

    Raises:
        EntryError, PolicyError: there is no such entry, or the predictions lack what it needs.
    """
    if fixed_views(name, specs, np.random.default_rng(0)) is None:
        entry_policy(name, specs)


def entry_policy(name: str, specs: EpisodeSpecs) -> Policy:
    """Create the policy of a benchmark entry.

    Args:
        name: of the policy.
        specs: the episodes.

    Returns:
        The policy.

    Raises:
        EntryError: the predictions lack what the policy needs.
    """
    policy = _make(name, specs)
    p = specs.predictions
    there = {*p.maps, *(TRUE + name for name in known_maps(p))}
    there |= {"azimuth_bins"} if p.azimuth_bins is not None else set()
    lacking = [wanted for wanted in policy.needs if wanted not in there]
    if lacking:
        known = {
            "azimuth_bins": "what the recogniser says of the azimuth bins",
            "observations": "the depth of the views",
            "outlook": "scans of taught things (nextview-lab benchmark things compares it)",
            "visibility": "depth frames of what stands around the object",
        }
        what = known.get(lacking[0], f"the map {lacking[0]!r}")
        raise EntryError(f"policy {name} needs {what}, which these predictions lack")

    return policy


def _make(name: str, specs: EpisodeSpecs) -> Policy:
    p = specs.predictions
    plain = name.partition("@")[0]
    if name in MAP_ORACLES:
        return _oracle(specs, *MAP_ORACLES[name])
    if name in GAINS:
        return OracleGain(
            p.sphere,
            p.log_evidence,
            len(p.classes),
            p.labels,
            specs.objects,
            GAINS[name],
            p.calibration,
        )
    if measured := TRUE_MEASURE.fullmatch(name):
        values = true_measure(p, measured[1])[specs.objects].astype(np.float64)
        return OracleMeasure(p.sphere, values)

    match = MAP_ORACLE.fullmatch(name)
    true, base, how = match.groups("") if match else ("", "", "")
    predicted = [
        name
        for name in p.maps
        if how == "-oracle-valley" and not name.endswith(SPHERE_SUFFIX)
    ]
    base = map_name(base) if true else base  # the true map of a measure, by either name
    if base in (known_maps(p) if true else predicted):
        return _oracle(specs, true, base, how)
    if true and base.isidentifier():
        there = ", ".join(f"{TRUE}{known}" for known in known_maps(p))
        raise EntryError(
            f"no true map is called {name!r}; there are {there}, and more after"
            " nextview-lab measure"
        )

    known = (
        plain in policy_names() or map_policy(plain, p.sphere, (), p.maps) is not None
    )
    card = plain.removeprefix(VISIBLE)
    if known or card in bundled_policies() or card.endswith(".json") or ":" in name:
        return make_policy(
            name,
            p.sphere,
            specs.valley_classes(plain),
            p.classes,
            p.maps,
        )
    if plain == DISCRIMINATE or plain in OF_MEMORIES:
        raise EntryError(
            f"the policy {plain} is for taught things; nextview-lab benchmark things compares it"
        )

    names = [*policy_names(), *map_policy_names(p.maps), *bundled_policies(), *ORACLES]
    names += ["true-MEASURE-all", *(f"{kind}-K" for kind in FIXED_ENTRIES)]
    raise EntryError(
        "no policy is called"
        f" {name!r}{did_you_mean(name, names) or '; there are ' + ', '.join(names)}"
    )


def _oracle(t: EpisodeSpecs, true: str, base: str, how: str) -> Policy:
    """Return the oracle of the map ``base``; ``true`` and ``how`` are parts of its name."""
    sphere = t.predictions.sphere
    valleys = t.valley_classes(base)
    if how == "-oracle-valley":
        return OracleValley(sphere, t.labels, valleys, true + base)
    return MapPeak(sphere, true + base, () if how == "-peak" else valleys)


def _ready(name: str, specs: EpisodeSpecs) -> bool:
    """Return True if predictions and view store contain what an entry needs."""
    try:
        entry_policy(name, specs)
    except (EntryError, OtherUseError):
        return False
    return True


def fixed_views(
    name: str,
    specs: EpisodeSpecs,
    rng: np.random.Generator,
) -> Index | None:
    """Return the views of an entry with fixed views.

    Args:
        name: of the entry, such as "orbit-8" or "best-5".
        specs: the E episodes.
        rng: source of all random numbers.

    Returns:
        Views in order, (E, k) int64; None if the entry does not have fixed views.

    Raises:
        EntryError: there are fewer views than the name asks for.
    """
    match = re.fullmatch(
        rf"({'|'.join([*FIXED_ENTRIES, 'true-[a-z0-9_]+'])})-(\d+)",
        name,
    )
    if not match:
        return None

    p = specs.predictions
    objects = specs.objects
    kind = match[1]
    k = int(match[2])

    if not 1 <= k <= len(p.sphere):
        raise EntryError(
            f"{name}: the sphere has {len(p.sphere)} views, so between 1 and {len(p.sphere)} can be"
            " taken"
        )

    if kind == "orbit":
        return orbit(p.sphere, specs.starts, k)
    if kind == "random-fixed":
        return ranked(rng.random((len(objects), len(p.sphere))), k)
    if kind.startswith("true-"):
        return ranked(true_measure(p, kind.removeprefix(TRUE)).astype(np.float64), k)[
            objects
        ]

    if kind in ("high-entropy", "low-entropy"):
        values = p.depth_entropy.astype(np.float64)
    else:
        values = p.log_truth
    return ranked(values if kind in ("high-entropy", "best") else -values, k)[objects]


@dataclass(frozen=True)
class OracleValley:
    """The map's peak, or its valley if the *true* class uses valleys (section 4.2.3).

    Attributes:
        sphere: of the views.
        labels: of each episode, (E,).
        valley_classes: classes for which the lowest valley is chosen.
        map_name: in the evidence.
    """

    sphere: ViewSphere
    labels: Index
    valley_classes: tuple[int, ...]
    map_name: str

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.map_name,)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the valley of the map if the true class uses valleys, else the peak.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        maps = np.asarray(state.evidence.maps[self.map_name], np.float64)
        valley = np.isin(self.labels[state.episodes], self.valley_classes)
        return best_in_window(
            self.sphere,
            state,
            peaks_first(np.where(valley[:, None, None], -maps, maps)),
        )


@dataclass(frozen=True)
class OracleMeasure:
    """The unvisited view with the highest true value of a measure.

    With viewpoint entropy this is the choice of Shui et al. (thesis, section 3.5), from a random
    first view; with the fused descriptor that of Ding et al.

    Attributes:
        sphere: of the views.
        values: of each view in each episode, (E, V).
        needs: required inputs, see ``Policy.needs``.
    """

    sphere: ViewSphere
    values: Floats
    needs: tuple[str, ...] = ()

    def view_values(self, state: EpisodeState) -> Float:
        """Return the true values, (B, V)."""
        return np.asarray(self.values[state.episodes], np.float64)

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the highest value of the true measure.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        return best_view(self.sphere, state, self.view_values(state))


@dataclass(frozen=True)
class OracleGain:
    """The view after which the belief in the true class is highest, one step ahead.

    Attributes:
        sphere: of the views.
        log_evidence: additive log-evidence of every view of every object, (N, V, D).
        classes: number of classes.
        labels: (N,).
        objects: of each episode, (E,).
        scope: views that may be chosen.
        calibration: from summed evidence to the belief.
        needs: required inputs, see ``Policy.needs``.
    """

    sphere: ViewSphere
    log_evidence: Floats
    classes: int
    labels: Index
    objects: Index
    scope: Scope = "local"
    calibration: Calibration = PLAIN_SUM
    needs: tuple[str, ...] = ()

    def next_views(self, state: EpisodeState, rng: np.random.Generator) -> Index:
        """Choose the view that raises the belief in the true class most.

        Args:
            state: the state of B episodes with V candidate views.
            rng: source of all random numbers.

        Returns:
            The next view of each episode, (B,) int64.
        """
        b = len(state.current)
        # in parts, to limit the memory
        parts = np.split(np.arange(b), range(500, b, 500))
        gain = np.concatenate([self._gains(state, rows) for rows in parts])
        if self.scope == "global":
            return best_view(self.sphere, state, gain)
        return best_in_window(self.sphere, state, gain.reshape(b, -1, 3))

    def _gains(self, state: EpisodeState, rows: Index) -> Float:
        """Return the log-belief in the true class after each view, or each view of the window."""
        objects = self.objects[state.episodes[rows]]
        current = state.current[rows]
        log_evidence = self.log_evidence[objects].astype(np.float64)
        so_far = np.matmul(state.visited[rows, None].astype(np.float64), log_evidence)[
            :,
            0,
        ]
        if self.scope == "local":
            window = self.sphere.windows[current].reshape(len(rows), -1)
            log_evidence = log_evidence[np.arange(len(rows))[:, None], window]
        logs = self.calibration.log_belief(
            so_far[:, None] + log_evidence,
            state.step + 1,
            self.classes,
        )

        return of_true_class(logs, self.labels[objects])


def orbit(sphere: ViewSphere, starts: Index, k: int) -> Index:
    """Return the next views around the ring of each start, then around the ring above.

    The lowest ring follows the top one.

    Args:
        sphere: the candidate views.
        starts: first view of each episode, (E,) int64.
        k: number of views.

    Returns:
        The views in order, (E, k) int64.
    """
    n = sphere.azimuths
    step = np.arange(k)
    ring = (sphere.ring[starts][:, None] + step // n) % sphere.rings
    return ring * n + (sphere.azimuth_index[starts][:, None] + step) % n
