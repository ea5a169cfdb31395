"""What is one thing in a view, and what a session keeps of its views."""

from dataclasses import replace

import numpy as np
import pytest
from exact_views import before_a_wall, turned_views

from nextview.geometry.camera import pinhole
from nextview.geometry.mesh import load_mesh
from nextview.geometry.viewsphere import look_at_origin
from nextview.segmentation.instances import Instances
from nextview.sensing.frame import Frame
from nextview.sensing.object_frame import ObjectFrame
from nextview.sensing.view import View
from nextview.session import recogniser as session_recogniser
from nextview.session.recogniser import ThingRecogniser
from nextview.simulation.simulated import SimulatedCamera

K = np.array([[300.0, 0, 80], [0, 300, 60], [0, 0, 1]])
ON_NO_PLANE = np.full((120, 160), np.inf, np.float32)
UP = np.array([0.0, 0, 1])


def split_view(pieces=None, behind=0.6, widest=0.3):
    """Two halves of one instance, one of them behind the other, metres."""
    depth = np.full((120, 160), 0.5, np.float32)
    depth[:, 80:] = behind
    frame = Frame(depth, K, np.eye(4), pixel_centre=0.5)
    shown = np.zeros(depth.shape, bool)
    shown[40:80, 60:100] = True
    none = np.zeros(depth.shape, bool)
    found = Instances((shown,), none, none, pieces)
    return View.of(frame, found, depth > 0, ON_NO_PLANE, UP, widest), shown


def test_a_stranger_ends_where_the_depth_jumps():
    one = np.ones((120, 160), np.int32)
    view, shown = split_view(one)
    front = shown & (view.depth < 0.55)
    assert [mask.tolist() for mask in view.strangers()] == [
        front.tolist(),
        (shown & ~front).tolist(),
    ]
    assert len(list(view.instances())) == 1
    assert len(list(split_view(one, behind=0.5)[0].strangers())) == 1


def test_a_mask_that_is_given_is_one_stranger():
    assert len(list(split_view()[0].strangers())) == 1


def test_a_small_piece_of_an_instance_that_is_too_large_stays_to_be_explained():
    pieces = np.zeros((120, 160), np.int32)
    pieces[40:80, 60:70] = 1  # 1.7 cm wide, of 7 cm
    view, shown = split_view(pieces, behind=0.5, widest=0.06)
    piece = pieces > 0
    assert not list(view.instances())
    assert view.inside[piece].all()
    assert view.surface[shown & ~piece].all()
    assert [mask.tolist() for mask in view.fragments()] == [piece.tolist()]


def test_a_thing_is_recognised_by_a_camera_that_is_many_radii_away(knobs, knobs_memory):
    """The view is in radii, and no depth camera measures 25 m."""
    recogniser = ThingRecogniser(knobs_memory / "memory.json", 1)
    mesh = load_mesh(knobs / "knob.ply", unit="m")
    camera = SimulatedCamera(mesh, intrinsics=pinhole(300, 25.0), shape=(300, 300))
    view = camera.observe(look_at_origin(np.radians(35), np.radians(20), 25.0))
    found = recogniser.together([view], np.zeros(len(recogniser.classes)), 1)
    assert recogniser.classes[found.belief.argmax()] == "knob"


def test_a_better_object_frame_searches_no_view_again(knobs, knobs_memory, monkeypatch):
    recogniser = ThingRecogniser(knobs_memory / "memory.json", 1)
    mesh = load_mesh(knobs / "knob.ply", unit="m")
    first, second = map(before_a_wall, turned_views(mesh, np.eye(3))[0][:2])
    seen = []
    original = session_recogniser.view_of
    monkeypatch.setattr(
        session_recogniser, "view_of", lambda one: seen.append(one) or original(one)
    )
    total = np.zeros(len(recogniser.classes))
    before = recogniser.together([first, second], total, 2)
    assert len(seen) == 2

    # the same views in an object frame that lies elsewhere
    shift = np.array([0.01, -0.02, 0.03])
    moved = ObjectFrame(shift, first.radius, np.eye(3))
    better = [replace(one, object_frame=moved) for one in (first, second)]
    after = recogniser.together(better, total, 2)
    assert len(seen) == 2
    assert after.belief == pytest.approx(before.belief)
    assert after.poses[0].place == pytest.approx(before.poses[0].place - shift)
