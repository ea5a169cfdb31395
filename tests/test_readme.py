"""The README's example runs as it stands, and its commands exist."""

import re
import shutil
from pathlib import Path

import pytest

from nextview.cli.commands import COMMANDS
from nextview.cli.main import main
from nextview.geometry.mesh import load_mesh
from nextview.simulation.simulated import SimulatedCamera

README = (Path(__file__).parent.parent / "README.md").read_text()


def test_the_page_is_short():
    assert len(README.splitlines()) <= 130


def test_the_example_runs(tmp_path, monkeypatch, capsys):
    example = re.search(r"```python\n(.*?)```", README, re.S)[1]
    assert len(example.strip().splitlines()) <= 12
    shutil.copytree(Path(__file__).parent.parent / "samples", tmp_path / "samples")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(example, names)
    assert names["result"].answer == "table"
    assert "chair (belief" in capsys.readouterr().out
    assert (tmp_path / "episode.png").exists()


@pytest.mark.parametrize("line", re.findall(r"^nextview recognise samples/.*?(?=\s+#|$)", README, re.M))
def test_its_commands_on_the_samples_run(line, tmp_path, monkeypatch, capsys):
    if "--models" in line:
        pytest.skip("with models that the commands before it make")
    shutil.copytree(Path(__file__).parent.parent / "samples", tmp_path / "samples")
    monkeypatch.chdir(tmp_path)
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


def test_its_session_runs(tmp_path, capsys):
    (example,) = re.findall(r"```\n(session = .*?)```", README, re.S)
    camera = SimulatedCamera(load_mesh(Path(__file__).parent.parent / "samples/chair.off"))
    exec(f"import nextview\n{example}", {"my_camera": camera})
    assert "chair (belief" in capsys.readouterr().out


SMALL = {
    "render": "--workers 1",
    "train recogniser": "--size 32 --epochs 1 --views 2 --batch 8 --validation 0.4",
    "predict": "--workers 1",
    "fit calibration": "--delta 0.2",
    "train gain": "--folds 2 --epochs 1 --walks 1 --networks 1",
    "benchmark": "--runs 2 --samples 100",
}
"""What makes a command of the page quick."""


def test_making_it_ones_own_works_from_the_first_line_to_the_last(furniture, tmp_path, monkeypatch, capsys):
    for package in ("torch", "onnx", "pandas", "jinja2"):
        pytest.importorskip(package)
    shutil.copytree(furniture, tmp_path / "data/ModelNet10")
    shutil.copytree(Path(__file__).parent.parent / "samples", tmp_path / "samples")
    monkeypatch.chdir(tmp_path)
    (part,) = re.findall(r"## Make it yours\n+```sh\n(.*?)```", README, re.S)
    lines = [line.partition("#")[0].strip() for line in part.splitlines()]
    assert lines[0] == "nextview download modelnet10 data"  # into the folder that is there already
    for line in lines[1:]:
        small = next((options for command, options in SMALL.items() if line.startswith(f"nextview {command} ")), "")
        capsys.readouterr()
        main([*line.split()[1:], *small.split()])
        if line.startswith("nextview recognise "):
            assert "It is a" in capsys.readouterr().out
    assert (tmp_path / "benchmark/leaderboard.md").exists() or (tmp_path / "benchmark/summary.csv").exists()
    assert list(tmp_path.rglob("*.html"))
