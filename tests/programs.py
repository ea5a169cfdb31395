"""Run a command line in this process."""

import re
from collections.abc import Sequence
from itertools import pairwise

import pytest

from nextview.cli.commands import NEXTVIEW, Command
from nextview.cli.main import run

UNTIDY = r"\{|\bNone\b|FLOAT|\bSTR\b|\(default: \)"  # in a help: Python, not words
COMMANDS = {f"nextview {name}": command for name, command in NEXTVIEW.commands.items()}


def main(arguments: Sequence[str]) -> None:
    """Run ``nextview``; the name of the program may stand before the arguments."""
    named = list(arguments[:1]) == [NEXTVIEW.name]
    run(NEXTVIEW, list(arguments[1:] if named else arguments))


def called(line: str) -> None:
    """Run a command line that begins with the name of the program."""
    main(line.split())


def example_of(name: str, command: Command) -> str:
    """The command line in the help of a command, with its program."""
    return f"{name.partition(' ')[0]} {command.example}"


def help_of(name: str, run_line, capsys) -> tuple[str, dict[str, str]]:
    """The help of a command, and what it says of each option, beside it or below."""
    with pytest.raises(SystemExit) as end:
        run_line(f"{name} --help")
    assert end.value.code == 0
    shown = capsys.readouterr().out
    explained = {}
    rows = [row.replace("│", " ").rstrip() for row in shown.splitlines()]
    for row, following in pairwise(rows):
        if re.match(r"  --[a-z]", row):
            beside = re.search(r"\S {2,}(\S.*)", row)
            explained[row.split()[0]] = (beside[1] if beside else following).strip()
    return shown, explained
