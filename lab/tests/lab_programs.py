"""Run a command line in this process, by the program that has the command."""

from collections.abc import Sequence
from functools import partial

import factories

from nextview.cli.commands import LAB, NEXTVIEW
from nextview.cli.main import run
from nextview_lab.cli.commands import LABORATORY

PROGRAMS = (NEXTVIEW, LABORATORY)
COMMANDS = {  # by how they are called, such as "nextview-lab train map"
    f"{program.name} {name}": command
    for program in PROGRAMS
    for name, command in program.commands.items()
}


def main(arguments: Sequence[str]) -> None:
    """Run ``nextview`` or ``nextview-lab``; a command that both have is that of ``nextview``.

    Args:
        arguments: of the command; the name of the program may stand before them.
    """
    named = {program.name: program for program in PROGRAMS}
    first, *rest = arguments or ("",)
    if first in named:
        run(named[first], rest)
    else:
        run(LABORATORY if first in LAB else NEXTVIEW, list(arguments))


def called(line: str) -> None:
    """Run a command line that begins with the name of the program."""
    main(line.split())


refused = partial(factories.refused, run=main)
