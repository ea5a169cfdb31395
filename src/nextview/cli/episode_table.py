"""An episode as a table, and as JSON."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich import box
from rich.console import JustifyMethod
from rich.table import Table
from rich.text import Text

from nextview.checks import number_of
from nextview.cli.exit_status import printable
from nextview.cli.progress import Terminal
from nextview.session.pose_json import pose_as_json
from nextview.session.result import Recognition

SHOWN_POSES = 5  # beside the likeliest


def _angles(view: int, angles: tuple[float, float]) -> str:
    return f"{view}\n{angles[0]:.0f}°, {round(angles[1]) % 360}°"


def print_episode(result: Recognition, name: str, policy: str, frames: Sequence[str] = ()) -> None:
    """Print each view and the answer.

    Args:
        result: how the episode ended.
        name: of what was looked at.
        policy: that chose the views.
        frames: of captured views, which frame answered each.
    """
    stops = [float(result.stopping.threshold_at(step)) for step in range(1, len(result.views) + 1)]
    has_threshold = bool(np.isfinite(stops).any())  # a rule of your own need not stop at a belief

    console = Terminal()
    console.print(_table_of_views(result, name, policy, frames, stops if has_threshold else []))
    for step, view in enumerate(result.views, 1):
        for warning in view.warnings:
            console.print(f"Step {step}: warning ({warning.name}): {warning.message}.")

    console.print(_answer_in_words(result, has_threshold))
    if result.novelty is not None and not result.unknown:
        console.print(
            f"Novelty: of known objects, {100 * result.novelty:.3g} % look at least as unusual."
        )
    for line in _pose_in_words(result):
        console.print(line, soft_wrap=True)


def _table_of_views(
    result: Recognition, name: str, policy: str, frames: Sequence[str], stops: Sequence[float]
) -> Table:
    """A row for each view; ``stops`` are the thresholds at which each stops, if there are any."""
    table = Table(box=box.SIMPLE, show_lines=True, pad_edge=False, padding=(0, 1, 0, 0))
    table.title = f"Looking at {name}, next views by {policy}"
    table.caption = (
        f"view: number, elevation, azimuth; travel: grid cells; stops by {result.stopping}"
    )

    columns = ["step", "view", "this view alone", "belief, top 3", "next", "travel"]
    if stops:
        columns.insert(4, "stops at")
    for column in columns:
        justify: JustifyMethod = "right" if column in ("step", "travel") else "left"
        table.add_column(column, justify=justify, no_wrap=True)
    if frames:  # their names may be long
        table.columns[1].no_wrap = False
        table.columns[1].overflow = "fold"
        table.columns[1].min_width = 9
        table.columns[1].max_width = 12

    for row, view in enumerate(result.views):
        looked = _angles(view.index, view.angles)
        if frames:
            looked += f"\n{frames[row]}\n{view.degrees_off:.1f}° off"

        own = int(view.alone.argmax())
        alone = "nothing\nis seen"
        if view.observation.seen:
            alone = f"{result.classes[own]}\n{view.alone[own]:.3f}"

        top = np.argsort(-view.belief)[:3]
        belief = "\n".join(f"{result.classes[c]} {view.belief[c]:.3f}" for c in top)
        stop = [f"{stops[row]:.2f}"] if stops else []
        after = "stop"
        if view.next_view is not None:
            after = _angles(view.next_view, result.sphere.angles(view.next_view))
        table.add_row(str(row + 1), looked, alone, belief, *stop, after, f"{view.travel:.2f}")
    return table


def _answer_in_words(result: Recognition, has_threshold: bool) -> Text:
    """What the object is, or that it is unknown, and after how many views."""
    views = number_of(len(result.views), "view")
    effort = f"after {views} and {result.travel:.2f} cells of travel"
    if result.unknown:
        why = f": {printable(result.why_unknown)}, {effort}."
        return Text.assemble("It is ", (printable(result.none_of_them), "bold"), why)

    reason = "no other view in reach" if result.stranded else "not confident"
    if result.confident:
        reason = "threshold reached" if has_threshold else f"{result.stopping}"
    rest = f"{result.views[-1].belief.max():.3f}, {effort} ({reason})."
    return Text.assemble("It is a ", (printable(f"{result.answer}"), "bold"), ", belief ", rest)


def _pose_in_words(result: Recognition) -> list[str]:
    """Where the object is, or why that is not known, a line each."""
    if result.pose is None:
        return (
            [f"Its pose is not known: {printable(result.why_no_pose)}."]
            if result.why_no_pose
            else []
        )

    others = [each for each in result.pose_candidates if not np.array_equal(each.pose, result.pose)]
    rows = [" ".join(f"{value:9.4f}" for value in row) for row in result.pose]
    lines = [
        f"From the frame of its scan into {result.poses_in}, metres ({result.pose_uncertainty}):",
        *rows,
    ]

    if others:
        alike = ", ".join(
            f"{printable(each.thing)} {each.probability:.2f}" for each in others[:SHOWN_POSES]
        )
        more = ", ..." if len(others) > SHOWN_POSES else ""
        lines.append(f"Other poses that it may have, by their probability: {alike}{more}.")
    return lines


def episode_as_json(
    result: Recognition, name: str, frames: Sequence[str] = (), indent: int | None = 1
) -> str:
    """Return all that the table shows, with complete beliefs and maps, as a JSON object.

    Args:
        result: of the episode.
        name: of the object.
        frames: names of the captured frames that were taken; empty for other cameras.
        indent: of the text, in spaces; None for one line.

    Returns:
        The text.
    """
    views = []
    for step, view in enumerate(result.views, 1):
        best = None
        if view.azimuth_bins is not None and view.observation.seen:
            bins = view.azimuth_bins[view.belief.argmax()]
            best = {"degrees": 360 * int(bins.argmax()) / len(bins), "belief": bins.max()}

        one: dict[str, Any] = {
            "view": view.index,
            "elevation": view.angles[0],
            "azimuth": view.angles[1],
        }
        one |= {"degrees_off": view.degrees_off} | ({"frame": frames[step - 1]} if frames else {})
        one |= {
            "seen": view.observation.seen,
            "alone": dict(zip(result.classes, view.alone, strict=True)),
        }
        one |= {
            "belief": dict(zip(result.classes, view.belief, strict=True)),
            "azimuth_bin": best,
            "maps": view.maps,
        }
        one |= {"values": view.values, "threshold": float(result.stopping.threshold_at(step))}
        one |= {
            "next_view": view.next_view,
            "travel_cells": view.travel,
            "travel_radians": view.arc,
        }
        views.append(one | {"warnings": [warning.message for warning in view.warnings]})

    parts = ("answer", "confidence", "beliefs", "most_like", "unknown", "novelty", "radius")
    whole = {"name": name} | {part: getattr(result, part) for part in parts}
    whole |= pose_as_json(result)
    whole |= {
        "unit": None if result.radius is None else "m",
        "threshold_reached": result.confident,
        "views": views,
    }
    whole["warnings"] = sorted(warning.name for warning in result.warnings)
    return json.dumps(plain(whole), indent=indent)


def plain(value: Any) -> Any:
    """As JSON has it: six digits, and null for what is no number."""
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float):
        return round(value, 6) if np.isfinite(value) else None
    return value
