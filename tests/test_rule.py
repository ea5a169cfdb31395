"""Names that an object cannot have: told of a system, and by a rule about a scene."""

import pickle
from types import SimpleNamespace

import pytest
from factories import camera_over, view

import nextview
from nextview.errors import ModelError, UsageError
from nextview.scene.rule import ruled_out_by
from nextview.sensing import ObservedObject


def one_of_each(objects):
    """No two copies of one thing: the one that is more certain has the name."""
    ruled_out, taken = {}, {}
    for one in sorted(objects, key=lambda one: -one.confidence):
        if one.name != "unknown" and one.name in taken:
            ruled_out[one.number] = {one.name: f"object {taken[one.name]} is it"}
        taken.setdefault(one.name, one.number)
    return ruled_out


@pytest.fixture(scope="module")
def banana_frame(ycb_meshes):
    camera = camera_over([ycb_meshes["banana"]])
    return camera.frame(view(20)), camera.table.things[0].placed.mean(0)


def result_of(system, seen):
    frame, point = seen
    session = system.session(object=ObservedObject(point=point), distance=0.6)
    session.update(frame)
    return session.result


@pytest.fixture(scope="module")
def before(ycb, banana_frame):
    """What it is where no name is ruled out."""
    return result_of(ycb, banana_frame)


def test_a_name_that_is_ruled_out_leaves_the_likeliest_other_one(
    ycb, banana_frame, before
):
    assert before.most_like == "banana"
    without = ycb.without("banana")
    after = result_of(without, banana_frame)
    assert after.most_like != "banana"
    assert after.beliefs["banana"] == 0
    assert sum(after.beliefs.values()) == pytest.approx(1)
    assert after.novelty < before.novelty
    assert "banana" not in {candidate.thing for candidate in after.pose_candidates}
    assert not after.confident

    assert pickle.loads(pickle.dumps(without)).ruled_out == ("banana",)


def test_a_scene_finds_no_thing_that_is_ruled_out(ycb, banana_frame):
    frame, _ = banana_frame
    for system, is_there in ((ycb, True), (ycb.without("banana"), False)):
        scene = nextview.Scene(system)
        scene.update(frame)
        assert ("banana" in scene.objects[0].beliefs) == is_there


def test_all_names_are_not_ruled_out(ycb):
    first, *others = ycb.classes
    with pytest.raises(UsageError):
        ycb.without(*others).without(first)


def test_what_is_no_taught_thing_is_not_ruled_out(ycb):
    with pytest.raises(UsageError):
        ycb.without("bananna")
    with pytest.raises(ModelError):
        nextview.load().without("chair")


def test_a_rule_about_all_objects_of_a_scene(ycb, ycb_meshes):
    """Two bananas: the rule leaves the name to one, and gives it back once the other is gone."""
    banana = ycb_meshes["banana"]
    camera = camera_over([banana, banana], gap=0.15)
    ruled = nextview.Scene(ycb, rule=one_of_each)
    ruled.update(camera.frame(view(20)))
    named = [one for one in ruled.objects if one.name == "banana"]
    others = [one for one in ruled.objects if one.name != "banana"]
    assert len(named) == len(others) == 1
    reasons = dict(others[0].ruled_out)
    assert reasons["banana"] == f"object {named[0].number} is it"
    assert "banana" not in others[0].beliefs
    assert not others[0].confident
    assert not named[0].ruled_out

    ruled.rule = lambda objects: {}
    ruled.update(camera.frame(view(70)))
    assert [one.name for one in ruled.objects] == ["banana", "banana"]


@pytest.mark.parametrize(
    ("rule", "sentence"),
    [
        (lambda objects: 1 / 0, "the rule of the scene raised ZeroDivisionError"),
        (lambda objects: ["banana"], "names by the number of an object"),
        (lambda objects: {99: {"banana": "so"}}, "names by the number of an object"),
        (lambda objects: {1: ["banana"]}, "the reason for each name"),
    ],
)
def test_what_is_no_rule_is_refused(rule, sentence):
    with pytest.raises(UsageError, match=sentence):
        ruled_out_by(rule, [SimpleNamespace(number=1, ruled_out=())])


def test_a_scene_is_unchanged_where_its_rule_is_refused(ycb, banana_frame):
    scene = nextview.Scene(ycb, rule=lambda objects: {1: {"bananna": "so"}})
    with pytest.raises(UsageError):
        scene.update(banana_frame[0])
    assert not scene.objects
    assert not scene.frames
