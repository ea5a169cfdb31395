"""``nextview completion``: print a script for tab completion in a shell."""

from typing import Literal

from tyro.extras import SubcommandApp

from nextview.cli.call_with_arguments import entry
from nextview.cli.commands import NEXTVIEW, Program
from nextview.cli.option_values import CONFIG, OPTION_VALUES
from nextview.cli.stand_ins import stand_ins


def completion(
    shell: Literal["bash", "zsh", "fish"],
    /,
) -> None:
    """Print a script for tab completion of commands, options and their values.

    For bash: nextview completion bash > ~/.local/share/bash-completion/completions/nextview

    Args:
        shell: name of the shell.
    """
    print_completion(NEXTVIEW, shell)


def print_completion(program: Program, shell: str) -> None:
    """Print a script for tab completion of a program.

    Args:
        program: the program.
        shell: name of the shell.
    """
    groups: dict[str, SubcommandApp] = {"": SubcommandApp()}
    with stand_ins(program.extras):
        for name, command in program.commands.items():
            group, _, word = name.rpartition(" ")
            if group not in groups:
                groups[group] = SubcommandApp()
                groups[""].command(
                    groups[group],
                    name=group,
                    help=f"the commands of {group}",
                )
            function, _ = entry(command)
            groups[group].command(name=word, help=command.line)(function)
        groups[""].cli(
            prog=program.name,
            args=["--tyro-print-completion", shell],
            config=CONFIG,
            registry=OPTION_VALUES,
        )
