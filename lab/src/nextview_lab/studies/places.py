"""Single taught things where they really lie: on a table, in a shelf, a bin, a bowl, a gripper.

    python -m nextview_lab.studies.places SCANS OUT.jsonl [--places shelf stack] [--things 20]
        [--seed 1]

A judge that shares no code with nextview's own simulation (``staged_things``): things fall by the
physics of MuJoCo, and a stereo camera measures the depth along MuJoCo's rays. MuJoCo is needed:
``pip install './lab[arm]'``. SCANS holds the scans of the things that the memory knows, in metres,
by their names. One episode is one thing in one place, and three views around it; a mask tells which
pixels are its own.

The places: ``alone`` on a table of uneven planks, as it falls; ``stood`` there in any orientation
in which it stays, however unlikely; ``shelf``, in a compartment; ``stack``, on another thing with a
flat top; ``bin``, a box with walls of 10 cm, with four other things poured in; ``bowl``, in the YCB
bowl, or for things above 11 cm in one of its shape as wide as they need; ``leaning`` on a wall or a
box that carries a part of its weight; ``held`` in the air by a gripper, in any orientation. A thing
that does not stay there in 12 tries (a ball does not lean) is not shown in that place.

Convex things collide as their hulls, others as the hulls of up to 20 pieces of their surface. Noise
is that of disparities: 0.08 pixels, correlated over 2 pixels, steps of 1/16 pixel. There are mixed
depths within 2 pixels of edges, and holes there, at grazing angles and where the second camera sees
nothing. The poses of the camera are wrong by ``--arm-error``, along and about each axis.

OUT.jsonl gets a line for each episode; episodes that it holds are not run again. Printed is for
each place how many are named right after 1, 2 and 3 views, and after the third how many are
confident and wrong, and unknown, with 95 % Wilson intervals; the median distance of the true
surface from the posed one in the world, with the error of the arm, as median and 90 % quantile of
the things that are named right; and the CPU time of a view. A view that shows fewer than 350 pixels
of the thing is taken from elsewhere, up to 6 times, and then not judged. Confident is what the
default rule of ``nextview.load`` would stop at. The things come in a random order, so what is
there of a run that was ended is a sample.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import tyro
from scipy.spatial import cKDTree

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.errors import ObservationError
from nextview.recognition.belief import Stopping
from nextview.sensing import Frame, ObservedObject
from nextview_lab.benchmark.board_page import markdown
from nextview_lab.benchmark.methods import never
from nextview_lab.studies.shared import results, scans_in, share
from nextview_lab.studies.staged_things import (
    CAMERA_MATRIX,
    ENOUGH_PIXELS,
    PLACES,
    VIEW_COUNT,
    Float,
    Place,
    Shot,
    scan_of,
    shots_of,
    staged,
    true_pose,
)

FIELDS = ("terms", "place", "thing")  # by which a line of the results is known


@dataclass(frozen=True)
class Terms:
    """What all episodes of a run share.

    Attributes:
        scans: folder of the scans.
        models: memory of the things.
        seed: of everything random.
        arm_error: standard deviations of the camera's pose along and about each axis, mm, degrees.
    """

    scans: str
    models: str
    seed: int
    arm_error: tuple[float, float]


@dataclass(frozen=True)
class AfterView:
    """What a thing is called after a view.

    Attributes:
        pixels: of the thing that have a depth in this view.
        answer: its name; None if it is unknown, or no frame could be used.
        right: whether this is its name.
        confident: whether an arm would stop here.
        belief: in the answer.
        doubt: why the answer is not confident whatever the belief is.
        refused: why the frame was refused.
        off_mm: median and 90 % quantile of the distances of the true surface from that of the
            posed scan, millimetres, in the world; None unless the name is right.
        seconds: of CPU for the view.
    """

    pixels: int
    answer: str | None
    right: bool
    confident: bool
    belief: float
    doubt: str
    refused: str
    off_mm: tuple[float, float] | None
    seconds: float


@lru_cache(maxsize=1)
def system_of(models: str) -> nextview.System:
    """What recognises the things; its policy does not matter, as the views are given."""
    return nextview.load(
        models=models,
        max_views=VIEW_COUNT,
        stopping=never,
        policy="random",
        threads=1,
    )


def apart(scan: trimesh.Trimesh, true: Float, found: Float) -> tuple[float, float]:
    """Median and 90 % quantile of the distances of a surface from where it was found, mm."""
    points, faces = trimesh.sample.sample_surface(scan, 20000, seed=0)
    normals = scan.face_normals[faces]
    seen = points[:2000] @ true[:3, :3].T + true[:3, 3]
    in_scan = (seen - found[:3, 3]) @ found[:3, :3]
    _, nearest = cKDTree(points).query(in_scan)
    off = np.abs(((in_scan - points[nearest]) * normals[nearest]).sum(1))
    low, high = 1000 * np.quantile(off, (0.5, 0.9))
    return round(float(low), 2), round(float(high), 2)


def recognised(
    place: Place,
    name: str,
    shots: Sequence[Shot],
    distance: float,
    true: Float,
    terms: Terms,
) -> list[AfterView | None]:
    """What a thing is called after each view; None for a view that shows too little of it."""
    system = system_of(terms.models)
    rule = Stopping.of(system.models.recogniser.calibration)
    session = system.session(
        object=ObservedObject(support=place != "held"),
        distance=distance,
    )
    scan = scan_of(terms.scans, name)
    found: list[AfterView | None] = []
    for shot in shots:
        if shot.pixels < ENOUGH_PIXELS:
            found.append(None)
            continue
        begun = time.process_time()
        refused = ""
        try:
            session.update(Frame(shot.depth, CAMERA_MATRIX, shot.told, mask=shot.mask))
        except ObservationError as error:
            refused = str(error)
        seconds = time.process_time() - begun
        result = session.result
        answer = result.answer if result.views else None
        belief = np.array([result.confidence])
        enough = bool(rule.reached(belief, max(len(result.views), 1)))
        pose = result.pose if answer == name else None
        found.append(
            AfterView(
                pixels=shot.pixels,
                answer=answer,
                right=answer == name,
                confident=answer is not None and enough and not result.joint_doubt,
                belief=round(result.confidence, 4),
                doubt=result.joint_doubt if answer is not None else "",
                refused=refused,
                off_mm=None if pose is None else apart(scan, true, pose),
                seconds=round(seconds, 3),
            )
        )
    return found


def episode(asked: tuple[Terms, Place, str]) -> dict[str, Any]:
    """Stage a thing in a place, and look at it three times.

    Args:
        asked: values of ``FIELDS``.

    Returns:
        What is written of it; views are None if the thing does not stay there.
    """
    terms, place, name = asked
    numbers = [terms.seed, PLACES.index(place), *name.encode()]
    rng = np.random.default_rng(numbers)
    found_rest = staged(place, terms.scans, name, rng)
    if found_rest is None:
        return {"views": None}
    scene, tries = found_rest
    true = true_pose(scene[1])
    shots, distance = shots_of(
        place, scene, scan_of(terms.scans, name), terms.arm_error, rng
    )
    found = recognised(place, name, shots, distance, true, terms)
    return {"tries": tries, "views": found}


def distances(views: Sequence[dict[str, Any]]) -> str:
    """Median and 90 % quantile of the median distances of surfaces, mm."""
    medians = [view["off_mm"][0] for view in views if view["off_mm"] is not None]
    if not medians:
        return "-"
    low, high = np.quantile(medians, (0.5, 0.9))
    return f"{low:.1f}, {high:.1f}"


def table(lines: Sequence[dict[str, Any]]) -> str:
    """The results as a table."""
    last = f"after {VIEW_COUNT}"
    heads = ["place", "shown"]
    heads += [f"right after {k + 1}" for k in range(VIEW_COUNT)]
    heads += [f"confident and right {last}", f"confident and wrong {last}"]
    heads += [f"unknown {last}", "refused frames"]
    heads += [f"off {last}, mm: median, 90 %", "s a view"]
    rows = []
    for place in (*PLACES, "all"):
        here = [line for line in lines if place in (line["place"], "all")]
        shown = [line["views"] for line in here if line["views"] is not None]
        if not shown:
            continue
        after = [[views[k] for views in shown if views[k]] for k in range(VIEW_COUNT)]
        cells = [place, f"{len(shown)} of {len(here)}"]
        cells += [share(sum(v["right"] for v in some), len(some)) for some in after]
        end = after[-1]
        sure = [view for view in end if view["confident"]]
        good = sum(view["right"] for view in sure)
        cells += [share(good, len(end)), share(len(sure) - good, len(end))]
        cells.append(share(sum(v["answer"] is None for v in end), len(end)))
        views = [view for some in after for view in some]
        cells.append(f"{sum(bool(view['refused']) for view in views)} of {len(views)}")
        cells.append(distances(end))
        cells.append(
            f"{np.median([view['seconds'] for view in views]):.2f}" if views else "-"
        )
        rows.append(cells)
    return markdown(heads, rows)


def main(
    scans: tyro.conf.Positional[Path],
    output: tyro.conf.Positional[Path],
    places: tuple[Place, ...] = PLACES,
    things: int = 0,
    seed: int = 1,
    models: str = "ycb",
    arm_error: tuple[float, float] = (3.0, 0.3),
    workers: int = 1,
) -> None:
    """Stage the things, recognise them, and print the table.

    Args:
        scans: folder of the scans, NAME.ply, in metres; with that of the YCB bowl, bowl.ply.
        output: a line of JSON for each episode; those that it holds are not run again.
        places: where the things are.
        things: how many of them, drawn by the seed; 0 for all.
        seed: of everything random.
        models: memory that was taught with the scans.
        arm_error: standard deviations of the camera's poses along and about each axis, mm, degrees.
        workers: processes.
    """
    names = (
        np.random.default_rng(seed)
        .permutation(list(scans_in(scans, (".ply",))))
        .tolist()
    )
    terms = Terms(str(scans), models, seed, arm_error)
    asked = [
        (terms, place, name) for name in names[: things or None] for place in places
    ]
    processes = workers if workers > 1 else 0
    print(table(results(output, FIELDS, asked, episode, "episodes", processes)))


if __name__ == "__main__":
    with orderly_end("the episodes that were done are kept"):
        tyro.cli(main)
