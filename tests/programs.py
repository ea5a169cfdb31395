"""Run a command line in this process."""

import re
from collections.abc import Sequence
from itertools import pairwise

import pytest

from nextview.cli.call_with_arguments import entry
from nextview.cli.commands import NEXTVIEW, Command
from nextview.cli.main import run
from nextview.cli.option_names import option_names

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


def check_help(name: str, command: Command, run_line, capsys) -> None:
    """Check that the help of a command explains each of its options, and ends with an example."""
    with pytest.raises(SystemExit) as end:
        run_line(f"{name} --help")
    assert end.value.code == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"usage: {name} ")
    without = ("nextview demo", "nextview demo-episode", "nextview explore")
    assert "(required)" in shown or name in without
    rows = [row.replace("│", " ").rstrip() for row in shown.splitlines()]
    for row, following in pairwise(rows):  # each option has a help, beside it or below
        beside = re.search(r"\S {2,}(\S)", row) or re.match(r" +(\S)", following)
        if re.match(r"  --[a-z]", row):
            assert beside, row
            assert beside[1] not in "-(", row
    assert not re.search(r"\{|\bNone\b|FLOAT|\bSTR\b|\(default: \)", shown)
    explained = {row.split()[0] for row in rows if re.match(r"  --[a-z]", row)}
    assert explained == option_names(entry(command)[0])
    assert shown.splitlines()[-1] == f"example: {example_of(name, command)}"
