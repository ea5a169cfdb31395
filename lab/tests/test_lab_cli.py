"""The command line: its table of commands, how they end, and what they show."""

import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
from factories import run_python
from lab_programs import COMMANDS, called, main
from programs import UNTIDY, example_of, help_of

from nextview.checks import EXTRAS
from nextview.cli.call_with_arguments import entry, find
from nextview.cli.option_names import option_names
from nextview_lab.data.store import ViewStore
from nextview_lab.extras import EXTRAS as EXTRAS_OF_LAB

OF_LAB = [name for name in COMMANDS if name.startswith("nextview-lab ")]
LAB_COMMAND = [sys.executable, "-m", "nextview_lab"]


@pytest.mark.parametrize("name", OF_LAB)
def test_every_command_explains_itself(name, capsys):
    pytest.importorskip("torch")
    shown, explained = help_of(name, called, capsys)
    assert shown.startswith(f"usage: {name} ")
    assert "(required)" in shown
    assert explained.keys() == option_names(entry(COMMANDS[name])[0])
    for option, text in explained.items():
        assert re.match(r"[^-(]", text), f"{option} has no explanation"
    assert not re.search(UNTIDY, shown)
    assert shown.splitlines()[-1] == f"example: {example_of(name, COMMANDS[name])}"


@pytest.mark.parametrize("preset", [None, "thesis"])
def test_a_preset_sets_defaults_that_options_change(preset, monkeypatch):
    stage = pytest.importorskip("nextview_lab.training.recogniser_training")
    kind, called = stage.RecogniserRecipe, []
    recipe = (
        find("nextview_lab.training.recipes:THESIS_RECOGNISER") if preset else kind()
    )

    def train(store: str, out: str, recipe: kind = kind()) -> list[str]:
        called.append(recipe)
        return []

    monkeypatch.setattr(stage, "train_recogniser", train)
    chosen = f"--preset {preset}" if preset else ""
    main(f"train recogniser s none {chosen} --epochs 1".split())
    assert called == [replace(recipe, epochs=1)]


def interrupted(command, ready):
    """Ctrl-C for a command, once it is ready."""
    running = subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    while not ready() and running.poll() is None:
        time.sleep(0.01)
    running.send_signal(signal.SIGINT)
    _, said = running.communicate(timeout=60)
    return (
        running.returncode,
        [
            line
            for line in said.splitlines()
            if line.startswith(("nextview: ", "nextview-lab: "))
        ][-1],
    )


def test_ctrl_c_ends_rendering_in_one_line_and_it_resumes(tmp_path, furniture):
    store = tmp_path / "v.zarr"
    command = ["render", str(furniture), str(store), "--size", "32", "--workers", "1"]

    def begun():
        return len(list(store.glob("image/c/*"))) > 1

    again = "nextview-lab: stopped; run the same command again; it resumes"
    assert interrupted([*LAB_COMMAND, *command], begun) == (130, again)
    main(command)
    assert ViewStore.open(store).done.all()


MISSING = [
    package
    for packages in (*EXTRAS.values(), *EXTRAS_OF_LAB.values())
    for package in packages
]
HIDDEN = f"""
from importlib.machinery import PathFinder
missing, plain = {MISSING!r}, PathFinder.find_spec
find = lambda name, *more: None if name.partition('.')[0] in missing else plain(name, *more)
PathFinder.find_spec = staticmethod(find)
"""
"""Code that hides packages from the search of installed ones."""


def test_help_needs_no_extra():
    """The packages are hidden from the search of installed ones."""
    ask = "from nextview_lab.cli.main import main; main(['benchmark', 'classes', '--help'])"
    done = run_python(HIDDEN + ask)
    assert done.returncode == 0, done.stderr
    assert "pip install 'nextview-lab[benchmark]'" in done.stderr
    assert done.stdout == run_python(ask).stdout
