"""Commands as text, so that whatever nextview makes can say how it was made."""

from __future__ import annotations

import shlex
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any


def command_line(words: str, *positional: Path | str, **options: Any) -> str:
    """The command that does this: to be noted by what it makes.

    Args:
        words: of the command, "fit calibration".
        positional: its arguments without a name.
        options: the others, by the names of Python. None, False and () are left out; True is an option without a value;
            of a dataclass, a recipe say, each field is an option that is left out where it has its default.

    Returns:
        One line for a shell.
    """
    line = ["nextview", *words.split(), *map(str, positional)]
    for name, value in options.items():
        if is_dataclass(value) and not isinstance(value, type):
            usual = type(value)()
            for field in fields(value):
                own = getattr(value, field.name)
                if own != getattr(usual, field.name):
                    line += _option(field.name, own)
        elif not (value is None or value is False or value == ()):
            line += _option(name, value)
    return shlex.join(line)


def _option(name: str, value: Any) -> list[str]:
    name = name.replace("_", "-")
    if isinstance(value, bool):
        return [f"--{name}" if value else f"--no-{name}"]
    values = value if isinstance(value, tuple | list) else (value,)
    return [f"--{name}", *map(str, values)]
