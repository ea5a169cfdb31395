"""Parts of a scene: objects that are one, the ground, what hides."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
from factories import camera_over, view

import nextview
from nextview.scene.next_view import TableGround, outline_of
from nextview.segmentation.instances import instances_of
from nextview.sensing.segmented_frame import segmented_frame
from nextview.sensing.tabletop import TableTop
from nextview.session.judging import Judge
from nextview.session.parting import (
    MOST_CUT,
    MOST_JOINED,
    MOST_TRIMMED,
    Bench,
    merged,
    new_track,
    part,
    taken_over,
)
from nextview.session.tracks import Track, judged

UP = np.array([0, 0, 1.0])


def top_of(frame):
    """What a frame shows on its surfaces by the bundled network."""
    return TableTop.of(segmented_frame(frame, instances_of(None, frame, UP), UP), UP)


def judged_by(ycb):
    judge = Judge(ycb.models, ycb.sphere, ycb.stopping, ycb.unknown)

    return partial(judged, judge=judge)


def two_sides(
    ycb,
    camera,
    degrees=(20, 140),
) -> tuple[list[list[Track]], list[Bench]]:
    """The objects of each of two frames as objects of their own, judged, with their frames."""
    judged = judged_by(ycb)
    found, benches = [], []
    for number, angle in enumerate(degrees):
        top = top_of(camera.frame(view(angle)))
        benches.append(Bench(top, number, judged))
        of_frame = [new_track(mask, benches[-1]) for mask in top.seen.segments()]
        found.append(
            [
                replace(one, number=10 * number + k)
                for k, one in enumerate(judged(of_frame))
            ]
        )
    return found, benches


def test_two_sides_of_one_thing_are_one_object_and_two_things_stay_two(ycb, ycb_meshes):
    found, benches = two_sides(
        ycb,
        camera_over([ycb_meshes["tomato_soup_can"], ycb_meshes["cracker_box"]]),
    )
    assert [len(tracks) for tracks in found] == [2, 2]
    every = [track for tracks in found for track in tracks]
    one_each = merged(every, benches)
    assert sorted(track.result.answer for track in one_each) == [
        "cracker_box",
        "tomato_soup_can",
    ]
    assert all(track.frames == (0, 1) for track in one_each)
    assert sorted(number for track in one_each for number in track.absorbed) == [10, 11]
    assert merged(found[0], benches[:1]) == found[0]


def test_a_frame_full_of_scraps_is_parted_otherwise_a_few_times_only(ycb_meshes):
    top = top_of(camera_over([ycb_meshes["cracker_box"]]).frame(view(20)))
    (box,) = top.seen.segments()
    rows = np.flatnonzero(box.any(1))
    strips = []
    for some in np.array_split(rows[2:-2], 20):
        strip = np.zeros_like(box)
        strip[some] = box[some]
        strips.append(strip)
    unknown = SimpleNamespace(answer=None, pose=None, pose_candidates=())
    judged = []

    def judge(tracks):
        judged.extend(tracks)
        return [replace(track, result=unknown) for track in tracks]

    bench = Bench(top, 0, judge)
    tracks = judge([new_track(strip, bench) for strip in strips])
    judged.clear()
    assert len(part(tracks, bench, {})) == len(tracks)
    # each strip and its neighbour would be 19 tries
    assert MOST_JOINED <= len(judged) <= MOST_JOINED + MOST_TRIMMED + 2 * MOST_CUT


def test_parts_that_one_hypothesis_explains_are_tried_as_one_before_larger_ones(
    ycb, ycb_meshes
):
    ((box,),), (bench,) = two_sides(
        ycb, camera_over([ycb_meshes["cracker_box"]]), (20,)
    )
    mask = box.mask_in(0)
    rows = np.flatnonzero(mask.any(1))[2:-2]
    strips = []
    for some in (*np.array_split(rows[8:], 18), rows[4:8], rows[:4]):
        strip = np.zeros_like(mask)
        strip[some] = mask[some]
        strips.append(strip)
    smallest = strips[-1] | strips[-2]
    assert smallest.sum() < min(strip.sum() for strip in strips[:-2]) * 2

    posed = SimpleNamespace(
        answer=None, pose=None, pose_candidates=box.result.pose_candidates
    )
    unknown = SimpleNamespace(answer=None, pose=None, pose_candidates=())
    judged = []

    def judge(tracks):
        judged.extend(tracks)
        return [replace(track, result=unknown) for track in tracks]

    bench = Bench(bench.top, 0, judge)
    tracks = [
        replace(new_track(strip, bench), result=unknown if k < 18 else posed)
        for k, strip in enumerate(strips)
    ]
    part(tracks, bench, {})
    assert any((one.mask_in(0) == smallest).all() for one in judged)


def test_an_object_that_ended_takes_no_pixels(ycb, ycb_meshes):
    found, benches = two_sides(ycb, camera_over([ycb_meshes["tomato_soup_can"]]), (20,))
    ((can,),) = found
    ended = replace(can, frames=())
    unjudged = replace(can, number=5, result=None)
    assert taken_over([ended, unjudged], benches) == [ended, unjudged]
    assert taken_over([can, unjudged], benches)[0].absorbed == (5,)


def test_a_look_lists_the_numbers_of_merged_objects(ycb, ycb_meshes):
    camera = camera_over([ycb_meshes["mug"], ycb_meshes["cracker_box"]])
    scene = nextview.Scene(ycb)
    scene.update(camera.frame(view(20)))
    mug = next(track for track in scene._state.tracks if track.result.answer == "mug")
    # as if another frame had shown it as another one
    state = scene._state
    scene._state = replace(state, tracks=(*state.tracks, replace(mug, number=7)))
    look = scene.update(camera.frame(view(140)))
    assert look.joined == ((7, mug.number),)
    assert look.appeared == look.gone == look.moved == ()
    assert len(scene.objects) == 2


def test_a_lone_thing_that_is_elsewhere_may_be_a_wrong_pose(ycb, ycb_meshes):
    camera = camera_over([ycb_meshes["mug"]])
    scene = nextview.Scene(ycb)
    scene.update(camera.frame(view(20)))
    frame = camera.frame(view(60))
    pose = frame.pose.copy()
    pose[:2, 3] += 0.2
    look = scene.update(replace(frame, pose=pose))
    assert [move.number for move in look.moved] == [1]
    assert [warning.name for warning in look.warnings] == ["pose"]


def test_an_occluded_thing_is_not_visible(ycb, ycb_meshes):
    camera = camera_over([ycb_meshes["cracker_box"], ycb_meshes["tomato_soup_can"]])
    scene = nextview.Scene(ycb)
    scene.update(camera.frame(view(20, elevation=65.0)))
    tracks = {track.result.most_like: track for track in scene._state.tracks}
    box, can = (
        tracks[name].thing.object_frame.centre
        for name in ("cracker_box", "tomato_soup_can")
    )
    ground = TableGround.of(scene.tops, scene._state.tracks)
    away = (box - can)[:2] / np.linalg.norm((box - can)[:2])
    behind_the_box = np.append(box[:2] + 0.5 * away, 0.08)
    before_the_can = np.append(can[:2] - 0.5 * away, 0.08)
    points = outline_of(tracks["tomato_soup_can"])
    assert ground.past_others(before_the_can, points).all()
    assert ground.past_others(behind_the_box, points).mean() < 0.5
