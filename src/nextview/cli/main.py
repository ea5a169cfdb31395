"""The ``nextview`` command: runs one of those in commands.py."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import tyro

from nextview import __version__
from nextview.cli.commands import COMMANDS, GROUPS
from nextview.cli.ending import orderly_end
from nextview.cli.presets import with_preset


def main(arguments: list[str] | None = None) -> None:
    """Run a command; see ``orderly_end`` for how it may end."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with orderly_end(_advice(arguments)):
        _run(arguments)


def _run(arguments: list[str]) -> None:
    commands = COMMANDS
    if arguments == ["--version"]:
        print(f"nextview {__version__}")
        return
    prog, description = "nextview", "Active 3D object recognition: what it is, and where to look next."
    if arguments and isinstance(commands.get(arguments[0]), dict):  # a group, such as nextview train
        prog, description = f"{prog} {arguments[0]}", GROUPS[arguments[0]]
        commands, arguments = commands[arguments[0]], arguments[1:]
        commands = {name: with_preset(command, arguments) for name, command in commands.items()}
    else:
        commands = {name: _group(name) if isinstance(c, dict) else c for name, c in commands.items()}
    tyro.extras.subcommand_cli_from_dict(
        commands,
        prog=prog,
        description=description,
        args=arguments,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )


def _advice(arguments: list[str]) -> str:
    """How to go on with a command that was stopped; those that resume say so in their help."""
    command: Any = COMMANDS
    for name in arguments[:2]:
        command = command.get(name) if isinstance(command, dict) else command
    resumes = "Resumes" in (getattr(command, "__doc__", None) or "") and not isinstance(command, dict)
    return "run the same command again" + ("; it resumes" if resumes else "")


def _group(name: str) -> Callable[[], None]:
    """Stands for a group in the list of commands; the group itself is taken apart before."""

    def group() -> None:
        raise AssertionError(name)

    group.__doc__ = GROUPS[name]
    return group


if __name__ == "__main__":
    main()
