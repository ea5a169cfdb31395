"""The two published policies go where the leading hypotheses look different."""

import numpy as np
import pytest
from test_expected_views import SPHERE, outlook_of

from nextview.errors import PolicyError
from nextview.geometry.viewsphere import angle_between
from nextview.policies.base import EpisodeState
from nextview.recognition.evidence import Evidence
from nextview_lab.benchmark.thing_policies import (
    LowestEntropy,
    predicted_entropy,
    sampled_information,
)

BOTH = pytest.mark.parametrize("values", [sampled_information, predicted_entropy])
KNOB_AT = np.array([1.0, 0, 0])
BEHIND = int(SPHERE.directions[:, 0].argmin())  # the body hides the knob


def state_from(view, outlook):
    visited = np.arange(len(SPHERE)) == view
    return EpisodeState(
        current=np.array([view]),
        visited=visited[None],
        belief=np.full((1, 2), 0.5),
        evidence=Evidence(np.zeros((1, 2))),
        step=1,
        outlook=outlook,
    )


@BOTH
@pytest.mark.parametrize("belief", [(0.5, 0.5), (0.9, 0.1)])
def test_the_next_view_shows_where_the_hypotheses_differ(values, belief):
    state = state_from(BEHIND, [outlook_of(belief)])
    for seed in range(3):
        chosen = LowestEntropy(SPHERE, values).next_views(
            state, np.random.default_rng(seed)
        )
        towards = np.degrees(angle_between(SPHERE.directions[chosen], KNOB_AT))
        assert towards[0] < 80


@BOTH
def test_a_visited_view_is_never_chosen(values):
    towards = angle_between(SPHERE.directions, KNOB_AT)
    best = int(towards.argmin())
    state = state_from(best, [outlook_of((0.5, 0.5))])
    chosen = LowestEntropy(SPHERE, values).next_views(state, np.random.default_rng(0))
    assert chosen[0] != best
    assert np.degrees(towards[chosen[0]]) < 80


@BOTH
def test_a_state_without_geometry_is_refused(values):
    with pytest.raises(PolicyError):
        LowestEntropy(SPHERE, values).next_views(
            state_from(0, None), np.random.default_rng(0)
        )
