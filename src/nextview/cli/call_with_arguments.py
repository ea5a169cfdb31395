"""Call a function with the arguments of a command line, using its signature and docstring."""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import docstring_parser
import tyro

from nextview.cli.commands import OUTPUT_NAMES, Command
from nextview.files import check_writable

CONFIG = (
    tyro.conf.OmitArgPrefixes,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.PositionalMetavarFromFieldName,
    tyro.conf.PositionalRequiredArgs,
)
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
        name: of the command.
        command: the command.
        arguments: of the command line.
        track: callable that shows the progress of the command.

    Returns:
        The return value of the function, and its arguments by name.
    """
    run, called = entry(command, arguments, track)
    returned = tyro.cli(run, prog=f"nextview {name}", args=arguments, config=CONFIG)
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
    about, helps = _described(function)
    parameters = []
    for parameter in signature.parameters.values():
        kind = hints[parameter.name]
        if parameter.name in helps:
            kind = Annotated[kind, tyro.conf.arg(help=helps[parameter.name])]
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
    run.__doc__ = about
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


def _described(function: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """Read the docstring of a function.

    Args:
        function: with a docstring in Google style.

    Returns:
        The description, with each paragraph on one line because tyro keeps line breaks; and the
        help of each parameter in the ``Args`` section.
    """
    parsed = docstring_parser.parse(
        function.__doc__ or "",
        docstring_parser.DocstringStyle.GOOGLE,
    )
    text = (parsed.description or "").replace("``", "")
    about = re.sub(r"(?<=\S)\n *(?=\S)", " ", text)

    helps = {}
    for parameter in parsed.params:
        helps[parameter.arg_name] = " ".join((parameter.description or "").split())
    return about, helps
