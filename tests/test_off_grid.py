"""Candidate views anywhere, and policies of the 40 views on them, against brute force."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nextview.geometry.viewsphere import (
    VISITED_ANGLE,
    Directions,
    ViewSphere,
    viewpoints_of,
)
from nextview.policies.base import EpisodeState, Evidence
from nextview.policies.maps import MapPeak, SpherePeak
from nextview.policies.off_grid import OffGrid, anywhere
from nextview.policies.registry import POLICIES, make_policy, make_policy_anywhere
from nextview.recognition.belief import Calibration, FixedLength
from nextview.session.episode import Episodes

SPHERE = ViewSphere.named("40")
CLASSES = 10
LAYOUTS = ("40", "12", "rings:0,30,60x12", "fibonacci:60", "fibonacci:7")
BUNDLED = (
    "gain",
    "visible-gain",
    "fixed-sequence",
    "fixed-ring",
    "class-table",
    "class-table-local",
)
NAMES = (*POLICIES, "lem", "lem-peak", "lcm", "lcm-peak", "lem-sphere-peak", *BUNDLED)


def evidence(rng, b=1) -> Evidence:
    maps = {name: rng.random((b, 5, 3)) for name in ("lem", "lcm")} | {
        "lem-sphere": rng.random((b, 5, 8))
    }
    bins = np.log(rng.dirichlet(np.ones(8), (b, CLASSES)))
    return Evidence(rng.normal(size=(b, CLASSES)), maps, bins)


# Policies off their grid


def state_at(sphere, place, rng, visited=(), reachable=None) -> EpisodeState:
    view, _ = sphere.nearest(place)
    seen = np.zeros((1, len(sphere)), bool)
    seen[0, [view, *visited]] = True
    e, bins = evidence(rng), rng.dirichlet(np.ones(8), (1, CLASSES))
    belief = rng.dirichlet(np.ones(CLASSES))[None]
    return EpisodeState(
        np.array([view]),
        seen,
        belief,
        e,
        1,
        np.zeros(1, int),
        bins,
        reachable,
        None,
        place[None, None],
        visibility=rng.random(seen.shape),
    )


@pytest.mark.parametrize(
    "name", ["gain", "visible-gain", "lem-peak", "class-table", "class-table-local"]
)
def test_on_views_that_happen_to_be_the_grid_the_interpolation_is_the_policy(name):
    """The 40 views as a mere list of directions: the same decisions and values as on the grid
    itself.
    """
    policy, rng = make_policy(name, SPHERE), np.random.default_rng(0)
    off = OffGrid(policy, SPHERE, Directions(SPHERE.directions))
    for k in range(40):
        state = state_at(
            SPHERE,
            SPHERE.directions[k],
            rng,
            rng.integers(0, 40, 6),
            rng.random((1, 40)) < 0.7,
        )
        assert off.next_views(state, rng) == policy.next_views(state, rng)
        if name in ("gain", "visible-gain", "lem-peak"):
            np.testing.assert_allclose(
                off.view_values(state), policy.view_values(state), atol=1e-9
            )
        assert anywhere(policy, SPHERE).next_views(state, rng) == policy.next_views(
            state, rng
        )


@settings(deadline=None, max_examples=150)
@given(
    st.data(), st.sampled_from(LAYOUTS), st.sampled_from(NAMES), st.integers(0, 10**6)
)
def test_every_policy_goes_to_a_view_that_is_free_and_believes_all_in_all_one(
    data, layout, name, seed
):
    sphere = viewpoints_of(layout)
    policy = make_policy_anywhere(name, sphere)
    policy = anywhere(
        replace(policy, sphere=SPHERE)
        if isinstance(policy, MapPeak | SpherePeak)
        else policy,
        sphere,
    )
    share = data.draw(st.sampled_from([0.1, 0.5, 1.0]))
    jitter = data.draw(st.sampled_from([0.0, 0.02, 0.3]))
    paths = []
    for _ in range(2):
        rng = np.random.default_rng(seed)
        reachable = rng.random(len(sphere)) < share
        first, rule, draws = (
            np.array([0]),
            FixedLength(max_views=8),
            np.random.default_rng(seed),
        )
        episodes = Episodes(sphere, policy, first, rule, draws, Calibration(0.8, 0.5))
        places, path = [], []
        while len(episodes.running):
            place = sphere.directions[episodes.current] + jitter * rng.normal(
                size=(1, 3)
            )
            place /= np.linalg.norm(place)
            places.append(place[0])
            step = episodes.update(
                evidence(rng), place, partial(replace, reachable=reachable[None])
            )
            assert step.belief.sum() == pytest.approx(1)
            to = int(step.next_views[0])
            path.append(to)
            angles = np.arccos(np.clip(np.array(places) @ sphere.directions.T, -1, 1))
            visited = {
                *angles.argmin(1),
                *np.flatnonzero((angles < VISITED_ANGLE - 1e-6).any(0)),
            }
            free = set(np.flatnonzero(reachable)) - visited
            if to >= 0:
                assert to in free
            else:
                near = set(np.flatnonzero((angles <= VISITED_ANGLE + 1e-6).any(0)))
                assert len(path) == min(8, len(sphere)) or free <= near
        assert not episodes.outcome.confident[0]
        paths.append(path)
    assert paths[0] == paths[1]
