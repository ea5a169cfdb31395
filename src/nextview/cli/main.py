"""The ``nextview`` command: find the requested command in commands.py and call it."""

import os
import shutil
import sys
from itertools import takewhile

from nextview import __version__
from nextview.checks import did_you_mean
from nextview.cli.commands import COMMANDS, RESUMES
from nextview.cli.exit_status import orderly_end
from nextview.cores import limit_blas
from nextview.errors import MissingExtraError, UsageError

ABOUT = "Active 3D object recognition: what an object is, and where to look next."


def main(arguments: list[str] | None = None) -> None:
    """Run a command; see ``orderly_end`` for the exit statuses."""
    arguments = sys.argv[1:] if arguments is None else arguments
    resumes = " ".join(arguments[:2]).startswith(RESUMES)
    # tyro hangs in a narrower terminal
    os.environ["COLUMNS"] = str(min(max(shutil.get_terminal_size().columns, 20), 500))
    with orderly_end(
        "run the same command again; it resumes" if resumes else "nothing was written"
    ):
        _run(arguments)


def _run(arguments: list[str]) -> None:
    if arguments == ["--version"]:
        return print(f"nextview {__version__}")

    words = list(takewhile(lambda word: not word.startswith("-"), arguments[:2]))
    for count in range(len(words), 0, -1):
        if (name := " ".join(words[:count])) in COMMANDS:
            return _call(name, arguments[count:])

    group = words[0] if words else ""
    listed = {
        name: command.line
        for name, command in COMMANDS.items()
        if f"{name} ".startswith(f"{group} ".lstrip())
    }

    if len(words) == 2 or not listed:
        name = " ".join(words) if listed else group
        if listed and not did_you_mean(words[1], " ".join(listed).split()):
            there = ", ".join(listed)
            raise UsageError(f"there is no command {name!r}; there are {there}")
        groups = [name.split()[0] for name in COMMANDS]
        near = did_you_mean(name, listed or [*COMMANDS, *groups])
        raise UsageError(
            f"there is no command {name!r}{near or '; nextview --help lists all'}"
        )

    usage = f"nextview {group} COMMAND".replace("  ", " ")
    print(f"usage: {usage} [ARGUMENTS]\n\n{ABOUT}\n")
    for name, line in listed.items():
        print(f"  {name:18}  {line}")
    print(f"\n{usage} --help explains a command; --version prints the version.")


def _call(name: str, arguments: list[str]) -> None:
    from nextview.cli.call_with_arguments import call, find
    from nextview.cli.progress import console, track

    command = COMMANDS[name]
    limit_blas()
    try:
        result, given = call(name, command, arguments, track)
    except MissingExtraError as missing:
        if not {"-h", "--help"} & set(arguments):
            raise
        from nextview.cli.stand_ins import stand_ins

        console.print(f"nextview {name}: {missing}", soft_wrap=True)
        with stand_ins():
            result, given = call(name, command, arguments, track)
    if command.show:
        find(command.show)(result)
    if command.then:
        console.print(command.then.format(found=result, **given), soft_wrap=True)


if __name__ == "__main__":
    main()
