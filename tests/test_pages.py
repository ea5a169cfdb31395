"""The pages and the examples do what they show."""

import doctest
import importlib
import json
import re
import sys
import types
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from factories import SAMPLE_FILES, camera_over, view
from programs import main

import nextview

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))
import documented_commands
import repeated


@pytest.mark.parametrize("page", ["add_a_policy", "add_a_recogniser"])
def test_the_examples_of_a_page_run(page):
    failed, tried = doctest.testfile(
        str(ROOT / f"docs/{page}.md"), module_relative=False
    )
    assert tried >= 10
    assert failed == 0


@pytest.mark.parametrize("name", ["arm_and_object", "turntable"])
def test_an_example_names_what_it_sees(name, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    example = importlib.import_module(name)
    kind = example.Arm if name == "arm_and_object" else example.Turntable
    robot = kind(
        nextview.load_mesh(SAMPLE_FILES / "table.off"), np.random.default_rng(1)
    )
    result = example.recognise(robot)
    assert result.answer == "table"
    assert result.confident
    if name == "arm_and_object":
        assert robot.pose[2, 3] > example.CLEARANCE - 0.02
    else:
        assert not any(view.warnings for view in result.views)


def test_the_grasp_point_is_at_the_handle(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    importlib.import_module("grasp_point").main()
    printed = capsys.readouterr().out
    assert printed.startswith("mug (")
    assert float(re.search(r"([\d.]+) mm from where the handle is", printed)[1]) < 3


def test_the_tests_named_on_pages_exist():
    tests = [
        path
        for folder in ("tests", "lab/tests")
        for path in (ROOT / folder).glob("test_*.py")
    ]
    names = {
        name
        for path in tests
        for name in re.findall(r"def (test_\w+)", path.read_text())
    }
    for page in (ROOT / "docs").glob("*.md"):
        text = page.read_text()
        for path in re.findall(r"`((?:lab/)?tests/\w+\.py)`", text):
            assert (ROOT / path).exists(), (page.name, path)
        column = re.findall(r"\| `(\w+)` \|$", text, re.M) if "| test |" in text else []
        for part in column:
            assert any(part in name for name in names), (page.name, part)


# What pages repeat


@pytest.mark.parametrize("page", repeated.PARTS)
def test_a_page_repeats_the_table_and_the_citation_as_they_are(page):
    said = "python workflow/repeated.py writes what has changed"
    assert (ROOT / page).read_text() == repeated.with_parts(page), said


@pytest.mark.parametrize("row", repeated.measured_rows(), ids=lambda row: row.task)
def test_a_row_of_the_table_has_its_command_in_the_section_that_it_names(row):
    name, _, anchor = row.page.partition("#")
    parts = re.split(r"^##+ (.*)$", (ROOT / name).read_text(), flags=re.M)
    titles = [re.sub(r"[^\w -]", "", title.lower()) for title in parts[1::2]]
    sections = dict(
        zip((title.replace(" ", "-") for title in titles), parts[2::2], strict=True)
    )
    assert row.command.strip() in (sections[anchor] if anchor else parts[0])


# The commands of all pages


def test_each_page_has_commands_and_each_reason_not_to_run_one_holds():
    steps = [
        step
        for page in documented_commands.PAGES
        for step in documented_commands.steps_of(page)
    ]
    assert {"README.md", "docs/picking.md", "docs/training.md"} <= {
        step.page for step in steps
    }
    for pattern in documented_commands.NOT_RUN:
        assert any(re.search(pattern, step.text) for step in steps), pattern
    run = [step for step in steps if step.why_not is None]
    assert len(run) > len(steps) / 2
    for step in run:
        if not step.python:
            assert step.command.startswith(step.text.split()[0])


def test_each_page_names_what_its_commands_need():
    needed = set()
    for page in documented_commands.PAGES:
        text = (ROOT / page).read_text()
        for step in documented_commands.steps_of(page):
            for wanted in step.needs if step.why_not is None else ():
                project, _, extra = wanted.rstrip("]").partition("[")
                name = {
                    "nextview": r"(nextview|\.)",
                    "nextview-lab": r"(nextview-lab|\./lab)",
                }[project]
                said = re.search(
                    name + (rf"\[[\w,-]*\b{extra}\b" if extra else ""), text
                )
                assert said, (
                    f"{page}:{step.line} needs {wanted}, which the page does not name"
                )
                needed.add(wanted)
    for command in documented_commands.PICTURES:
        needed |= documented_commands.needs_of(command)
    assert needed == set(documented_commands.NEEDS.values())


# From a RealSense


class StandInCamera:
    """What ``pyrealsense2`` is for the script of the page: its calls, on simulated depth images.

    Every thirtieth image shows the table, those before nothing, as of a camera that has just begun.
    """

    def __init__(self, depth, matrix, scale):
        self.images = iter(
            np.zeros_like(depth) if n % 30 < 29 else depth for n in range(90)
        )
        self.intrinsics = SimpleNamespace(
            width=depth.shape[1],
            height=depth.shape[0],
            fx=matrix[0, 0],
            fy=matrix[1, 1],
            ppx=matrix[0, 2],
            ppy=matrix[1, 2],
            coeffs=[0.0] * 5,
        )
        sensor = SimpleNamespace(get_depth_scale=lambda: scale)
        device = SimpleNamespace(first_depth_sensor=lambda: sensor)
        self.started = SimpleNamespace(get_device=lambda: device)
        self.stopped = False

    def module(self):
        found = types.ModuleType("pyrealsense2")
        found.stream = SimpleNamespace(depth="depth")
        found.format = SimpleNamespace(z16="z16")
        found.config = lambda: SimpleNamespace(enable_stream=lambda *_: None)
        found.pipeline = lambda: SimpleNamespace(
            start=lambda _: self.started,
            wait_for_frames=lambda: SimpleNamespace(get_depth_frame=self._frame),
            stop=self._stop,
        )
        return found

    def _frame(self):
        image = next(self.images)
        profile = SimpleNamespace(intrinsics=self.intrinsics)
        return SimpleNamespace(
            get_data=lambda: image,
            profile=SimpleNamespace(as_video_stream_profile=lambda: profile),
        )

    def _stop(self):
        self.stopped = True


@pytest.fixture
def recorded(tmp_path, monkeypatch, ycb_meshes):
    """The folder in which the script of the page has taken two shots of a simulated table."""
    things = [ycb_meshes[name] for name in ("mug", "banana", "cracker_box")]
    camera = camera_over(things, seed=8)
    frame = camera.frame(view(20))
    scale = 0.0005  # of a camera that does not count in millimetres
    steps = np.where(frame.depth > 0, frame.depth / scale, 0).round().astype(np.uint16)
    matrix = np.array(frame.intrinsics)
    matrix[:2, 2] -= 0.5  # from a frame's own to the centre of the first pixel at 0
    driver = StandInCamera(steps, matrix, scale)

    page = (ROOT / "docs/from_a_realsense.md").read_text()
    (script,) = re.findall(r"```python\n(.*?)```", page, re.S)
    pressed = iter(["", "", "q"])
    monkeypatch.setitem(sys.modules, "pyrealsense2", driver.module())
    monkeypatch.setattr("builtins.input", lambda _: next(pressed))
    monkeypatch.chdir(tmp_path)
    exec(script, {})
    assert driver.stopped
    return tmp_path


def test_look_reads_the_recording_of_the_realsense_page(recorded, capsys):
    assert sorted(path.name for path in recorded.iterdir()) == ["shot_0", "shot_1"]
    page = (ROOT / "docs/from_a_realsense.md").read_text()
    for key in json.loads((recorded / "shot_1/intrinsics.json").read_text()):
        assert f"`{key}`" in page, key

    main(["look", "shot_1", "--json", "--figure", "shot_1.png"])
    shown = capsys.readouterr()
    names = {thing["name"] for thing in json.loads(shown.out)["objects"]}
    assert {"mug", "banana", "cracker_box"} <= names
    assert "wrote shot_1.png" in shown.err
    assert (recorded / "shot_1.png").exists()
