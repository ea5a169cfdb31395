"""``Session``: one object under way, the caller moves the camera."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import pytest
import trimesh

import nextview
from nextview import Session, SimulatedCamera, Stopping
from nextview.data.samples import sample_mesh
from nextview.errors import SessionError


@pytest.fixture(scope="module")
def system():
    return nextview.load()


@pytest.fixture(scope="module")
def camera():
    return SimulatedCamera(sample_mesh("chair"))


def test_it_asks_for_views_until_it_is_done(system, camera):
    session = system.session(start=3)
    asked = []
    while not session.done:
        np.testing.assert_array_equal(session.pose, system.sphere.poses[session.view])
        asked.append(session.view)
        view = session.update(camera.observe(session.pose))
        assert (view.next_view is None) == session.done
    assert asked == [view.index for view in session.result.views]
    assert session.result.answer == "chair"
    with pytest.raises(SessionError):
        session.update(camera.observe(system.sphere.poses[0]))


@dataclass(frozen=True)
class Margin(Stopping):
    """Stop when the class believed most leads by so much."""

    lead: float = 0.9

    def reached(self, belief, n_views):
        top = np.sort(belief, -1)
        return top[..., -1] - top[..., -2] >= self.lead


def test_a_stopping_rule_of_ones_own(camera):
    system = nextview.load(stopping=Margin(max_views=6, lead=0.95))
    assert len(pickle.dumps(system)) < 1000  # as how it was loaded
    for again in (system, pickle.loads(pickle.dumps(system))):
        result = again.recognise(camera, start=20)
        leads = [np.ptp(np.sort(view.belief)[-2:]) for view in result.views]
        assert (leads[-1] >= 0.95) == result.confident
        assert max(leads[:-1], default=0) < 0.95


@pytest.mark.parametrize(
    ("first", "confident", "n_views"), [("chair", True, 5), ("table", False, 6)]
)
def test_an_object_that_is_swapped_after_the_first_view_gets_no_confident_answer(
    first, confident, n_views
):
    cameras = [SimulatedCamera(sample_mesh(name)) for name in (first, *["chair"] * 5)]
    session = nextview.load(
        stopping=lambda seen, _: seen.n_views >= 5, max_views=6
    ).session(start=9)
    while not session.done:
        session.update(cameras[len(session.views)].observe(session.pose))
    assert not session.views[-1].warnings
    assert (session.result.confident, len(session.views)) == (confident, n_views)


def test_the_two_sides_of_a_symmetric_object_are_two_views(system, tmp_path):
    trimesh.creation.box((0.4, 0.2, 0.3)).export(tmp_path / "box.off")
    camera = SimulatedCamera(nextview.load_mesh(tmp_path / "box.off"))
    session = Session(system.models, system.policy, system.sphere, 16, Stopping(1.0, 2))
    sides = [camera.observe(system.sphere.poses[view]) for view in (16, 20)]
    np.testing.assert_array_equal(sides[0].depth, sides[1].depth)
    first, second = map(session.update, sides)
    assert not second.warnings
    assert (first.belief != second.belief).any()


@pytest.mark.parametrize(
    "again", [deepcopy, lambda session: pickle.loads(pickle.dumps(session))]
)
@pytest.mark.parametrize("policy", ["gain", "lem", "visible-gain"])
def test_a_copy_of_a_session_continues_independently(camera, policy, again):
    session = nextview.load(policy=policy, threshold=1, max_views=3).session(start=20)
    session.update(camera.observe(session.pose))
    result = again(session).run(camera)
    assert len(session.views) == 1
    assert repr(session.run(camera)) == repr(result)


def test_threads_that_share_a_session_wait_for_each_other(system, camera):
    """What is taken in is a session of its own; who comes too late is told so."""
    session = Session(system.models, system.policy, system.sphere, 20, Stopping(1.0, 5))
    seen = [camera.observe(pose) for pose in system.sphere.poses[8:24]]
    with ThreadPoolExecutor(4) as pool:
        ended = [
            done.exception()
            for done in [pool.submit(session.update, one) for one in seen]
        ]
    assert sorted(map(str, filter(None, ended))) == [
        "this session has ended; begin another one"
    ] * (len(seen) - 5)
    alone = Session(system.models, system.policy, system.sphere, 20, Stopping(1.0, 5))
    for view in session.views:
        alone.update(view.observation)
    np.testing.assert_array_equal(
        [v.belief for v in session.views], [v.belief for v in alone.views]
    )


def test_an_unfinished_session_reports_the_current_belief(system, camera):
    session = Session(system.models, system.policy, system.sphere, 20, Stopping(1.0, 3))
    before = session.result
    assert (
        before.answer,
        before.beliefs,
        before.travel,
        before.radius,
        before.views,
    ) == (None, {}, 0, None, ())
    assert repr(before) == "nothing is seen (0 views)"
    view = session.update(camera.observe(session.pose))
    result = session.result
    assert result.views == (view,)
    assert (result.confident, result.stranded) == (False, False)
    assert result.beliefs == dict(
        zip(system.classes, view.belief.tolist(), strict=True)
    )
    assert result.answer == max(result.beliefs, key=result.beliefs.get)
    session.run(camera)
    assert len(session.result.views) == 3
