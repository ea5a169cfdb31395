"""``nextview-lab completion``: print a script for tab completion in a shell."""

from typing import Literal

from nextview.cli.completion import print_completion
from nextview_lab.cli.commands import LABORATORY


def completion(
    shell: Literal["bash", "zsh", "fish"],
    /,
) -> None:
    """Print a script for tab completion of commands, options and their values.

    For bash: nextview-lab completion bash > ~/.local/share/bash-completion/completions/nextview-lab

    Args:
        shell: name of the shell.
    """
    print_completion(LABORATORY, shell)
