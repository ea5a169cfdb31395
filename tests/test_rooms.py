"""Finding an object in a room: walls, support planes, what stands aside or far behind, and
flying pixels.
"""

import numpy as np
import pytest
import trimesh
from factories import INTRINSICS, SHAPE, TABLE, box, cast, meshed, pose_at

from nextview.data.samples import sample_mesh
from nextview.sensing import Frame, ObservedObject
from nextview.sensing.noise import Noise
from nextview.sensing.planes import Plane, sample
from nextview.sensing.walls import find_walls

UP = np.array([0, 0, 1.0])
FLOOR = box((12, 12, 0.02), (0, 0, -0.01))
FAR_WALL = box((0.02, 12, 3), (-3.0, 0, 1.4))
NEAR_WALL = box((0.02, 12, 3), (-0.5, 0, 1.4))
SIDE_WALL = box((12, 0.02, 3), (0, 1.2, 1.4))
SLANTED_WALL = box((0.02, 14, 3)).apply_transform(
    trimesh.transformations.rotation_matrix(0.6, UP, (0, 0, 0))
)
SLANTED_WALL.apply_translation((-2.5, 0, 1.4))
CRATE = box((0.4, 0.4, 0.4), (0.2, 0.9, 0.2))


def sample_of_size(name: str, height: float, at=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    mesh = sample_mesh(name)
    vertices = mesh.vertices * height / np.ptp(mesh.vertices[:, 2])
    vertices = vertices - [0, 0, vertices[:, 2].min()] + at
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


CUPBOARD = box((0.4, 1.2, 0.9), (0, 0, 0.45))
DESK = trimesh.util.concatenate(
    [box((0.8, 1.5, 0.04), (0, 0, 0.7))]
    + [
        box((0.05, 0.05, 0.68), (x, y, 0.34))
        for x in (-0.35, 0.35)
        for y in (-0.7, 0.7)
    ]
)
MUG = trimesh.creation.cylinder(0.04, 0.1).apply_translation((-0.1, 0.2, 0.77))
MONITOR = sample_of_size("monitor", 0.45, (0, 0.1, 0.72))


def frame(meshes, pose, seed=0, sigma=0.003, mask_of=None, wide=0) -> Frame:
    """A frame whose noise grows with the square of the distance: ``sigma`` metres at one metre."""
    depth, which = cast(meshes, pose)
    rng = np.random.default_rng(seed)
    noisy = depth + sigma * depth**2 * rng.normal(size=SHAPE)
    noisy[rng.random(SHAPE) < 0.02] = 0
    mask = None
    if mask_of is not None:
        mask = which == mask_of
        for _ in range(wide):
            mask = (
                mask
                | np.roll(mask, 1, 0)
                | np.roll(mask, -1, 0)
                | np.roll(mask, 1, 1)
                | np.roll(mask, -1, 1)
            )
    return Frame(
        np.where(depth > 0, noisy, 0), INTRINSICS, pose, mask=mask, pixel_centre=0.5
    )


def assert_is(thing: ObservedObject, mesh: trimesh.Trimesh, radius=0.15) -> None:
    true = meshed(mesh)
    assert thing.object_frame.radius == pytest.approx(true.radius, rel=radius)
    assert np.linalg.norm(thing.object_frame.centre - true.centre) < 0.35 * true.radius


def share_of(thing: ObservedObject, which: np.ndarray, number: int) -> float:
    """Intersection over union of what was taken for the object and what shows a mesh."""
    mask = thing.sightings[-1].mask
    return float((mask & (which == number)).sum() / (mask | (which == number)).sum())


def middle_of(mesh: trimesh.Trimesh) -> np.ndarray:
    return mesh.bounds.mean(0)


# Walls


ROOMS = {
    "far": [FAR_WALL],
    "near": [NEAR_WALL],
    "corner": [NEAR_WALL, SIDE_WALL],
    "slanted": [SLANTED_WALL],
    "none": [],
}


@pytest.mark.parametrize("asked", ["aim", "point"])
@pytest.mark.parametrize("walls", ["far", "corner", "slanted", "none"])
def test_objects_in_a_room_are_segmented_without_its_walls(walls, asked):
    pose = pose_at(15, -30, 2.6, middle_of(CUPBOARD))
    scene = [CUPBOARD, FLOOR, *ROOMS[walls], CRATE]
    thing = ObservedObject(point=middle_of(CUPBOARD) if asked == "point" else None)
    thing.add(frame(scene, pose))
    assert_is(thing, CUPBOARD)
    _, which = cast(scene, pose)
    assert (which == 0)[thing.sightings[0].mask].mean() > 0.95


@pytest.mark.parametrize("sigma", [0.008])
@pytest.mark.parametrize("walls", ROOMS)
def test_walls_are_found_and_no_side_of_a_cupboard_is_one(walls, sigma):
    pose = pose_at(12, 20, 2.4, middle_of(CUPBOARD))
    seen = frame([CUPBOARD, FLOOR, *ROOMS[walls]], pose, sigma=sigma)
    _, which = cast([CUPBOARD, FLOOR, *ROOMS[walls]], pose)
    noise = Noise(np.array([1.0]), np.array([sigma]))
    samples = sample(seen, seen.depth > 0, noise)
    found = find_walls(samples, Plane(UP, 0.0), np.random.default_rng(0))
    of_walls = (which >= 2) & (seen.depth > 0)
    if found:
        apart = np.abs([seen.along(wall.normal, wall.offset) for wall in found]).min(0)
        # noise moves a point along its ray, so that some are farther off
        allowed = 0.02 + 3 * sigma * seen.depth**2
        assert (apart < allowed)[of_walls].mean() > 0.9
    assert len(found) == sum(
        (which == 2 + k).mean() > 0.03 for k in range(len(ROOMS[walls]))
    )


@pytest.mark.parametrize("asked", ["aim", "point"])
@pytest.mark.parametrize("behind", [1.5, 6.0])
@pytest.mark.parametrize("elevation", [10])
def test_objects_far_behind_a_table_are_ignored(elevation, behind, asked):
    mug = box((0.08, 0.08, 0.1), (0.1, 0, 0.05))
    clutter = [
        box((0.02, 3, 2), (-behind, 0, 0.2)),
        box((0.3, 0.5, 0.8), (-behind + 0.4, 0.3, -0.1)),
    ]
    thing = ObservedObject(point=middle_of(mug) if asked == "point" else None)
    pose = pose_at(elevation, 35, 0.5, middle_of(mug))
    thing.add(frame([mug, box((0.9, 1.2, 0.04), (0, 0, -0.02)), *clutter], pose))
    assert_is(thing, mug)
    turned = pose_at(elevation, 80, 0.5, middle_of(mug))
    thing.add(frame([mug, box((0.9, 1.2, 0.04), (0, 0, -0.02)), *clutter], turned))
    assert_is(thing, mug)


@pytest.mark.parametrize("side", [-1, 1])
def test_the_object_on_the_optical_axis_is_preferred_to_a_larger_one(side):
    mug = box((0.08, 0.08, 0.1), (0, 0, 0.05))
    carton = box((0.2, 0.2, 0.25), (0, 0.28 * side, 0.125))
    thing = ObservedObject()
    thing.add(frame([mug, carton, TABLE], pose_at(30, 0, 0.6, (0, 0.01, 0.06))))
    assert_is(thing, mug)


# The support plane


@pytest.mark.parametrize("asked", ["mask", "wide mask", "point"])
@pytest.mark.parametrize("elevation", [8, 20])
def test_a_monitor_stands_on_its_desk(asked, elevation):
    target = middle_of(MONITOR)
    thing = ObservedObject(point=target if asked == "point" else None)
    by_mask = 0 if "mask" in asked else None
    seen = frame(
        [MONITOR, DESK, FLOOR, FAR_WALL],
        pose_at(elevation, 15, 2.0, target),
        mask_of=by_mask,
        wide=2,
    )
    thing.add(seen)
    assert_is(thing, MONITOR, radius=0.2)


@pytest.mark.parametrize("height", [0.7, 0.72, 0.77])
def test_a_point_at_a_thing_on_a_table_names_the_thing(height):
    scene = [DESK, NEAR_WALL, MUG]
    pose = pose_at(25, 20, 1.2, (0, 0, 0.72))
    _, which = cast(scene, pose)
    thing = ObservedObject(point=(-0.1, 0.2, height))
    thing.add(frame(scene, pose))
    assert share_of(thing, which, 2) > 0.8
    assert thing.warnings == []


# Pieces


@pytest.mark.parametrize("gap", [0.01, 0.15, 0.3])
@pytest.mark.parametrize("elevation", [20])
def test_a_top_is_held_by_the_foot_that_shows_below_it(elevation, gap):
    side = 0.2 + 2 * gap
    table = trimesh.util.concatenate(
        [box((side, 2 * side, 0.05), (0, 0, 0.7)), box((0.2, 0.2, 0.68), (0, 0, 0.34))]
    )
    thing = ObservedObject(point=middle_of(table))
    thing.add(
        frame([table, FLOOR, FAR_WALL], pose_at(elevation, 10, 2.2, middle_of(table)))
    )
    assert_is(thing, table)


# Extent


@pytest.mark.parametrize("flying", [4, 40])
def test_flying_pixels_do_not_affect_the_size(flying):
    ball = trimesh.creation.icosphere(3, 0.04).apply_translation((0, 0, 0.04))
    clean = frame([ball, TABLE], pose_at(35, 0, 0.6, (0, 0, 0.04)), mask_of=0)
    rows, columns = np.nonzero(clean.mask)
    rng = np.random.default_rng(2)
    chosen = rng.choice(len(rows), flying, replace=False)
    depth = clean.depth.copy()
    depth[rows[chosen], columns[chosen]] += rng.uniform(0.03, 0.4, flying)
    radii = []
    for seen in (clean, clean.with_depth(depth)):
        thing = ObservedObject()
        thing.add(seen)
        radii.append(thing.object_frame.radius)
    assert radii[1] == pytest.approx(radii[0], rel=0.03)
