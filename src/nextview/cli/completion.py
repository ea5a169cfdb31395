"""``nextview completion``: what makes a shell complete commands and options."""

from __future__ import annotations

from typing import Literal

import tyro


def completion(shell: tyro.conf.Positional[Literal["bash", "zsh", "fish"]], /) -> None:
    """Print the script by which a shell completes the commands of nextview and their options.

    For bash: nextview completion bash > ~/.local/share/bash-completion/completions/nextview.
    For zsh: nextview completion zsh > ~/.zfunc/_nextview, where ~/.zfunc is in fpath.
    For fish: nextview completion fish > ~/.config/fish/completions/nextview.fish.

    Args:
        shell: which one.
    """
    from nextview.cli.application import CONFIG, application

    application().cli(prog="nextview", args=["--tyro-write-completion", shell, "-"], config=CONFIG)
