"""The environment for taught things: Gymnasium's own checks, the joint belief, and an agent."""

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env

import nextview_lab.benchmark.environments  # noqa: F401
from nextview.errors import SessionError
from nextview.policies.learned_tables import cells_from
from nextview_lab.benchmark.thing_episodes import EPISODE_SPHERE

NAME = "nextview/RecogniseThings-v0"


@pytest.fixture(scope="module")
def env(knobs, knobs_memory):
    given = {"objective": "belief", "max_views": 3, "travel_price": 0.1, "draws": 2}
    return gymnasium.make(NAME, scans=knobs, models=str(knobs_memory), **given)


def test_gymnasium_finds_nothing_wrong_with_it(env):
    check_env(env.unwrapped, skip_render_check=True)  # raises what it finds
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)


def test_the_observation_is_the_joint_belief_of_thing_and_pose(env):
    names = env.unwrapped.things.names
    observation, info = env.reset(
        seed=0, options={"object": names.index("knob"), "draw": 0}
    )
    assert observation["belief"].sum() == pytest.approx(1, abs=1e-5)
    assert observation["hypotheses"].sum() == pytest.approx(1, abs=1e-5)
    assert (np.diff(observation["hypotheses"]) <= 0).all()
    there = observation["things"] < len(names)
    assert (observation["hypotheses"][~there] == 0).all()
    assert info["answer"] == observation["belief"].argmax()

    # A camera looks along z, at most half a metre away, at things that stand upright.
    poses = observation["poses"][there].astype(float)
    ahead = poses @ np.array([0, 0, 0.05, 1])
    assert (np.abs(ahead[:, :2]) < 0.05).all()
    assert ((ahead[:, 2] > 0.2) & (ahead[:, 2] < 0.6)).all()
    turned = poses[:, :, :3]
    np.testing.assert_allclose(
        turned @ turned.swapaxes(1, 2),
        np.tile(np.eye(3), (len(poses), 1, 1)),
        atol=1e-5,
    )
    down = -np.sin(EPISODE_SPHERE.elevation[info["view"]])
    assert poses[0, 2, 2] == pytest.approx(
        down, abs=0.1
    )  # the thing's up, along the view


def test_rewards_add_up_and_an_action_is_counted_from_the_camera(env):
    observation, info = env.reset(seed=3, options={"object": 0, "draw": 0})
    first = observation["belief"][0]
    start = info["view"]
    assert observation["visited"].sum() == 1
    action = 11
    expected = cells_from(EPISODE_SPHERE)[start, action]
    assert info["travel_to"][action] == EPISODE_SPHERE.travel[start, expected]
    observation, reward, over, cut, info = env.step(action)
    assert info["view"] == expected or expected == start
    assert not over
    assert not cut
    total = reward
    # Where it stands already: the nearest free view is taken.
    stay = int(EPISODE_SPHERE.ring[info["view"]] * EPISODE_SPHERE.azimuths)
    before = info["view"]
    observation, reward, over, cut, info = env.step(stay)
    assert info["view"] not in (start, before)
    assert over
    total += reward
    assert total == pytest.approx(
        observation["belief"][0] - first - 0.1 * info["travel"], abs=1e-5
    )
    with pytest.raises(SessionError):
        env.unwrapped.step(0)
