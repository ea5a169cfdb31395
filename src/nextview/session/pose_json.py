"""The pose of an object as JSON."""

from __future__ import annotations

from typing import Any

from nextview.session.result import Recognition


def pose_as_json(result: Recognition) -> dict[str, Any]:
    """Return the pose attributes of a ``Recognition`` under the same names.

    Args:
        result: of a session, or of one object of a scene.
    """
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
            None
            if off is None
            else {"degrees": off.degrees, "millimetres": off.millimetres}
        ),
        "pose_candidates": candidates,
        "symmetry": axes,
        "why_no_pose": result.why_no_pose,
    }
