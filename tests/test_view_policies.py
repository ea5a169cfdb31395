"""Policies of a whole table: built-in rules, rules of one's own, and what is wrong with them."""

from dataclasses import replace

import numpy as np
import pytest
from factories import camera_over, view

import nextview
from nextview.errors import PolicyError
from nextview.scene.view_policies import NamedPolicy

MINE = """
import numpy as np

def lowest(choice, rng):
    return -choice.views.poses[:, 2, 3]

def near_doubts(choice, rng):
    doubtful = [thing.place for thing in choice.objects if not thing.settled]
    assert len(choice.frames) == 1
    return choice.by_ground - choice.views.travel - len(doubtful)

def raises(choice, rng):
    return choice.nothing                        # line 13

class Twice:
    def __init__(self):
        self.asked = 0
    def __call__(self, choice, rng):
        self.asked += 1
        return int(np.flatnonzero(choice.views.free)[self.asked - 1])

class OfOneObject:
    needs = ()
    def __init__(self, sphere):
        pass
    def next_views(self, state, rng):
        return state.free.argmax(1)

number = 3
"""


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "rules_of_mine.py").write_text(MINE)


@pytest.fixture(scope="module")
def seen(ycb, ycb_meshes):
    """A scene after one frame of three things, and what its policy was asked with."""
    asked = []

    def keep(choice, rng):
        asked.append(choice)
        return choice.information

    scene = nextview.Scene(ycb, policy=keep)
    things = [ycb_meshes[name] for name in ("cracker_box", "mug", "banana")]
    scene.update(camera_over(things, seed=3).frame(view(20)))
    assert scene.target is not None
    assert scene.target is not None
    assert len(asked) == 1  # once a frame
    return scene, asked[0]


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def chosen(choice, policy) -> int:
    return NamedPolicy.of(policy).ranked(choice, rng())[0]


def test_a_policy_is_told_what_the_scene_knows(seen):
    scene, choice = seen
    views = choice.views
    v = len(views.poses)
    for values, shape in (
        (views.free, (v,)),
        (views.directions, (v, 3)),
        (views.travel, (v,)),
        (views.current, (3,)),
        (choice.by_ground, (v,)),
    ):
        assert values.shape == shape
    here = scene.frames[-1].camera_to_world[:3, 3]
    away = np.linalg.norm(views.poses[:, :3, 3] - here, axis=1)
    np.testing.assert_allclose(views.travel, away)

    assert [thing.number for thing in choice.objects] == [
        thing.number for thing in scene.objects
    ]
    assert all(thing.settled for thing in choice.objects if thing.confident)
    assert choice.frames == scene.frames
    assert choice.ground.hidden.shape == (len(choice.ground.points),)
    assert set(choice.by_object) == {thing.number for thing in choice.objects}
    total = sum(choice.by_object.values()) + choice.by_ground
    np.testing.assert_allclose(choice.information, total)
    assert (choice.information[views.free] > 0).all()


def test_the_named_rules_choose_what_they_say(seen):
    _, choice = seen
    views = choice.views
    free = np.flatnonzero(views.free)
    most = free[choice.information[free].argmax()]
    best = chosen(choice, "target")
    assert choice.information[best] > 0.94 * choice.information[most]
    assert views.travel[best] <= views.travel[most] + 1e-9

    turned = chosen(choice, "fixed")
    azimuths = np.arctan2(views.directions[:, 1], views.directions[:, 0])
    ahead = azimuths[turned] - np.arctan2(views.current[1], views.current[0])
    assert abs((np.degrees(ahead) - 90 + 180) % 360 - 180) <= 22.5
    assert abs(views.directions[turned, 2] - views.current[2]) < np.sin(np.radians(12))

    policy = NamedPolicy.of("random")
    source = rng()
    drawn = {policy.ranked(choice, source)[0] for _ in range(200)}
    heights = np.degrees(np.arcsin(views.directions[:, 2]))
    usual = views.free & (heights >= 30) & (heights <= 60)
    assert drawn == set(np.flatnonzero(usual))
    high = replace(choice, views=replace(views, free=views.free & (heights > 60)))
    assert high.views.free[chosen(high, "random")]


def test_own_rules_are_functions_classes_and_names(seen):
    _, choice = seen
    free = np.flatnonzero(choice.views.free)
    height = choice.views.poses[:, 2, 3]
    assert height[chosen(choice, "rules_of_mine:lowest")] == height[free].min()
    assert chosen(choice, "rules_of_mine:near_doubts") in free
    twice = NamedPolicy.of("rules_of_mine:Twice")
    assert [twice.ranked(choice, rng())[0] for _ in range(2)] == free[:2].tolist()

    values = np.full(len(height), np.nan)
    values[free[3]] = -5
    values[np.flatnonzero(~choice.views.free)] = 100
    assert chosen(choice, lambda choice, rng: values.tolist()) == free[3]
    assert chosen(choice, lambda choice, rng: np.int64(free[-1])) == free[-1]
    assert chosen(choice, lambda choice, rng: np.zeros(len(height), int)) == free[0]


def test_a_scene_goes_where_its_policy_says(ycb, ycb_meshes):
    camera = camera_over([ycb_meshes["mug"]])
    targets = []
    for policy in ("rules_of_mine:lowest", "random", "random"):
        scene = nextview.Scene(
            ycb,
            reachable=lambda pose: pose[0, 3] > 0.1,
            policy=policy,
            rng=np.random.default_rng(len(targets)),
        )
        assert scene.target is None
        scene.update(camera.frame(view(20)))
        targets.append(scene.target)
    assert all(target[0, 3] > 0.1 for target in targets)
    assert targets[0][2, 3] == min(target[2, 3] for target in targets)
    assert not np.allclose(targets[1], targets[2])


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        (np.zeros(3), r"has to return \d+ numbers, .* not float64 of the shape \(3,\)"),
        (None, "has to return .*, not object of the shape"),
        ([[1], [2, 3]], "raised ValueError: "),
        (10_000, "chose view 10000; there are "),
        (np.full(40, np.nan), "values every free view as NaN"),
    ],
)
def test_what_is_no_choice_is_refused(seen, said, sentence):
    with pytest.raises(PolicyError, match=f"^policy mine {sentence}"):
        NamedPolicy("mine", lambda choice, rng: said).ranked(seen[1], rng())
