"""All commands as one application."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from typing import Any

import tyro
from tyro.extras import SubcommandApp

from nextview.cli.commands import COMMANDS, GROUPS
from nextview.cli.presets import with_preset

CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff, tyro.conf.PositionalMetavarFromFieldName)


def application(arguments: Sequence[str] = ()) -> SubcommandApp:
    """The commands, groups of them nested.

    Args:
        arguments: of the command line; a preset that they name sets the defaults of the command's options.
    """
    app = SubcommandApp()
    for name, command in COMMANDS.items():
        if isinstance(command, dict):
            app.command(group(name, arguments), name=name, help=GROUPS[name])
        else:
            app.command(name=name)(_laid_out(command))
    return app


def group(name: str, arguments: Sequence[str] = ()) -> SubcommandApp:
    """The commands of one group; see ``application``."""
    app = SubcommandApp()
    for each, function in COMMANDS[name].items():
        app.command(name=each)(_laid_out(with_preset(function, arguments)))
    return app


def _laid_out(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command with each paragraph of its docstring on one line, for tyro would keep where the lines end."""
    text = inspect.cleandoc(command.__doc__ or "").replace("``", "")
    command.__doc__ = re.sub(r"(?<=\S)\n(?: {8,})?(?=\S)", " ", text)
    return command
