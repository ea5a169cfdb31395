"""From what explains a thing to its name: how likely each name and each pose is."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, softmax

from nextview.recognition.poses import PoseCandidate, distinct
from nextview.things.register import POINT_INFORMATION, normal_equations
from nextview.things.score import PIXEL_GAIN
from nextview.things.support import supported
from nextview.things.world import STRANGER_GAIN, Thing, World
from nextview.types import Float, Index

PIXELS_ALIKE = 6.0  # pixels of the grid whose errors are alike: their nats count once
TOTAL_ERROR = 0.015  # of what a hypothesis explains: error by its pose and scan
# log-odds that a name is right, beside those that it stands: of the share of what it could explain,
# of the logarithm of what it explains, and of its lead over other names, up to LARGEST_LEAD of that
CONSTANT, OF_SHARE, OF_GAIN, OF_LEAD = -15.5, 12.5, 1.0, 15.0
LARGEST_LEAD = 0.2  # of what it explains: a larger lead counts as much
CONFIDENT = 0.97  # belief from which on a name is confident
LIKELY = 0.5  # belief below which an object is unknown
OUTLINE_PIXELS = 2.0  # of the grid, within which an outline is where it is measured
SYMMETRIC = 1e9  # information about a turn that changes nothing, 1/radians^2
LEAST_LISTED = 0.01  # belief in a pose that is listed beside the likeliest


@dataclass(frozen=True, eq=False)
class Named:
    """What is believed of a named thing of a world.

    Attributes:
        rows: hypotheses of its place, the likeliest first, (N,) int64.
        probabilities: of each, (N,) float64; the rest of 1 is that of a stranger.
        right: probability that the likeliest name is right.
        gain: what the likeliest hypothesis explains and nothing else does, nats.
        lead: over the likeliest other name or size, as a share of what it explains.
        share: of what it could explain.
        support: how much likelier right than wrong poses are to stand as it does, nats.
        most: probability that no other name or size explains the views; ``right`` is no higher.
    """

    rows: Index
    probabilities: Float
    right: float
    gain: float
    lead: float
    share: float
    support: float
    most: float

    def beliefs(self, world: World) -> dict[str, float]:
        """Return the belief in each name, the likeliest first; their sum is 1 at most."""
        found: dict[str, float] = {}
        for row, probability in zip(self.rows, self.probabilities, strict=True):
            name = world.library.names[int(world.hypotheses.things[row])]
            found[name] = found.get(name, 0.0) + float(probability)
        first = next(iter(found))
        others = sum(found.values()) - found[first]
        part = min(1.0, (1 - self.right) / max(others, 1e-9))
        return {
            name: self.right if name == first else part * belief
            for name, belief in found.items()
        }


def score_error(total: float) -> float:
    """Return the error of a score, nats: of alike pixels, and of the pose and the scan."""
    return PIXELS_ALIKE + TOTAL_ERROR * total


def named(world: World, thing: Thing, ruled_out: Collection[str]) -> Named | None:
    """Return what is believed of a thing with a hypothesis; None if every name is ruled out.

    Args:
        world: the world.
        thing: one of its things.
        ruled_out: names that it cannot have.
    """
    rows = world.rivals(thing.row)
    totals = world.totals[rows]
    of_row = totals[rows == thing.row]
    names = np.array(world.library.names)[world.hypotheses.things[rows]]
    kept = (totals > 0) & (totals <= of_row) & ~np.isin(names, list(ruled_out))
    rows = rows[kept]
    totals = totals[kept]
    taught = world.hypotheses.taught[rows]
    if not taught.any():
        return None

    carriers = [one.row for one in world.things if one.row >= 0 and one is not thing]
    support = supported(world, rows, np.array(carriers, np.int64))
    error = score_error(float(totals[taught].max()))
    logits = totals / error + support
    # the same thing in another size is something that was not taught
    resized = [each[~taught].max(initial=0.0) for each in (totals, logits)]
    order = np.flatnonzero(taught)[np.argsort(-logits[taught], kind="stable")]
    rows = rows[order]
    totals = totals[order]

    seen = sum(one.seen for one in world.scores[rows[0]] if one is not None)
    beliefs = softmax(
        np.append(logits[order], [resized[1], STRANGER_GAIN * seen / error])
    )
    probabilities = beliefs[:-2]
    alike = beliefs[-2]
    others = world.hypotheses.things[rows] != world.hypotheses.things[rows[0]]
    lead = float(1 - totals[others].max(initial=resized[0]) / max(totals[0], 1.0))
    # what other things and planes explain as well does not speak for it
    gain = float(totals[0] - of_row.max() + thing.gain)
    share = gain / max(1.0, PIXEL_GAIN * seen)
    standing = float(support[order[0]])
    odds = CONSTANT + OF_SHARE * share + OF_GAIN * np.log(max(gain, 1.0))
    odds += OF_LEAD * min(lead, LARGEST_LEAD) + standing
    # of two that explain the views alike, neither is sure
    alike += probabilities[others].sum()
    most = float(1 - alike / beliefs[:-1].sum())
    right = min(float(expit(odds)), most)
    return Named(rows, probabilities, right, gain, lead, share, standing, most)


def why_in_doubt(world: World, found: Named) -> str:
    """Return the main reason why a name is not confident, in words.

    Args:
        world: the world.
        found: what is believed of one of its things.
    """
    things = world.hypotheses.things[found.rows]
    totals = world.totals[found.rows]
    others = things != things[0]
    rival = "the same thing in another size"
    if totals[others].max(initial=0.0) >= (1 - found.lead) * totals[0] - 1e-6:
        rival = world.library.names[int(things[others.argmax()])]
    alike = f"{rival} explains the views nearly as well"
    if found.right >= found.most:
        return alike

    terms = {
        f"it fits only {100 * found.share:.0f} % of its pixels": (
            OF_SHARE * (found.share - 0.7)
        ),
        "few pixels show it": OF_GAIN * (np.log(max(found.gain, 1.0)) - np.log(1000)),
        alike: OF_LEAD * (min(found.lead, LARGEST_LEAD) - LARGEST_LEAD),
        "it would not stand in this pose": found.support,
    }
    return min(terms, key=lambda one: terms[one])


def pose_candidates(
    world: World, found: Named, labels: Index | None = None
) -> tuple[PoseCandidate, ...]:
    """Return the distinct poses of the hypotheses of a place, the likeliest first.

    Args:
        world: the world.
        found: what is believed of a thing.
        labels: class of each thing of the library, (T,) int64; by default its number there.
    """
    rows = found.rows
    some = world.hypotheses[rows]
    left = np.zeros((len(rows), 6, 6))
    for view in world.views:
        left += normal_equations(world.library, view, some, 0.03)[0]
    radius = world.library.radii[some.things]
    left *= POINT_INFORMATION
    for number, view in enumerate(world.views):
        # what is not hidden of its outline lies within pixels of the grid
        scores = [world.scores[row][number] for row in rows]
        shown = np.array(
            [
                0.0 if one is None else one.seen / (one.seen + one.hidden + 1)
                for one in scores
            ]
        )
        ray = some.centres - view.camera[:3, 3]
        square = (ray**2).sum(1)[:, None, None]
        across = np.eye(3) - ray[:, :, None] * ray[:, None] / square
        error = OUTLINE_PIXELS * view.grid().pitch
        left[:, 3:, 3:] += shown[:, None, None] * across / (square * error**2)
    # a pose is known to its thing's own size, at least
    left[:, range(3), range(3)] += 1.0
    left[:, range(3, 6), range(3, 6)] += 1 / radius[:, None] ** 2
    for k, thing in enumerate(some.things):
        # a turn that changes nothing is no error
        for one in world.library.symmetries.get(world.library.names[thing]) or ():
            if one.order == 0:
                axis = some.rotations[k] @ one.axis
                left[k, :3, :3] += SYMMETRIC * np.outer(axis, axis)
    variances = np.diagonal(np.linalg.inv(left), axis1=1, axis2=2)
    degrees = np.degrees(np.sqrt(variances[:, :3].sum(1)))
    millimetres = 1000 * np.sqrt(variances[:, 3:].sum(1))
    every = []
    for k, row in enumerate(rows):
        thing = int(some.things[k])
        surface = world.library.caster.surfaces[thing]
        every.append(
            PoseCandidate(
                thing=surface.name,
                label=thing if labels is None else int(labels[thing]),
                pose=world.hypotheses.pose(int(row), world.library),
                probability=float(found.probabilities[k]),
                degrees=float(degrees[k]),
                millimetres=float(millimetres[k]),
                centre=surface.centroid,
                vertices=surface.vertices,
                faces=surface.faces,
                symmetry=world.library.symmetries.get(surface.name),
            )
        )
    # hypotheses that ended in one pose are one
    kept = [every[k] for k in distinct(every)]
    whole = sum(one.probability for one in kept)
    listed = [
        one for one in kept if one is kept[0] or one.probability > LEAST_LISTED * whole
    ]
    whole = sum(one.probability for one in listed)
    return tuple(replace(one, probability=one.probability / whole) for one in listed)
