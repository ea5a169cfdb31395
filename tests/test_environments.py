"""The environments: what Gymnasium promises for them, and that they are the replay's own episodes."""

import doctest
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from test_predictions import some_predictions

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

import nextview.envs  # noqa: E402, F401
from nextview.belief import Calibration, Stopping, of_true_class  # noqa: E402
from nextview.data.predictions import Predictions  # noqa: E402
from nextview.episode import run_episodes  # noqa: E402
from nextview.errors import DatasetError, NextviewError, PredictionsError, SessionError, UsageError  # noqa: E402
from nextview.policies.learned_tables import cells_to  # noqa: E402
from nextview.policies.spread import Spread  # noqa: E402

RECOGNISE = "nextview/Recognise-v0"
INPUTS = ("belief", "view", "place", "lem", "azimuth_bin")


def learnable(n: int = 12, seed: int = 0, split: str = "train") -> Predictions:
    p = some_predictions(n, seed)
    azimuth_bins = np.random.default_rng(seed + 9).normal(size=(n, 40, 3, 8)).astype(np.float32)
    return replace(
        p,
        splits=np.array([split] * n),
        azimuth_bins=azimuth_bins,
        calibration=Calibration(1.5, 0.3, bin_correlation=0.2),
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
        {"threshold": 0.6, "view_price": 0.1, "travel_price": 0.01, "balanced": True, "inputs": ("lem", "azimuth_bin")},
    ],
)
def test_gymnasium_finds_nothing_wrong(file, options):
    env = gymnasium.make(RECOGNISE, predictions=str(file), **options)
    check_env(env.unwrapped)
    assert all(env.observation_space.contains(observation) for observation, *_ in played(env, 0))


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


def test_a_seed_decides_everything(file):
    def same(a, b):
        return all(
            np.array_equal(x, y) for one, other in zip(a, b, strict=True) for x, y in zip(one, other, strict=True)
        )

    options = {"predictions": str(file), "threshold": 0.7}
    first, again, other = (played(gymnasium.make(RECOGNISE, **options), seed) for seed in (3, 3, 4))
    assert same(first, again)
    assert not same(first, other)


@pytest.mark.parametrize("options", [{}, {"threshold": 0.7, "travel_price": 0.02, "frame": "object", "inputs": INPUTS}])
def test_the_vectorised_environment_is_many_single_ones(options):
    p, n, rng = learnable(), 7, np.random.default_rng(1)
    many = gymnasium.make_vec(RECOGNISE, num_envs=n, predictions=p, **options)
    singles = [gymnasium.make(RECOGNISE, predictions=p, **options) for _ in range(n)]
    many.action_space.seed(0)
    observation, info = many.reset(seed=0)
    lengths = set()

    def begin(row):
        """The single environment on the same object, from the same first view."""
        begun = {"object": info["object"][row], "start": info["view"][row]}
        return singles[row].reset(options=begun)[0]

    for row in range(n):
        np.testing.assert_array_equal(begin(row), observation[row])
    for _ in range(40):
        actions = rng.integers(40, size=n)
        observation, rewards, ended, truncated, info = many.step(actions)
        assert not truncated.any()
        for row in range(n):
            seen, reward, over, _, alone = singles[row].step(actions[row])
            last = info["final_info"] if over else info
            np.testing.assert_array_equal(seen, info["final_obs"][row] if over else observation[row])
            assert (reward, over) == (rewards[row], ended[row])
            assert all(np.array_equal(alone[name], last[name][row]) for name in alone)
            if over:
                lengths.add(int(alone["n_views"]))
                np.testing.assert_array_equal(begin(row), observation[row])
    assert len(lengths) > 1 or not options  # with a threshold some end earlier than others


def test_an_episode_is_the_loop_of_a_robot():
    """Beliefs, travel and the end are those of ``run_episodes`` with a policy that goes where the actions went."""
    p = learnable()
    policy, stopping = Spread(p.sphere), Stopping(0.75, 5, p.calibration.correlation)
    for k in range(6):

        def observe(_, views, row=k):
            return p.evidence(np.array([row]), views)

        rng = np.random.default_rng(k)
        expected = run_episodes(observe, p.sphere, policy, np.array([3 * k]), stopping, rng, p.calibration)
        views = expected.outcome.views[0]
        env = gymnasium.make(RECOGNISE, predictions=p, threshold=0.75, objective="belief", inputs=("belief",))
        observation, info = env.reset(options={"object": k, "start": int(views[0])})
        total, ended = observation[p.labels[k]], False
        for step, (here, there) in zip(expected.steps[1:], pairwise(views), strict=False):
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


def test_rewards_are_what_a_view_changes_less_its_prices():
    p = learnable()
    prices = {"view_price": 0.25, "travel_price": 0.125}
    env = gymnasium.make(RECOGNISE, predictions=p, objective="log-belief", **prices)
    for k in range(5):
        _, info = env.reset(seed=k)
        first, row, views, total, ended = info["view"], info["object"], [info["view"]], 0.0, False
        while not ended:
            _, reward, ended, _, info = env.step(env.action_space.sample())
            views.append(info["view"])
            total += reward
        assert len(set(views)) == 5
        logs = [
            p.calibration.log_belief(p.log_evidence[row, taken].astype(np.float64).sum(0), len(taken), 3)
            for taken in ([first], views)
        ]
        change = np.subtract(*[of_true_class(one[None], p.labels[[row]])[0] for one in logs[::-1]])
        travel = sum(p.sphere.travel[a, b] for a, b in pairwise(views))
        assert np.isclose(total, change - 4 * 0.25 - 0.125 * travel)


def test_an_action_that_leads_to_a_view_taken_goes_to_the_nearest_other():
    p = learnable()
    env = gymnasium.make(RECOGNISE, predictions=p)
    _, info = env.reset(options={"object": 0, "start": 19})
    own = 2 * 8  # the ring of view 19, no step ahead
    assert info["action_mask"][own] == 0
    assert info["action_mask"].sum() == 39
    _, _, _, _, info = env.step(own)
    assert p.sphere.travel[19, info["view"]] == 1


def test_training_and_test_objects_stay_apart(tmp_path):
    train, test = learnable(9), learnable(6, 5, "test")
    names = tuple(f"test_{name}" for name in test.names)
    both = replace(
        train, names=train.names + names, logits=np.concatenate([train.logits, test.logits]),
        maps={"lem": np.concatenate([train.maps["lem"], test.maps["lem"]])},
        depth_entropy=np.concatenate([train.depth_entropy, test.depth_entropy]),
        labels=np.concatenate([train.labels, test.labels]), splits=np.concatenate([train.splits, test.splits]),
        conflicting=np.zeros(15, bool), azimuth_bins=np.concatenate([train.azimuth_bins, test.azimuth_bins]),
    )  # fmt: skip
    for split, expected in (("train", train.names), ("test", names), (None, both.names)):
        env = gymnasium.make(RECOGNISE, predictions=both, split=split).unwrapped
        assert env.task.names == expected
    with pytest.raises(PredictionsError, match="no objects of the split 'test'"):
        gymnasium.make(RECOGNISE, predictions=train, split="test")


def test_every_class_is_drawn_equally_often_where_that_is_asked_for():
    p = replace(learnable(30), labels=np.array([0] * 27 + [1] * 2 + [2]))
    drawn = {}
    for balanced in (False, True):
        task = gymnasium.make(RECOGNISE, predictions=p, balanced=balanced).unwrapped.task
        objects, _ = task.draw(3000, np.random.default_rng(0))
        drawn[balanced] = np.bincount(p.labels[objects], minlength=3)
    assert drawn[False][0] > 2600
    assert (np.abs(drawn[True] - 1000) < 130).all()  # five standard deviations


@pytest.mark.parametrize(
    ("options", "error", "sentence"),
    [
        (
            {"inputs": ("belief", "smell")},
            PredictionsError,
            "no map 'smell'; inputs are some of belief, view, .*, lem$",
        ),
        ({"inputs": ("visibility",)}, UsageError, "not 'visibility'"),
        ({"inputs": ()}, UsageError, "not nothing"),
        ({"objective": "joy"}, UsageError, "not 'joy'"),
        ({"max_views": 1}, UsageError, "at least two views"),
        ({"max_views": 41}, UsageError, "40 views"),
        ({"travel_price": -1.0}, UsageError, "travel_price"),
        ({"threshold": 2.0}, UsageError, "probability"),
        ({"inputs": ("lcm",)}, PredictionsError, "no map 'lcm'"),
    ],
)
def test_what_makes_no_sense_is_refused_in_a_sentence(file, options, error, sentence):
    with pytest.raises(error, match=sentence):
        gymnasium.make(RECOGNISE, predictions=str(file), **options)


JUNK = {
    "None": None, "-1": -1, "a half": 2.5, "NaN": np.nan, "huge": 10**40, "a word": "a", "uneven lists": [[1, 2], [3]],
    "an object": object(), "no array": np.zeros(0), "zeros": np.zeros((4, 4)), "a path": Path("/no/such/file"),
}  # fmt: skip


@pytest.mark.parametrize("junk", JUNK)
def test_wrong_arguments_are_one_sentence(file, junk):
    single = gymnasium.make(RECOGNISE, predictions=str(file)).unwrapped
    many = gymnasium.make_vec(RECOGNISE, num_envs=3, predictions=str(file))
    single.reset(seed=0)
    many.reset(seed=0)
    doors = [
        *(lambda junk, env=env: env.step(junk) for env in (single, many)),
        *(lambda junk, env=env: env.reset(options={"object": junk}) for env in (single, many)),
        *(lambda junk, env=env: env.reset(options={"start": junk}) for env in (single, many)),
        lambda junk: gymnasium.make_vec(RECOGNISE, num_envs=junk, predictions=str(file)),
        *(
            lambda junk, name=name: gymnasium.make(RECOGNISE, **{"predictions": str(file), name: junk})
            for name in ("predictions", "inputs", "frame", "objective", "max_views")
        ),
    ]
    for door in doors:
        with pytest.raises(NextviewError):
            door(JUNK[junk])
    for name in ("view_price", "travel_price") if junk not in ("a half", "huge") else ():
        with pytest.raises(NextviewError):
            gymnasium.make(RECOGNISE, predictions=str(file), **{name: JUNK[junk]})
    if junk != "None":
        for door in (single.reset, many.reset):
            with pytest.raises(NextviewError):
                door(options=JUNK[junk])


def test_a_step_without_an_episode_is_refused(file):
    env = gymnasium.make(RECOGNISE, predictions=str(file)).unwrapped
    with pytest.raises(SessionError, match="call reset"):
        env.step(0)


@pytest.mark.filterwarnings("error")
def test_meshes_are_rendered_as_the_agent_goes(tmp_path):
    from nextview.session import Session
    from nextview.system import load, simulated

    options = {"depth": True, "size": 112, "inputs": ("belief", "place", "lem-sphere")}
    env = gymnasium.make("nextview/RecogniseMesh-v0", **options)
    check_env(env.unwrapped, skip_render_check=True)
    observation, _ = env.reset(seed=1)
    assert observation["depth"].shape == (112, 112)
    assert observation["depth"].max() > 2
    # The beliefs are those of a session that takes the same views.
    from nextview.data.samples import SAMPLES, sample_mesh

    plain = gymnasium.make("nextview/RecogniseMesh-v0", inputs=("belief",), max_views=2)
    observation, _ = plain.reset(options={"object": 0, "start": 3})
    system = load(policy="spread", max_views=2)
    camera = simulated(sample_mesh(next(iter(SAMPLES))))
    session: Session = system.session(start=3)
    view = session.update(camera.observe(session.pose))
    np.testing.assert_allclose(observation[:10], view.belief, atol=1e-5)
    with pytest.raises(DatasetError, match="no such folder"):
        gymnasium.make("nextview/RecogniseMesh-v0", meshes=str(tmp_path / "none"))
    box = tmp_path / "spoon/train/box.off"
    box.parent.mkdir(parents=True)
    box.write_text("OFF\n")
    with pytest.raises(DatasetError, match="knows no class 'spoon'"):
        gymnasium.make("nextview/RecogniseMesh-v0", meshes=str(tmp_path))
    with pytest.raises(DatasetError, match="no meshes of the split 'test'"):
        gymnasium.make("nextview/RecogniseMesh-v0", meshes=str(tmp_path), split="test")


def test_ap_gym_takes_it_for_one_of_its_own():
    """Rewards are its own normalised cross-entropy, by its own loss, and our prices."""
    ap_gym = pytest.importorskip("ap_gym")
    from scipy.special import log_softmax

    p = learnable()
    env = gymnasium.make("nextview/ActiveRecognise-v0", predictions=p, travel_price=0.5).unwrapped
    assert isinstance(env, ap_gym.ActiveClassificationEnv)
    assert ap_gym.ensure_active_perception_env(env) is env
    env.action_space.seed(0)
    _, info = env.reset(seed=0)
    here = info["view"]
    for _ in range(4):
        action = env.action_space.sample()
        _, reward, ended, _, info = env.step(action)
        target = info["prediction"]["target"]
        loss = -log_softmax(action["prediction"])[target] / np.log(3)
        assert np.isclose(reward, info["base_reward"] - loss, atol=1e-5)
        assert info["base_reward"] <= -0.5
    assert ended
    assert 0 <= here < 40
    many = gymnasium.make_vec("nextview/ActiveRecognise-v0", num_envs=5, predictions=p, max_views=3)
    many.action_space.seed(0)
    _, begun = many.reset(seed=0)
    targets = [begun["prediction_target"]]
    for _ in range(4):
        _, rewards, ended, _, info = many.step(many.action_space.sample())
        np.testing.assert_array_equal(info["prediction"]["target"], targets[-1])
        targets.append(info["prediction_target"])
    assert rewards.shape == (5,)


def test_the_page_does_what_it_says(tmp_path, monkeypatch):
    learnable().save(tmp_path / "validation.npz")
    monkeypatch.chdir(tmp_path)
    page = Path(__file__).parents[1] / "docs/environments.md"
    failed, tried = doctest.testfile(str(page), module_relative=False)
    assert tried > 12
    assert failed == 0
