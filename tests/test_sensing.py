"""From frames to observations in whole scenes: what is found, where, and that it looks as a
render would.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from factories import INTRINSICS, SHAPE, TABLE, box, cast, meshed, pose_at
from scipy.spatial.transform import Rotation

from nextview import Observation, SimulatedCamera
from nextview.errors import ObservationError
from nextview.geometry.viewsphere import look_at_origin
from nextview.sensing import (
    Box,
    Frame,
    ObjectFrame,
    ObservedObject,
    check_observation,
    check_views,
)
from nextview.sensing.facets import fit_facets
from nextview.sensing.resampling import look_again, virtual_pose

WEDGE = trimesh.util.concatenate(
    [box((0.2, 0.16, 0.1), (0, 0, 0.05)), box((0.06, 0.16, 0.08), (-0.07, 0, 0.14))]
)
"""A little sofa, 0.18 m high."""
HULL = WEDGE.convex_hull
WALL = box((0.02, 1.4, 1.0), (-0.9, 0, 0.3))
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def frame(meshes, pose, seed=None, sigma=0.001, holes=0.05, **more) -> Frame:
    depth, _ = cast(meshes, pose)
    if seed is not None:
        rng = np.random.default_rng(seed)
        depth = np.where(depth > 0, depth + sigma * rng.normal(size=SHAPE), 0)
        depth[rng.random(SHAPE) < holes] = np.nan
    return Frame(depth, INTRINSICS, pose, pixel_centre=0.5, **more)


def true_frame(mesh, axes=np.eye(3)) -> ObjectFrame:
    normal = meshed(mesh)
    return ObjectFrame(normal.centre, normal.radius, axes)


def overlap(depth, other) -> float:
    return ((depth > 0) & (other > 0)).sum() / ((depth > 0) | (other > 0)).sum()


def assert_found(thing, mesh, centre, radius):
    """The object's frame is that of the mesh, up to shares of its radius."""
    true = true_frame(mesh)
    assert (
        np.linalg.norm(thing.object_frame.centre - true.centre) < centre * true.radius
    )
    assert thing.object_frame.radius == pytest.approx(true.radius, rel=radius)


def rendered(mesh, frame_: ObjectFrame, pose) -> Observation:
    """What a camera sees of the mesh alone, level, from three true radii."""
    return SimulatedCamera(meshed(mesh)).observe(
        virtual_pose(frame_.pose_in_object(pose))
    )


# The virtual view


@pytest.mark.parametrize(
    ("elevation", "azimuth"),
    [(0, 0), (20, 100), (72, 300), (-15, 40)],
)
def test_the_virtual_pose_is_that_of_the_view_sphere(elevation, azimuth):
    pose = pose_at(elevation, azimuth, 5.0, turn=(4, -5, 30))
    expected = look_at_origin(np.radians(elevation), np.radians(azimuth))
    np.testing.assert_allclose(virtual_pose(pose), expected, atol=1e-12)


@pytest.mark.parametrize("distance", [0.4, 0.6, 1.2])
def test_a_frame_is_seen_again_as_a_render_from_three_radii(distance):
    """The camera is at another distance, rolled and aimed beside the object: against a camera
    that is not.
    """
    known = true_frame(WEDGE)
    pose = pose_at(35, 25, distance, known.centre, (3, -4, 17))
    depth, _ = cast([WEDGE], pose)
    facets = fit_facets(depth, depth > 0, INTRINSICS, denoise=False)
    again, facet = look_again(facets, known.pose_in_object(pose), known.radius, 224)
    expected = rendered(WEDGE, known, pose).depth
    assert overlap(again, expected) > 0.94
    both = (again > 0) & (expected > 0)
    assert np.median(np.abs(again - expected)[both]) < 1e-3
    assert np.quantile(np.abs(again - expected)[both], 0.9) < 0.01
    np.testing.assert_array_equal(facet >= 0, again > 0)


# What is found


def test_a_frame_becomes_an_observation_of_the_object_alone():
    pose = pose_at(40, 25, 0.7, (0.02, -0.03, 0.06), (2, 3, -8))
    thing = ObservedObject()
    observation = thing.add(frame([TABLE, HULL, WALL], pose, seed=0))
    assert_found(thing, HULL, 0.05, 0.04)
    assert observation.radius == thing.object_frame.radius
    assert observation.depth.shape == (224, 224)
    expected = rendered(HULL, true_frame(HULL), pose)
    assert overlap(observation.depth, expected.depth) > 0.9
    both = (observation.depth > 0) & (expected.depth > 0)
    assert np.median(np.abs(observation.depth - expected.depth)[both]) < 0.03
    assert thing.warnings == []


def test_the_requested_object_is_selected_among_several():
    small, large = (
        box((0.08, 0.08, 0.1), (0.2, 0.2, 0.05)),
        box((0.2, 0.2, 0.15), (-0.15, -0.1, 0.075)),
    )
    seen = frame([TABLE, small, large], pose_at(45, 20, 0.9), seed=1)
    for options, mesh in (
        ({}, large),
        ({"point": (0.18, 0.22, 0.1)}, small),
        ({"point": (-0.2, -0.1, 0.0)}, large),
        ({"box": Box([0.16, 0.16, 0], [0.24, 0.24, 0.1])}, small),
        ({"known": true_frame(small)}, small),
    ):
        thing = ObservedObject(**options)
        thing.add(seen)
        assert_found(thing, mesh, 0.1, 0.08)


def test_a_small_object_at_the_axis_is_selected_beside_a_larger_one():
    small = box((0.08, 0.08, 0.1), (0, 0, 0.05))
    large = box((0.2, 0.4, 0.3), (0.05, 0.3, 0.15))
    thing = ObservedObject()
    pose = pose_at(45, 20, 0.9, (0, 0, 0.05))
    thing.add(frame([TABLE, small, large], pose, seed=1))
    assert_found(thing, small, 0.1, 0.08)


def test_what_is_far_behind_in_a_mask_is_no_part_of_the_object():
    pose = pose_at(20, 0, 0.7, (0, 0, 0.06))
    owner = cast([TABLE, HULL, WALL], pose)[1]
    mask = (owner == 1) | ((owner == 2) & (np.indices(SHAPE)[1] % 40 < 8))
    assert (owner[mask] == 2).mean() > 0.1
    thing = ObservedObject()
    thing.add(frame([TABLE, HULL, WALL], pose, seed=0, mask=mask))
    assert_found(thing, HULL, 0.1, 0.1)


@pytest.mark.parametrize("gap", [0.01, 0.03])
def test_things_that_nearly_touch_are_two(gap):
    """The boxes are turned, so that they meet in a concave edge."""
    turn = trimesh.transformations.rotation_matrix(np.radians(45), (0, 0, 1))
    one = box((0.1, 0.1, 0.12), (0, 0, 0.06)).apply_transform(turn)
    other = box((0.12, 0.12, 0.08), (0, 0.0707 + 0.06 + gap, 0.04))
    thing = ObservedObject(point=(0, 0, 0.1))
    for k, azimuth in enumerate((0, 30, -20)):
        thing.add(frame([TABLE, one, other], pose_at(35, azimuth, 0.7), seed=k))
    assert_found(thing, one, 0.15, 0.12)


def test_a_frame_that_shows_next_to_nothing_says_nothing_of_the_size():
    one, thing = box((0.1, 0.1, 0.12), (0, 0, 0.06)), ObservedObject()
    for k, azimuth in enumerate((0, 30)):
        pose = pose_at(35, azimuth, 0.7)
        owner = cast([TABLE, one], pose)[1]
        # some table
        mask = (owner == 1 - k) & (
            (owner == 1) | (np.cumsum(owner == 0).reshape(owner.shape) < 300)
        )
        thing.add(frame([TABLE, one], pose, seed=k, mask=mask))
        assert_found(thing, one, 0.05, 0.05)


@pytest.mark.parametrize("wider", [0.006, 0.012])
def test_a_narrow_strip_of_what_is_behind_belongs_to_it(wider):
    """The rear box shows all around the front one, a few pixels wide."""
    front, rear = (
        box((0.1, 0.1, 0.12), (0, 0, 0.06)),
        box((0.1, 0.1 + 2 * wider, 0.16), (-0.15, 0, 0.08)),
    )
    thing = ObservedObject(point=(0, 0, 0.1))
    thing.add(frame([TABLE, front, rear], pose_at(15, 0, 0.7, (0, 0, 0.06)), seed=0))
    _, seen = cast([TABLE, front, rear], pose_at(15, 0, 0.7, (0, 0, 0.06)))
    mask = thing.sightings[0].mask
    assert (mask & (seen == 2)).sum() < 0.02 * mask.sum()
    assert (mask & (seen == 1)).sum() > 0.85 * (seen == 1).sum()


@pytest.mark.parametrize("parts", ["handle", "back", "bowl"])
def test_concave_edges_within_one_thing_do_not_cut_it(parts):
    made = {
        "handle": [
            box((0.1, 0.1, 0.14), (0, 0, 0.07)),
            box((0.02, 0.06, 0.06), (0, 0.08, 0.08)),
        ],
        "back": [
            box((0.16, 0.16, 0.08), (0, 0, 0.04)),
            box((0.03, 0.16, 0.12), (-0.065, 0, 0.14)),
        ],
        "bowl": [
            box((0.2, 0.2, 0.012), (0, 0, 0.006)),
            *(box((0.02, 0.2, 0.08), (x, 0, 0.04)) for x in (-0.09, 0.09)),
            *(box((0.2, 0.02, 0.08), (0, y, 0.04)) for y in (-0.09, 0.09)),
        ],
    }[parts]
    thing = ObservedObject(point=(0, 0, 0.05))
    for k, azimuth in enumerate((0, 60)):
        thing.add(frame([TABLE, *made], pose_at(40, azimuth, 0.7), seed=k))
    assert_found(thing, trimesh.util.concatenate(made), 0.1, 0.08)
    assert thing.warnings == []


def test_a_mask_on_a_table_reaches_down_to_it():
    lid = box((0.2, 0.2, 0.01), (0, 0, 0.095))
    pose = pose_at(60, 10, 0.7)
    depth, seen = cast([lid, TABLE], pose)
    masked = Frame(depth, INTRINSICS, pose, seen == 0, pixel_centre=0.5)
    on_table, floating = ObservedObject(), ObservedObject(support=False)
    on_table.add(masked)
    floating.add(masked)
    assert on_table.object_frame.centre[2] == pytest.approx(0.05, abs=0.004)
    assert floating.object_frame.centre[2] > 0.09


def test_an_object_without_a_support_plane_is_given_by_a_mask_or_a_box():
    """A brick that a rod holds above a table: no depth tells where the brick ends."""
    brick = box((0.1, 0.06, 0.04), (0, 0, 0.4))
    rod = box((0.02, 0.02, 0.3), (0, 0, 0.57))
    pose = pose_at(25, 30, 0.7, (0, 0, 0.4))
    depth, seen = cast([brick, rod, TABLE], pose)
    whole = Frame(depth, INTRINSICS, pose, pixel_centre=0.5)

    held = ObservedObject(support=False)
    with pytest.raises(ObservationError) as refused:
        held.add(whole)
    assert "OpenGL" not in str(refused.value)

    held.add(Frame(depth, INTRINSICS, pose, seen == 0, pixel_centre=0.5))
    around = Box(np.array([-0.05, -0.03, 0.38]), np.array([0.05, 0.03, 0.42]))
    boxed = ObservedObject(support=False, box=around)
    boxed.add(whole)
    for thing in (held, boxed):
        assert np.linalg.norm(thing.object_frame.centre - (0, 0, 0.4)) < 0.03
        assert thing.warnings == []


# More frames


def test_the_object_frame_gets_better_and_earlier_views_with_it():
    """From the front at the height of the table the depth of a long box is not seen; from the
    side it is.
    """
    long = box((0.4, 0.12, 0.12), (0, 0, 0.06))
    thing = ObservedObject(life_size=False)
    first = thing.add(frame([TABLE, long], pose_at(4, 0, 0.8, (0, 0, 0.06)), seed=6))
    early = thing.object_frame
    assert thing.revision == 0
    second = thing.add(frame([TABLE, long], pose_at(45, 90, 0.8, (0, 0, 0.06)), seed=7))
    assert early.radius < 0.7 * true_frame(long).radius
    assert_found(thing, long, 0.05, 0.04)
    assert thing.revision == 1
    anew, latest = thing.observations
    assert latest is second
    assert not np.array_equal(anew.depth, first.depth)
    expected = rendered(long, true_frame(long), pose_at(4, 0, 0.8, (0, 0, 0.06)))
    assert (
        overlap(anew.depth, expected.depth)
        > 0.85
        > overlap(first.depth, expected.depth)
    )


def test_a_frame_without_the_object_is_not_taken_in():
    thing = ObservedObject()
    thing.add(frame([TABLE, WEDGE], pose_at(40, 25, 0.7)))
    known, observations = thing.object_frame, thing.observations
    with pytest.raises(ObservationError):
        thing.add(frame([TABLE], pose_at(40, 120, 0.7)))
    assert thing.object_frame is known
    assert len(thing.observations) == len(observations) == len(thing.sightings) == 1
    thing.add(frame([TABLE, WEDGE], pose_at(40, 120, 0.7)))
    assert len(thing.observations) == 2


@pytest.mark.parametrize("thing", ["carton", "tin", "tray"])
@pytest.mark.parametrize("raised", [-0.004, 0.004])
def test_the_table_is_no_part_of_an_object_where_the_poses_of_an_arm_err(thing, raised):
    made = {
        "carton": box((0.12, 0.07, 0.09), (0.02, 0, 0.045)),
        "tin": trimesh.creation.cylinder(0.04, 0.12).apply_translation((0.02, 0, 0.06)),
        "tray": box((0.2, 0.14, 0.018), (0, 0, 0.009)),
    }[thing]
    views = [(40, 20), (28, 75), (45, 200)]
    turn = Rotation.from_euler("xyz", (-0.4, 0.4, 0.2), degrees=True).as_matrix()
    seen = ObservedObject()

    for k, (view, sign) in enumerate(zip(views, (0, 1, -1), strict=True)):
        pose = pose_at(*view, 0.55, (0, 0, 0.04))
        believed = pose.copy()
        believed[:3, :3] = np.linalg.matrix_power(turn, sign) @ pose[:3, :3]
        believed[:3, 3] += sign * np.array([0, 0.003, raised])
        seen.add(replace(frame([TABLE, made], pose, seed=k), pose=believed))

        plane = seen.sightings[-1].plane
        # a point of it, as the camera sees it
        on_table = np.linalg.inv(pose) @ [0.2, -0.1, 0, 1]
        stands = seen.sightings[-1].frame.camera_to_world
        assert abs(plane.height((stands @ on_table)[:3])) < 0.002

    assert seen.object_frame.radius == pytest.approx(true_frame(made).radius, rel=0.15)


def test_a_pose_that_contradicts_the_frames_before_is_warned_of():
    thing = ObservedObject()
    thing.add(frame([TABLE, WEDGE], pose_at(40, 25, 0.7)))
    wrong = pose_at(40, 120, 0.7)
    wrong[:3, 3] += 0.08, 0, 0
    thing.add(replace(frame([TABLE, WEDGE], pose_at(40, 120, 0.7)), pose=wrong))
    assert [warning.name for warning in thing.warnings] == ["contradiction"]


# What is refused


def turned(pose, axes):
    changed = pose.copy()
    changed[:3, :3] = pose[:3, :3] @ axes
    return changed


@pytest.mark.parametrize(
    ("turns", "said"),
    [(1, "to the left"), (-1, "to the right"), (2, "head")],
)
@pytest.mark.parametrize("azimuth", [20, 110, 200])
def test_a_picture_that_is_turned_against_its_pose_is_named(turns, said, azimuth):
    pose = pose_at(60, azimuth, 0.7)
    seen = frame([TABLE, WEDGE], pose)
    intrinsics = seen.intrinsics.copy()
    if turns != 2:
        intrinsics[[0, 1], 2] = intrinsics[[1, 0], 2]
    turned_depth = np.rot90(seen.depth, turns).copy()
    with pytest.raises(ObservationError, match=rf"the picture .*{said}"):
        ObservedObject().add(Frame(turned_depth, intrinsics, pose, pixel_centre=0.5))


def test_an_old_pose_and_a_missing_plane_are_warned_of():
    first, second = (
        frame([TABLE, WEDGE], pose_at(40, azimuth, 0.7), seed=1) for azimuth in (25, 80)
    )
    thing = ObservedObject(point=(0, 0, 0.1))
    thing.add(first)
    assert thing.warnings == []
    thing.add(replace(second, pose=first.pose))
    assert "stale pose" in [warning.name for warning in thing.warnings]
    pose = pose_at(40, 25, 0.7)
    depth, seen = cast([WEDGE, TABLE], pose)
    alone = Frame(
        np.where(seen == 0, depth, 0),
        INTRINSICS,
        pose,
        seen == 0,
        pixel_centre=0.5,
    )
    thing = ObservedObject()
    thing.add(alone)
    assert [warning.name for warning in thing.warnings] == ["support"]
    thing = ObservedObject(support=False)
    thing.add(alone)
    assert thing.warnings == []


@pytest.mark.parametrize("height", [-0.01, 0.0, 0.003, 0.05])
def test_a_point_may_lie_on_the_table_itself(height):
    for azimuth in (0, 90):
        thing = ObservedObject(point=(0, 0, height))
        thing.add(frame([TABLE, HULL], pose_at(50, azimuth, 0.7)))
        assert_found(thing, HULL, 1 / 3, 0.15)
        assert thing.warnings == []


@pytest.mark.parametrize(
    ("point", "warned"),
    [((0.2, 0, 0), False), ((0.6, -0.3, 0), True)],
)
def test_a_point_far_from_all_that_is_seen_is_warned_of(point, warned):
    thing = ObservedObject(point=point)
    thing.add(frame([TABLE, WEDGE], pose_at(40, 25, 0.7)))
    assert ["point"] * warned == [warning.name for warning in thing.warnings]


def test_a_part_of_a_picture_is_warned_of_and_taken_in():
    seen = frame([TABLE, WEDGE], pose_at(40, 25, 0.7))
    k = seen.intrinsics.copy()
    k[0, 2] -= 240
    thing = ObservedObject()
    thing.add(Frame(seen.depth[:, 240:], k, seen.pose, pixel_centre=0.5))
    assert [warning.name for warning in thing.warnings] == ["intrinsics"]


# Warnings of views


BENCH = meshed(WEDGE)


def view(elevation=30.0, azimuth=50.0, distance=3.0) -> Observation:
    return SimulatedCamera(BENCH).observe(pose_at(elevation, azimuth, distance))


def with_depth(observation, factor):
    return replace(observation, depth=(observation.depth * factor).astype(np.float32))


def in_metres(observation, radius):
    pose = observation.pose.copy()
    pose[:3, 3] *= radius
    return replace(with_depth(observation, radius), pose=pose)


@pytest.mark.parametrize("elevation", [-10, 0, 30, 72])
@pytest.mark.parametrize("distance", [2.0, 3.0, 6.0])
def test_correct_views_get_no_warning(elevation, distance):
    views = [view(elevation, azimuth, distance) for azimuth in (0, 50, 200)]
    assert [check_observation(v) for v in views] == [[], [], []]
    assert check_views(views[0], views[1]) == check_views(views[1], views[2]) == []


def test_two_sides_of_a_cube_are_one_object():
    scene = [TABLE, box((0.1, 0.1, 0.1), (0, 0, 0.05))]
    thing = ObservedObject(point=(0, 0, 0.05), life_size=False)
    for k, (elevation, azimuth) in enumerate(((5, 0), (40, 180))):
        thing.add(frame(scene, pose_at(elevation, azimuth, 0.8, (0, 0, 0.05)), seed=k))
    assert [view.seen for view in thing.observations] == [True, True]
    assert thing.object_frame.radius == pytest.approx(0.05 * np.sqrt(3), rel=0.1)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("nothing seen", lambda o: with_depth(o, 0)),
        ("opengl axes", lambda o: replace(o, pose=o.pose @ FLIP)),
        (
            "ros axes",
            lambda o: replace(
                o,
                pose=turned(o.pose, np.array([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]])),
            ),
        ),
        ("inverse pose", lambda o: replace(o, pose=np.linalg.inv(o.pose))),
        ("scale", lambda o: with_depth(o, 0.12)),
        ("scale", lambda o: with_depth(o, 2.5)),
        ("scale", lambda o: in_metres(o, 0.12)),
        (
            "outside",
            lambda o: replace(
                o,
                pose=turned(o.pose, Rotation.from_euler("y", 1.0).as_matrix()),
            ),
        ),
    ],
)
def test_mistakes_in_observations_are_named(name, wrong):
    warnings = check_observation(wrong(view()))
    assert [warning.name for warning in warnings] == [name]
    assert "\n" not in warnings[0].message
