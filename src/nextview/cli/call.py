"""Call a function with the arguments of a command line: tyro reads its parameters, their comments and its docstring."""

import inspect
import re
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Annotated, Any, Literal, get_type_hints

import tyro

from nextview.cli.commands import Command

CONFIG = (
    tyro.conf.OmitArgPrefixes,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.PositionalMetavarFromFieldName,
    tyro.conf.PositionalRequiredArgs,
)
PRESET = "which recipe the options of the recipe begin as"
PARAMETER = re.compile(r" +(?:# (?P<above>.+)|(?P<name>\w+): .*?(?:  # (?P<beside>.+))?)")


def find(path: str) -> Any:
    """What MODULE:NAME means."""
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)


def call(name: str, command: Command, arguments: Sequence[str], track: Callable[..., None]) -> tuple[Any, dict]:
    """What the function of a command returns, and its arguments by their names."""
    run, called = entry(command, arguments, track)
    returned = tyro.cli(run, prog=f"nextview {name}", args=arguments, config=CONFIG)
    return returned, called


def entry(
    command: Command, arguments: Sequence[str] = (), track: Callable[..., None] | None = None
) -> tuple[Callable[..., Any], dict[str, Any]]:
    """A function that tyro can ask for on a command line, and a dictionary of the arguments that it is called with.

    Parameters without a default, and those that are positional only, are arguments; all others are options. A parameter
    ``track`` is given, and is not asked for. ``arguments`` tell whether the defaults are those of another preset.
    """
    function = find(command.function)
    signature = inspect.signature(function)
    hints = get_type_hints(function, include_extras=True)
    comments = _comments(function)
    parameters = []
    for parameter in signature.parameters.values():
        kind = hints[parameter.name]
        if parameter.name in comments:
            kind = Annotated[kind, tyro.conf.arg(help=comments[parameter.name])]
        if parameter.name != "track":
            parameters.append(parameter.replace(annotation=kind))
    if command.thesis:
        if re.search(r"(^| )--preset[ =]thesis( |$)", " ".join(arguments)):
            parameters = [p.replace(default=find(command.thesis)) if p.name == "recipe" else p for p in parameters]
        kind = Annotated[Literal["default", "thesis"], tyro.conf.arg(help=PRESET)]
        keyword = inspect.Parameter.KEYWORD_ONLY
        parameters.append(inspect.Parameter("preset", keyword, default="default", annotation=kind))
    given = {"track": track} if "track" in hints else {}
    called: dict[str, Any] = {}

    def run(*positional: Any, preset: str = "default", **options: Any) -> Any:
        called.update(signature.bind_partial(*positional, **options).arguments)
        return function(*positional, **options, **given)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    text = inspect.cleandoc(function.__doc__ or "").replace("``", "")
    run.__doc__ = re.sub(r"(?<=\S)\n(?: {8,})?(?=\S)", " ", text)  # a paragraph a line: tyro would keep where lines end
    return run, called


def _comments(function: Callable[..., Any]) -> dict[str, str]:
    """Help of parameters: the comment beside each, or the lines above it, as tyro reads it of the fields of a class."""
    found, above = {}, []
    for line in inspect.getsource(function).partition('"""')[0].splitlines()[1:]:
        if match := PARAMETER.fullmatch(line):
            if match["above"]:
                above.append(match["above"])
            else:
                found[match["name"]], above = match["beside"] or " ".join(above), []
    return found
