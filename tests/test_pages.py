"""The pages and the examples do what they show."""

import doctest
import importlib
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from pipeline import SAMPLE_FILES

import nextview
from nextview.cli.commands import COMMANDS
from nextview.cli.main import main

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


@pytest.fixture
def there(tmp_path, monkeypatch):
    """A working folder with the sample meshes."""
    shutil.copytree(SAMPLE_FILES, tmp_path / "samples")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", ["add_a_measure", "add_a_policy", "add_a_recogniser"])
def test_a_page_does_what_it_says(page):
    try:
        failed, tried = doctest.testfile(str(ROOT / f"docs/{page}.md"), module_relative=False)
    finally:
        sys.modules.pop("spread", None)
    assert tried > 10
    assert failed == 0


@pytest.mark.parametrize("name", ["arm_over_table", "turntable"])
def test_an_example_names_what_it_sees(name, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    example = importlib.import_module(name)
    kind = example.Arm if name == "arm_over_table" else example.Turntable
    robot = kind(nextview.load_mesh(SAMPLE_FILES / "table.off"), np.random.default_rng(1))
    result = example.recognise(robot)
    assert result.answer == "table"
    assert result.confident
    if name == "arm_over_table":
        assert robot.pose[2, 3] > example.CLEARANCE - 0.02
    else:
        assert not any(view.warnings for view in result.views)


# The README


def test_the_example_runs(there, capsys):
    names: dict = {}
    exec(re.search(r"```python\n(.*?)```", README, re.S)[1], names)
    assert names["result"].answer == "table"
    assert "chair (belief" in capsys.readouterr().out
    assert (there / "episode.png").exists()


def test_its_session_runs(capsys):
    (example,) = re.findall(r"```\n(session = .*?)```", README, re.S)
    camera = nextview.SimulatedCamera(nextview.load_mesh(SAMPLE_FILES / "chair.off"))
    exec(f"import nextview\n{example}", {"my_camera": camera})
    assert "chair (belief" in capsys.readouterr().out


@pytest.mark.parametrize("line", re.findall(r"^nextview recognise samples/.*?(?=\s+#|$)", README, re.M))
def test_its_commands_on_the_samples_run(line, there, capsys):
    if "--models" in line:
        pytest.skip("with models that the commands before it make")
    main(line.split()[1:])
    assert "It is a" in capsys.readouterr().out


@pytest.mark.parametrize("line", re.findall(r"^nextview .*?(?=\s+#|$)", README, re.M))
def test_its_options_are_there(line, capsys):
    """Every option that a line gives stands in the help of its command."""
    words = line.split()[1:]
    group = 1 if words[0] in COMMANDS else 2
    with pytest.raises(SystemExit) as end:
        main([*words[:group], "--help"])
    assert end.value.code == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in words if word.startswith("--"))


SMALL = {
    "render": "--workers 1",
    "train recogniser": "--size 32 --epochs 1 --views-per-object 2 --batch 8 --validation-share 0.4",
    "predict": "--workers 1",
    "fit calibration": "--delta 0.2",
    "train gain": "--folds 2 --epochs 1 --episodes 1 --networks-per-fold 1",
    "benchmark": "--runs 2 --samples 100",
}
"""What makes a command of the page quick."""


def test_making_it_ones_own_works_from_the_first_line_to_the_last(furniture, there, capsys):
    for package in ("torch", "onnx", "pandas", "jinja2"):
        pytest.importorskip(package)
    shutil.copytree(furniture, there / "data/ModelNet10")
    (part,) = re.findall(r"## Make it yours\n+```sh\n(.*?)```", README, re.S)
    lines = [line.partition("#")[0].strip() for line in part.splitlines()]
    assert lines[0] == "nextview download modelnet10 data"  # into the folder that is there already
    for line in lines[1:]:
        small = next((options for command, options in SMALL.items() if line.startswith(f"nextview {command} ")), "")
        capsys.readouterr()
        main([*line.split()[1:], *small.split()])
        if line.startswith("nextview recognise "):
            assert "It is a" in capsys.readouterr().out
    assert (there / "benchmark/leaderboard.md").exists() or (there / "benchmark/summary.csv").exists()
    assert list(there.rglob("*.html"))
