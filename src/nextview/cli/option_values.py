"""How values of options are read and named in the help: the rules that tyro is given."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass, replace
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import docstring_parser
import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
    UnsupportedTypeAnnotationError,
)

from nextview.checks import one_line

CONFIG = (
    tyro.conf.OmitArgPrefixes,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.PositionalMetavarFromFieldName,
    tyro.conf.PositionalRequiredArgs,
)
WORDS = {str: "TEXT", int: "INT", float: "NUMBER"}
NUMBERS = {3: "X Y Z", 4: "FX FY CX CY", 6: "X Y Z X Y Z"}  # by the length of a tuple
UNIONS = (Union, UnionType)
UNSAID = ("", "''", "None", "False", "True")  # defaults that go without saying

OPTION_VALUES = ConstructorRegistry()
_asked: list[PrimitiveTypeInfo | StructTypeInfo] = []


def value_word(kind: Any) -> str:
    """Return the placeholder of a value in the help.

    >>> value_word(tuple[float, float, float, float] | Literal["auto"] | None)
    'FX FY CX CY|auto'

    Args:
        kind: type of the value.
    """
    parts = get_args(kind)
    origin = get_origin(kind)
    if origin in UNIONS:
        words = [value_word(part) for part in parts if part is not type(None)]
        return "|".join(word for word in words if f"{word} ..." not in words)
    if origin is Literal:
        return "|".join(str(part) for part in parts if part is not None)
    if origin is tuple and parts[-1] is Ellipsis:
        return f"{value_word(parts[0])} ..."
    if origin is tuple:
        return NUMBERS.get(len(parts)) or " ".join(map(value_word, parts))
    return WORDS.get(kind) or kind.__name__.upper()


def described(documented: Any) -> tuple[str, dict[str, str]]:
    """Read the docstring of a function or a dataclass.

    Args:
        documented: with a docstring in Google style.

    Returns:
        The description, with each paragraph on one line because tyro keeps line breaks; and the
        help of each parameter or attribute.
    """
    style = docstring_parser.DocstringStyle.GOOGLE
    parsed = docstring_parser.parse(documented.__doc__ or "", style)
    paragraphs = (parsed.description or "").replace("``", "").split("\n\n")
    about = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)

    helps = {}
    for parameter in parsed.params:
        helps[parameter.arg_name] = " ".join((parameter.description or "").split())
    return about, helps


def explained(kind: Any, about: str | None) -> Any:
    """Return the type of an option with its help, and with its default if that says something.

    Args:
        kind: type of the option.
        about: its help.
    """

    def hint(label: str) -> str:
        return "" if label in UNSAID else f"(default: {label})"

    return Annotated[kind, tyro.conf.arg(help=about, help_behavior_hint=hint)]


@contextmanager
def _tyros_own(info: PrimitiveTypeInfo | StructTypeInfo) -> Iterator[None]:
    """Ask tyro for its own rule: those below do not apply meanwhile."""
    _asked.append(info)
    try:
        yield
    finally:
        _asked.pop()


def _may_be_empty(kind: Any) -> bool:
    """Return True for a list whose absence means something else than an empty one."""
    lists = [part for part in get_args(kind) if get_args(part)[-1:] == (Ellipsis,)]
    return bool(lists) and type(None) in get_args(kind)


@OPTION_VALUES.primitive_rule
def _value(
    info: PrimitiveTypeInfo,
) -> PrimitiveConstructorSpec | UnsupportedTypeAnnotationError | None:
    """Name the placeholder of a value, and say in one line what does not fit."""
    kind = info.type_origin or info.type
    if _asked or kind not in (*UNIONS, *WORDS, tuple, Literal):
        return None
    with _tyros_own(info):
        spec = ConstructorRegistry.get_primitive_spec(info)
    if isinstance(spec, UnsupportedTypeAnnotationError):
        return spec

    def read(words: list[str]) -> Any:
        if not words and not _may_be_empty(info.type):
            raise ValueError(f"its value is missing: {word}")
        try:
            return spec.instance_from_str(words)
        except ValueError:
            given = one_line(" ".join(words))
            raise ValueError(f"{word} is expected, not {given}") from None

    word = value_word(info.type)
    choices = None if spec.choices is None else tuple(word.split("|"))
    return replace(spec, metavar=word, instance_from_str=read, choices=choices)


@OPTION_VALUES.struct_rule
def _options(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Explain the options of a dataclass as those of a function."""
    if _asked or not is_dataclass(info.type):
        return None
    with _tyros_own(info):
        spec = ConstructorRegistry.get_struct_spec(info)
    if not isinstance(spec, StructConstructorSpec):
        return None

    _, helps = described(info.type)

    def field(one: StructFieldSpec) -> StructFieldSpec:
        return replace(one, type=explained(one.type, helps.get(one.name)))

    return replace(spec, fields=tuple(map(field, spec.fields)))
