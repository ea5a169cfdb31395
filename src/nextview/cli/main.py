"""The ``nextview`` command: find the requested command in commands.py and call it."""

import os
import shutil
import sys
from itertools import takewhile

from nextview.checks import did_you_mean
from nextview.cli.commands import NEXTVIEW, Program
from nextview.cli.exit_status import orderly_end
from nextview.cores import limit_blas
from nextview.errors import MissingExtraError, UsageError, shell_words


def main(arguments: list[str] | None = None) -> None:
    """Run a command of ``nextview``; see ``orderly_end`` for the exit statuses.

    Args:
        arguments: of the command line; by default those of the process.
    """
    run(NEXTVIEW, arguments)


def run(program: Program, arguments: list[str] | None = None) -> None:
    """Run a command of a program.

    Args:
        program: the program.
        arguments: of the command line; by default those of the process.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    resumes = " ".join(arguments[:2]).startswith(program.resumes)
    # tyro hangs in a narrower terminal
    os.environ["COLUMNS"] = str(min(max(shutil.get_terminal_size().columns, 20), 500))
    after_stop = (
        "run the same command again; it resumes" if resumes else "nothing was written"
    )
    with shell_words(), orderly_end(after_stop, program.name):
        _run(program, arguments)


def _run(program: Program, arguments: list[str]) -> None:
    if arguments in (["--version"], ["version"]):
        return print(f"{program.name} {program.version}")

    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    commands = program.commands
    words = list(takewhile(lambda word: not word.startswith("-"), arguments[:2]))
    for count in range(len(words), 0, -1):
        if (name := " ".join(words[:count])) in commands:
            return _call(program, name, arguments[count:])

    group = words[0] if words else ""
    listed = {
        name: command.line
        for name, command in commands.items()
        if f"{name} ".startswith(f"{group} ".lstrip())
    }
    if len(words) == 2 or not listed:
        raise UsageError(_no_command(program, words, list(listed)))

    usage = f"{program.name} {group} COMMAND".replace("  ", " ")
    print(f"usage: {usage} [ARGUMENTS]\n\n{program.about}\n")
    width = max(map(len, listed))
    for name, line in listed.items():
        print(f"  {name:{width}}  {line}")
    print(f"\n{usage} --help explains a command; --version prints the version.")


def _no_command(program: Program, words: list[str], group: list[str]) -> str:
    """Say that there is no such command, and which one may be meant.

    Args:
        program: the program.
        words: first words of the command line.
        group: commands that begin with the first word.
    """
    from nextview.cli.words import suggested_commands

    moved, elsewhere = program.elsewhere
    if words[0] in moved:
        return f"{program.name} {words[0]} is now {elsewhere} {words[0]}: pip install ./lab"
    if not group:
        near = suggested_commands(program, words[0])
        near = near or f"; {program.name} --help lists all"
        return f"there is no command {words[0]!r}{near}"

    name = " ".join(words)
    if did_you_mean(words[1], " ".join(group).split()):
        return f"there is no command {name!r}{did_you_mean(name, group)}"
    near = suggested_commands(program, words[0])
    return f"there is no command {name!r}; there are {', '.join(group)}{near}"


def _call(program: Program, name: str, arguments: list[str]) -> None:
    from nextview.cli.call_with_arguments import call, find
    from nextview.cli.progress import console, track

    command = program.commands[name]
    called = f"{program.name} {name}"
    limit_blas()
    try:
        result, given = call(called, command, arguments, track)
    except MissingExtraError as missing:
        if not {"-h", "--help"} & set(arguments):
            raise
        from nextview.cli.stand_ins import stand_ins

        console.print(f"{called}: {missing}", soft_wrap=True)
        with stand_ins(program.extras):
            result, given = call(called, command, arguments, track)
    if command.show:
        find(command.show)(result)
    if command.then:
        console.print(command.then.format(found=result, **given), soft_wrap=True)


if __name__ == "__main__":
    main()
