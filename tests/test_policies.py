"""Policies against scikit-image, brute force and what their names promise."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare
from skimage.feature import peak_local_max

from nextview.errors import PolicyError
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.base import EpisodeState, Evidence
from nextview.policies.baselines import Furthest, MostVisible, Random, RandomAll, Spread
from nextview.policies.learned_tables import ClassTable, FixedRing, FixedSequence
from nextview.policies.maps import MapPeak
from nextview.policies.policy_card import (
    bundled_policies,
    read_policy_card,
    write_policy_card,
)
from nextview.policies.registry import POLICIES, make_policy

SPHERE = ViewSphere.named("40")
RING = ViewSphere.named("12")
spheres = st.sampled_from([SPHERE, RING, ViewSphere((0.0, 45.0), 3)])


def state_of(sphere, current, visited=None, belief=None, **local_maps) -> EpisodeState:
    """Episodes that stand at ``current``, having visited that and what is told."""
    current = np.atleast_1d(current)
    seen = np.zeros((len(current), len(sphere)), bool)
    seen[np.arange(len(current)), current] = True
    for row, views in enumerate(visited or []):
        seen[row, list(views)] = True
    belief = np.full((len(current), 2), 0.5) if belief is None else np.asarray(belief)
    evidence = Evidence(
        np.zeros((len(current), 2)),
        {k: np.asarray(m, float) for k, m in local_maps.items()},
    )
    return EpisodeState(
        current, seen, belief, evidence, int(seen.sum(1).max()), np.arange(len(current))
    )


def random_state(sphere, rng, episodes=50) -> EpisodeState:
    """Episodes under way, with maps whose values often tie."""
    state = state_of(
        sphere,
        rng.integers(len(sphere), size=episodes),
        belief=rng.dirichlet([1, 1], episodes),
    )
    state.visited[:] |= rng.random(state.visited.shape) < rng.random((episodes, 1))
    cells = rng.integers(0, 4, (episodes, sphere.rings, 3)) / 4.0
    whole = rng.integers(0, 4, (episodes, sphere.rings, sphere.azimuths)) / 4.0
    evidence = Evidence(
        np.zeros((episodes, 2)), {"lem": cells, "lcm": cells, "lem-sphere": whole}
    )
    return replace(state, evidence=evidence, visibility=rng.random(state.visited.shape))


# What every policy promises


def policies(sphere, rng):
    by_map = ("lem", "lem-peak", "lcm", "lem-sphere-peak")
    yield from (make_policy(name, sphere, (1,)) for name in (*POLICIES, *by_map))
    for scope in ("global", "local"):
        yield FixedSequence(
            sphere, rng.integers(len(sphere), size=(sphere.rings, 4)), scope
        )
        yield ClassTable(sphere, rng.random((2, sphere.rings, len(sphere))), scope)
    yield FixedRing(sphere, sphere.rings - 1, 2)


@settings(deadline=None, max_examples=30)
@given(spheres, st.integers(0, 2**32))
def test_no_policy_goes_back_while_a_view_is_left(sphere, seed):
    rng = np.random.default_rng(seed)
    state = random_state(sphere, rng)
    for policy in policies(sphere, rng):
        chosen = policy.next_views(state, rng)
        assert chosen.shape == (50,)
        assert np.issubdtype(chosen.dtype, np.integer)
        assert ((chosen >= 0) & (chosen < len(sphere))).all()
        again = state.visited[np.arange(50), chosen]
        assert not (again & ~state.visited.all(1)).any(), policy


@settings(deadline=None, max_examples=20)
@given(spheres, st.integers(0, 2**32))
def test_no_row_depends_on_another(sphere, seed):
    rng = np.random.default_rng(seed)
    state = random_state(sphere, rng)
    for policy in policies(sphere, rng):
        if isinstance(
            policy,
            (
                Random,
                RandomAll,
                Furthest,
                Spread,
                FixedSequence,
                FixedRing,
                MostVisible,
            ),
        ):
            continue  # they draw, or may
        together = policy.next_views(state, rng)
        for row in range(0, 50, 7):
            assert policy.next_views(state.select([row]), rng)[0] == together[row]


# Baselines


@pytest.mark.parametrize(
    "policy", [Random(SPHERE), RandomAll(SPHERE)], ids=["window", "all"]
)
def test_random_is_uniform_over_free_views(policy):
    visited = [11, 3, 28, 36, 0, 25]
    state = state_of(SPHERE, np.full(20_000, 11), [visited] * 20_000)
    chosen = policy.next_views(state, np.random.default_rng(0))
    candidates = (
        SPHERE.windows[11].ravel() if isinstance(policy, Random) else np.arange(40)
    )
    free = np.setdiff1d(candidates, visited)
    drawn = np.bincount(chosen, minlength=40)
    assert drawn[free].sum() == 20_000
    assert chisquare(drawn[free]).pvalue > 1e-3


# Maps

HILLS = [
    [0.1, 0.9, 0.1],
    [0.2, 0.3, 0.2],
    [0.4, 0.2, 0.1],
    [0.5, 0.3, 0.2],
    [0.8, 0.6, 0.7],
]
"""Around view 11: peaks at the top left (0.8), the bottom middle (0.9) and the top right (0.7)."""


@settings(deadline=None)
@given(st.integers(0, 2**32))
def test_map_peak_is_the_highest_free_peak_of_scikit_image(seed):
    rng = np.random.default_rng(seed)
    state = random_state(SPHERE, rng, 20)
    cells = rng.random((20, 5, 3))
    state = replace(state, evidence=Evidence(np.zeros((20, 2)), {"lem": cells}))
    chosen = MapPeak(SPHERE, "lem").next_views(state, rng)
    for row, window in enumerate(SPHERE.windows[state.current]):
        free = ~state.visited[row, window]
        peaks = peak_local_max(
            cells[row], min_distance=1, threshold_abs=-1, exclude_border=False
        )
        peaks = [tuple(p) for p in peaks if free[tuple(p)]] or [
            tuple(p) for p in np.argwhere(free)
        ]
        if peaks:
            assert chosen[row] == window[max(peaks, key=lambda p: cells[row][p])]


def test_a_valley_is_chosen_by_the_believed_class():
    state = state_of(
        SPHERE, [11, 11], belief=[[0.9, 0.1], [0.2, 0.8]], lem=[HILLS, HILLS]
    )
    peak, valley = MapPeak(SPHERE, "lem", valley_classes=(1,)).next_views(
        state, np.random.default_rng(0)
    )
    assert peak == 3
    assert (
        HILLS[SPHERE.ring[valley]][[2, 3, 4].index(SPHERE.azimuth_index[valley])] == 0.1
    )
    both = MapPeak(SPHERE, "lem", valley_classes=(0, 1)).next_views(
        state, np.random.default_rng(0)
    )
    assert both.tolist() == [valley, valley]
    assert MapPeak(SPHERE, "lem").next_views(
        state, np.random.default_rng(0)
    ).tolist() == [3, 3]


# By name


def test_a_card_is_written_as_it_was_read_and_a_broken_one_is_named(tmp_path):
    for name, path in bundled_policies().items():
        write_policy_card(tmp_path / f"{name}.json", read_policy_card(path))
        assert read_policy_card(tmp_path / f"{name}.json") == read_policy_card(path)
    good = json.loads((tmp_path / "fixed-ring.json").read_text())
    wrong = (
        {"kind": "agent"},
        {"table": {"ring": 9, "steps": 1}},
        {"more": 1},
        {"schema": 2},
    )
    for k, change in enumerate(wrong):
        (tmp_path / f"{k}.json").write_text(json.dumps(good | change))
        with pytest.raises(PolicyError, match=rf"^\S+{k}\.json: not a policy card"):
            make_policy(str(tmp_path / f"{k}.json"), SPHERE)
    with pytest.raises(PolicyError):
        make_policy("fixed-ring", SPHERE, classes=("cup", "mug"))
