"""Worlds: what hides what, by closed forms and another ray caster; nothing overlaps; the same seed, the same world."""

import json
import os
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import scenes
import trimesh
from matplotlib.path import Path as Outline

import nextview
from nextview.cameras.simulated import SimulatedCamera
from nextview.cli.main import main
from nextview.data.checking import check
from nextview.data.rendering import render
from nextview.data.store import PENDING, ViewStore
from nextview.data.world_drawing import draw_worlds
from nextview.data.world_views import world_views
from nextview.errors import DatasetError, MeshError, NoViewLeftError, UsageError
from nextview.mesh import make_mesh
from nextview.viewsphere import ViewSphere, look_at_origin
from nextview.worlds import (
    LEVELS,
    NOTHING,
    OTHER,
    TABLE_TOP,
    TARGET,
    Block,
    OccludedCamera,
    Placement,
    Scene,
    SceneCamera,
    World,
    WorldCamera,
    build_scene,
)
from nextview.worlds.drawing import SPREAD, TOLERANCE
from nextview.worlds.footprint import distances, footprint, separation
from nextview.worlds.scene import TABLE, block_item

GRID = ViewSphere.named("40")
BALL = make_mesh(*(lambda m: (m.vertices, m.faces))(trimesh.creation.icosphere(4)))
FRONT = GRID.poses[0]
"""From +x, level."""


def scene_of(*blocks: Block, target=BALL) -> Scene:
    floor = float(target.vertices[:, 2].min())
    return Scene(target, tuple(block_item(block, floor) for block in blocks))


@pytest.fixture(scope="module")
def meshes(tmp_path_factory) -> Path:
    """Six simple objects of two classes."""
    folder, rng = tmp_path_factory.mktemp("things") / "things", np.random.default_rng(0)
    for i in range(12):
        kind = ("jar", "crate")[i % 2]
        mesh = trimesh.creation.cylinder(0.5, 1, sections=24) if i % 2 == 0 else trimesh.creation.box()
        path = folder / kind / ("train" if i < 8 else "test") / f"{kind}_{i}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        mesh.apply_scale(rng.uniform(0.5, 1.5, 3)).export(path)
    return folder


@pytest.fixture(scope="module")
def worlds(meshes, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("drawn") / "worlds"
    drawn = list(draw_worlds(meshes, folder, worlds=1, seed=3, workers=0))
    assert len(drawn) == 6
    assert not [reason for _, reason in drawn if reason]
    return folder


@pytest.fixture(scope="module")
def store(worlds, meshes, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("store") / "worlds.zarr"
    assert [reason for _, reason in render(worlds, path, GRID, 48, workers=0, meshes=meshes)] == [None] * 6
    return path


# What hides what


def test_a_wall_before_one_half_hides_exactly_half():
    camera = OccludedCamera(scene_of(Block(1.6, 1.5, 0.0, 0.1, 3.0, 3.0)), 112)
    assert camera.visible_share(FRONT) == pytest.approx(0.5, abs=0.005)
    assert camera.visible_share(GRID.poses[4]) == 1  # from behind
    seen = camera.observe(FRONT)  # x to the right in the picture is +y: looking along -x with z up
    columns = np.flatnonzero(seen.depth.any(0))
    assert columns.max() < 56 or columns.min() >= 56
    np.testing.assert_array_equal(seen.depth > 0, seen.picture > 0)


def test_a_low_wall_hides_what_is_below_its_edge():
    """Its upper edge at the height of the camera and of the ball's centre hides the lower half."""
    camera = OccludedCamera(scene_of(Block(1.6, 0.0, 0.0, 0.1, 6.0, 1.0)), 112)
    assert camera.visible_share(FRONT) == pytest.approx(0.5, abs=0.005)
    rows = np.flatnonzero(camera.observe(FRONT).depth.any(1))
    assert rows.max() < 56


def test_a_box_before_the_target_hides_it_and_shows_its_own_face():
    scene = scene_of(Block(1.5, 0.0, 0.0, 0.2, 2.5, 2.5))
    assert OccludedCamera(scene).visible_share(FRONT) == 0
    assert not OccludedCamera(scene).observe(FRONT).seen
    depth, owner = SceneCamera(scene, np.array([[60.0, 0, 40], [0, 60, 40], [0, 0, 1]]), (80, 80)).look(FRONT)
    assert owner[40, 40] == OTHER
    assert depth[40, 40] == pytest.approx(3 - 1.6, abs=1e-5)  # its near face is at x = 1.6


def test_every_pixel_has_its_owner():
    scene = scene_of(Block(0.0, 2.0, 0.3, 0.5, 0.5, 1.0))
    k, pose = np.array([[40.0, 0, 40], [0, 40, 40], [0, 0, 1]]), GRID.poses[24]
    depth, owner = SceneCamera(scene, k, (80, 80)).look(pose)
    row, column = np.mgrid[:80, :80]
    rays = np.stack([(column + 0.5 - 40) / 40, (row + 0.5 - 40) / 40, np.ones((80, 80))], -1)
    places = (depth[..., None] * rays) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(places[owner == TARGET], axis=-1), 1, atol=0.01)
    np.testing.assert_allclose(places[owner == TABLE_TOP][:, 2], -1, atol=1e-4)
    assert np.abs(places[owner == TABLE_TOP][:, :2]).max() <= TABLE + 1e-4
    assert (np.linalg.norm(places[owner == OTHER][:, :2] - (0, 2), axis=1) < 0.36).all()
    assert {*np.unique(owner)} == {NOTHING, TARGET, OTHER, TABLE_TOP}
    np.testing.assert_array_equal(depth == 0, owner == NOTHING)


def test_alone_on_its_table_the_target_looks_as_without_one():
    alone, in_world = SimulatedCamera(BALL, 64), OccludedCamera(scene_of(), 64)
    for pose in GRID.poses[::7]:
        np.testing.assert_array_equal(in_world.observe(pose).depth, alone.observe(pose).depth)
        np.testing.assert_array_equal(in_world.observe(pose).picture, alone.observe(pose).picture)
        assert in_world.visible_share(pose) == 1


def test_shares_are_those_of_another_ray_caster(worlds, meshes):
    path = sorted(worlds.rglob("*heavy*.json"))[0]
    world, k = World.load(path), np.array([[60.0, 0, 32], [0, 60.0, 32], [0, 0, 1]])
    scene = build_scene(world, meshes)
    things = [trimesh.Trimesh(item.vertices, item.faces, process=False) for item in (scene.target, *scene.items)]
    for view in (3, 14, 25, 36):
        _, alone = scenes.cast(things[:1], GRID.poses[view], k, (64, 64))
        _, among = scenes.cast(things, GRID.poses[view], k, (64, 64))
        assert world.visible[view] == pytest.approx((among == 0).sum() / (alone == 0).sum(), abs=0.03)


# Where things stand


def test_separation_of_squares():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    assert separation(square, square + np.array([1.5, 0.2])) == pytest.approx(0.5)
    assert separation(square, square + np.array([0.75, 0.2])) == pytest.approx(-0.25)
    diamond = np.array([[0.5, -0.5], [1.5, 0.5], [0.5, 1.5], [-0.5, 0.5]])
    assert separation(square, diamond + np.array([2, 0])) == pytest.approx(0.5)
    assert separation(square, square + np.array([1.3, 1.4])) == pytest.approx(0.4)  # corner to corner it is 0.5
    assert separation(np.array([[-1, 0.5], [2, 0.5]]), square) < 0 < separation(np.array([[-1, 2], [2, 2.0]]), square)


def test_distances_from_a_square():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    points = np.array([[0.5, 0.5], [2, 0.5], [1 + 3, 1 + 4], [0.2, -0.7]])
    np.testing.assert_allclose(distances(square, points), [0, 1, 5, 0.7], atol=1e-12)


def test_a_footprint_is_the_hull_of_what_is_above_it():
    points = np.random.default_rng(1).normal(size=(500, 3))
    outline = footprint(points)
    assert Outline(outline).contains_points(points[:, :2]).all()
    flat = footprint(np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1.0]]))  # a sheet on its edge
    assert np.ptp(flat, axis=0) == pytest.approx([1, 0], abs=0.003)


def test_drawn_worlds_stand_on_their_table_and_never_overlap(worlds, meshes):
    for path in sorted(worlds.rglob("*.json")):
        world = World.load(path)
        scene = build_scene(world, meshes)
        assert len(scene.items) >= 3
        for item in scene.items:
            assert item.vertices[:, 2].min() == pytest.approx(scene.floor, abs=1e-12)
            assert np.abs(item.footprint).max() <= TABLE
        outlines = [footprint(scene.target.vertices), *(item.footprint for item in scene.items)]
        for a, b in combinations(outlines, 2):
            assert not Outline(a).intersects_path(Outline(b), filled=True)
        assert abs(np.mean(world.visible) - LEVELS[world.level]) < SPREAD + TOLERANCE + 0.03
        split = path.parent.name
        assert all(f"/{split}/" in placed.mesh for placed in (world.target, *world.objects))
        assert world.target.mesh not in [placed.mesh for placed in world.objects]


def test_cameras_reach_no_place_in_things_behind_walls_or_below_the_table():
    inside = scene_of(Block(3.0, 0.0, 0.0, 0.6, 0.6, 1.5))
    there = inside.reachable(GRID.poses[:, :3, 3])
    assert not there[0]
    assert there[1:8].all()
    behind = scene_of(Block(0.0, 1.5, 0.0, 2.0, 0.1, 0.5, wall=True))
    there = behind.reachable(GRID.poses[:, :3, 3])
    assert not there[2]
    assert not there[10]  # above it, but behind it
    assert there[[0, 4, 6, 14]].all()
    assert scene_of(Block(0.0, 1.5, 0.0, 2.0, 0.1, 0.5)).reachable(GRID.poses[:, :3, 3]).all()
    below = look_at_origin(np.radians([-10.0, -30.0]), 0.0)[:, :3, 3]
    np.testing.assert_array_equal(scene_of().reachable(below), [True, False])  # 0.48 above, 0.5 below
    np.testing.assert_allclose(inside.clearance(np.array([[3.0, 2.3, 0.0], [3.0, 0.0, 2.0]])), [1.0, 1.5], atol=0.01)


# The same again


def test_the_same_seed_draws_the_same_bytes(worlds, meshes, tmp_path):
    files = sorted(path.relative_to(worlds) for path in worlds.rglob("*.json"))
    list(draw_worlds(meshes, tmp_path / "again", ["light"], 1, 3, workers=0))
    again = sorted(path.relative_to(tmp_path / "again") for path in tmp_path.rglob("*.json"))
    assert again == [file for file in files if "@light-" in file.name]
    for file in again:
        assert (tmp_path / "again" / file).read_bytes() == (worlds / file).read_bytes()
    with pytest.raises(DatasetError, match="another seed"):
        list(draw_worlds(meshes, tmp_path / "again", ["light"], 1, 4, workers=0))


def test_a_world_is_read_as_it_was_written(worlds, tmp_path):
    path = sorted(worlds.rglob("*.json"))[0]
    world = World.load(path)
    world.save(tmp_path / "copy.json")
    assert (tmp_path / "copy.json").read_bytes() == path.read_bytes()
    assert World.load(tmp_path / "copy.json") == world


HERE = {"mesh": "a.off", "sha256": "0" * 64, "x": 0, "y": 0, "turn": 0, "radius": 1}
BLOCK = {"x": 1, "y": 1, "turn": 0, "width": 1, "depth": 1, "height": 1}


@pytest.mark.parametrize(
    "change",
    [
        {"schema": 2},
        {"blocks": [{"x": 1}]},
        {"objects": 3},
        {"target": {}},
        {"visible": "all"},
        {"more": 1},
        *(
            {"target": {"mesh": mesh, "sha256": "0" * 64}}
            for mesh in ("/etc/passwd", "../a.off", "a/../../b", "C:\\a.off")
        ),
        *({"objects": [HERE | {"mesh": mesh}]} for mesh in ("..", "a\0.off", "\ud800.off", "a\n.off")),
        *({"objects": [HERE | {name: 1e300}]} for name in ("x", "y", "turn", "radius")),
        *({"blocks": [BLOCK | {name: 1e39}]} for name in BLOCK),
        {"blocks": [BLOCK] * 1001},
        {"visible": [0.5] * 3},
        {"visible": [2] * 40},
        {"unreachable": [40]},
        {"unreachable": [1e300]},
        {"unreachable": [0.5]},
    ],
)
def test_what_is_no_world_or_cannot_be_is_refused(worlds, tmp_path, change):
    values = json.loads(sorted(worlds.rglob("*.json"))[0].read_text())
    (tmp_path / "w.json").write_text(json.dumps(values | change))
    with pytest.raises(DatasetError, match=r"w\.json"):
        World.load(tmp_path / "w.json")


def test_a_world_reads_mesh_files_alone_and_no_more_triangles_than_are_allowed(worlds, meshes, tmp_path):
    world = World.load(sorted(worlds.rglob("*.json"))[0])
    os.mkfifo(tmp_path / "pipe.off")
    with pytest.raises(DatasetError, match="is a pipe or a device"):
        build_scene(replace(world, target=Placement("pipe.off", "0" * 64)), tmp_path)
    alone = len(build_scene(replace(world, objects=()), meshes).target.faces)
    twice = replace(world, objects=(replace(world.target, x=2.0),))
    with pytest.raises(MeshError, match=f"{2 * alone:,} triangles, more than {2 * alone - 1:,}"):
        build_scene(twice, meshes, 2 * alone - 1)


def test_there_are_not_more_worlds_than_anyone_can_draw(meshes, tmp_path):
    with pytest.raises(UsageError, match="from 1 to 100000"):
        next(draw_worlds(meshes, tmp_path / "w", ["light"], 10**12))


def test_a_world_of_other_meshes_is_refused(worlds, meshes, tmp_path):
    world = World.load(sorted(worlds.rglob("*.json"))[0])
    (tmp_path / world.target.mesh).parent.mkdir(parents=True)
    (tmp_path / world.target.mesh).write_text("OFF\n")
    with pytest.raises(DatasetError, match="is not the mesh that this world was made with"):
        build_scene(world, tmp_path)
    with pytest.raises(DatasetError, match="is it the folder of the meshes"):
        build_scene(world, tmp_path / "nowhere")


# The store


def test_a_store_of_worlds_holds_what_shows_and_the_scene(store, worlds, meshes):
    opened = ViewStore.open(store)
    assert sorted(opened.names) == sorted(path.stem for path in worlds.rglob("*.json"))
    assert sorted(set(opened.splits)) == ["test", "train"]
    assert not [wrong for _, wrong in check(store, workers=0) if wrong]
    i = opened.names.index(next(name for name in opened.names if "@heavy-" in name))
    world = World.load(next(worlds.rglob(f"{opened.names[i]}.json")))
    views, scene = world_views(opened, i), build_scene(world, meshes)
    assert views.visible_share == pytest.approx(np.array(world.visible), abs=1e-4)
    assert np.flatnonzero(~views.reachable).tolist() == list(world.unreachable)
    np.testing.assert_allclose(views.clearance, scene.clearance(GRID.poses[:, :3, 3]), rtol=1e-6)
    alone = [SimulatedCamera(scene.target, 48).observe(pose).visible for pose in GRID.poses]
    shown = np.count_nonzero(opened.depth(i), axis=(1, 2)) / alone
    assert shown == pytest.approx(views.visible_share, abs=0.05)
    # The same object fills the same part of both pictures.
    wide = np.count_nonzero(views.owner == TARGET, axis=(1, 2)) / views.intrinsics[0, 0] ** 2
    narrow = np.count_nonzero(opened.depth(i), axis=(1, 2)) / opened.intrinsics[0, 0] ** 2
    assert wide == pytest.approx(narrow, abs=0.1 * narrow.max())


def test_a_store_of_worlds_goes_on_where_it_was_cut_off(store, worlds, meshes, tmp_path):
    path = tmp_path / "cut.zarr"
    begun = render(worlds, path, GRID, 48, workers=0, meshes=meshes)
    next(begun)
    begun.close()
    opened = ViewStore.open(path)
    assert opened.done.sum() == 1
    opened.mark(int(np.flatnonzero(opened.done)[0]), PENDING)
    assert len(list(render(worlds, path, GRID, 48, workers=0, meshes=meshes))) == 6
    whole, cut = ViewStore.open(store), ViewStore.open(path)
    for name in whole.rendered:
        np.testing.assert_array_equal(whole.array(name)[:], cut.array(name)[:], err_msg=name)


def test_what_worlds_are_not_rendered_with_is_refused(worlds, meshes, store, tmp_path):
    from nextview.data.rendering import Deform

    with pytest.raises(DatasetError, match="say with --meshes"):
        list(render(worlds, tmp_path / "a.zarr", GRID, 48, workers=0))
    with pytest.raises(UsageError, match="neither stretched nor turned"):
        list(render(worlds, tmp_path / "a.zarr", GRID, 48, deform=Deform(turn=True), workers=0, meshes=meshes))
    with pytest.raises(DatasetError, match="no worlds in"):
        list(render(meshes, tmp_path / "a.zarr", GRID, 48, workers=0, meshes=meshes))


def test_the_commands_draw_and_render(meshes, tmp_path, capsys):
    arguments = ["--level", "light", "--worlds", "1", "--split", "test", "--workers", "0"]
    main(["worlds", str(meshes), str(tmp_path / "w"), *arguments])
    main(["worlds", str(meshes), str(tmp_path / "w"), *arguments])  # all there
    assert len(list((tmp_path / "w").rglob("*@light-0.json"))) == 1
    options = ["--meshes", str(meshes), "--size", "32", "--workers", "0"]
    main(["render", str(tmp_path / "w"), str(tmp_path / "v.zarr"), *options])
    assert ViewStore.open(tmp_path / "v.zarr").done.all()


# Live


@pytest.mark.parametrize("named", ["known", "mask", "box", "point"])
def test_a_robot_sees_the_target_that_it_was_told_of(named):
    crate = make_mesh(*(lambda m: (m.vertices, m.faces))(trimesh.creation.box([1, 1.2, 0.9])))
    scene = scene_of(Block(-1.9, 0.4, 0.2, 0.6, 0.6, 0.9), Block(0.5, 1.6, 0.5, 0.5, 0.4, 0.7), target=crate)
    camera = WorldCamera(scene, named=named)
    frame = camera.observe(GRID.poses[16])
    seen = camera.object.add(frame)
    frame_of_it = camera.object.object_frame
    radius = camera._camera.sensor.radius
    assert np.linalg.norm(frame_of_it.centre) < 0.12 * radius
    assert frame_of_it.radius == pytest.approx(radius, rel=0.12)
    expected = OccludedCamera(scene).observe(GRID.poses[16])
    both = (seen.depth > 0) & (expected.depth > 0)
    either = (seen.depth > 0) | (expected.depth > 0)
    assert both.sum() > (0.9 if named in ("known", "box") else 0.75) * either.sum()
    assert (frame.mask is not None) == (named in ("known", "mask"))
    with pytest.raises(UsageError, match="named by"):
        WorldCamera(scene, named="colour")


def test_a_robot_looks_from_the_nearest_place_from_which_the_target_shows():
    hidden = scene_of(Block(1.5, 0.0, 0.0, 0.2, 2.5, 2.5))
    camera = WorldCamera(hidden, named="known")
    frame = camera.observe(FRONT)
    away = frame.pose[:3, 3] / np.linalg.norm(frame.pose[:3, 3])
    assert 0 < np.degrees(np.arccos(away @ [1, 0, 0])) <= 55  # the views beside it, or above
    assert camera.reachable(frame.pose)
    again = camera.observe(FRONT).pose  # the same frame would be taken for another view of the target
    assert np.linalg.norm(again[:3, 3] - frame.pose[:3, 3]) > 0.1
    there = camera.observe(frame.pose).pose  # unless it is asked for
    np.testing.assert_allclose(there[:3, 3], frame.pose[:3, 3], atol=1e-6)
    filled = scene_of(Block(0.0, 0.0, 0.0, 7.0, 7.0, 6.0))  # all cameras would be in it
    with pytest.raises(NoViewLeftError):
        WorldCamera(filled, named="known").observe(FRONT)


def test_a_session_runs_live_in_a_world(worlds, meshes):
    world = World.load(sorted(worlds.rglob("*medium*.json"))[0])
    camera = WorldCamera(build_scene(world, meshes), "stereo", np.random.default_rng(1), "known")
    session = nextview.load(policy="random", threshold=1.0, max_views=3).session_with(camera, start=1)
    session.reachable = camera.reachable
    result = session.run(camera)
    assert len(result.views) == 3
    assert result.seen
    assert all(world.visible[view.index] > 0 and view.index not in world.unreachable for view in result.views)
