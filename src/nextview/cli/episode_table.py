"""An episode as a table, and as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from nextview.cli.ending import printable
from nextview.cli.terminal import Terminal
from nextview.session import Recognition


def _angles(view: int, angles: tuple[float, float]) -> str:
    elevation, azimuth = angles
    return f"{view}\n{elevation:.0f}°, {round(azimuth) % 360}°"


def print_episode(result: Recognition, name: str, policy: str, frames: Sequence[str] = ()) -> None:
    """Print each view and the answer; of captured views, which frame answered and how far off it was."""
    sphere = result.sphere
    table = Table(
        box=box.SIMPLE,
        show_lines=True,
        pad_edge=False,
        padding=(0, 1, 0, 0),
        title=f"Looking at {name}, next views by {policy}",
        caption=f"view: number, elevation, azimuth; travel: grid cells; stops at {result.stopping}",
    )
    for column in ("step", "view", "this view alone", "belief, top 3", "stops at", "next", "travel"):
        table.add_column(column, justify="right" if column in ("step", "travel") else "left", no_wrap=True)
    if frames:  # their names may be long
        table.columns[1].no_wrap, table.columns[1].overflow = False, "fold"
        table.columns[1].min_width, table.columns[1].max_width = 9, 12
    for step, view in enumerate(result.views, 1):
        top = np.argsort(-view.belief)[:3]
        own = int(view.alone.argmax())
        table.add_row(
            str(step),
            _angles(view.index, view.angles) + (f"\n{frames[step - 1]}\n{view.degrees_off:.1f}° off" if frames else ""),
            f"{result.classes[own]}\n{view.alone[own]:.3f}" if view.observation.seen else "nothing\nis seen",
            "\n".join(f"{result.classes[c]} {view.belief[c]:.3f}" for c in top),
            f"{float(result.stopping.threshold_at(step)):.2f}",
            "stop" if view.next_view is None else _angles(view.next_view, sphere.angles(view.next_view)),
            f"{view.travel:.2f}",
        )
    console = Terminal()
    console.print(table)
    for step, view in enumerate(result.views, 1):
        for doubt in view.doubts:
            console.print(f"Step {step} is doubtful ({doubt.name}): {doubt.message}.", markup=False, highlight=False)
    left = "no other view in reach" if result.stranded else "no views left"
    reason = "threshold reached" if result.confident else left
    belief = float(result.views[-1].belief.max())
    rest = (
        f"belief {belief:.3f}, after {len(result.views)} view{'s' * (len(result.views) > 1)} "
        f"and {result.travel:.2f} cells of travel ({reason})."
    )
    if result.unknown:
        most_like = f": most like a {printable(f'{result.most_like}')}, "
        console.print(Text.assemble("It is ", ("of no known class", "bold"), most_like, rest))
    else:
        console.print(Text.assemble("It is a ", (printable(f"{result.answer}"), "bold"), ", ", rest))
    if result.novelty is not None:
        share = f"{100 * result.novelty:.2g} %"
        console.print(f"Of objects of known classes, {share} look at least as strange.")


def as_json(result: Recognition, frames: Sequence[str] = ()) -> str:
    """Everything the table shows, and the whole beliefs and maps, as one JSON object."""

    def rounded(values: np.ndarray) -> list:
        """As JSON has them: what is no number becomes null."""
        found = np.round(np.asarray(values, float), 6)
        return [None if np.isnan(x) else x for x in found.tolist()] if found.ndim == 1 else found.tolist()

    views = []
    for step, view in enumerate(result.views, 1):
        bins = (
            None if view.azimuth_bins is None or not view.observation.seen else view.azimuth_bins[view.belief.argmax()]
        )
        views.append(
            {
                "view": view.index,
                "elevation": round(view.angles[0], 6),
                "azimuth": round(view.angles[1], 6),
                "degrees_off": round(view.degrees_off, 6),
                **({"frame": frames[step - 1]} if frames else {}),
                "seen": view.observation.seen,
                "alone": dict(zip(result.classes, rounded(view.alone), strict=True)),
                "belief": dict(zip(result.classes, rounded(view.belief), strict=True)),
                "azimuth_bin": None
                if bins is None
                else {"degrees": 360 * int(bins.argmax()) / len(bins), "belief": round(float(bins.max()), 6)},
                "maps": {name: rounded(values) for name, values in view.maps.items()},
                "values": None if view.values is None else rounded(view.values),
                "threshold": round(float(result.stopping.threshold_at(step)), 6),
                "next_view": view.next_view,
                "travel_cells": round(view.travel, 6),
                "travel_radians": round(view.arc, 6),
                "doubts": [doubt.message for doubt in view.doubts],
            }
        )
    return json.dumps(
        {
            "answer": result.answer,
            "confidence": round(result.confidence, 6),
            "most_like": result.most_like,
            "unknown": result.unknown,
            "novelty": None if result.novelty is None else round(result.novelty, 6),
            "threshold_reached": result.confident,
            "views": views,
        },
        indent=1,
    )
