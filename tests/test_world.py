"""The set of things that explains some views: names, numbers, strangers, changes, cameras."""

import numpy as np
import pytest
import trimesh
from drawn_views import camera, drawn, library, standing, surface

from nextview.scene.changes import changes
from nextview.things.naming import CONFIDENT, named
from nextview.things.world import World, corrected


@pytest.fixture(scope="module")
def things():
    return library()


def after(world, view, camera_stands=False):
    """A world after a view, and what has changed."""
    told = changes(world, view, camera_stands)
    everything = np.ones(len(world.library), bool)
    return told.world.with_view(told.view).searched(everything).numbered(), told


def names(world):
    """Names of the things, by their numbers; None for a stranger."""
    return {
        one.number: None
        if one.row < 0
        else world.library.names[int(world.hypotheses.things[one.row])]
        for one in world.things
    }


@pytest.fixture(scope="module")
def table(things):
    """A box and a can beside each other, and the world after one view."""
    box, _, can, _ = things.caster.surfaces
    placed = [(box, standing(box, -0.08, 0, 25)), (can, standing(can, 0.08, 0.02))]
    world, _ = after(World(things), drawn(placed, camera(20)))
    return placed, world


def test_things_are_named_and_posed_after_one_view(table, things):
    placed, world = table
    assert sorted(names(world).values()) == ["box", "can"]
    for one in world.things:
        pose = world.hypotheses.pose(one.row, things)
        name = names(world)[one.number]
        true = next(pose for surface, pose in placed if surface.name == name)
        assert np.linalg.norm(pose[:3, 3] - true[:3, 3]) < 0.15
        middle = world.hypotheses.centres[one.row]
        centre = things.centres[world.hypotheses.things[one.row]]
        assert np.linalg.norm(middle - true[:3, :3] @ centre - true[:3, 3]) < 0.005


def test_only_a_view_that_shows_something_new_is_searched(things):
    box = things.caster.surfaces[0]
    tin = surface("tin", trimesh.creation.cylinder(0.045, 0.1))
    placed = [(box, standing(box, -0.08, 0)), (tin, standing(tin, 0.08, 0))]
    world, _ = after(World(things), drawn(placed, camera(20)))
    assert set(names(world).values()) == {"box", None}
    again, told = after(world, drawn(placed, camera(20)))
    assert set(told.stand) == set(names(world))
    assert names(again) == names(world)
    assert again.next_key == world.next_key
    aside, _ = after(world, drawn(placed, camera(50)))
    assert aside.next_key > world.next_key

    # where the tin was, something else is
    placed[1] = box, standing(box, 0.08, 0, 40)
    other, told = after(world, drawn(placed, camera(20)))
    assert len(told.stand) == 1
    assert sorted(names(other).values()) == ["box", "box"]


def test_a_second_view_keeps_the_numbers(table):
    placed, world = table
    later, told = after(world, drawn(placed, camera(70)))
    assert names(later) == names(world)
    assert set(told.stand) == set(names(world))
    assert not told.moved
    assert not told.gone


def test_a_thing_that_was_taken_away_is_gone(table):
    placed, world = table
    number = next(key for key, name in names(world).items() if name == "can")
    later, told = after(world, drawn(placed[:1], camera(70)))
    assert [one.number for one in told.gone] == [number]
    assert list(names(later).values()) == ["box"]


@pytest.mark.parametrize("metres", [0.03, 0.1])
def test_a_thing_that_was_moved_keeps_its_number(table, things, metres):
    (first, can), world = table
    there = (can[0], can[1] + [[0, 0, 0, metres], *np.zeros((3, 4))])
    number = next(key for key, name in names(world).items() if name == "can")
    later, told = after(world, drawn([first, there], camera(70)), camera_stands=True)
    assert number in told.moved or number in [one.number for one in told.gone]
    middles = {
        names(later)[one.number]: later.hypotheses.centres[one.row]
        for one in later.things
    }
    assert abs(middles["can"][0] - 0.08 - metres) < 0.005
    assert np.linalg.norm(middles["box"][:2] - first[1][:2, 3]) < 0.005


def test_the_error_of_a_camera_is_told_from_the_things(table):
    placed, world = table
    true = camera(70)
    told = true.copy()
    told[:3, 3] += [0.004, -0.003, 0.002]
    view = corrected(world, drawn(placed, true, told))
    before = np.linalg.norm(told[:3, 3] - true[:3, 3])
    assert np.linalg.norm(view.camera[:3, 3] - true[:3, 3]) < before / 2


def test_a_thing_that_nobody_taught_has_no_confident_name(things):
    box = things.caster.surfaces[0]
    slab = things.caster.surfaces[1]
    few = library_without(things, "box")
    placed = [(box, standing(box, -0.08, 0, 25)), (slab, standing(slab, 0.1, 0))]
    world, _ = after(World(few), drawn(placed, camera(20)))
    sure = [
        one
        for one in world.things
        if one.row >= 0 and named(world, one, ()).right >= CONFIDENT
    ]
    assert [names(world)[one.number] for one in sure] == ["slab"]
    assert abs(world.hypotheses.centres[sure[0].row][0] - 0.1) < 0.005


def library_without(things, name):
    """The library without a thing, and without those that look like it."""
    from nextview.things.library import Library

    kept = [one for one in things.caster.surfaces if name not in one.name]
    return Library(kept)


def test_a_pixel_counts_once(table):
    _, world = table
    owners = world.owners[0]
    for one in world.things:
        found = one.scores[0]
        own = found.cells[found.gain > 0.5]
        assert np.mean(owners[own] == one.number) > 0.95


def test_the_mean_error_of_the_cameras_is_zero(things):
    box, _, can, _ = things.caster.surfaces
    placed = [(box, standing(box, -0.08, 0, 25)), (can, standing(can, 0.08, 0.02))]
    world = World(things)
    for azimuth, off in ((20, 0.004), (70, -0.004)):
        true = camera(azimuth)
        told = true.copy()
        told[:3, 3] += [off, 0, off]
        world, _ = after(world, drawn(placed, true, told))
    middles = {
        names(world)[one.number]: world.hypotheses.centres[one.row]
        for one in world.things
    }
    assert np.linalg.norm(middles["box"] - [-0.08, 0, 0.07]) < 0.002
    assert np.linalg.norm(middles["can"] - [0.08, 0.02, 0.05]) < 0.002
