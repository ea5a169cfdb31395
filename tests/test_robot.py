"""A session for a robot: frames of a depth camera from wherever it stands, and a robot that
cannot go everywhere.
"""

import numpy as np
import pytest
import trimesh
from factories import TABLE, box, cast, pose_at
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import nextview
from nextview import SessionError, SimulatedCamera, Stopping, ViewSphere
from nextview.data.samples import sample_mesh
from nextview.geometry.viewsphere import viewpoints_of
from nextview.policies.maps import MapPeak
from nextview.policies.registry import make_policy
from nextview.sensing import Frame, ObservedObject
from nextview.session.session import Session

SPHERE = ViewSphere.named("40")
SHAPE = 120, 160
INTRINSICS = np.array([[260.0, 0, 80], [0, 260.0, 60], [0, 0, 1]])
SOFA = trimesh.util.concatenate(
    [box((0.2, 0.16, 0.1), (0, 0, 0.05)), box((0.06, 0.16, 0.08), (-0.07, 0, 0.14))]
)


def frame(
    pose, move=np.eye(4), scale=1.0, meshes=(TABLE, SOFA), masked=False, **more
) -> Frame:
    """What a camera at a pose sees of the sofa on the table; then the world is moved and scaled."""
    depth, which = cast(meshes, pose, INTRINSICS, SHAPE)
    moved = move @ pose
    moved[:3, 3] *= scale
    mask = which == len(meshes) - 1 if masked else None
    return Frame(scale * depth, INTRINSICS, moved, mask, pixel_centre=0.5, **more)


def begin(
    models, policy=None, max_views=4, threshold=1.0, seed=0, sphere=SPHERE, **more
) -> Session:
    policy = policy or MapPeak(SPHERE, "lem")
    stopping = Stopping(threshold, max_views)
    return Session(
        models,
        policy,
        sphere,
        0,
        stopping,
        np.random.default_rng(seed),
        **({"distance": 0.7} | more),
    )


def run(session, first, look=frame) -> Session:
    pose = first
    while not session.done:
        session.update(look(pose))
        pose = session.target
    return session


def same_decisions(a, b, atol):
    assert [v.index for v in a.views] == [v.index for v in b.views]
    assert [v.next_view for v in a.views] == [v.next_view for v in b.views]
    for one, other in zip(a.views, b.views, strict=True):
        np.testing.assert_allclose(one.belief, other.belief, atol=atol)
        np.testing.assert_allclose(one.direction, other.direction, atol=atol)


# Frames


def test_the_whole_way_from_frames_to_a_name():
    """The bundled networks name a sample chair on a table that stands anywhere, in its true
    size.
    """
    mesh = sample_mesh("chair")
    chair = trimesh.Trimesh(0.12 * mesh.vertices, mesh.faces)
    chair.apply_translation([0.3, -0.2, -chair.vertices[:, 2].min()])
    middle = chair.bounds.mean(0)
    session = nextview.load().session(
        object=ObservedObject(life_size=False), distance=0.6
    )
    run(
        session,
        pose_at(40, 77, 0.6, middle),
        lambda pose: frame(pose, meshes=(TABLE, chair)),
    )
    assert session.result.answer == "chair"
    assert session.result.confident
    assert not any(view.warnings for view in session.views)
    target = session.poses[3]
    np.testing.assert_allclose(
        target[:3, 3] + 0.6 * target[:3, 2],
        session.object.object_frame.centre,
        atol=1e-9,
    )
    assert np.linalg.norm(session.object.object_frame.centre - middle) < 0.02


@settings(deadline=None, max_examples=3)
@given(
    st.integers(5, 70),
    st.integers(0, 359),
    st.floats(-3.1, 3.1),
    st.tuples(*[st.floats(-2, 2)] * 3),
)
def test_moving_the_world_and_the_poses_together_changes_nothing(
    tiny, elevation, azimuth, turn, shift
):
    move = np.eye(4)
    move[:3, :3] = Rotation.from_euler("z", turn).as_matrix()
    move[:3, 3] = shift
    pose = pose_at(elevation, azimuth, 0.7, (0, 0, 0.08), turn=(2, -1, 4))
    here, there = begin(tiny), begin(tiny)
    while not here.done:
        here.update(frame(pose, masked=True))
        there.update(frame(pose, move, masked=True))
        assert (there.view, there.done) == (here.view, here.done)
        if not here.done:
            np.testing.assert_allclose(there.target, move @ here.target, atol=2e-3)
        pose = here.target
    same_decisions(here, there, 5e-3)


# Where the camera really stands


def test_the_pose_that_was_reached_counts(tiny):
    camera = SimulatedCamera(sample_mesh("chair"), 32)
    session = begin(tiny, distance=None)
    place = (27.0, 100.0)
    pose = nextview.geometry.viewsphere.look_at_origin(*np.radians(place), 3.0)
    view = session.update(camera.observe(pose))
    assert view.index == (SPHERE.directions @ (pose[:3, 3] / 3)).argmax()
    assert view.angles == pytest.approx(place)
    second = session.update(camera.observe(session.pose))
    (up, round_), (to_up, to_round) = place, SPHERE.angles(second.index)
    steps = abs(to_round - round_) / 45 % 8
    assert second.travel == pytest.approx(
        np.hypot((to_up - up) / 18, min(steps, 8 - steps))
    )
    a, b = pose[:3, 3] / 3, SPHERE.directions[second.index]
    assert second.arc == pytest.approx(np.arccos(a @ b))


# What the robot can do


@settings(deadline=None, max_examples=30)
@given(
    st.data(),
    st.sampled_from(["40", "fibonacci:30"]),
    st.sampled_from(["random-all", "spread", "lem"]),
)
def test_failed_and_unreachable_views_never_come(tiny, data, layout, name):
    sphere = viewpoints_of(layout)
    policy = MapPeak(SPHERE, "lem") if name == "lem" else make_policy(name, sphere)
    camera = SimulatedCamera(sample_mesh("chair"), 32)
    session = begin(
        tiny,
        policy,
        sphere=sphere,
        max_views=6,
        distance=None,
        seed=data.draw(st.integers(0, 99)),
    )
    mask = np.random.default_rng(data.draw(st.integers(0, 999))).random(
        len(sphere)
    ) < data.draw(st.floats(0.05, 1))
    assume(mask.any())
    session.reachable = mask
    if data.draw(st.booleans()):
        session.reachable = lambda pose: mask[
            np.abs(sphere.poses - pose).sum((1, 2)).argmin()
        ]
    failed, visited = set(), set()
    while not session.done:
        if session.views or not callable(session.reachable):
            assert mask[session.view]
        assert session.view not in failed | visited
        if data.draw(st.booleans()) and session.views:
            failed.add(session.view)
            session.failed()
            continue
        visited.add(session.view)
        view = session.update(camera.observe(session.pose))
        assert view.belief.sum() == pytest.approx(1)
        assert view.next_view == (None if session.done else session.view)
    result = session.result
    left = set(np.flatnonzero(mask)) - failed - visited
    assert result.stranded == (len(result.views) < 6)
    assert not (result.stranded and left)
    assert not result.confident


def test_a_view_that_becomes_unreachable_is_replaced_at_once(tiny):
    camera = SimulatedCamera(sample_mesh("chair"), 32)
    session = begin(tiny, distance=None)
    session.update(camera.observe(session.pose))
    first = session.view
    session.reachable = np.arange(40) != first
    assert session.view != first
    assert session.views[-1].next_view == session.view
    session.reachable = np.zeros(40, bool)
    assert session.done
    assert session.result.stranded
    assert "no other view in reach" in repr(session.result)
    with pytest.raises(SessionError):
        session.failed()


def test_reach_and_cost_are_asked_in_the_world(tiny):
    session, asked = begin(tiny), []

    def reachable(pose):
        asked.append(pose)
        return pose[2, 3] > 0.3

    session.reachable = reachable
    starts = []
    session.travel_cost = lambda a, b: starts.append(a) or 1.0
    first = pose_at(35, 40, 0.7, (0, 0, 0.08))
    session.update(frame(first))
    centre = session.object.object_frame.centre
    for pose in asked:
        assert np.linalg.norm(pose[:3, 3] - centre) == pytest.approx(0.7)
        np.testing.assert_allclose(pose[:3, 3] + 0.7 * pose[:3, 2], centre, atol=1e-9)
    assert session.target[2, 3] > 0.3
    for pose in starts:
        np.testing.assert_allclose(pose, first, atol=1e-12)
