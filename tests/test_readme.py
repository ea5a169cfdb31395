"""The README's example runs as it stands, and its commands exist."""

import re
from pathlib import Path

import pytest

from nextview.cli.main import COMMANDS
from nextview.data.samples import sample_mesh

README = (Path(__file__).parent.parent / "README.md").read_text()


def write_off(path, mesh):
    lines = ["OFF", f"{len(mesh.vertices)} {len(mesh.faces)} 0"]
    lines += [" ".join(map(str, vertex)) for vertex in mesh.vertices]
    lines += [" ".join(map(str, (3, *face))) for face in mesh.faces]
    path.write_text("\n".join(lines) + "\n")


def test_example_recognises_a_chair(tmp_path, monkeypatch, capsys):
    example = re.search(r"```python\n(.*?)```", README, re.S)[1]
    assert len(example.strip().splitlines()) <= 12
    write_off(tmp_path / "chair.off", sample_mesh("chair"))
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(example, names)
    assert names["result"].answer == "chair"
    assert "chair" in capsys.readouterr().out


@pytest.mark.parametrize("command", sorted(set(re.findall(r"^nextview (\w+)", README, re.M))))
def test_commands_exist(command):
    assert command in COMMANDS
