"""The ``nextview`` command: runs one of those in commands.py."""

from __future__ import annotations

import sys
from typing import Any

from nextview import __version__
from nextview.cli.application import CONFIG, application, group
from nextview.cli.commands import COMMANDS, GROUPS
from nextview.cli.ending import orderly_end


def main(arguments: list[str] | None = None) -> None:
    """Run a command; see ``orderly_end`` for how it may end."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with orderly_end(_advice(arguments)):
        _run(arguments)


def _run(arguments: list[str]) -> None:
    if arguments == ["--version"]:
        print(f"nextview {__version__}")
        return
    prog, description = "nextview", "Active 3D object recognition: what it is, and where to look next."
    app = application(arguments)
    if arguments and isinstance(COMMANDS.get(arguments[0]), dict):  # by itself, for shorter messages
        name, *arguments = arguments
        prog, description, app = f"{prog} {name}", GROUPS[name], group(name, arguments)
    app.cli(prog=prog, description=description, args=arguments, config=CONFIG)


def _advice(arguments: list[str]) -> str:
    """How to go on with a command that was stopped; those that resume say so in their help."""
    command: Any = COMMANDS
    for name in arguments[:2]:
        command = command.get(name) if isinstance(command, dict) else command
    resumes = "Resumes" in (getattr(command, "__doc__", None) or "") and not isinstance(command, dict)
    return "run the same command again" + ("; it resumes" if resumes else "")


if __name__ == "__main__":
    main()
