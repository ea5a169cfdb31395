"""Run a command line in this process."""

from collections.abc import Sequence

from nextview.cli.commands import NEXTVIEW
from nextview.cli.main import run

COMMANDS = {f"nextview {name}": command for name, command in NEXTVIEW.commands.items()}


def main(arguments: Sequence[str]) -> None:
    """Run ``nextview``; the name of the program may stand before the arguments."""
    named = list(arguments[:1]) == [NEXTVIEW.name]
    run(NEXTVIEW, list(arguments[1:] if named else arguments))


def called(line: str) -> None:
    """Run a command line that begins with the name of the program."""
    main(line.split())
