"""Parts of a scene: objects that are one, the ground, what hides, what floats."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_tables import camera_over, view

import nextview
from nextview.scene.floating import floating
from nextview.scene.following import parts_of, same_objects
from nextview.scene.fragments import fragments
from nextview.scene.judging import Judge
from nextview.scene.next_view import TableGround
from nextview.scene.parting import (
    MOST_CUT,
    MOST_JOINED,
    MOST_TRIMMED,
    Bench,
    merged,
    new_track,
    part,
    taken_over,
)
from nextview.scene.tracks import Track
from nextview.sensing.frame import Frame
from nextview.sensing.tabletop import TableTop

UP = np.array([0, 0, 1.0])


def judged_by(ycb):
    judge = Judge(ycb, 1)

    def judged(tracks):
        results = judge([track.thing for track in tracks])
        return [
            replace(track, result=one)
            for track, one in zip(tracks, results, strict=True)
        ]

    return judged


def two_sides(
    ycb,
    camera,
    degrees=(20, 140),
) -> tuple[list[list[Track]], list[Bench]]:
    """The objects of each of two frames as objects of their own, judged, with their frames."""
    judged = judged_by(ycb)
    found, benches = [], []
    for number, angle in enumerate(degrees):
        top = TableTop.of(camera.frame(view(angle)), UP)
        benches.append(Bench(top, number, judged))
        of_frame = [new_track(mask, benches[-1]) for mask in top.segments()]
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
    top = TableTop.of(camera_over([ycb_meshes["cracker_box"]]).frame(view(20)), UP)
    (box,) = top.segments()
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


def test_an_object_that_ended_takes_no_pixels(ycb, ycb_meshes):
    found, benches = two_sides(ycb, camera_over([ycb_meshes["tomato_soup_can"]]), (20,))
    ((can,),) = found
    ended = replace(can, frames=())
    unjudged = replace(can, number=5, result=None)
    assert taken_over([ended, unjudged], benches) == [ended, unjudged]
    assert taken_over([can, unjudged], benches)[0].absorbed == (5,)


def test_a_look_tells_which_numbers_end_in_another_object(ycb, ycb_meshes):
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
    look = scene.update(replace(frame, pose=pose, pixel_centre=0.5))
    assert look.moved == (1,)
    assert [warning.name for warning in look.warnings] == ["pose"]


def test_the_ground_is_below_what_may_be_a_thing(ycb_meshes):
    camera = camera_over([ycb_meshes["mug"]])
    frame = camera.frame(view(20, elevation=35.0, distance=2.2))
    table = np.array([0, 0, 0.0])
    small = TableTop.of(frame, UP, widest=0.4).plane
    assert small.height(table) == pytest.approx(0, abs=0.02)
    large = TableTop.of(frame, UP, widest=5.0).plane  # tables are looked for, too
    assert large.height(table) == pytest.approx(0.75, abs=0.03)
    assert TableTop.of(frame, UP).plane.height(table) == pytest.approx(0, abs=0.02)


def test_no_ground_has_anything_below_it(ycb_meshes):
    camera = camera_over([ycb_meshes["mug"]])
    frame = camera.frame(view(20, elevation=35.0, distance=2.2))
    x, y, z = (frame.along(axis) for axis in np.eye(3))
    depth = frame.depth.copy()
    depth[(z < -0.3) & (np.hypot(x, y) > 0.9)] = 0  # a scrap of the floor
    scrap = Frame(depth, frame.intrinsics, frame.pose, pixel_centre=0.5)
    top = TableTop.of(scrap, UP, widest=5.0)
    floor = float(np.median(z[(depth > 0) & (z < -0.3)]))
    assert top.plane.height(np.zeros(3)) == pytest.approx(-floor, abs=0.05)

    depth[z < -0.3] = 0
    alone = Frame(depth, frame.intrinsics, frame.pose, pixel_centre=0.5)
    assert TableTop.of(alone, UP, widest=5.0).plane.height(
        np.zeros(3)
    ) == pytest.approx(0, abs=0.02)


def test_a_thing_stands_on_the_table_and_the_table_on_the_ground(ycb_meshes):
    camera = camera_over([ycb_meshes["mug"]])
    frame = camera.frame(view(20, elevation=35.0, distance=2.2))
    top = TableTop.of(frame, UP, widest=5.0)
    heights = frame.along(UP)
    mug = camera.owner == 0
    assert top.under(mug).height(np.zeros(3)) == pytest.approx(0, abs=0.02)
    table = heights > -0.1
    assert top.under(table).height(np.zeros(3)) == pytest.approx(0.75, abs=0.03)

    near = camera.frame(view(20, elevation=60.0, distance=0.4))
    known = TableTop.of(near, UP, top.ground, widest=5.0)
    assert not known.lower
    assert known.plane is top.plane  # it is out of the picture


def test_all_frames_are_judged_anew_once_one_shows_the_floor(ycb_meshes):
    camera = camera_over([ycb_meshes["mug"], ycb_meshes["cracker_box"]])
    scene = nextview.Scene("modelnet10")
    near = camera.frame(view(20, elevation=60.0, distance=0.4))
    scene.update(near)
    assert scene.tops[0].plane.height(np.zeros(3)) == pytest.approx(0, abs=0.02)
    on_the_table = [thing.number for thing in scene.objects]
    assert on_the_table

    look = scene.update(camera.frame(view(20, elevation=35.0, distance=2.2)))
    assert [warning.name for warning in look.warnings] == ["ground"]
    assert sorted(ended for ended, _ in look.joined) == on_the_table
    for top in scene.tops:
        assert top.plane.height(np.zeros(3)) == pytest.approx(0.75, abs=0.03)
    table = max(scene.objects, key=lambda thing: np.prod(thing.size))
    assert {whole for _, whole in look.joined} == {table.number}
    assert set(table.pixels) == {0, 1}


def test_objects_keep_their_numbers_if_they_keep_most_of_their_pixels():
    def track(number, *columns):
        masks = {}
        for frame, own in enumerate(columns):
            masks[frame] = np.zeros((4, 20), bool)
            masks[frame][:, own] = True
        return SimpleNamespace(number=number, pixels=masks)

    kept = track(1, slice(0, 4), slice(0, 4))
    cup = track(2, slice(8, 10))
    gone = track(3, slice(18, 20))
    now = [track(5, slice(0, 3), slice(0, 4)), track(6, slice(6, 16), slice(6, 16))]
    same = same_objects(now, [kept, cup, gone])
    assert same == {5: 1}
    assert parts_of([kept, cup, gone], now, same) == ((2, 6),)


def test_what_stands_behind_another_thing_is_not_seen(ycb, ycb_meshes):
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
    assert ground.share_visible(before_the_can, tracks["tomato_soup_can"]) == 1
    assert ground.share_visible(behind_the_box, tracks["tomato_soup_can"]) < 0.5


@pytest.mark.parametrize(
    ("pixels", "touching", "expected"),
    [
        ((300, 6000), {(1, 2)}, [True, False]),  # the tip of a banana
        ((300, 6000), set(), [False, False]),  # a die that stands alone
        ((300, 900), {(1, 2)}, [False, False]),  # beside one that is as small
        ((900, 6000), {(1, 2)}, [False, False]),
    ],
)
def test_few_pixels_beside_a_larger_object_may_be_a_part_of_it(
    pixels,
    touching,
    expected,
):
    tracks = []
    for number, count in enumerate(pixels, start=1):
        mask = np.arange(10_000).reshape(100, 100) < count
        tracks.append(SimpleNamespace(number=number, pixels={0: mask, 1: mask[:1]}))
    assert fragments(tracks, touching) == expected


def test_a_thing_floats_unless_it_stands_on_the_plane_or_on_another_object(
    ycb,
    ycb_meshes,
):
    camera = camera_over([ycb_meshes["mug"]])
    top = TableTop.of(camera.frame(view(20)), UP)
    whole = max(top.segments(), key=np.count_nonzero)
    judged = judged_by(ycb)
    mug = judged([new_track(whole, Bench(top, 0, judged))])[0]
    assert mug.result.answer == "mug"
    assert floating([mug], [top.plane]) == [False]

    lower = replace(top.plane, offset=top.plane.offset + 0.05)
    assert floating([mug], [lower]) == [True]
    assert replace(mug, result=replace(mug.result, confident=True)).confident
    assert not replace(
        mug,
        floats=True,
        result=replace(mug.result, confident=True),
    ).confident

    scan = mug.posed.vertices @ mug.posed.pose[:3, :3].T + mug.posed.pose[:3, 3]
    middle = scan.mean(0) * (1, 1, 0)
    square = np.array([[-1, -1, 0], [-1, 1, 0], [1, -1, 0], [1, 1, 0]]) * 0.2
    corners = np.concatenate([square, square - (0, 0, 0.05)])
    for place, floats in ((middle, False), (middle + np.array([0.5, 0, 0]), True)):
        hull = SimpleNamespace(hull=corners + place)
        box = SimpleNamespace(posed=None, thing=SimpleNamespace(sightings=[hull]))
        assert floating([mug, box], [lower, lower]) == [floats, False]
