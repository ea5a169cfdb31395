"""The parts that pages are made of, and the templates that put them together; a page is one file."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from nextview.report.style import to_svg

NONE = "\N{EN DASH}"
GENERATOR = '<meta name="generator" content="nextview">'
"""Near the beginning of every page; by this a page of our own is known."""


class Number(NamedTuple):
    """A number with its interval and the published one; NaN where there is none."""

    value: float
    low: float = np.nan
    high: float = np.nan
    published: float = np.nan


@dataclass(frozen=True)
class Cell:
    """A cell of a table; all plain text.

    Attributes:
        text: what it says.
        small: lines below it in small print.
        published: the published number, below that.
        oracle: whether it names a policy that is told what a robot cannot know.
    """

    text: str
    small: tuple[str, ...] = ()
    published: str = ""
    oracle: bool = False


@dataclass(frozen=True)
class Table:
    """A table; the first cell of each row is its heading."""

    head: Sequence[Cell | str]
    rows: Sequence[Sequence[Cell | str]]
    caption: str


@dataclass(frozen=True)
class Card:
    """A number to be seen first."""

    title: str
    number: str
    small: str


@dataclass(frozen=True)
class Picture:
    """A figure as a picture in the page.

    Attributes:
        image: a data URI.
        alt: its content in words, for those who cannot see it.
        caption: below it.
        broad: as wide as the page, not as a column.
    """

    image: str
    alt: str
    caption: str
    broad: bool = False


def picture(drawn: Figure, alt: str, caption: str, broad: bool = False) -> Picture:
    """A figure as a ``Picture``."""
    data = base64.b64encode(to_svg(drawn).encode()).decode()
    return Picture(f"data:image/svg+xml;base64,{data}", alt, caption, broad)


def numbers(frame: pd.DataFrame, *keys: str) -> dict[tuple, Number]:
    """A long table as a mapping; a threshold that is NaN becomes None."""
    names = [[None if key != key else key for key in row] for row in frame[list(keys)].to_numpy(object).tolist()]
    values = frame[list(Number._fields)].to_numpy(float).tolist()
    return {tuple(name): Number(*value) for name, value in zip(names, values, strict=True)}


def cell(number: Number | None, digits: int = 3, below: str = "") -> Cell:
    """A number, its interval and ``below`` under it, and the published one under that."""
    if number is None or np.isnan(number.value):
        return Cell(NONE, (below,) if below else ())
    interval = f"{number.low:.{digits}f} {NONE} {number.high:.{digits}f}" if number.high > number.low else ""
    published = f"{number.published:.{digits}f}" if np.isfinite(number.published) else ""
    return Cell(f"{number.value:.{digits}f}", tuple(line for line in (interval, below) if line), published)


def percent(share: float, digits: int = 1) -> str:
    """A share as it is written."""
    return f"{100 * share:.{digits}f}\u00a0%"


def label(name: str) -> str:
    """The name of a class as it is written."""
    return name.replace("_", " ")


def render(template: str, **context: Any) -> str:
    """A whole page from one of the templates in ``page/``; what it is given is text and never markup."""
    return _environment().get_template(template).render(context)


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("nextview.report", "page"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"percent": percent, "label": label}
    made.policies["json.dumps_kwargs"] = {"separators": (",", ":")}  # in their order, and short
    made.globals |= {"asset": asset, "generator": GENERATOR}
    return made


def asset(name: str) -> str:
    """A style sheet or script that ships with the package."""
    return (files("nextview.report") / "page" / name).read_text(encoding="utf-8")
