"""The simulated arm against the published geometry of a Panda, MuJoCo's own rays, and closed
forms.
"""

import mujoco
import numpy as np
import pytest

import nextview
from nextview.data.samples import sample_mesh
from nextview.geometry.ray_caster import RayCaster
from nextview.geometry.viewsphere import angle_between, look_at_origin
from nextview.sensing import ObservedObject
from nextview.simulation.sensor import SENSORS
from research.arm import (
    CAMERA,
    CLOSE,
    FASTEST,
    HOME,
    OFFSETS,
    RANGES,
    STARTS,
    STRAIGHT,
    Arm,
    along,
    put_down,
    seconds_of,
)


def denavit_hartenberg(a, d, alpha, theta):
    """Craig's convention, as in Franka's documentation."""
    ca = np.cos(alpha)
    sa = np.sin(alpha)
    ct = np.cos(theta)
    st = np.sin(theta)
    return np.array(
        [
            [ct, -st, 0, a],
            [st * ca, ct * ca, -sa, -d * sa],
            [st * sa, ct * sa, ca, d * ca],
            [0, 0, 0, 1],
        ]
    )


def link_7(joints):
    """Pose of the last link by Franka's table of Denavit-Hartenberg parameters, (4, 4)."""
    a = [0, 0, 0, 0.0825, -0.0825, 0, 0.088]
    d = [0.333, 0, 0.316, 0, 0.384, 0, 0]
    alpha = [0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2]
    pose = np.eye(4)
    for each in zip(a, d, alpha, joints + OFFSETS, strict=True):
        pose = pose @ denavit_hartenberg(*each)
    return pose


@pytest.fixture(scope="module")
def arm():
    rng = np.random.default_rng(1)
    return Arm([put_down(sample_mesh("chair"), rng)], rng)


@pytest.fixture
def at_home(arm):
    arm.joints = HOME
    return arm


def looking(elevation, azimuth, distance=0.4):
    pose = look_at_origin(np.radians(elevation), np.radians(azimuth), distance)
    pose[:3, 3] += [0.5, 0, 0.08]
    return pose


@pytest.mark.parametrize(
    "joints",
    [HOME, *STARTS[1:], np.array([0.3, -0.2, 0.5, -1.5, -0.4, 0.2, 1.0])],
)
def test_the_camera_is_where_the_published_geometry_has_it(arm, joints):
    pose = arm.camera_at(joints)
    last = link_7(joints)
    turn = np.pi / 4  # of the hand about the flange, Franka's hand
    x = np.array([np.cos(turn), -np.sin(turn), 0])
    place = last[:3, 3] + last[:3, :3] @ (CAMERA[0] * x + [0, 0, CAMERA[2]])
    # the model writes pi / 2 as 1.57
    np.testing.assert_allclose(pose[:3, 2], last[:3, 2], atol=3e-3)
    np.testing.assert_allclose(pose[:3, 3], place, atol=2e-3)
    # the hand is below in the picture
    np.testing.assert_allclose(pose[:3, 1], -last[:3, :3] @ x, atol=3e-3)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-9)


@pytest.mark.parametrize("view", [(18, 135), (36, 225), (54, 90), (72, 0)])
def test_joints_that_are_found_bring_the_camera_there(at_home, view):
    pose = looking(*view)
    joints = at_home.solve(pose)
    reached = at_home.camera_at(joints)
    assert np.linalg.norm(reached[:3, 3] - pose[:3, 3]) < CLOSE
    assert angle_between(reached[:3, 2], pose[:3, 2]) < STRAIGHT
    assert (
        (joints + OFFSETS >= RANGES[:, 0] - 1e-6)
        & (joints + OFFSETS <= RANGES[:, 1] + 1e-6)
    ).all()
    assert not at_home.touches(joints)


def test_what_is_out_of_reach_is_not_reached(at_home):
    assert at_home.solve(looking(20, 0, 1.0)) is None  # 1.4 m from the base
    assert not at_home.can_reach(looking(20, 0, 1.0))
    below = looking(20, 180)
    below[2, 3] = -0.1
    assert at_home.solve(below) is None
    assert at_home.travel_cost(at_home.pose, below) == np.inf
    assert not at_home.go_to(below)
    np.testing.assert_array_equal(at_home.joints, HOME)


def test_it_touches_what_is_in_its_way(at_home):
    assert not at_home.touches(HOME)
    assert at_home.touches(
        np.array([0, 1.5, 0, -0.5, 0, 0, 0])
    )  # stretched down through the table
    assert at_home.touches(np.array([0, 0, 0, -3.0, 0, -1.6, 0]))  # folded into itself
    inside, ((vertices, _), _) = looking(89.9, 0), at_home.things()[1]
    # between the legs of the chair: in its convex hull
    inside[:3, 3] = (vertices.min(0) + vertices.max(0)) / 2
    assert at_home.touches(at_home.descend(inside, HOME))
    assert at_home.solve(inside) is None


def test_a_way_goes_round_what_blocks_it(at_home):
    """From one side of the object to the other, low: straight through it is blocked, by home it
    is not.
    """
    left = at_home.solve(looking(5, 120, 0.3))
    right = at_home.solve(looking(5, 240, 0.3))
    assert left is not None
    assert right is not None
    at_home.joints = left
    way = at_home.way(looking(5, 240, 0.3))
    assert way is not None
    assert not any(at_home.touches(joints) for joints in along(way, 0.01))
    np.testing.assert_array_equal(way[0], left)


def test_the_slowest_joint_counts():
    a = np.zeros(7)
    b = np.zeros(7)
    b[0], b[6] = 2.175, 5.22
    assert seconds_of([a, b]) == pytest.approx(2.0)
    assert seconds_of([a, b, a]) == pytest.approx(4.0)
    assert seconds_of([a]) == 0
    assert (FASTEST <= 2.61).all()


def test_depth_is_what_mujocos_own_rays_say(at_home):
    """Another ray caster, on the same model: MuJoCo's, on the meshes that are seen and not on
    their hulls.
    """
    pose = at_home.pose
    sensor = SENSORS["stereo"]
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, [sensor.width, sensor.height], (300, 2))
    k = sensor.intrinsics
    rays = (
        np.column_stack([(pixels - k[:2, 2]) / k[[0, 1], [0, 1]], np.ones(300)])
        @ pose[:3, :3].T
    )
    depth, which = RayCaster([triangles for triangles, _ in at_home.things()]).cast(
        pose[:3, 3],
        rays,
    )
    seen = np.zeros(300)
    groups = np.array([1, 1, 1, 0, 1, 1], np.uint8)
    geom = np.zeros(1, np.int32)
    for i, ray in enumerate(rays):
        seen[i] = mujoco.mj_ray(
            at_home.model,
            at_home.data,
            pose[:3, 3],
            ray / np.linalg.norm(ray),
            groups,
            1,
            -1,
            geom,
        )
    theirs = seen / np.linalg.norm(rays, axis=1)
    assert ((seen >= 0) == (which >= 0)).mean() > 0.98
    both = (seen >= 0) & (which >= 0)
    assert both.sum() > 100
    assert (np.abs(depth - theirs)[both] < 1e-3).mean() > 0.98


def test_it_finds_out_what_stands_there(at_home):
    session = nextview.load(threshold=1.0, max_views=3).session(
        object=ObservedObject(life_size=False),
        distance=0.4,
    )
    at_home.joints = at_home.solve(looking(35, 215))
    at_home.motions = []
    at_home.seconds = 0.0
    moved = []
    result = at_home.run(session, lambda: moved.append(at_home.seconds))
    assert result.answer == "chair"
    assert len(result.views) == 3
    assert moved[0] == 0
    assert moved[-1] == pytest.approx(sum(map(seconds_of, at_home.motions)))
    np.testing.assert_allclose(
        session.object.object_frame.centre[:2],
        [0.5, 0],
        atol=0.1,
    )
