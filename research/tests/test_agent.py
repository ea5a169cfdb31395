"""Agents of reinforcement learning: trained on the replay, written, and run without what trained
them; ap_gym.
"""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import tyro
from pipeline import some_predictions, train_predictions
from scipy.special import log_softmax

pytest.importorskip("stable_baselines3")

from programs import main

from nextview.errors import PolicyError
from nextview.geometry.viewsphere import ViewSphere
from nextview.policies.baselines import RandomAll
from nextview.policies.registry import make_policy
from nextview.recognition.belief import Calibration
from nextview_lab.data.predictions import Predictions
from nextview_lab.training.rollout import ReplayTable, judge, rollout
from research import train_agent as module

SMALL = ViewSphere((0.0, 30.0, 60.0), 4)
QUICK = [
    "--steps",
    "64",
    "--envs",
    "8",
    "--rollout",
    "4",
    "--evaluations",
    "2",
    "--hidden",
    "8",
    "--batch",
    "8",
]
PLAIN = ["--inputs", "belief", "place", "--frame", "camera"]


def train(arguments):
    tyro.extras.subcommand_cli_from_dict(
        {"ppo": module.main, "mvselect": module.mvselect},
        args=arguments,
    )


def hinting(n, seed=0):
    """Three classes, each told on one ring alone; every view hints at the class: labels, logits
    (n, 12, 3).
    """
    rng = np.random.default_rng(seed)
    labels = np.arange(n) % 3
    right = (
        np.where(SMALL.ring == labels[:, None], 4.0, 1.0)[..., None]
        * np.eye(3)[labels][:, None]
    )
    return labels, (right + 0.3 * rng.normal(size=(n, len(SMALL), 3))).astype(
        np.float32
    )


def learnable(n, seed=0, split="train"):
    return replace(
        some_predictions(n, seed),
        splits=np.array([split] * n),
        calibration=Calibration(1.5, 0.3),
    )


@pytest.mark.parametrize("preset", ["ppo", "mvselect"])
def test_an_agent_finds_the_ring_of_the_class_believed(tmp_path, preset):
    labels, logits = hinting(150)
    names = tuple(map(str, range(150)))
    entropy = np.random.default_rng(0).random((150, 12)).astype(np.float32)
    about = (
        ("a", "b", "c"),
        np.array(["train"] * 150),
        np.zeros(150, bool),
        SMALL,
        {},
        {},
        Calibration(1.01),
    )
    Predictions(logits, {}, entropy, names, labels, *about).save(tmp_path / "p.npz")
    learns = [
        "--steps",
        "24000",
        "--envs",
        "64",
        "--evaluations",
        "4",
        "--batch",
        "256",
        "--max-views",
        "2",
    ]
    train(
        [
            preset,
            str(tmp_path / "p.npz"),
            str(tmp_path / "a.json"),
            *learns,
            "--objective",
            "log-belief",
            *PLAIN,
        ]
    )
    labels, logits = hinting(90, seed=1)
    fresh = ReplayTable(
        train_predictions(
            logits,
            labels,
            SMALL,
            ("a", "b", "c"),
            calibration=Calibration(1.01),
        )
    )
    agent = make_policy(str(tmp_path / "a.json"), SMALL)
    first, second = (
        SMALL.ring[m.state.current]
        for m in rollout(fresh, agent, 2, np.random.default_rng(5))
    )
    assert np.mean((second == labels)[first != labels]) > 0.7  # a third by chance
    blind, ours = (
        judge(fresh, p, 2, "log-belief", np.random.default_rng(0))
        for p in (RandomAll(SMALL), agent)
    )
    assert ours.mean[-1] > blind.mean[-1]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent")
    learnable(30).save(folder / "p.npz")
    for preset in ("ppo", "mvselect"):
        train(
            [
                preset,
                str(folder / "p.npz"),
                str(folder / f"{preset}.json"),
                *QUICK,
                *PLAIN,
            ]
        )
    return folder


def test_the_benchmark_takes_agents_beside_the_others(trained, tmp_path):
    learnable(9, 3, "test").save(tmp_path / "test.npz")
    cards = [str(trained / "ppo.json"), str(trained / "mvselect.json")]
    out = tmp_path / "out"
    main(
        [
            "benchmark",
            "classes",
            str(tmp_path / "test.npz"),
            str(out),
            "--policies",
            "random",
            *cards,
            "--runs",
            "2",
        ]
    )
    settings = next(
        json.loads(path.read_text())
        for path in out.rglob("*.json")
        if "failures" in path.read_text()
    )
    assert settings["failures"] == {}
    assert set(cards) < set(settings["policies"])


def test_a_card_says_how_and_its_file_is_the_one_that_was_written(trained, tmp_path):
    card = json.loads((trained / "mvselect.json").read_text())
    assert (card["kind"], card["settings"]["algorithm"]) == ("gain", "dqn")
    assert "24 objects" in card["learned_from"]
    for suffix in ("json", "onnx"):
        (tmp_path / f"bad.{suffix}").write_bytes(
            (trained / f"mvselect.{suffix}").read_bytes()
        )
    with (tmp_path / "bad.onnx").open("r+b") as file:
        file.seek(200)
        file.write(b"x")
    with pytest.raises(PolicyError, match=r"bad\.onnx"):
        make_policy(str(tmp_path / "bad.json"), ViewSphere.named("40"))


def test_an_agent_runs_where_nothing_that_trained_it_is(trained):
    script = f"""
import sys
sys.modules |= dict.fromkeys(["torch", "stable_baselines3", "gymnasium", "onnx"])
import numpy as np
from nextview.policies.base import EpisodeState, Evidence
from nextview.policies.registry import make_policy
from nextview.geometry.viewsphere import ViewSphere
sphere = ViewSphere.named("40")
visited = np.zeros((1, 40), bool)
visited[0, 3] = True
state = EpisodeState(np.array([3]), visited, np.full((1, 3), 1 / 3), Evidence(np.zeros((1, 3))), 1)
policy = make_policy({str(trained / "ppo.json")!r}, sphere)
print(*policy.next_views(state, np.random.default_rng(0)))
"""
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(done.stdout) in set(range(40)) - {3}


def test_the_same_seed_gives_the_same_agent(trained, tmp_path):
    for seed in ("0", "1"):
        train(
            [
                "ppo",
                str(trained / "p.npz"),
                str(tmp_path / f"{seed}.json"),
                *QUICK,
                *PLAIN,
                "--seed",
                seed,
            ]
        )
    paths = (trained / "ppo.onnx", tmp_path / "0.onnx", tmp_path / "1.onnx")
    first, again, other = (path.read_bytes() for path in paths)
    assert first == again
    assert first != other


def test_ap_gym_takes_the_replay_for_one_of_its_own():
    """Rewards are its own normalised cross-entropy, by its own loss, and our prices."""
    ap_gym = pytest.importorskip("ap_gym")
    import gymnasium

    name = "research.active_classification:nextview/ActiveRecognise-v0"
    p = learnable(12)
    env = gymnasium.make(name, predictions=p, travel_price=0.5).unwrapped
    assert ap_gym.ensure_active_perception_env(env) is env
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(4):
        action = env.action_space.sample()
        _, reward, ended, _, info = env.step(action)
        loss = -log_softmax(action["prediction"])[
            info["prediction"]["target"]
        ] / np.log(3)
        assert np.isclose(reward, info["base_reward"] - loss, atol=1e-5)
        assert info["base_reward"] <= -0.5
    assert ended
    many = gymnasium.make_vec(name, num_envs=5, predictions=p, max_views=3)
    many.action_space.seed(0)
    _, begun = many.reset(seed=0)
    targets = [begun["prediction_target"]]
    for _ in range(4):
        _, rewards, ended, _, info = many.step(many.action_space.sample())
        np.testing.assert_array_equal(info["prediction"]["target"], targets[-1])
        targets.append(info["prediction_target"])
    assert rewards.shape == (5,)
