"""``nextview completion``: print a script for tab completion in a shell."""

from typing import Literal

from tyro.extras import SubcommandApp

from nextview.cli.call_with_arguments import entry
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
    from nextview.cli.commands import COMMANDS

    groups: dict[str, SubcommandApp] = {"": SubcommandApp()}
    with stand_ins():
        for name, command in COMMANDS.items():
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
            prog="nextview",
            args=["--tyro-print-completion", shell],
            config=CONFIG,
            registry=OPTION_VALUES,
        )
