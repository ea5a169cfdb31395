"""Fit the belief in a name to drawn frames and real ones: what each term of it should weigh.

    python -m benchmarks.belief [DATA] [--strangers 4]

DATA is that of ``benchmarks.gate``. Its tables, hidden and moved things are shown to scenes, and
each of its real frames to a scene of its own: to scenes that know all things, and to others that
know one half of them. Of each name that a scene considers this keeps its evidence
(``nextview.things.naming.Named``), and whether it is right.

It prints how often names are right by their present belief, and the best weights: a right name
counts one, a confident one two, a wrong name takes a half away. Allowed are confident wrong names
of three in a hundred of a drawn part (five, where one half is known), one on the taught things of
real frames, and ``--strangers`` on real things that nobody taught. Frames that were fitted do not
judge the fit: ``nextview-lab benchmark tables`` does.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro

import nextview
from benchmarks import gate
from benchmarks.gate_frames import Case, middle, moved
from nextview.things import naming
from nextview.things.naming import CONFIDENT, LIKELY, named
from nextview_lab.benchmark.real import pixels_met
from nextview_lab.data.real_frames import real_frames

INTERVALS = 0, 0.5, 0.7, 0.85, 0.95, 0.97, 0.99, 1.001
WEIGHTS = {  # that are tried
    "OF_SHARE": (8.0, 10.0, 12.5, 15.0, 20.0),
    "OF_GAIN": (0.25, 0.4, 0.5, 0.75, 1.0),
    "OF_LEAD": (10.0, 15.0, 20.0, 30.0),
    "LARGEST_LEAD": (0.1, 0.15, 0.2, 0.3),
}


class Evidence(NamedTuple):
    """What speaks for a name, and whether it is right.

    Attributes:
        where: part of the gate, or kind of real frames.
        share: of what it could explain; this and the next four as in ``Named``.
        gain: nats.
        lead: share of what it explains.
        support: nats.
        most: probability that nothing else explains the views.
        belief: in the name, with the present weights.
        right: whether the name is.
    """

    where: str
    share: float
    gain: float
    lead: float
    support: float
    most: float
    belief: float
    right: bool


def of_scene(
    scene: nextview.Scene, shapes: gate.Shapes
) -> Iterator[tuple[naming.Named, str, gate.Float]]:
    """The best name of each thing of a scene, and points on it in its pose.

    Args:
        scene: after a frame.
        shapes: points on the scans by their names.
    """
    world = scene._state.world
    for thing in world.things:
        found = None if thing.row < 0 else named(world, thing, ())
        if found is not None:
            row = int(found.rows[0])
            name = world.library.names[int(world.hypotheses.things[row])]
            pose = world.hypotheses.pose(row, world.library)
            yield found, name, moved(shapes[name][0], pose)


def drawn(
    part: str,
    cases: Iterator[tuple[str, Case]],
    system: nextview.System,
    shapes: gate.Shapes,
) -> Iterator[Evidence]:
    """Evidence of drawn frames.

    Args:
        part: of the gate.
        cases: of the part, each with its name.
        system: that knows the things.
        shapes: points on the scans by their names.
    """
    for _, seen in cases:
        scene = nextview.Scene(system)
        for frame in range(len(seen.depth)):
            gate.updated(scene, gate.frame_of(seen, frame))
            placed = map(moved, seen.points, seen.poses[frame])
            true = dict(zip(seen.names.tolist(), placed, strict=True))
            for found, name, points in of_scene(scene, shapes):
                off = middle(points) - middle(true.get(name, np.full((1, 3), np.inf)))
                yield row_of(part, found, bool(np.linalg.norm(off) < gate.NEAR))


def real(
    bench: gate.Bench, system: nextview.System, shapes: gate.Shapes
) -> Iterator[Evidence]:
    """Evidence of all real frames.

    Args:
        bench: with the folders.
        system: that knows the things.
        shapes: points on the scans by their names.
    """
    for folder, (group, camera, _) in gate.REAL.items():
        for seen in real_frames(bench.data / folder, camera):
            scene = nextview.Scene(system, up=None)
            gate.updated(scene, seen.read())
            masks = {one.name: one.pixels for one in seen.things()}
            for found, name, points in of_scene(scene, shapes):
                mask = masks.get(name)
                met = mask is not None and pixels_met(
                    points, seen.captured.intrinsics, mask
                )
                yield row_of(group, found, bool(met))


def row_of(where: str, found: naming.Named, right: bool) -> Evidence:
    """One name as a row.

    Args:
        where: part of the gate, or kind of real frames.
        found: what is believed.
        right: whether the name is.
    """
    return Evidence(
        where,
        found.share,
        found.gain,
        found.lead,
        found.support,
        found.most,
        found.right,
        right,
    )


def fitted(rows: Sequence[Evidence], strangers: int) -> tuple[float, dict[str, float]]:
    """The weights that are worth most, and how much: see above.

    Args:
        rows: all names.
        strangers: real strangers that may get a confident name.
    """
    _, share, gain, lead, support, most, _, right = map(
        np.array, zip(*rows, strict=True)
    )
    where = np.array([row.where for row in rows])
    names, counts = np.unique(where, return_counts=True)
    allowed = {}
    for name, count in zip(names.tolist(), counts.tolist(), strict=True):
        allowed[name] = int(count * (0.03 if name.endswith("all") else 0.05))
        for group, number in (("none taught", strangers), ("taught", 1)):
            if name.startswith(group):
                allowed[name] = number
    sure = np.log(CONFIDENT / (1 - CONFIDENT))
    best: tuple[float, dict[str, float]] = (0.0, {})
    for values in itertools.product(*WEIGHTS.values()):
        of_share, of_gain, of_lead, largest = values
        odds = of_share * share + of_gain * np.log(np.maximum(gain, 1))
        odds += of_lead * np.minimum(lead, largest) + support
        certain = np.where(most > CONFIDENT, odds, -np.inf)
        # the most convincing wrong name that is not allowed
        limits = []
        for name, number in allowed.items():
            wrong = certain[(where == name) & ~right]
            wrong = np.append(wrong, [-np.inf] * (number + 1))
            limits.append(np.sort(wrong)[-1 - number])
        limit = max(limits)
        named = (odds > limit - sure) & (most > LIKELY)
        worth = worth_of(right, named, certain > limit)
        if worth > best[0]:
            weights = dict(zip(WEIGHTS, values, strict=True))
            best = worth, {"CONSTANT": round(float(sure - limit), 2), **weights}
    return best


def worth_of(right: gate.Mask, named: gate.Mask, sure: gate.Mask) -> float:
    """What names are worth: a right one 1, a confident one 2, a wrong one -1/2.

    Args:
        right: whether each is right, (N,) bool.
        named: whether it is given, (N,) bool.
        sure: whether it is confident, (N,) bool.
    """
    return float(
        (named & right).sum() + (sure & right).sum() - (named & ~right).sum() / 2
    )


def main(
    data: tyro.conf.Positional[Path] = Path(os.environ.get("NEXTVIEW_DATA", "data")),
    strangers: int = 4,
    frames: Path = Path("~/.cache/nextview/gate"),
) -> None:
    """Fit the belief in a name.

    Args:
        data: folder of the gate's data.
        strangers: real things without a name that may get a confident one.
        frames: folder of the drawn frames.
    """
    bench = gate.Bench(data, frames.expanduser(), 1)
    system, shapes = bench.taught()
    one, other = np.array_split(np.random.default_rng(0).permutation(system.classes), 2)
    rows = []
    for knows, some in (
        ("all", system),
        ("one half", system.without(*other.tolist())),
        ("the other half", system.without(*one.tolist())),
    ):
        found = [
            row
            for part in ("tables", "places", "moves")
            for row in drawn(part, bench.cases(part), some, shapes)
        ]
        found += real(bench, some, shapes)
        rows += [row._replace(where=f"{row.where}, knows {knows}") for row in found]

    print("where, belief, names, right")
    for where in dict.fromkeys(row.where for row in rows):
        for low, high in itertools.pairwise(INTERVALS):
            some = [
                r.right for r in rows if r.where == where and low <= r.belief < high
            ]
            if some:
                print(
                    f"{where}, {low:.2f} to {min(high, 1):.2f}, {len(some)}, {sum(some)}"
                )

    worth, weights = fitted(rows, strangers)
    right = np.array([row.right for row in rows])
    belief = np.array([row.belief for row in rows])
    now = worth_of(right, belief >= LIKELY, belief >= CONFIDENT)
    print(f"worth {now} now, {worth} with {weights}")


if __name__ == "__main__":
    tyro.cli(main)
