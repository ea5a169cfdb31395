"""Code of users' own: what it raises is one sentence that says where, and its traceback is to be
had.
"""

import numpy as np
import pytest

import nextview
from nextview.data.samples import sample_mesh
from nextview.errors import PolicyError, UsageError
from nextview.scene.grasps import FreeGrasp, within_reach
from nextview.segmentation.instances import instances_of
from nextview.sensing.frame import Frame

LONGEST = 300

MINE = """
import sys
class Policy:
    needs = ()
    def __init__(self, sphere):
        pass
    def next_views(self, state, rng):
        raise self.raises                        # line 8
class Lines(Policy):
    raises = ValueError("first\\n\\tsecond \\x1b[31m" + "x" * 10**6)
class Leaves(Policy):
    raises = SystemExit("bye")
class Stops(Policy):
    raises = KeyboardInterrupt()
class Values(Policy):
    def next_views(self, state, rng):
        return state.free.argmax(1)
    def view_values(self, state):
        return self.found
    found = property(lambda self: 1 / 0)         # line 20
class Flat(Values):
    found = 0.0
"""


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "code_of_mine.py").write_text(MINE)


def asked(name: str) -> None:
    system = nextview.load(policy=f"code_of_mine:{name}", threads=1, threshold=1.0)
    system.recognise(nextview.SimulatedCamera(sample_mesh("chair"), 112))


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        (
            "Lines",
            r"raised ValueError: first second \\x1b\[31mx+\.\.\., at code_of_mine.py:8",
        ),
        ("Leaves", "raised SystemExit: bye, at code_of_mine.py:8"),
        (
            "Values",
            r"asked what it values views at, raised ZeroDivisionError: .*, at code_of_mine.py:20",
        ),
        ("Flat", r"values views by \(B, V\) numbers, here \(1, 40\)"),
    ],
)
def test_a_policy_that_raises_is_one_sentence_that_says_where(name, sentence):
    with pytest.raises(PolicyError, match=f"^policy {name},? {sentence}$") as refused:
        asked(name)
    assert len(str(refused.value)) < LONGEST + 100
    assert (refused.value.__cause__ is None) == (name == "Flat")


@pytest.mark.parametrize("said", [None, "yes", np.nan])
def test_a_callable_that_says_nothing_of_a_pose_is_refused_and_the_session_goes_on(
    said,
):
    camera = nextview.SimulatedCamera(sample_mesh("chair"), 112)
    session = nextview.load(policy="spread", threads=1, threshold=1.0).session(start=3)
    for name, what in (
        ("reachable", "whether a view can be reached"),
        ("travel_cost", "a travel cost"),
    ):
        setattr(session, name, lambda *poses: said)
        with pytest.raises(UsageError, match=f"^{what} is "):
            session.update(camera.observe(session.pose))
        assert session.views == []
        setattr(session, name, None)
    session.update(camera.observe(session.pose))
    assert len(session.views) == 1


def test_what_a_segmentation_or_the_arm_raises_is_named():
    def of_mine(*given):
        raise OSError("the camera is off")

    frame = Frame(np.ones((48, 64)), [[60, 0, 32], [0, 60, 24], [0, 0, 1]])
    with pytest.raises(UsageError):
        instances_of(of_mine, frame)
    grasp = FreeGrasp(1, "mug", np.eye(4), 0.04, 0.06, 0.0, 1.0)
    with pytest.raises(UsageError):
        within_reach([grasp], of_mine, None)
    with pytest.raises(UsageError):
        within_reach([grasp], lambda pose: None, None)
