"""Format numbers and fill templates for the HTML pages of benchmarks and evaluations."""

import base64
import re
from collections.abc import Mapping
from io import StringIO
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from nextview.figures.style import FIGURE_STYLE
from nextview.recognition.map_names import measure_of
from nextview_lab.benchmark.entries import knows_truth
from nextview_lab.benchmark.text_tables import NONE, points
from nextview_lab.data.predictions import Predictions
from nextview_lab.extras import extras

with extras():
    import pandas as pd
    from jinja2 import Environment, PackageLoader, StrictUndefined


class Number(NamedTuple):
    """A number with its interval and its published value; NaN if missing."""

    value: float
    low: float = np.nan
    high: float = np.nan
    published: float = np.nan


def numbers(frame: pd.DataFrame, *keys: str) -> dict[tuple, Number]:
    """Convert a long table to a mapping; NaN thresholds become None."""
    names = [
        [None if key != key else key for key in row]
        for row in frame[list(keys)].to_numpy(object).tolist()
    ]
    values = frame[list(Number._fields)].to_numpy(float).tolist()
    return {
        tuple(name): Number(*value) for name, value in zip(names, values, strict=True)
    }


def percent(share: float) -> str:
    """Format a share."""
    return f"{100 * share:.1f}\u00a0%"


def words(name: str) -> str:
    """Format the name of a class or measure."""
    return name.replace("_", " ")


def render(template: str, **given: Any) -> str:
    """Fill a template of this package. All arguments are escaped as text."""
    loader = PackageLoader("nextview_lab.benchmark", "templates")
    pages = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )

    pages.tests["oracle"] = knows_truth
    pages.filters |= {
        "percent": percent,
        "points": points,
        "words": words,
        "measure_of": measure_of,
        "fixed": lambda value, digits: f"{value:.{digits}f}",
        "between": lambda number: (
            f"{100 * number.low:.1f} {NONE} {percent(number.high)}"
        ),
        "p_value": lambda p: (
            NONE if np.isnan(p) else "< 0.001" if p < 0.001 else f"{p:.3f}"
        ),
    }

    return pages.get_template(template).render(given)


def picture(figure: Figure) -> str:
    """Return a figure as a data URI."""
    return f"data:image/svg+xml;base64,{base64.b64encode(to_svg(figure).encode()).decode()}"


def origin(p: Predictions, settings: Mapping[str, Any]) -> dict[str, str]:
    """Return the predictions, models and objects behind a page.

    Args:
        p: the predictions.
        settings: of the benchmark or the evaluation.

    Returns:
        Texts by heading.
    """
    splits = zip(*np.unique(p.splits, return_counts=True), strict=True)
    conflicting = [
        name for name, twice in zip(p.names, p.conflicting, strict=True) if twice
    ]
    return {
        "predictions": f"{settings['predictions']}, SHA-256 {settings['predictions_sha256']}",
        **{
            f"model: {kind}": f"{name}, SHA-256 {sha}"
            for kind, (name, sha) in p.models.items()
        },
        "splits": ", ".join(f"{n} {name or 'unnamed'}" for name, n in splits),
        "the same mesh under another label": ", ".join(conflicting) or "none",
    }


def to_svg(figure: Figure) -> str:
    """Return a figure as reproducible SVG text."""
    text = StringIO()
    with matplotlib.rc_context(FIGURE_STYLE):
        figure.savefig(
            text,
            format="svg",
            bbox_inches="tight",
            pad_inches=0.05,
            metadata={"Date": None},
        )
    # characters that XML does not allow
    return re.sub(r"[\x00-\x08\x0b\x0c\x0e-\x1f]", "\ufffd", text.getvalue())
