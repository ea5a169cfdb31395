"""Poses of a real arm, a nudged object, and a table that is not level: what is allowed for, and
what is warned of.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from factories import INTRINSICS, SHAPE, TABLE, box, cast, meshed, pose_at
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nextview.sensing import Frame, ObservedObject
from nextview.sensing.known_frames import lean_of
from nextview.sensing.planes import Plane
from nextview.sensing.registration import displacement
from nextview.session.pose_frame import PoseFrame

CARTON = box((0.12, 0.07, 0.09), (0.02, 0, 0.045))
MUG = trimesh.util.concatenate(
    [
        trimesh.creation.cylinder(0.04, 0.1).apply_translation((0, 0, 0.05)),
        box((0.05, 0.012, 0.06), (0.05, 0, 0.05)),
    ]
)
THINGS = {"carton": CARTON, "mug": MUG}
VIEWS = ((40, 20), (32, 75), (45, -50))
NOISE = 0.002  # metres at 0.5 m; four times that of a good stereo camera


def seen(meshes, pose, seed, told=None, sigma=NOISE) -> Frame:
    """A noisy frame, with the pose that it was taken from or another one."""
    depth, _ = cast(meshes, pose)
    rng = np.random.default_rng(seed)
    depth = np.where(
        depth > 0,
        depth + sigma * (depth / 0.5) ** 2 * rng.normal(size=SHAPE),
        0,
    )
    depth[rng.random(SHAPE) < 0.03] = 0
    return Frame(depth, INTRINSICS, pose if told is None else told, pixel_centre=0.5)


def looked_at(thing, moves, views=VIEWS, **more) -> ObservedObject:
    """An object that stands elsewhere in each frame, as do the camera and the table if it is the
    pose that errs.
    """
    known = ObservedObject(alone=True, **more)
    for k, (view, move) in enumerate(zip(views, moves, strict=True)):
        moved = thing.copy().apply_translation(move)
        known.add(seen([TABLE, moved], pose_at(*view, 0.5, (0, 0, 0.04)), k))
    return known


def names(thing: ObservedObject) -> list[str]:
    return [warning.name for warning in thing.warnings]


@pytest.mark.parametrize("thing", THINGS)
@pytest.mark.parametrize("views", [VIEWS, ((25, 0), (60, 40), (30, 150))])
def test_right_poses_are_left_as_they_are(thing, views):
    known = looked_at(THINGS[thing], np.zeros((3, 3)), views)
    assert names(known) == []
    assert all(not sighting.shift.any() for sighting in known.sightings)


@pytest.mark.parametrize(
    ("thing", "nudge"),
    [
        ("carton", (0.01, 0, 0)),
        ("carton", (-0.005, 0.009, 0)),
        ("mug", (0, -0.01, 0)),
    ],
)
def test_a_nudged_object_is_put_back_and_warned_of(thing, nudge):
    mesh = THINGS[thing]
    views = (40, 20), (32, 50), (45, 85)  # so near that two sides are seen in each
    known = looked_at(mesh, [np.zeros(3), nudge, nudge], views)
    for sighting in known.sightings[1:]:
        np.testing.assert_allclose(sighting.shift, -np.array(nudge), atol=0.005)
    assert names(known) == []  # it did not move again
    assert known.object_frame.radius == pytest.approx(meshed(mesh).radius, rel=0.08)

    again = looked_at(mesh, [np.zeros(3), nudge], views[:2])
    assert names(again) == ["displaced"]
    assert not again.warnings[0].holds


@pytest.mark.parametrize("seed", range(4))
def test_errors_of_an_arm_are_allowed_for(seed):
    """Hand-eye calibration, joints and time stamp: the object is seen nearer to one place."""
    rng = np.random.default_rng(seed)
    known = ObservedObject()
    places = []
    for k, view in enumerate(VIEWS):
        pose = pose_at(*view, 0.5, (0, 0, 0.04))
        told = pose.copy()
        told[:3, 3] += 0.006 * _direction(rng)
        told[:3, :3] = (
            Rotation.from_rotvec(0.01 * _direction(rng)).as_matrix() @ told[:3, :3]
        )
        known.add(seen([TABLE, CARTON], pose, k, told))
        places.append((told @ np.linalg.inv(pose) @ [*CARTON.centroid, 1])[:3])

    stood = np.array(places)
    mended = stood + [sighting.shift for sighting in known.sightings]
    before = np.linalg.norm(stood[1:] - stood[0], axis=1)
    after = np.linalg.norm(mended[1:] - mended[0], axis=1)
    assert after.mean() < before.mean() / 2
    assert "contradiction" not in names(known)

    # In the world it is where the frames show it in the mean: their errors differ.
    centre = PoseFrame.of(known).from_object[:3, 3]
    np.testing.assert_allclose(
        centre - known.object_frame.centre,
        stood.mean(0) - mended.mean(0),
        atol=1e-9,
    )


def _direction(rng) -> np.ndarray:
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


def test_what_moved_far_is_not_put_back():
    known = looked_at(
        CARTON,
        [np.zeros(3), (0.06, 0.03, 0)],
        VIEWS[:2],
        point=(0.02, 0, 0.04),
    )
    assert not known.sightings[-1].shift.any()


def test_the_displacement_moves_with_the_world():
    """Frames of a world that is turned and moved are displaced by the same, turned."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 70, degrees=True).as_matrix()
    turn[:3, 3] = 3, -2, 0.4
    found = []
    for world in (np.eye(4), turn):
        known = ObservedObject()
        for k, (view, move) in enumerate(zip(VIEWS[:2], (0, 0.01), strict=True)):
            pose = pose_at(*view, 0.5, (0, 0, 0.04))
            moved = CARTON.copy().apply_translation((move, 0, 0))
            known.add(seen([TABLE, moved], pose, k, world @ pose))
        told = [
            replace(one.shifted(-one.shift), shift=np.zeros(3))
            for one in known.sightings
        ]
        found.append(displacement(told[1], told[:1]).shift)
    np.testing.assert_allclose(found[1], turn[:3, :3] @ found[0], atol=1e-4)


# A table that leans


def plane_of(lean) -> Plane:
    return Plane(np.array([*lean, 1.0]), 0.0)


def leaning(degrees, azimuth) -> np.ndarray:
    a = np.radians(azimuth)
    axis = np.array([np.cos(a), np.sin(a), 0])
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
    return turn


@pytest.mark.parametrize(
    ("degrees", "azimuth", "warned"),
    [
        (0.0, 0, False),
        (0.4, 10, False),
        (2.0, 10, True),
        (2.0, 130, True),
        (2.0, 250, True),
    ],
)
def test_a_table_that_leans_is_warned_of(degrees, warned, azimuth):
    turn = leaning(degrees, azimuth)
    scene = [mesh.copy().apply_transform(turn) for mesh in (TABLE, CARTON)]
    known = ObservedObject()
    for k, view in enumerate(VIEWS):
        known.add(seen(scene, pose_at(*view, 0.5, (0, 0, 0.04)), k))
    assert names(known) == ["lean"] * warned

    wrong_up = ObservedObject(up=turn[:3, 2])
    for k, view in enumerate(VIEWS):
        wrong_up.add(seen([TABLE, CARTON], pose_at(*view, 0.5, (0, 0, 0.04)), k))
    assert names(wrong_up) == ["lean"] * warned


azimuths = st.lists(st.floats(0, 2 * np.pi), min_size=2, max_size=6)


@settings(deadline=None, max_examples=60)
@given(azimuths, st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
def test_depth_that_leans_every_plane_with_the_camera_is_no_lean(turns, forward, aside):
    """The same error in the camera's frame from all sides: never named, whatever its size."""
    poses = [pose_at(40, np.degrees(turn), 0.5) for turn in turns]
    planes = []
    for pose in poses:
        ahead = pose[:2, 2] / np.linalg.norm(pose[:2, 2])
        right = np.array([ahead[1], -ahead[0]])
        planes.append(plane_of(forward * ahead + aside * right))
    assert lean_of(planes, poses, np.eye(3)) is None
