"""The page of a benchmark or an evaluation: its parts, and the template that makes one file of them."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import NamedTuple

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from nextview.session.style import to_svg

NONE = "\N{EN DASH}"


class Number(NamedTuple):
    """A number with its interval and the published one; NaN where there is none."""

    value: float
    low: float = np.nan
    high: float = np.nan
    published: float = np.nan


class Cell(NamedTuple):
    """A cell of a table: text, small lines below it, the published number, and whether it names an oracle."""

    text: str
    small: tuple[str, ...] = ()
    published: str = ""
    oracle: bool = False


Row = Sequence[Cell | str]


class Table(NamedTuple):
    """A table; the first cell of each row is its heading."""

    head: Row
    rows: Sequence[Row]
    caption: str


class Picture(NamedTuple):
    """A figure as a data URI, its content in words, and its caption; a broad one is as wide as the page."""

    image: str
    alt: str
    caption: str
    broad: bool = False


class Strip(NamedTuple):
    """An object in words, and images (data URIs) by what they show."""

    name: str
    text: str
    small: str
    images: Mapping[str, str]


Part = str | Table | Mapping[str, str] | Sequence[Picture] | Sequence[Strip]
"""A paragraph, a table, facts by name, pictures side by side, or objects one below the other."""
Section = tuple[str, str, Sequence[Part]]
"""Anchor, heading and parts; without parts it is left out."""
Card = tuple[str, str, str]
"""A number to be seen first: title, number, small print."""


def render(title: str, lead: Sequence[tuple[str, str]], cards: Sequence[Card], sections: Sequence[Section]) -> str:
    """A whole page; ``lead`` has paragraphs and their looks. All that is given is text and never markup."""
    loader = PackageLoader("nextview.benchmark", "templates")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    css = (files("nextview.benchmark") / "templates" / "page.css").read_text(encoding="utf-8")
    given = {"title": title, "lead": lead, "cards": cards, "sections": sections, "css": css}
    return environment.get_template("page.html").render(given)


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


def between(number: Number) -> str:
    """An interval of shares as it is written."""
    return f"{100 * number.low:.1f} {NONE} {percent(number.high)}"


def words(name: str) -> str:
    """The name of a class or measure as it is written."""
    return name.replace("_", " ")
