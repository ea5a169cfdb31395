"""An episode as a table, and as JSON."""

from __future__ import annotations

import json

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from nextview.belief import Stopping
from nextview.cli.ending import printable
from nextview.cli.terminal import Terminal
from nextview.session import Recognition, View
from nextview.viewsphere import ViewSphere


def _angles(sphere: ViewSphere, view: int) -> str:
    elevation, azimuth = sphere.angles(view)
    return f"{view}\n{elevation:.0f}°, {azimuth:.0f}°"


def _peak(sphere: ViewSphere, view: View) -> tuple[int, float] | None:
    """View and value of the highest cell of the view's predicted map; None without a map, or if nothing is seen."""
    if not view.observation.seen:
        return None
    for predicted in view.maps.values():
        cell = int(predicted.argmax())
        return int(sphere.window(view.index).flat[cell]), float(predicted.flat[cell])
    return None


def print_episode(result: Recognition, sphere: ViewSphere, name: str, stopping: Stopping) -> None:
    """Print each view and the answer."""
    table = Table(
        box=box.SIMPLE,
        show_lines=True,
        pad_edge=False,
        padding=(0, 1, 0, 0),
        title=f"Looking at {name}",
        caption="view: number, elevation, azimuth; travel: grid cells",
    )
    for column in ("step", "view", "this view alone", "belief, top 3", "map's peak", "next", "travel"):
        table.add_column(column, justify="right" if column in ("step", "travel") else "left", no_wrap=True)
    for step, view in enumerate(result.views, 1):
        top = np.argsort(-view.belief)[:3]
        own = int(view.alone.argmax())
        peak = _peak(sphere, view)
        table.add_row(
            str(step),
            _angles(sphere, view.index),
            f"{result.classes[own]}\n{view.alone[own]:.3f}" if view.observation.seen else "nothing\nis seen",
            "\n".join(f"{result.classes[c]} {view.belief[c]:.3f}" for c in top),
            "-" if peak is None else f"{_angles(sphere, peak[0])}\n{peak[1]:.2f}",
            "stop" if view.next_view is None else _angles(sphere, view.next_view),
            f"{view.travel:.2f}",
        )
    console = Terminal()
    console.print(table)
    threshold = float(stopping.threshold_at(len(result.views)))
    reason = f"threshold {threshold:.3g} reached" if result.confident else "no views left"
    rest = (
        f", belief {result.confidence:.3f}, after {len(result.views)} view{'s' * (len(result.views) > 1)} "
        f"and {result.travel:.2f} cells of travel ({reason})."
    )
    console.print(Text.assemble("It is a ", (printable(f"{result.answer}"), "bold"), rest))


def as_json(result: Recognition, sphere: ViewSphere) -> str:
    """Everything the table shows, and the whole beliefs and maps, as one JSON object."""

    def rounded(values: np.ndarray) -> list:
        return np.round(np.asarray(values, float), 6).tolist()

    views = []
    for view in result.views:
        peak = _peak(sphere, view)
        bins = (
            None if view.azimuth_bins is None or not view.observation.seen else view.azimuth_bins[view.belief.argmax()]
        )
        views.append(
            {
                "view": view.index,
                "elevation": sphere.angles(view.index)[0],
                "azimuth": sphere.angles(view.index)[1],
                "seen": view.observation.seen,
                "alone": dict(zip(result.classes, rounded(view.alone), strict=True)),
                "belief": dict(zip(result.classes, rounded(view.belief), strict=True)),
                "azimuth_bin": None
                if bins is None
                else {"degrees": 360 * int(bins.argmax()) / len(bins), "belief": round(float(bins.max()), 6)},
                "maps": {name: rounded(values) for name, values in view.maps.items()},
                "map_peak": None if peak is None else peak[0],
                "next_view": view.next_view,
                "travel_cells": round(view.travel, 6),
                "travel_radians": round(view.arc, 6),
            }
        )
    return json.dumps(
        {
            "answer": result.answer,
            "confidence": round(result.confidence, 6),
            "threshold_reached": result.confident,
            "views": views,
        },
        indent=1,
    )
