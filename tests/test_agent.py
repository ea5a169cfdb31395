"""Agents of reinforcement learning: trained on the replay, written, and run without what trained them."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from test_environments import learnable
from test_fitting import SMALL, telling
from test_gain import some_state

pytest.importorskip("stable_baselines3")

from nextview.belief import Calibration
from nextview.calibration.rollout import ReplayTable, judge, rollout
from nextview.cli.main import main
from nextview.data.predictions import Predictions
from nextview.errors import PolicyError, ResultsError, UsageError
from nextview.policies.agent import Agent
from nextview.policies.baselines import RandomAll
from nextview.policies.registry import make_policy
from nextview.training.agent.agent_training import train_agent
from nextview.training.recipes import AgentRecipe

QUICK = ["--steps", "64", "--envs", "8", "--rollout", "4", "--evaluations", "2", "--hidden", "8", "--batch", "8"]
PLAIN = ["--inputs", "belief", "place", "--frame", "camera"]


def as_predictions(data, split="train") -> Predictions:
    n = len(data)
    entropy = np.random.default_rng(0).random((n, len(data.sphere))).astype(np.float32)
    names = tuple(f"{split}_{i}" for i in range(n))
    return Predictions(
        data.logits.astype(np.float32), {}, entropy, names, data.labels, data.classes, np.array([split] * n),
        np.zeros(n, bool), data.sphere, {"recogniser": ("r", "0" * 64)}, {}, Calibration(1.01),
    )  # fmt: skip


@pytest.mark.parametrize(("preset", "steps"), [("default", 24_000), ("mvselect", 24_000)])
def test_an_agent_finds_the_views_that_tell_the_class_believed(tmp_path, preset, steps):
    """Every class is told on one ring alone, and each view hints at the class: go to the ring of the class believed."""
    as_predictions(telling(SMALL, [[0], [1], [2]], 150)).save(tmp_path / "p.npz")
    learns = ["--steps", str(steps), "--envs", "64", "--evaluations", "4", "--batch", "256", "--n-views", "2"]
    learns += ["--objective", "log-belief", *PLAIN]
    main(["train", "agent", str(tmp_path / "p.npz"), str(tmp_path / "a.json"), "--preset", preset, *learns])
    fresh = ReplayTable(telling(SMALL, [[0], [1], [2]], 90, seed=1), {}, Calibration(1.01))
    agent = make_policy(str(tmp_path / "a.json"), SMALL)
    assert isinstance(agent, Agent)
    first, second = (SMALL.ring[m.state.current] for m in rollout(fresh, agent, 2, np.random.default_rng(5)))
    not_told_yet = first != fresh.data.labels
    assert np.mean((second == fresh.data.labels)[not_told_yet]) > 0.7  # a third by chance
    blind, ours = (
        judge(fresh, policy, 2, "log-belief", np.random.default_rng(0)) for policy in (RandomAll(SMALL), agent)
    )
    assert ours.mean[-1] > blind.mean[-1]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent")
    learnable(30).save(folder / "p.npz")
    for name, preset in (("agent", "default"), ("mvselect", "mvselect")):
        main(
            ["train", "agent", str(folder / "p.npz"), str(folder / f"{name}.json"), "--preset", preset, *QUICK, *PLAIN]
        )
    return folder


def test_the_benchmark_takes_agents_beside_the_others(trained, tmp_path, capsys):
    learnable(9, 3, "test").save(tmp_path / "test.npz")
    cards = [str(trained / "agent.json"), str(trained / "mvselect.json")]
    out = tmp_path / "out"
    main(["benchmark", str(tmp_path / "test.npz"), "--out", str(out), "--policies", "random", *cards, "--runs", "2"])
    printed = "".join(capsys.readouterr().out.split())
    assert "agent.json" in printed
    assert "mvselect.json" in printed
    settings = next(json.loads(path.read_text()) for path in out.rglob("*.json") if "failures" in path.read_text())
    assert settings["failures"] == {}
    assert set(cards) < set(settings["policies"])


def test_a_card_says_how_and_its_file_is_the_one_that_was_written(trained, tmp_path):
    card = json.loads((trained / "mvselect.json").read_text())
    assert (card["kind"], card["settings"]["algorithm"]) == ("agent", "dqn")
    assert "24 objects" in card["learned_from"]
    assert any("train agent" in line for line in card["commands"])
    for suffix in ("json", "onnx"):
        (tmp_path / f"bad.{suffix}").write_bytes((trained / f"mvselect.{suffix}").read_bytes())
    with (tmp_path / "bad.onnx").open("r+b") as file:
        file.seek(200)
        file.write(b"x")
    with pytest.raises(PolicyError, match=r"bad\.onnx"):
        make_policy(str(tmp_path / "bad.json"), learnable().sphere)


def test_an_agent_runs_where_nothing_that_trained_it_is(trained):
    script = f"""
import sys
sys.modules |= dict.fromkeys(["torch", "stable_baselines3", "gymnasium", "onnx"])
import numpy as np
from nextview.policies.base import EpisodeState, Evidence
from nextview.policies.registry import make_policy
from nextview.viewsphere import ViewSphere
sphere = ViewSphere.named("40")
visited = np.zeros((1, 40), bool)
visited[0, 3] = True
state = EpisodeState(np.array([3]), visited, np.full((1, 3), 1 / 3), Evidence(np.zeros((1, 3))), 1)
print(*make_policy({str(trained / "agent.json")!r}, sphere).next_views(state, np.random.default_rng(0)))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert int(done.stdout) in set(range(40)) - {3}


def test_the_same_seed_gives_the_same_agent(trained, tmp_path):
    for seed in ("0", "1"):
        main(["train", "agent", str(trained / "p.npz"), str(tmp_path / f"{seed}.json"), *QUICK, *PLAIN, "--seed", seed])
    first, again, other = (
        path.read_bytes() for path in (trained / "agent.onnx", tmp_path / "0.onnx", tmp_path / "1.onnx")
    )
    assert first == again
    assert first != other


def test_an_agent_chooses_free_views_in_each_episode_by_itself(trained):
    state = some_state()
    state = replace(state, belief=state.belief[:, :3], evidence=state.evidence)
    agent = make_policy(str(trained / "agent.json"), learnable().sphere)
    state = replace(state, belief=state.belief / state.belief.sum(1, keepdims=True))
    chosen = agent.next_views(state, np.random.default_rng(0))
    free = ~state.visited.all(1)
    assert not state.visited[np.arange(60), chosen][free].any()
    alone = [agent.next_views(state.of(np.array([k])), np.random.default_rng(1))[0] for k in range(0, 60, 9)]
    np.testing.assert_array_equal(alone, chosen[::9])


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["p.npz", "agent"], "NAME.json"),
        (["none.npz", "a.json"], "no such file"),
        (["p.npz", "a.json", "--inputs", "lcm"], "no map 'lcm'"),
        (["test.npz", "a.json"], "no objects of the split 'train'"),
        (["p.npz", "a.json", "--discount", "2"], "--discount"),
        (["p.npz", "a.json", "--preset", "dreamer"], "dreamer"),
    ],
)
def test_what_makes_no_sense_is_refused_in_a_sentence(trained, arguments, sentence, monkeypatch, capsys):
    monkeypatch.chdir(trained)
    learnable(6, 1, "test").save(trained / "test.npz")
    with pytest.raises(SystemExit) as end:
        main(["train", "agent", *arguments])
    assert end.value.code == 2
    assert sentence in capsys.readouterr().err


def test_a_card_that_cannot_be_written_is_refused_before_any_learning(tmp_path):
    (tmp_path / "a.json").mkdir()
    with pytest.raises(ResultsError, match="is a folder"):
        train_agent(tmp_path / "none.npz", tmp_path / "a.json")


@pytest.mark.parametrize("wrong", [{"seed": 2**32}, {"envs": 1, "rollout": 1}])
def test_a_recipe_that_no_agent_can_follow_is_refused(wrong):
    with pytest.raises(UsageError, match="--"):
        AgentRecipe(**wrong)
