"""Report the objects of a scene as rows of a table and as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from nextview.recognition.poses import place_in_words
from nextview.scene.objects import UNKNOWN_NAME, SceneObject
from nextview.scene.scene import Look, Scene
from nextview.session.result_json import pose_as_json
from nextview.types import Mask

REPORT_COLUMNS = ("", "name", "belief", "place, m", "± mm, °", "frames", "touches")
MOST_CANDIDATES = 3  # alternatives listed beside a name
LEAST_LISTED = 0.01  # least value of a listed alternative


def row_of(thing: SceneObject) -> list[str]:
    """Return the table row of an object, in ``REPORT_COLUMNS``.

    Args:
        thing: an object of a scene.
    """
    off = thing.pose_uncertainty
    name = thing.name
    belief = f"{thing.confidence:.3f}"
    if thing.name == UNKNOWN_NAME:
        sides = "x".join(f"{100 * side:.0f}" for side in thing.size)
        name = f"{UNKNOWN_NAME} ({sides} cm)"
        belief = ""
    elif not thing.confident:
        name = f"{name} ?"

    return [
        str(thing.number),
        name,
        belief,
        place_in_words(thing.place).strip("[] m"),
        "" if off is None else f"{off.millimetres:.1f}, {off.degrees:.1f}",
        str(len(thing.pixels)),
        ", ".join(str(number) for number in thing.touches),
    ]


def doubts_of(scene: Scene) -> list[str]:
    """Return a sentence with the alternatives for each object that is not confident.

    Args:
        scene: with the objects.
    """
    said = []
    for thing in scene.objects:
        if thing.confident or thing.name == UNKNOWN_NAME:
            continue
        beliefs = sorted(thing.beliefs.items(), key=lambda pair: -pair[1])
        rest = [f"{one} {belief:.2f}" for one, belief in beliefs[:MOST_CANDIDATES]]
        why = thing.doubt
        said.append(f"{thing.number} is not confident: {', '.join(rest)} ({why})")
    return said


def changes_in_words(look: Look) -> list[str]:
    """Return a phrase for each object that has appeared, moved or gone.

    Args:
        look: changes made by a frame.
    """
    said = [f"{number} has appeared" for number in look.appeared]
    for move in look.moved:
        how_far = ""
        if move.before is not None and move.after is not None:
            metres = np.linalg.norm(move.after[:3, 3] - move.before[:3, 3])
            how_far = f" by {1000 * metres:.0f} mm"
        said.append(f"{move.number} has moved{how_far}")
    return said + [f"{number} is gone" for number in look.gone]


def scene_as_json(
    scene: Scene,
    looks: Mapping[str, Look],
    left_out: Mapping[str, str],
) -> dict[str, Any]:
    """Return all results as a dictionary for JSON.

    Args:
        scene: with the objects.
        looks: changes made by each frame, by frame name.
        left_out: reasons for unused frames, by frame name.
    """
    names = [name for name, one in looks.items() if one.taken]
    objects = []

    for thing in scene.objects:
        likely = {
            name: belief
            for name, belief in thing.beliefs.items()
            if belief >= LEAST_LISTED
        }
        one: dict[str, Any] = {
            "number": thing.number,
            "name": thing.name,
            "confidence": thing.confidence,
            "confident": thing.confident,
            "doubt": thing.doubt,
            "most_like": thing.most_like,
            "beliefs": likely,
            "place": thing.place,
            "size": thing.size,
            "touches": thing.touches,
            "warnings": sorted({warning.name for warning in thing.warnings}),
        }
        one |= pose_as_json(
            thing.pose, thing.pose_uncertainty, thing.candidates, thing.symmetry
        )
        one["frames"] = {
            names[number]: {"pixels": int(mask.sum()), "box": _box_of(mask)}
            for number, mask in thing.pixels.items()
        }
        objects.append(one)
    frames = [
        {
            "name": name,
            "taken": one.taken,
            "appeared": one.appeared,
            "moved": [
                {"number": move.number, "before": move.before, "after": move.after}
                for move in one.moved
            ],
            "gone": one.gone,
            "joined": one.joined,
            "warnings": [warning.message for warning in one.warnings],
        }
        for name, one in looks.items()
    ]

    return {"unit": "m", "objects": objects, "frames": frames, "left_out": left_out}


def _box_of(mask: Mask) -> list[int]:
    """Return left, top, width and height of a mask, pixels, as in BOP."""
    rows, columns = np.nonzero(mask)
    left, top = int(columns.min()), int(rows.min())
    return [left, top, int(columns.max()) - left + 1, int(rows.max()) - top + 1]
