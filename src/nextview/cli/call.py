"""Call a function with the arguments of a command line: tyro reads its parameters and its docstring."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from importlib import import_module
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

from nextview.cli.commands import Command

CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff, tyro.conf.PositionalMetavarFromFieldName)
PRESET = "which recipe the options of the recipe begin as"


def find(path: str) -> Any:
    """What MODULE:NAME means."""
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)


def call(name: str, command: Command, arguments: Sequence[str], given: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """What the function of a command returns, and its arguments; ``given`` fills parameters that are no options.

    Parameters without a default, and those that are positional only, are arguments; all others are options.
    """
    function = find(command.function)
    hints, parameters = get_type_hints(function, include_extras=True), []
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name in given:
            continue
        kind = _none_first(hints[parameter.name])
        if parameter.default is parameter.empty or parameter.kind is parameter.POSITIONAL_ONLY:
            kind = tyro.conf.Positional[kind]  # type: ignore[misc, valid-type]
        parameters.append(parameter.replace(annotation=kind, kind=parameter.KEYWORD_ONLY))
    if command.presets:
        parameters = _with_preset(parameters, command.presets, arguments)
    called: dict[str, Any] = {}

    def run(**options: Any) -> Any:
        called.update(options)
        options.pop("preset", None)
        options |= {key: value for key, value in given.items() if key in hints}
        own = inspect.signature(function).parameters.values()
        positional = [options.pop(p.name) for p in own if p.kind is p.POSITIONAL_ONLY]
        return function(*positional, **options)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    text = inspect.cleandoc(function.__doc__ or "").replace("``", "")
    run.__doc__ = re.sub(r"(?<=\S)\n(?: {8,})?(?=\S)", " ", text)  # a paragraph a line: tyro would keep where lines end
    return tyro.cli(run, prog=f"nextview {name}", args=arguments, config=CONFIG), called


def _none_first(kind: Any) -> Any:
    """A type whose unions begin with None: tyro checks those without typeguard, whose import takes 50 ms."""
    if is_dataclass(kind):
        hints = get_type_hints(kind, include_extras=True)
        kind.__annotations__ = {name: _none_first(each) for name, each in hints.items()}
    elif isinstance(kind, UnionType) or get_origin(kind) is Union:
        kind = Union[tuple(sorted(get_args(kind), key=lambda each: each is not NoneType))]  # noqa: UP007
    return kind


def _with_preset(
    parameters: list[inspect.Parameter], presets: Mapping[str, str], arguments: Sequence[str]
) -> list[inspect.Parameter]:
    """Let --preset choose the defaults of the recipe, so that any option of it can still be changed."""
    named = re.search(r"(?:^| )--preset[ =](\S+)", " ".join(arguments))
    kind = Annotated[Literal[("default", *presets)], tyro.conf.arg(help=PRESET)]  # type: ignore[valid-type]
    preset = inspect.Parameter("preset", inspect.Parameter.KEYWORD_ONLY, default="default", annotation=kind)
    if named and named[1] in presets:
        recipe = find(presets[named[1]])
        parameters = [p.replace(default=recipe) if p.name == "recipe" else p for p in parameters]
    return [*parameters, preset]
