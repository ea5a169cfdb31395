"""An episode as a table, and as JSON."""

from __future__ import annotations

import json

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from nextview.cli.ending import printable
from nextview.cli.terminal import Terminal
from nextview.recognition import Stopping
from nextview.session import Look, Recognition
from nextview.viewsphere import ViewSphere


def _angles(sphere: ViewSphere, view: int) -> str:
    elevation, azimuth = sphere.angles(view)
    return f"{view}\n{elevation:.0f}°, {azimuth:.0f}°"


def _peak(sphere: ViewSphere, look: Look) -> tuple[int, float] | None:
    """View and value of the highest cell of the look's predicted map."""
    for predicted in look.maps.values():
        cell = int(predicted.argmax())
        return int(sphere.window(look.view).flat[cell]), float(predicted.flat[cell])
    return None


def print_episode(result: Recognition, sphere: ViewSphere, name: str, stopping: Stopping) -> None:
    """Print each look and the answer."""
    table = Table(
        box=box.SIMPLE,
        show_lines=True,
        pad_edge=False,
        padding=(0, 1, 0, 0),
        title=f"Looking at {name}",
        caption="view: number, elevation, azimuth; travel: grid cells",
    )
    for column in ("step", "view", "image says", "belief, top 3", "map's peak", "next", "travel"):
        table.add_column(column, justify="right" if column in ("step", "travel") else "left", no_wrap=True)
    for step, look in enumerate(result.looks, 1):
        top = np.argsort(-look.belief)[:3]
        own = int(look.guess.argmax())
        peak = _peak(sphere, look)
        table.add_row(
            str(step),
            _angles(sphere, look.view),
            f"{result.classes[own]}\n{look.guess[own]:.3f}",
            "\n".join(f"{result.classes[c]} {look.belief[c]:.3f}" for c in top),
            "-" if peak is None else f"{_angles(sphere, peak[0])}\n{peak[1]:.2f}",
            "stop" if look.next_view is None else _angles(sphere, look.next_view),
            f"{look.travel:.2f}",
        )
    console = Terminal()
    console.print(table)
    bar = float(stopping.bar(len(result.looks)))
    reason = f"threshold {bar:.3g} reached" if result.confident else "no views left"
    rest = (
        f", belief {result.confidence:.3f}, after {len(result.looks)} look{'s' * (len(result.looks) > 1)} "
        f"and {result.travel:.2f} cells of travel ({reason})."
    )
    console.print(Text.assemble("It is a ", (printable(result.answer), "bold"), rest))


def as_json(result: Recognition, sphere: ViewSphere) -> str:
    """Everything the table shows, and the whole beliefs and maps, as one JSON object."""

    def rounded(values: np.ndarray) -> list:
        return np.round(np.asarray(values, float), 6).tolist()

    looks = []
    for look in result.looks:
        peak = _peak(sphere, look)
        side = None if look.sides is None else look.sides[look.belief.argmax()]
        looks.append(
            {
                "view": look.view,
                "elevation": sphere.angles(look.view)[0],
                "azimuth": sphere.angles(look.view)[1],
                "image_says": dict(zip(result.classes, rounded(look.guess), strict=True)),
                "belief": dict(zip(result.classes, rounded(look.belief), strict=True)),
                "side": None
                if side is None
                else {"degrees": 360 * int(side.argmax()) / len(side), "belief": round(float(side.max()), 6)},
                "maps": {name: rounded(values) for name, values in look.maps.items()},
                "map_peak": None if peak is None else peak[0],
                "next_view": look.next_view,
                "travel_cells": round(look.travel, 6),
                "travel_radians": round(look.arc, 6),
            }
        )
    return json.dumps(
        {
            "answer": result.answer,
            "confidence": round(result.confidence, 6),
            "threshold_reached": result.confident,
            "looks": looks,
        },
        indent=1,
    )
