"""The parts that pages are made of: text, tables, figures, all in one file."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nextview.report.style import to_svg

NONE = "&ndash;"
GENERATOR = '<meta name="generator" content="nextview">'
"""Near the beginning of every page; by this a page of our own is known."""


class Number(NamedTuple):
    """A number with its interval and the published one; NaN where there is none."""

    value: float
    low: float = np.nan
    high: float = np.nan
    published: float = np.nan


def numbers(frame: pd.DataFrame, *keys: str) -> dict[tuple, Number]:
    """A long table as a mapping; a threshold that is NaN becomes None."""
    names = [[None if key != key else key for key in row] for row in frame[list(keys)].to_numpy(object).tolist()]
    values = frame[list(Number._fields)].to_numpy(float).tolist()
    return {tuple(name): Number(*value) for name, value in zip(names, values, strict=True)}


def table(head: Sequence[str], rows: Iterable[Sequence[str]], caption: str) -> str:
    """A table of ready-made cells; the first of each row is its heading. Wide ones scroll by themselves."""
    top = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    body = "".join(
        f'<tr><th scope="row">{row[0]}</th>' + "".join(f"<td>{cell}</td>" for cell in row[1:]) + "</tr>" for row in rows
    )
    return (
        f'<p class="soft">{caption}</p><div class="wide" tabindex="0"><table aria-label="{caption}">'
        f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def cell(number: Number | None, digits: int = 3) -> str:
    """A number, its interval below it, and the published one below that."""
    if number is None or np.isnan(number.value):
        return NONE
    text = f"{number.value:.{digits}f}"
    if number.high > number.low:
        text += f"<small>{number.low:.{digits}f} &ndash; {number.high:.{digits}f}</small>"
    if np.isfinite(number.published):
        text += f'<small class="published">published {number.published:.{digits}f}</small>'
    return text


def picture(drawn: Figure, alt: str, caption: str, broad: bool = False) -> str:
    """A figure as a picture in the page.

    Args:
        drawn: the figure.
        alt: its content in words, for those who cannot see it; plain text.
        caption: below it, HTML.
        broad: as wide as the page, not as a column.
    """
    data = base64.b64encode(to_svg(drawn).encode()).decode()
    return (
        f'<figure{" class=broad" if broad else ""}><img src="data:image/svg+xml;base64,{data}" alt="{escape(alt)}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def side_by_side(*pictures: str, small: bool = False) -> str:
    """Pictures side by side, as many as fit."""
    return f'<div class="figures{" small" if small else ""}">{"".join(pictures)}</div>'


def card(title: str, number: str, small: str) -> str:
    """A number to be seen first; all HTML."""
    return f'<div class="card"><span>{title}</span><b>{number}</b><span>{small}</span></div>'


def description(facts: Mapping[str, Any]) -> str:
    """A list of facts by name, plain text."""
    return "<dl>" + "".join(f"<dt>{escape(k)}</dt><dd>{escape(str(v))}</dd>" for k, v in facts.items()) + "</dl>"


def document(title: str, lead: str, sections: Iterable[tuple[str, str, str]], script: str = "") -> str:
    """A whole page.

    Args:
        title: of the window, plain text.
        lead: what comes first, HTML.
        sections: anchor, title and content (HTML) of each; those without content are left out.
        script: run at the end.
    """
    shown = [section for section in sections if section[2]]
    links = "".join(f'<a href="#{name}">{heading}</a>' for name, heading, _ in shown)
    body = "".join(f'<section id="{name}"><h2>{heading}</h2>{content}</section>' for name, heading, content in shown)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"{GENERATOR}<title>{escape(title)}</title><style>{asset('report.css')}</style></head><body><main>"
        f"{lead}<nav>{links}</nav>{body}</main>{f'<script>{script}</script>' if script else ''}</body></html>\n"
    )


def asset(name: str) -> str:
    """A style sheet or script that ships with the package."""
    return (files("nextview.report") / "page" / name).read_text(encoding="utf-8")
