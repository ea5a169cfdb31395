"""Names that an object cannot have: told of a system, and by a rule about a scene."""

import pickle

import numpy as np
import pytest
from factories import camera_over, view

import nextview
from nextview.errors import ModelError, UsageError
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


def test_a_name_that_is_ruled_out_leaves_the_likeliest_other_one(ycb, banana_frame):
    before = result_of(ycb, banana_frame)
    assert before.most_like == "banana"
    without = ycb.without("banana")
    after = result_of(without, banana_frame)
    assert after.most_like != "banana"
    assert after.beliefs["banana"] == 0
    assert sum(after.beliefs.values()) == pytest.approx(1)
    assert after.novelty < before.novelty
    assert "banana" not in {candidate.thing for candidate in after.pose_candidates}
    assert not after.confident

    copied = pickle.loads(pickle.dumps(without))
    assert copied.ruled_out == ("banana",)
    assert result_of(copied, banana_frame).beliefs == after.beliefs


def test_to_rule_out_another_name_changes_nothing(ycb, banana_frame):
    before = result_of(ycb, banana_frame)
    after = result_of(
        ycb.without("bleach_cleanser").without("wood_block"), banana_frame
    )
    assert after.answer == "banana"
    assert after.novelty == before.novelty
    assert after.doubt == before.doubt
    np.testing.assert_array_equal(after.pose, before.pose)


def test_if_all_names_are_ruled_out_the_object_is_unknown(ycb, banana_frame):
    result = result_of(ycb.without(*ycb.classes), banana_frame)
    assert result.unknown
    assert result.answer is None
    assert result.pose is None


def test_what_is_no_taught_thing_is_not_ruled_out(ycb):
    with pytest.raises(UsageError, match="did you mean 'banana'"):
        ycb.without("bananna")
    with pytest.raises(ModelError, match="known geometry"):
        nextview.load().without("chair")


def test_a_rule_about_all_objects_of_a_scene(ycb, ycb_meshes):
    """Two bananas: the rule leaves the name to one, and gives it back once the other is gone."""
    banana = ycb_meshes["banana"]
    camera = camera_over([banana, banana], gap=0.15)
    free = nextview.Scene(ycb)
    ruled = nextview.Scene(ycb, rule=one_of_each)
    frame = camera.frame(view(20))
    free.update(frame)
    ruled.update(frame)
    assert [one.name for one in free.objects] == ["banana", "banana"]

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
        (
            lambda objects: {1: {"bananna": "so"}},
            "bananna is none of the taught things",
        ),
    ],
)
def test_what_is_no_rule_is_refused_and_the_scene_stays(
    ycb, banana_frame, rule, sentence
):
    scene = nextview.Scene(ycb, rule=rule)
    with pytest.raises(UsageError, match=sentence):
        scene.update(banana_frame[0])
    assert not scene.objects
    assert not scene.frames
