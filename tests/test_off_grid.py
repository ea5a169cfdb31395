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
    look_at_origin,
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


def direction(elevation, azimuth):
    return look_at_origin(np.radians(elevation), np.radians(azimuth), 1.0)[..., :3, 3]


# Layouts


def test_a_fibonacci_hemisphere_is_even():
    directions = viewpoints_of("fibonacci:200").directions
    assert directions.shape == (200, 3)
    assert (directions[:, 2] > 0).all()
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))
    np.fill_diagonal(angles, 180)
    # side of a square of each one's share of the half sphere
    even = np.degrees(np.sqrt(2 * np.pi / 200))
    assert angles.min(1).min() > 0.75 * even
    assert angles.min(1).max() < 1.1 * even
    heights = np.sort(directions[:, 2])  # equal areas: heights are uniform (Archimedes)
    np.testing.assert_allclose(heights, (np.arange(200) + 0.5) / 200)


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


@settings(deadline=None, max_examples=40)
@given(
    st.floats(-20, 89), st.floats(0, 360), st.sampled_from(LAYOUTS), st.integers(0, 99)
)
def test_values_lie_between_those_of_the_turned_grid(elevation, azimuth, layout, seed):
    """Bilinear in elevation and in azimuth from the camera, written out for each view."""

    class Fixed:
        sphere, needs, travel_weight = SPHERE, (), 0.5
        cells = np.random.default_rng(seed).random((1, 40))

        def scores(self, state):
            assert SPHERE.azimuth_index[state.current[0]] == 0
            return self.cells

        def next_views(self, state, rng):
            raise AssertionError

    sphere, rng = (
        Directions(viewpoints_of(layout).directions),
        np.random.default_rng(seed),
    )
    state = state_at(
        sphere,
        direction(elevation, azimuth),
        rng,
        reachable=rng.random((1, len(sphere))) < 0.5,
    )
    travel = rng.random((1, len(sphere)))
    state = replace(state, travel=travel)
    if not state.free.any():
        return
    grid = np.column_stack([Fixed.cells.reshape(5, 8), Fixed.cells.reshape(5, 8)[:, 0]])
    expected = []
    for view in range(len(sphere)):
        up, round_ = sphere.angles(view)
        row = np.clip(up, 0, 72) / 18
        column = (round_ - azimuth) % 360 / 45
        r, c = min(int(row), 3), min(int(column), 7)
        a, b = row - r, column - c
        corners = (
            grid[r, c] * (1 - b) + grid[r, c + 1] * b,
            grid[r + 1, c] * (1 - b) + grid[r + 1, c + 1] * b,
        )
        expected.append(corners[0] * (1 - a) + corners[1] * a - 0.5 * travel[0, view])
    expected = np.where(state.free[0], expected, -np.inf)
    chosen = OffGrid(Fixed(), SPHERE, sphere).next_views(state, rng)[0]
    assert state.free[0, chosen]
    assert expected[chosen] == pytest.approx(expected.max(), abs=1e-6)


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
