"""The names of the options of a command."""

import inspect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from itertools import takewhile
from typing import Any

from nextview.checks import did_you_mean
from nextview.errors import UsageError

HELP_OPTIONS = frozenset(("-h", "--help"))
GROUPS = {  # title of a group of options in the help, by the parameter that holds it
    "how": "further",
    "looking": "recognition",
    "settings": "run",
    "source": "input",
}


def check_options(
    command: str,
    function: Callable[..., Any],
    arguments: Sequence[str],
) -> None:
    """Check that a command has the options of a command line.

    Args:
        command: as it is typed.
        function: its function, see ``entry``.
        arguments: of the command line.

    Raises:
        UsageError: there is no such option; the message names the one that is meant.
    """
    known = option_names(function)
    for word in takewhile(lambda each: each != "--", arguments):
        option = word.partition("=")[0].replace("_", "-")
        if option.startswith("--") and option not in known | HELP_OPTIONS:
            near = did_you_mean(option, sorted(known))
            near = near or f"; {command} --help lists those that there are"
            raise UsageError(f"{command} has no option {option}{near}")


def option_names(function: Callable[..., Any]) -> set[str]:
    """Return the names of the options of a command, as they are typed.

    Args:
        function: of the command, see ``entry``.
    """
    parameters = inspect.signature(function).parameters.values()
    defaults = {
        one.name: one.default
        for one in parameters
        if one.default is not one.empty and one.kind is not one.POSITIONAL_ONLY
    }
    return set(_typed(defaults))


def _typed(defaults: dict[str, Any]) -> Iterator[str]:
    """Yield the options for some parameters, and for those inside of dataclasses."""
    for name, default in defaults.items():
        if is_dataclass(default):
            yield from _typed(
                {f.name: getattr(default, f.name) for f in fields(default)}
            )
        else:
            yield f"--{'no-' if default is True else ''}{name.replace('_', '-')}"
