"""Code of users' own: what it raises is one sentence that says where, and its traceback is to be had."""

import multiprocessing
import pickle

import numpy as np
import pytest
from test_predictions import some_predictions

import nextview
from nextview.benchmark.experiment import Grid, run_grid
from nextview.benchmark.replay import make_specs
from nextview.data.samples import sample_mesh
from nextview.errors import MeasureError, PolicyError, UsageError
from nextview.measures.registry import find_measure
from nextview.own_code import LONGEST, fails, own_code, said_of
from nextview.policies.registry import make_policy

SPHERE = nextview.ViewSphere.named("40")
MINE = """
import sys
class Silent(Exception):
    def __str__(self):
        raise RuntimeError
class Other(BaseException):
    pass
class Policy:
    needs = ()
    def __init__(self, sphere):
        pass
    def next_views(self, state, rng):
        raise self.raises                        # line 13
class Lines(Policy):
    raises = ValueError("first\\n\\tsecond \\x1b[31m" + "x" * 10**6)
class Leaves(Policy):
    raises = SystemExit("bye")
class Strange(Policy):
    raises = Other("no exception")
class Says(Policy):
    raises = Silent()
class Stops(Policy):
    raises = KeyboardInterrupt()
class Needs(Policy):
    @property
    def needs(self):
        raise KeyError("which")                  # line 27
class Values(Policy):
    def next_views(self, state, rng):
        return state.free.argmax(1)
    def view_values(self, state):
        return self.found
    found = property(lambda self: 1 / 0)         # line 33
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
        ("Lines", r"policy Lines raised ValueError: first second \\x1b\[31mx+\.\.\., at code_of_mine.py:13"),
        ("Leaves", "policy Leaves raised SystemExit: bye, at code_of_mine.py:13"),
        ("Strange", "policy Strange raised Other: no exception, at code_of_mine.py:13"),
        ("Says", "policy Says raised Silent, at code_of_mine.py:13"),
        ("Needs", r"policy code_of_mine:Needs cannot be made \(KeyError: 'which', at code_of_mine.py:27\)"),
        (
            "Values",
            r"policy Values, asked what it values views at, raised ZeroDivisionError: .*, at code_of_mine.py:33",
        ),
        ("Flat", r"policy Flat values views by \(B, V\) numbers, here \(1, 40\)"),
    ],
)
def test_a_policy_that_raises_is_one_sentence_that_says_where(name, sentence):
    with pytest.raises(PolicyError, match=f"^{sentence}$") as refused:
        asked(name)
    assert len(str(refused.value)) < LONGEST + 100
    assert (refused.value.__cause__ is None) == (name == "Flat")


def test_a_ctrl_c_in_it_passes():
    with pytest.raises(KeyboardInterrupt):
        asked("Stops")


def test_the_whole_traceback_is_shown_where_it_is_asked_for(monkeypatch, capsys):
    with pytest.raises(PolicyError):
        asked("Leaves")
    assert capsys.readouterr().err == ""
    monkeypatch.setenv("NEXTVIEW_TRACEBACK", "1")
    with pytest.raises(PolicyError):
        asked("Leaves")
    assert "raise self.raises  " in capsys.readouterr().err


def test_what_a_module_does_when_it_is_imported_is_its_users_too(tmp_path):
    (tmp_path / "stumbles.py").write_text("import math\n\nmath.sqrt(-1)\n")
    (tmp_path / "wrong.py").write_text("def broken(:\n")
    for make, name in ((find_measure, "measure"), (lambda path: make_policy(path, SPHERE), "policy")):
        with pytest.raises((MeasureError, PolicyError), match=f"^{name} stumbles:it .*ValueError.*at stumbles.py:3"):
            make("stumbles:it")
        with pytest.raises((MeasureError, PolicyError), match=f"^{name} wrong:it .*SyntaxError.*wrong.py, line 1"):
            make("wrong:it")


def test_the_errors_go_from_one_process_to_another():
    with pytest.raises(PolicyError) as refused, own_code(lambda said: PolicyError(f"it raised {said}", 3)):
        raise multiprocessing.ProcessError("gone")
    assert str(pickle.loads(pickle.dumps(refused.value))) == str(refused.value)


def test_whether_code_fails():
    assert fails(lambda: exit(0))
    assert fails(lambda: 1 / 0)
    assert not fails(lambda: None)
    with pytest.raises(KeyboardInterrupt):
        fails(lambda: (_ for _ in ()).throw(KeyboardInterrupt))
    assert said_of(ValueError()) == "ValueError"


@pytest.mark.parametrize("said", [None, "yes", np.zeros(2, bool), np.nan, 1j, [], object()])
def test_a_callable_that_says_nothing_of_a_pose_is_refused_and_the_session_goes_on(said):
    camera = nextview.SimulatedCamera(sample_mesh("chair"), 112)
    session = nextview.load(policy="spread", threads=1, threshold=1.0).session(start=3)
    for name, what in (("reachable", "whether a view can be reached"), ("travel_cost", "a travel cost")):
        setattr(session, name, lambda *poses: said)
        with pytest.raises(UsageError, match=f"^{what} is "):
            session.update(camera.observe(session.pose))
        assert session.views == []
        setattr(session, name, None)
    session.update(camera.observe(session.pose))
    assert len(session.views) == 1


def test_what_a_callable_of_a_program_raises_is_the_programs():
    """It is called by whoever handed it in, who may be waiting for that very error."""
    camera = nextview.SimulatedCamera(sample_mesh("chair"), 112)
    session = nextview.load(policy="spread", threads=1, threshold=1.0).session(start=3)
    session.reachable = lambda pose: {}["the arm is off"]
    with pytest.raises(KeyError, match="the arm is off"):
        session.update(camera.observe(session.pose))
    assert session.views == []


def test_an_entry_of_the_benchmark_that_leaves_takes_nothing_from_the_others():
    grid = Grid(make_specs(some_predictions(5), 2, 0), 2, (0.9,), 3, 0)
    names = [f"code_of_mine:{name}" for name in ("Leaves", "Strange")]
    assert list(run_grid(grid, [*names, "furthest"])) == [1, 2, 3]
    assert set(grid.failures) == set(names)
    assert set(grid.paths) == {"furthest"}
