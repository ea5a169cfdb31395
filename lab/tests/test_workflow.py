"""The workflow from the meshes to every table: its graph, how a stage resumes, and a small run
of it.
"""

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

WORKFLOW = Path(__file__).parents[2] / "workflow"
BUNDLED = WORKFLOW.parent / "src" / "nextview"


def stage(folder, *arguments):
    command = [sys.executable, WORKFLOW / "stage.py", *arguments]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=60
    )


def needed(folder, name, content):
    """The .done file of an earlier stage."""
    (folder / f"{name}.done").write_text(
        json.dumps({"sha256": hashlib.sha256(content.encode()).hexdigest()})
    )
    return f"{name}.done"


GROW = "mkdir -p out && echo line >> out/lines && test -e enough"
"""A command that leaves more each time, and is done when a file is there."""


def test_an_interrupted_stage_resumes(tmp_path):
    arguments = ("out", "--needs", needed(tmp_path, "meshes", "a"), "--commands", GROW)
    assert stage(tmp_path, *arguments).returncode
    assert not (tmp_path / "out.done").exists()
    (tmp_path / "enough").touch()
    assert stage(tmp_path, *arguments).returncode == 0
    assert (tmp_path / "out/lines").read_text() == "line\nline\n"


@pytest.mark.parametrize("change", ["input", "command", "state"])
def test_a_stage_starts_over_if_its_inputs_have_changed(tmp_path, change):
    needs, state, command = needed(tmp_path, "meshes", "a"), "1", GROW
    assert stage(
        tmp_path, "out", "--needs", needs, f"--state={state}", "--commands", command
    ).returncode
    (tmp_path / "enough").touch()
    if change == "input":
        needed(tmp_path, "meshes", "b")
    elif change == "command":
        command += " -o 1 = 1"
    else:
        state = "2"
    assert (
        stage(
            tmp_path, "out", "--needs", needs, f"--state={state}", "--commands", command
        ).returncode
        == 0
    )
    assert (tmp_path / "out/lines").read_text() == "line\n"


def test_a_stage_is_made_by_one_process_at_a_time(tmp_path):
    inner = f"{sys.executable} {WORKFLOW / 'stage.py'} out --commands true"
    result = stage(tmp_path, "out", "--commands", f"touch out; {inner}")
    assert result.returncode
    assert "another process is at work" in result.stderr


def snakemake(folder, *arguments, config=()):
    pytest.importorskip("snakemake", reason="the workflow extra is not installed")
    command = [
        sys.executable,
        "-m",
        "snakemake",
        "-s",
        WORKFLOW / "Snakefile",
        "--directory",
        folder,
        "--cores",
        "2",
    ]
    command += ["--nolock", *arguments, "--config", *config]
    return subprocess.run(command, capture_output=True, text=True, timeout=900)


def test_the_whole_graph_makes_every_bundled_model_and_table(tmp_path):
    (tmp_path / "ModelNet10/chair/train").mkdir(parents=True)
    result = snakemake(
        tmp_path, "-n", "-p", config=(f"data={tmp_path / 'ModelNet10'}",)
    )
    assert result.returncode == 0, result.stdout + result.stderr
    planned = result.stdout + result.stderr
    for card in (BUNDLED / "recognition/bundled").glob("*-modelnet10.json"):
        assert (
            f"--name {card.stem}" in planned
            or f"{card.stem.partition('-')[0]} runs/" in planned
        )
    for command in (
        "render ModelNet10 sensed-held-out.zarr --sensor mix",
        "fit calibration",
        "fit size",
        "fit valleys",
        "train gain",
        "evaluate",
        "benchmark classes",
        "report",
    ):
        assert f"nextview-lab {command} " in planned
    assert "docs/results.md" in planned
