"""Call a function with the arguments of a command line, using its signature and docstring."""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import tyro

from nextview.cli.commands import OUTPUT_NAMES, Command
from nextview.cli.option_names import GROUPS, HELP_OPTIONS, check_options
from nextview.cli.option_values import CONFIG, OPTION_VALUES, described, explained
from nextview.cores import CORES_HELP
from nextview.files import check_writable

PRESET = "recipe that sets the defaults of the recipe options"


def find(path: str) -> Any:
    """Import the object that MODULE:NAME names."""
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)


def call(
    name: str,
    command: Command,
    arguments: Sequence[str],
    track: Callable[..., None],
) -> tuple[Any, dict]:
    """Call the function of a command with the arguments of a command line.

    Args:
        name: of the program and the command.
        command: the command.
        arguments: of the command line.
        track: callable that shows the progress of the command.

    Returns:
        The return value of the function, and its arguments by name.
    """
    run, called = entry(command, arguments, track)
    helped = not HELP_OPTIONS.isdisjoint(arguments)
    if not helped:
        check_options(name, run, arguments)
    try:
        returned = tyro.cli(
            run,
            prog=name,
            args=arguments,
            config=CONFIG,
            registry=OPTION_VALUES,
        )
    except SystemExit:
        if helped:
            program = name.partition(" ")[0]
            print(f"\nexample: {program} {command.example}")
        raise
    return returned, called


def entry(
    command: Command,
    arguments: Sequence[str] = (),
    track: Callable[..., None] | None = None,
) -> tuple[Callable[..., Any], dict[str, Any]]:
    """Create a function that tyro can read from a command line.

    Parameters without a default, and positional-only ones, become arguments; all others become
    options. A parameter ``track`` is passed in and is not an option.

    Args:
        command: the command.
        arguments: of the command line; ``--preset`` among them selects the defaults.
        track: callable that shows the progress of the command.

    Returns:
        The function, and a dictionary that is filled with its arguments when it is called.
    """
    function = find(command.function)
    signature = inspect.signature(function)
    hints = get_type_hints(function, include_extras=True)
    about, helps = described(function)
    parameters = []
    for parameter in signature.parameters.values():
        kind = hints[parameter.name]
        if parameter.name in helps:
            kind = explained(kind, helps[parameter.name])
        if parameter.name in GROUPS:
            kind = Annotated[kind, tyro.conf.arg(name=GROUPS[parameter.name])]
        if parameter.name != "track":
            parameters.append(parameter.replace(annotation=kind))
    if command.thesis:
        if re.search(r"(^| )--preset[ =]thesis( |$)", " ".join(arguments)):
            parameters = [
                p.replace(default=find(command.thesis)) if p.name == "recipe" else p
                for p in parameters
            ]
        kind = Annotated[Literal["default", "thesis"], tyro.conf.arg(help=PRESET)]
        keyword = inspect.Parameter.KEYWORD_ONLY
        parameters.append(
            inspect.Parameter("preset", keyword, default="default", annotation=kind)
        )
    given = {"track": track} if "track" in hints else {}
    called: dict[str, Any] = {}

    def run(*positional: Any, preset: str = "default", **options: Any) -> Any:
        called.update(signature.bind_partial(*positional, **options).arguments)
        for path in written(called, command):
            check_writable(path)
        return function(*positional, **options, **given)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {
        parameter.name: parameter.annotation for parameter in parameters
    }
    run.__doc__ = f"{about}\n\n{CORES_HELP}" if command.computes else about
    return run, called


def written(arguments: Mapping[str, Any], command: Command) -> list[Path]:
    """Return the paths of what a command writes.

    Args:
        arguments: of its function, by name.
        command: the command.
    """
    groups = [
        arguments,
        *(vars(each) for each in arguments.values() if is_dataclass(each)),
    ]
    names = (*OUTPUT_NAMES, command.changes)
    found = [group.get(name) for group in groups for name in names]
    return [path for path in found if isinstance(path, Path)]
