"""The README's example runs as it stands, and its commands exist."""

import re
import shutil
from pathlib import Path

import pytest

from nextview.cli.main import COMMANDS, main

README = (Path(__file__).parent.parent / "README.md").read_text()


def write_off(path, mesh):
    lines = ["OFF", f"{len(mesh.vertices)} {len(mesh.faces)} 0"]
    lines += [" ".join(map(str, vertex)) for vertex in mesh.vertices]
    lines += [" ".join(map(str, (3, *face))) for face in mesh.faces]
    path.write_text("\n".join(lines) + "\n")


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
    group = 2 if isinstance(COMMANDS[words[0]], dict) else 1
    with pytest.raises(SystemExit) as end:
        main([*words[:group], "--help"])
    assert end.value.code == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in words if word.startswith("--"))


@pytest.mark.parametrize("command", sorted(set(re.findall(r"^nextview (\w+)", README, re.M))))
def test_commands_exist(command):
    assert command in COMMANDS
