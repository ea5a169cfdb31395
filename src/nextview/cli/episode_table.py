"""An episode as a table, and as JSON."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from nextview.cli.ending import printable
from nextview.cli.progress import Terminal
from nextview.session.recognition import Recognition

SHOWN_POSES = 5  # beside the likeliest


def _angles(view: int, angles: tuple[float, float]) -> str:
    return f"{view}\n{angles[0]:.0f}°, {round(angles[1]) % 360}°"


def print_episode(result: Recognition, name: str, policy: str, frames: Sequence[str] = ()) -> None:
    """Print each view and the answer; of captured views, which frame answered and how far off it
    was.
    """
    sphere = result.sphere
    table = Table(box=box.SIMPLE, show_lines=True, pad_edge=False, padding=(0, 1, 0, 0))
    table.title = f"Looking at {name}, next views by {policy}"
    table.caption = (
        f"view: number, elevation, azimuth; travel: grid cells; stops by {result.stopping}"
    )
    stops = [float(result.stopping.threshold_at(step)) for step in range(1, len(result.views) + 1)]
    enough = ["stops at"] * any(np.isfinite(stops))  # a rule of your own need not stop at a belief
    for column in ("step", "view", "this view alone", "belief, top 3", *enough, "next", "travel"):
        table.add_column(
            column, justify="right" if column in ("step", "travel") else "left", no_wrap=True
        )
    if frames:  # their names may be long
        table.columns[1].no_wrap, table.columns[1].overflow = False, "fold"
        table.columns[1].min_width, table.columns[1].max_width = 9, 12
    for step, view in enumerate(result.views, 1):
        top = np.argsort(-view.belief)[:3]
        own = int(view.alone.argmax())
        table.add_row(
            str(step),
            _angles(view.index, view.angles)
            + (f"\n{frames[step - 1]}\n{view.degrees_off:.1f}° off" if frames else ""),
            (
                f"{result.classes[own]}\n{view.alone[own]:.3f}"
                if view.observation.seen
                else "nothing\nis seen"
            ),
            "\n".join(f"{result.classes[c]} {view.belief[c]:.3f}" for c in top),
            *[f"{stops[step - 1]:.2f}"] * len(enough),
            (
                "stop"
                if view.next_view is None
                else _angles(view.next_view, sphere.angles(view.next_view))
            ),
            f"{view.travel:.2f}",
        )
    console = Terminal()
    console.print(table)
    for step, view in enumerate(result.views, 1):
        for warning in view.warnings:
            console.print(f"Step {step}: warning ({warning.name}): {warning.message}.")
    left = "no other view in reach" if result.stranded else "not confident"
    reason = ("threshold reached" if enough else f"{result.stopping}") if result.confident else left
    views = f"{len(result.views)} view{'s' * (len(result.views) > 1)}"
    rest = (
        f"{result.views[-1].belief.max():.3f}, after {views} and {result.travel:.2f} cells of"
        f" travel ({reason})."
    )
    if result.unknown:
        why = (
            f": {printable(result.why_unknown)}, after {views} and {result.travel:.2f} cells of"
            " travel."
        )
        console.print(Text.assemble("It is ", (printable(result.none_of_them), "bold"), why))
    else:
        console.print(
            Text.assemble("It is a ", (printable(f"{result.answer}"), "bold"), ", belief ", rest)
        )
    if result.novelty is not None and not result.unknown:
        console.print(
            f"Of objects of known classes, {100 * result.novelty:.3g} % are at least as novel."
        )
    for line in _pose_in_words(result):
        console.print(line, soft_wrap=True)


def _pose_in_words(result: Recognition) -> list[str]:
    """Where the object is, or why that is not known, a line each."""
    if result.pose is None:
        return (
            [f"Where it is: not known, for {printable(result.why_no_pose)}."]
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
    """Everything the table shows, and the whole beliefs and maps, as one JSON object."""
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
    whole |= _pose_as_json(result)
    whole |= {
        "unit": None if result.radius is None else "m",
        "threshold_reached": result.confident,
        "views": views,
    }
    whole["warnings"] = sorted({warning.name for view in result.views for warning in view.warnings})
    return json.dumps(_plain(whole), indent=indent)


def _pose_as_json(result: Recognition) -> dict[str, Any]:
    """Where the object is: what ``Recognition`` says of it, by the same names."""
    off = result.pose_uncertainty
    candidates = [
        {
            "thing": each.thing,
            "probability": each.probability,
            "pose": each.pose,
            "degrees": each.degrees,
            "millimetres": each.millimetres,
        }
        for each in result.pose_candidates
    ]
    symmetry = result.symmetry
    axes = (
        None
        if symmetry is None
        else [{"axis": each.axis, "order": each.order} for each in symmetry]
    )
    return {
        "pose": result.pose,
        "pose_of": result.pose_of,
        "pose_frame": result.pose_frame,
        "pose_uncertainty": (
            None if off is None else {"degrees": off.degrees, "millimetres": off.millimetres}
        ),
        "pose_candidates": candidates,
        "symmetry": axes,
        "why_no_pose": result.why_no_pose,
    }


def _plain(value: Any) -> Any:
    """As JSON has it: six digits, and null for what is no number."""
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return (round(value, 6) if np.isfinite(value) else None) if isinstance(value, float) else value
