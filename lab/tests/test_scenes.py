"""Scenes: what hides what, by closed forms and another ray caster; nothing overlaps; the same
seed, the same scene.
"""

import factories
import numpy as np
import pytest
import trimesh

from nextview import SimulatedCamera
from nextview.errors import DatasetError
from nextview.geometry.viewsphere import ViewSphere, look_at_origin
from nextview_lab.data.scene_drawing import SPREAD, VISIBLE_TOLERANCE, draw_scenes
from nextview_lab.data.scene_views import scene_views
from nextview_lab.data.store import ViewStore, check
from nextview_lab.worlds.robot_camera import RobotCamera
from nextview_lab.worlds.scene import (
    SCENE_TABLE,
    TargetScene,
    block_item,
    build_scene,
    separation,
)
from nextview_lab.worlds.scene_cameras import (
    SHOWS_NOTHING,
    SHOWS_OTHER,
    SHOWS_TABLE,
    SHOWS_TARGET,
    OccludedCamera,
    SceneCamera,
)
from nextview_lab.worlds.scene_layout import CLUTTER_LEVELS, Block, SceneLayout

GRID = ViewSphere.named("40")
BALL = factories.meshed(trimesh.creation.icosphere(4))
FRONT = GRID.poses[0]
"""From +x, level."""


def scene_of(*blocks: Block, target=BALL) -> TargetScene:
    floor = float(target.vertices[:, 2].min())
    return TargetScene(target, tuple(block_item(block, floor) for block in blocks))


def things_under_a_point(*things) -> int:
    """The most things that a vertical line meets, by another ray caster."""
    grid = np.linspace(-SCENE_TABLE, SCENE_TABLE, 100)
    above = np.stack([*np.meshgrid(grid, grid), np.full((100, 100), 9.0)], -1)
    down = np.tile([0.0, 0, -1], (100 * 100, 1))
    meshes = [trimesh.Trimesh(t.vertices, t.faces, process=False) for t in things]
    met = [m.ray.intersects_any(above.reshape(-1, 3), down) for m in meshes]
    return int(np.sum(met, axis=0).max())


# What hides what


def test_a_wall_before_one_half_hides_exactly_half():
    camera = OccludedCamera(scene_of(Block(1.6, 1.5, 0.0, 0.1, 3.0, 3.0)), 112)
    assert camera.visible_share(FRONT) == pytest.approx(0.5, abs=0.005)
    assert camera.visible_share(GRID.poses[4]) == 1  # from behind
    # x to the right in the picture is +y: looking along -x with z up
    seen = camera.observe(FRONT)
    columns = np.flatnonzero(seen.depth.any(0))
    assert columns.max() < 56 or columns.min() >= 56
    np.testing.assert_array_equal(seen.depth > 0, seen.picture > 0)
    assert (
        not OccludedCamera(scene_of(Block(1.5, 0.0, 0.0, 0.2, 2.5, 2.5)))
        .observe(FRONT)
        .seen
    )


def test_every_pixel_has_its_owner():
    scene = scene_of(Block(0.0, 2.0, 0.3, 0.5, 0.5, 1.0))
    k, pose = np.array([[40.0, 0, 40], [0, 40, 40], [0, 0, 1]]), GRID.poses[24]
    depth, owner = SceneCamera(scene, k, (80, 80)).look(pose)
    row, column = np.mgrid[:80, :80]
    rays = np.stack(
        [(column + 0.5 - 40) / 40, (row + 0.5 - 40) / 40, np.ones((80, 80))],
        -1,
    )
    places = (depth[..., None] * rays) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(
        np.linalg.norm(places[owner == SHOWS_TARGET], axis=-1),
        1,
        atol=0.01,
    )
    np.testing.assert_allclose(places[owner == SHOWS_TABLE][:, 2], -1, atol=1e-4)
    assert np.abs(places[owner == SHOWS_TABLE][:, :2]).max() <= SCENE_TABLE + 1e-4
    assert (
        np.linalg.norm(places[owner == SHOWS_OTHER][:, :2] - (0, 2), axis=1) < 0.36
    ).all()
    assert {*np.unique(owner)} == {
        SHOWS_NOTHING,
        SHOWS_TARGET,
        SHOWS_OTHER,
        SHOWS_TABLE,
    }
    np.testing.assert_array_equal(depth == 0, owner == SHOWS_NOTHING)


def test_shares_are_those_of_another_ray_caster(cluttered, furniture):
    path = sorted(cluttered.rglob("*heavy*.json"))[0]
    layout, k = (
        SceneLayout.load(path),
        np.array([[200.0, 0, 100], [0, 200.0, 100], [0, 0, 1]]),
    )
    scene = build_scene(layout, furniture)
    things = [
        trimesh.Trimesh(item.vertices, item.faces, process=False)
        for item in (scene.target, *scene.items)
    ]
    for view in (3, 14, 25, 36):
        _, alone = factories.cast(things[:1], GRID.poses[view], k, (200, 200))
        _, among = factories.cast(things, GRID.poses[view], k, (200, 200))
        assert layout.visible[view] == pytest.approx(
            (among == 0).sum() / (alone == 0).sum(),
            abs=0.03,
        )


# Where things stand


def test_separation_of_squares():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    assert separation(square, square + np.array([1.5, 0.2])) == pytest.approx(0.5)
    assert separation(square, square + np.array([0.75, 0.2])) == pytest.approx(-0.25)
    diamond = np.array([[0.5, -0.5], [1.5, 0.5], [0.5, 1.5], [-0.5, 0.5]])
    assert separation(square, diamond + np.array([2, 0])) == pytest.approx(0.5)
    # corner to corner it is 0.5
    assert separation(square, square + np.array([1.3, 1.4])) == pytest.approx(0.4)
    assert (
        separation(np.array([[-1, 0.5], [2, 0.5]]), square)
        < 0
        < separation(np.array([[-1, 2], [2, 2.0]]), square)
    )


def test_drawn_scenes_stand_on_their_table_and_never_overlap(cluttered, furniture):
    for path in sorted(cluttered.rglob("*.json")):
        layout = SceneLayout.load(path)
        scene = build_scene(layout, furniture)
        assert len(scene.items) >= 3
        for item in scene.items:
            assert item.vertices[:, 2].min() == pytest.approx(scene.floor, abs=1e-12)
            assert np.abs(item.footprint).max() <= SCENE_TABLE
        assert things_under_a_point(scene.target, *scene.items) <= 1
        assert (
            abs(np.mean(layout.visible) - CLUTTER_LEVELS[layout.level])
            < SPREAD + VISIBLE_TOLERANCE + 0.03
        )
        split = path.parent.name
        assert all(
            f"/{split}/" in placed.mesh for placed in (layout.target, *layout.objects)
        )
        assert layout.target.mesh not in [placed.mesh for placed in layout.objects]


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
    assert (
        scene_of(Block(0.0, 1.5, 0.0, 2.0, 0.1, 0.5))
        .reachable(GRID.poses[:, :3, 3])
        .all()
    )
    below = look_at_origin(np.radians([-10.0, -30.0]), 0.0)[:, :3, 3]
    # 0.48 above, 0.5 below
    np.testing.assert_array_equal(scene_of().reachable(below), [True, False])
    np.testing.assert_allclose(
        inside.clearance(np.array([[3.0, 2.3, 0.0], [3.0, 0.0, 2.0]])),
        [1.0, 1.5],
        atol=0.01,
    )


# The same again


def test_the_same_seed_draws_the_same_bytes(cluttered, furniture, tmp_path):
    files = sorted(path.relative_to(cluttered) for path in cluttered.rglob("*.json"))
    list(draw_scenes(furniture, tmp_path / "again", ["light"], 1, 3, workers=0))
    again = sorted(
        path.relative_to(tmp_path / "again") for path in tmp_path.rglob("*.json")
    )
    assert again == [file for file in files if "@light-" in file.name]
    for file in again:
        assert (tmp_path / "again" / file).read_bytes() == (
            cluttered / file
        ).read_bytes()
    with pytest.raises(DatasetError, match="another seed"):
        list(draw_scenes(furniture, tmp_path / "again", ["light"], 1, 4, workers=0))


# The store


def test_a_store_of_scenes_holds_what_shows_and_the_scene(
    cluttered_views,
    cluttered,
    furniture,
):
    opened = ViewStore.open(cluttered_views)
    assert sorted(opened.names) == sorted(
        path.stem for path in cluttered.rglob("*.json")
    )
    assert sorted(set(opened.splits)) == ["test", "train"]
    assert not [wrong for _, wrong in check(cluttered_views, workers=0) if wrong]
    i = opened.names.index(next(name for name in opened.names if "@heavy-" in name))
    layout = SceneLayout.load(next(cluttered.rglob(f"{opened.names[i]}.json")))
    views, scene = scene_views(opened, i), build_scene(layout, furniture)
    assert views.visible_share == pytest.approx(np.array(layout.visible), abs=1e-4)
    assert np.flatnonzero(~views.reachable).tolist() == list(layout.unreachable)
    np.testing.assert_allclose(
        views.clearance,
        scene.clearance(GRID.poses[:, :3, 3]),
        rtol=1e-6,
    )
    alone = [
        SimulatedCamera(scene.target, 48).observe(pose).visible for pose in GRID.poses
    ]
    shown = np.count_nonzero(opened.depth(i), axis=(1, 2)) / alone
    # through slits between things, 48 pixels show another share than 112
    assert shown == pytest.approx(views.visible_share, abs=0.15)
    assert np.abs(shown - views.visible_share).mean() < 0.02
    # The same object fills the same part of both pictures.
    wide = (
        np.count_nonzero(views.owner == SHOWS_TARGET, axis=(1, 2))
        / views.intrinsics[0, 0] ** 2
    )
    narrow = (
        np.count_nonzero(opened.depth(i), axis=(1, 2)) / opened.intrinsics[0, 0] ** 2
    )
    assert wide == pytest.approx(narrow, abs=0.1 * narrow.max())


# Live


@pytest.mark.parametrize("named", ["known", "mask", "box", "point"])
def test_a_robot_sees_the_target_that_it_was_told_of(named):
    crate = factories.meshed(factories.box([1, 1.2, 0.9]))
    scene = scene_of(
        Block(-1.9, 0.4, 0.2, 0.6, 0.6, 0.9),
        Block(0.5, 1.6, 0.5, 0.5, 0.4, 0.7),
        target=crate,
    )
    camera = RobotCamera(scene, named=named)
    frame = camera.observe(GRID.poses[16])
    seen = camera.object.add(frame)
    frame_of_it = camera.object.object_frame
    radius = 0.2  # metres: a third of the distance of a sensor without errors
    assert np.linalg.norm(frame_of_it.centre) < 0.12 * radius
    assert frame_of_it.radius == pytest.approx(radius, rel=0.12)
    expected = OccludedCamera(scene).observe(GRID.poses[16])
    both = (seen.depth > 0) & (expected.depth > 0)
    either = (seen.depth > 0) | (expected.depth > 0)
    assert both.sum() > (0.9 if named in ("known", "box") else 0.75) * either.sum()
    assert (frame.mask is not None) == (named in ("known", "mask"))
