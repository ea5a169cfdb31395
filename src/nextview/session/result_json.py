"""A result, and its pose, as JSON."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nextview.recognition.poses import PoseCandidate, PoseUncertainty
from nextview.session.result import Recognition
from nextview.session.view import View
from nextview.types import Float


def episode_as_json(
    result: Recognition,
    name: str,
    frames: Sequence[str] = (),
    indent: int | None = 1,
) -> str:
    """Return the contents of the table, with complete beliefs and maps, as a JSON object.

    Args:
        result: of the episode.
        name: of the object.
        frames: names of the captured frames that were used; empty for other cameras.
        indent: of the text, in spaces; None for one line.

    Returns:
        The text.
    """
    views = []
    for step, view in enumerate(result.views, 1):
        one = _view_as_json(result, view)
        one["threshold"] = float(result.stopping.threshold_at(step))
        if frames:
            one["frame"] = frames[step - 1]
        views.append(one)

    parts = (
        "answer",
        "confidence",
        "beliefs",
        "most_like",
        "unknown",
        "novelty",
        "radius",
    )
    whole = {"name": name} | {part: getattr(result, part) for part in parts}
    whole |= pose_as_json(
        result.pose, result.pose_uncertainty, result.pose_candidates, result.symmetry
    )
    whole |= {
        "pose_of": result.pose_of,
        "pose_frame": result.pose_frame,
        "why_no_pose": result.why_no_pose,
    }
    whole |= {
        "unit": None if result.radius is None else "m",
        "threshold_reached": result.confident,
        "doubt": result.doubt,
        "views": views,
    }
    whole["warnings"] = sorted(warning.name for warning in result.warnings)
    return json.dumps(plain(whole), indent=indent)


def _view_as_json(result: Recognition, view: View) -> dict[str, Any]:
    """Return one view: camera position, belief, and next view."""
    azimuth = None
    if view.azimuth_bins is not None and view.observation.seen:
        bins = view.azimuth_bins[view.belief.argmax()]
        azimuth = {
            "degrees": 360 * int(bins.argmax()) / len(bins),
            "belief": bins.max(),
        }

    elevation, around = view.angles
    return {
        "view": view.index,
        "elevation": elevation,
        "azimuth": around,
        "degrees_off": view.degrees_off,
        "seen": view.observation.seen,
        "alone": dict(zip(result.classes, view.alone, strict=True)),
        "belief": dict(zip(result.classes, view.belief, strict=True)),
        "azimuth_bin": azimuth,
        "maps": view.maps,
        "values": view.values,
        "next_view": view.next_view,
        "travel_cells": view.travel,
        "travel_radians": view.arc,
        "warnings": [warning.message for warning in view.warnings],
    }


def pose_as_json(
    pose: Float | None,
    off: PoseUncertainty | None,
    every: Sequence[PoseCandidate],
    symmetry: Sequence[Any] | None,
) -> dict[str, Any]:
    """Return what is known of a pose.

    Args:
        pose: of the scan, (4, 4), metres; None if it is not known.
        off: its uncertainty.
        every: candidate poses, the likeliest first.
        symmetry: of the thing; None if it is not known.
    """
    candidates = [
        {
            "thing": each.thing,
            "probability": each.probability,
            "pose": each.pose,
            "degrees": each.degrees,
            "millimetres": each.millimetres,
        }
        for each in every
    ]

    axes = (
        None
        if symmetry is None
        else [{"axis": each.axis, "order": each.order} for each in symmetry]
    )

    return {
        "pose": pose,
        "pose_uncertainty": (
            None
            if off is None
            else {"degrees": off.degrees, "millimetres": off.millimetres}
        ),
        "pose_candidates": candidates,
        "symmetry": axes,
    }


def plain(value: Any) -> Any:
    """Convert a value for JSON: floats with six decimals, and null for NaN and infinity."""
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float):
        return round(value, 6) if np.isfinite(value) else None
    return value
