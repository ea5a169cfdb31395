"""The environments: what Gymnasium promises for them, and that they are the replay's own
episodes.
"""

import doctest
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from pipeline import some_predictions

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env

import nextview_lab.benchmark.environments  # noqa: F401
from nextview.policies.baselines import Spread
from nextview.policies.learned_tables import cells_to
from nextview.recognition.belief import Calibration, Stopping
from nextview.session.episode import run_episodes
from nextview_lab.data.predictions import Predictions

RECOGNISE = "nextview/Recognise-v0"
INPUTS = ("belief", "view", "place", "lem", "azimuth_bin")


def learnable(n: int = 12) -> Predictions:
    azimuth_bins = (
        np.random.default_rng(9).normal(size=(n, 40, 3, 8)).astype(np.float32)
    )
    calibration = Calibration(1.5, 0.3, bin_correlation=0.2)
    splits = np.array(["train"] * n)
    return replace(
        some_predictions(n),
        splits=splits,
        azimuth_bins=azimuth_bins,
        calibration=calibration,
    )


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("envs") / "p.npz"
    learnable().save(path)
    return path


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"inputs": INPUTS, "frame": "object", "objective": "log-belief"},
        {
            "threshold": 0.6,
            "view_price": 0.1,
            "travel_price": 0.01,
            "balanced": True,
            "inputs": ("lem", "azimuth_bin"),
        },
    ],
)
def test_gymnasium_finds_nothing_wrong(file, options):
    env = gymnasium.make(RECOGNISE, predictions=str(file), **options)
    check_env(env.unwrapped)
    assert all(
        env.observation_space.contains(observation)
        for observation, *_ in played(env, 0)
    )


def played(env, seed: int, n: int = 60):
    """Observations, rewards and ends of random episodes."""
    actions, found = np.random.default_rng(seed), []
    observation, _ = env.reset(seed=seed)
    for _ in range(n):
        found.append([observation])
        observation, reward, ended, _, info = env.step(int(actions.integers(40)))
        found[-1] += [reward, ended, info["view"]]
        if ended:
            observation, _ = env.reset()
    return found


def test_an_episode_is_the_loop_of_a_robot():
    """Beliefs, travel and the end are those of ``run_episodes`` with a policy that goes where
    the actions went.
    """
    p = learnable()
    policy, stopping = Spread(p.sphere), Stopping(0.75, 5, p.calibration.correlation)
    for k in range(6):

        def observe(_, views, row=k):
            return p.evidence(np.array([row]), views)

        rng = np.random.default_rng(k)
        expected = run_episodes(
            observe, p.sphere, policy, np.array([3 * k]), stopping, rng, p.calibration
        )
        views = expected.outcome.views[0]
        env = gymnasium.make(
            RECOGNISE,
            predictions=p,
            threshold=0.75,
            objective="belief",
            inputs=("belief",),
        )
        observation, info = env.reset(options={"object": k, "start": int(views[0])})
        total, ended = observation[p.labels[k]], False
        for step, (here, there) in zip(
            expected.steps[1:], pairwise(views), strict=False
        ):
            action = cells_to(p.sphere)[here, there]
            assert info["action_mask"][action]
            observation, reward, ended, _, info = env.step(action)
            total += reward
            np.testing.assert_allclose(observation[:3], step.belief[0], atol=1e-6)
            assert (info["view"], info["answer"]) == (there, step.belief[0].argmax())
            np.testing.assert_allclose(total, step.belief[0, p.labels[k]], atol=1e-6)
        assert ended or len(expected.steps) == 1
        if len(expected.steps) > 1:
            assert np.isclose(info["travel"], expected.outcome.travel[0])


def test_the_examples_of_the_page_run(tmp_path, monkeypatch):
    learnable().save(tmp_path / "validation.npz")
    monkeypatch.chdir(tmp_path)
    failed, tried = doctest.testfile(
        str(Path(__file__).parents[2] / "docs/environments.md"), module_relative=False
    )
    assert tried > 12
    assert failed == 0
