"""The benchmark of next views of taught things: scans to tables, replays, statistics."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from lab_programs import main, refused

from nextview.errors import DatasetError, ResultsError, UsageError
from nextview.files import read_record
from nextview.geometry.mesh import UNITS
from nextview_lab.benchmark import things as stage
from nextview_lab.benchmark.thing_episodes import EPISODE_SPHERE
from nextview_lab.benchmark.thing_policies import BLIND_RULES
from nextview_lab.benchmark.thing_runs import EpisodeRuns, ThingRun
from nextview_lab.benchmark.things import (
    ThingSettings,
    benchmark_things,
    summarise_things,
)

SETTINGS = ThingSettings(
    views=(1, 2), policies=("random", "geometry"), repeats=1, samples=200
)


class FarAzimuth:
    """A policy of a user: goes to the free view that is farthest round, and looks at its inputs."""

    needs = ("outlook",)
    seen = []  # noqa: RUF012  # what it was given, for the test

    def __init__(self, viewpoints):
        self.viewpoints = viewpoints

    def next_views(self, state, rng):
        self.seen.append(state.outlook[0].hypotheses)
        far = np.where(state.free[0], self.viewpoints.arc[state.current[0]], -1)
        return np.array([far.argmax()])


@pytest.fixture(scope="module")
def settings(knobs_memory):
    return replace(SETTINGS, models=str(knobs_memory))


@pytest.fixture(scope="module")
def made(shared, knobs, settings):
    """A folder of results."""
    return (
        shared(
            "knobs_results",
            lambda f: benchmark_things(knobs, f / "out", settings, workers=0),
        )
        / "out"
    )


@pytest.fixture
def results(made, tmp_path):
    """A copy of it."""
    return shutil.copytree(made, tmp_path / "out")


# From scans to tables


def test_the_command_prints_and_writes_tables_of_all_policies(
    knobs, knobs_memory, results, capsys, monkeypatch
):
    monkeypatch.setattr(
        stage, "work", lambda job: pytest.fail("nothing was left to do")
    )
    line = f"benchmark things {knobs} {results} --models {knobs_memory} --views 1 2"
    main(f"{line} --policies random geometry --repeats 1 --workers 0".split())
    shown = capsys.readouterr().out
    assert "geometry" in shown
    assert "All things: share named right after views; 3 things" in shown
    text = (results / "tables.md").read_text()
    assert text.count("| geometry | ") == 1 + 2  # one table, two tests
    for name in ("measures.csv", "tests.csv", "accuracy.png"):
        assert (results / name).stat().st_size > 100


def test_another_policy_takes_part_in_the_same_episodes(knobs, results, settings):
    before = {file: file.read_bytes() for file in (results / "runs").iterdir()}
    benchmark_things(knobs, results, settings, workers=0)
    assert before == {file: file.read_bytes() for file in (results / "runs").iterdir()}

    FarAzimuth.seen.clear()
    own = f"{__name__}:FarAzimuth"
    tables = benchmark_things(
        knobs, results, replace(settings, policies=(own,)), workers=0
    )
    for file, text in before.items():
        runs = json.loads(file.read_text())["runs"]
        earlier = json.loads(text)["runs"]
        assert runs[own][0]["views"][0] == earlier["geometry"][0]["views"][0]
        assert {name: runs[name] for name in earlier} == earlier
    assert list(tables.measures["policy"].unique()) == ["random", "geometry", own]
    hypotheses = FarAzimuth.seen[0]
    assert hypotheses.belief.sum() == pytest.approx(1)
    assert hypotheses.poses.shape == (len(hypotheses.things), 4, 4)
    away = EPISODE_SPHERE.arc.max(1)
    travel = tables.measures.query(
        "policy == @own and measure == 'travel, rad' and views == 2"
    )
    assert travel["value"].iloc[0] == pytest.approx(away.mean(), abs=away.std() + 1e-9)


class Fails(FarAzimuth):
    """A policy of a user that breaks a rule of the page, named by a class below."""

    def next_views(self, state, rng):
        return {
            "Raises": lambda: state.nothing,
            "Scalar": lambda: 3,
            "Repeats": lambda: state.current,
            "Outside": lambda: state.current + 40,
        }[type(self).__name__]()


class Raises(Fails):
    pass


class Scalar(Fails):
    pass


class Repeats(Fails):
    pass


class Outside(Fails):
    pass


@pytest.mark.parametrize("policy", [Raises, Scalar, Repeats, Outside])
def test_a_policy_of_ones_own_that_fails_is_named_with_the_thing(
    policy, knobs, knobs_memory, results, capsys
):
    own = f"{__name__}:{policy.__name__}"
    line = f"benchmark things {knobs} {results} --models {knobs_memory} --views 1 2"
    more = f"--policies {own} --repeats 1 --workers 0"
    sentence = refused(capsys, *f"{line} {more}".split())
    assert f"policy {own} " in sentence
    assert "(object can)" in sentence
    assert ("test_thing_benchmark.py:" in sentence) == (policy is Raises)


def scaled(scans, unit, folder):
    """The same things saved in another unit."""
    folder.mkdir()
    for scan in scans.glob("*.ply"):
        mesh = trimesh.load(scan, process=False)
        mesh.apply_scale(1 / UNITS[unit])
        mesh.export(folder / scan.name)
    return folder


def test_a_scan_that_is_not_what_was_taught_is_refused_with_the_cure(
    knobs, settings, tmp_path
):
    scans = scaled(knobs, "cm", tmp_path / "cm")
    with pytest.raises(DatasetError):
        benchmark_things(scans, tmp_path / "out", settings, workers=0)

    moved = tmp_path / "moved"
    moved.mkdir()
    for scan in knobs.glob("*.ply"):
        trimesh.load(scan).apply_translation((0, 0.1, 0)).export(moved / scan.name)
    with pytest.raises(DatasetError):
        benchmark_things(moved, tmp_path / "out2", settings, workers=0)


# A recogniser of a user's own


class AlwaysCan:
    """Believes in the can whatever it sees; its classes are not in alphabetical order."""

    classes = ("plain", "can", "knob")

    def belief(self, observations):
        return np.array([0.01, 0.98, 0.01])


def test_a_recogniser_of_ones_own_is_shown_the_same_episodes_without_a_memory(
    knobs, tmp_path, capsys
):
    out = tmp_path / "out"
    line = f"benchmark things {knobs} {out} --recogniser {__name__}:AlwaysCan"
    main(f"{line} --views 1 2 --policies random fixed --workers 0".split())
    assert "fixed" in capsys.readouterr().out
    assert not (out / "memory").exists()
    runs = [
        read_record(file, EpisodeRuns, "runs", ResultsError)
        for file in sorted((out / "runs").iterdir())
    ]
    assert [each.thing for each in runs] == ["can", "knob", "plain"]
    right = {each.thing: each.runs["fixed"][0].right for each in runs}
    assert right == {"can": [True] * 2, "knob": [False] * 2, "plain": [False] * 2}

    settings = replace(SETTINGS, recogniser=f"{__name__}:AlwaysCan")
    with pytest.raises(UsageError):
        benchmark_things(knobs, tmp_path / "new", settings, workers=0)


# The best blind rule


def test_policies_are_compared_with_the_best_blind_rule_of_other_episodes(
    knobs, settings, tmp_path
):
    asked = replace(settings, policies=("geometry",), reference="best-blind")
    out = tmp_path / "out"
    tables = benchmark_things(knobs, out, asked, workers=0)
    assert tables.reference in BLIND_RULES
    assert set(tables.tests["policy"]) == {"geometry"}
    assert (
        f"The best blind rule is {tables.reference}: "
        in (out / "tables.md").read_text()
    )
    record = json.loads((out / "benchmark.json").read_text())
    assert record["reference"] == "best-blind"
    assert record["compared_with"] == tables.reference
    start = [
        {
            read_record(f, EpisodeRuns, "runs", ResultsError)
            .runs[tables.reference][0]
            .views[0]
            for f in (folder / "runs").iterdir()
        }
        for folder in (out, out / "choosing")
    ]
    assert start[0] != start[1]  # chosen where it is not compared
    with pytest.raises(UsageError):
        benchmark_things(knobs, out, replace(asked, choose_seed=0), workers=0)


# Statistics


def runs_of(thing, right, confidence, views, p_value=None, policy="random"):
    pose = [1.0 if each else None for each in right]
    times = [0.01] * (len(views) - 1)
    explained = p_value or [None] * len(views)
    made = ThingRun(views, right, confidence, explained, times, pose)
    return EpisodeRuns(thing, 0, {policy: [made]})


def both(thing, random, other):
    """An episode with two policies, each (right, confidence, views)."""
    runs = {}
    for policy, given in (("random", random), ("spread", other)):
        runs |= runs_of(thing, *given, policy=policy).runs
    return EpisodeRuns(thing, 0, runs)


def test_measures_are_those_of_a_hand_count():
    wrong = ([False, False, True], [0.5, 0.98, 0.6], [0, 4, 1])
    good = ([False, True, True], [0.5, 0.9, 0.99], [0, 4, 2])
    episodes = [
        both("a_x", wrong, good),
        both("a_y", good, good),
        both("b_x", wrong, good),
    ]
    how = ThingSettings(views=(1, 2, 3), threshold=0.97, families=True, samples=2000)
    tables = summarise_things(episodes, how)
    rows = tables.measures.set_index(["set", "policy", "measure", "views"])["value"]
    random = rows["all", "random"]
    assert random["accuracy", 2] == pytest.approx(1 / 3)
    assert random["accuracy", 3] == 1
    assert random["views until confident", 0] == pytest.approx((2 + 3 + 2) / 3)
    assert random["confident", 0] == 1
    assert random["wrong, of the confident", 0] == pytest.approx(2 / 3)
    assert random["pose error, 95 %", 3] == 1
    assert random["travel, rad", 2] == pytest.approx(
        np.pi * np.cos(EPISODE_SPHERE.elevation[0]), abs=0.2
    )
    difference = tables.tests.query(
        "set == 'all' and measure == 'accuracy' and views == 2"
    )
    assert difference["difference"].iloc[0] == pytest.approx(2 / 3)
    # Two families: in a quarter of the samples both draws are the family b, and so on.
    assert difference["low"].iloc[0] == pytest.approx(0.5)
    assert difference["high"].iloc[0] == pytest.approx(1)
