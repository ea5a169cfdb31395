"""What the explorer shows, without a page: objects, walks and what follows from each view."""

from pathlib import Path

import numpy as np
import pytest

import nextview
from nextview.data.samples import sample_mesh
from nextview.geometry.viewsphere import ViewSphere
from nextview.viewers.exploration import Exploration, shown_objects

SAMPLES, SPHERE = Path(__file__).parents[1] / "samples", ViewSphere.named("40")


@pytest.fixture
def chair():
    return Exploration(shown_objects(), ("gain", "furthest"), start=3, threads=1)


@pytest.mark.parametrize("policy", ["gain", "lem", "spread"])
@pytest.mark.parametrize("start", [3, 22])
def test_a_policy_walks_as_it_does_in_an_episode(policy, start):
    options = {"threshold": 0.9995, "max_views": 4, "threads": 1}
    episode = nextview.load(policy=policy, **options).recognise(
        sample_mesh("monitor"), start=start
    )
    monitor = [shown for shown in shown_objects() if shown.name == "monitor"]
    exploration = Exploration(monitor, (policy,), start=start, **options)
    walk = exploration.walks[0]
    while exploration.walk_on():
        assert len(walk.views) < 5
    assert walk.stopped
    assert walk.visited == [view.index for view in episode.views]
    for seen, expected in zip(walk.views, episode.views, strict=True):
        np.testing.assert_array_equal(seen.belief, expected.belief)
        np.testing.assert_array_equal(
            seen.observation.depth, expected.observation.depth
        )


def test_a_view_by_hand_counts_from_where_it_was_taken(chair):
    walk = chair.walks[0]
    walk.look(5)
    view = walk.look(chair.pose_towards(np.array([2.0, -1.0, 1.5])))
    assert walk.visited[0] == 5
    np.testing.assert_allclose(
        view.direction, np.array([2.0, -1.0, 1.5]) / np.sqrt(7.25)
    )
    assert view.travel == pytest.approx(
        float(walk.sphere.travel_between(walk.sphere.directions[5], view.direction))
    )
    assert len(chair.walks[1].views) == 0  # the other one is where it was
