"""Strangers: the shapes of taught things in other sizes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nextview.segmentation.view import View
from nextview.things.library import Hypotheses, Library
from nextview.things.score import score
from nextview.types import Float

# by which one axis of a thing is stretched in a round
FACTORS = np.array([0.8, 0.9, 0.96, 1.04, 1.1, 1.22])
LIMITS = 0.55, 1.9  # of the size along an axis, all rounds together
ROUNDS = 3
COARSER = 2


def other_size(
    library: Library, views: Sequence[View], one: Hypotheses
) -> tuple[float, Float]:
    """Return how much better than a thing itself its shape in another size explains the views.

    In each round the axis, the factor and the face that stays where it is are chosen that explain
    most (a ray is cast at a stretched scan by dividing its origin and its direction).

    Args:
        library: the things.
        views: that show it.
        one: the hypothesis, a single one.

    Returns:
        What is explained more, as a share of what the thing explains; and the size that does,
        factors along the axes of the scan, (3,).
    """
    taught = float(_totals(library, views, one)[0])
    vertices = library.caster.surfaces[int(one.things[0])].vertices
    half = np.ptp(vertices, axis=0).astype(np.float64) / 2
    best, top = one, taught
    axis, factor, side = (
        each.ravel() for each in np.meshgrid(range(3), FACTORS, (-1, 1), indexing="ij")
    )
    axis = axis.astype(np.int64)
    for _ in range(ROUNDS):
        sizes = np.repeat(best.sizes, len(axis), 0)
        shift = np.zeros((len(axis), 3))
        rows = np.arange(len(axis))
        shift[rows, axis] = side * (factor - 1) * sizes[rows, axis] * half[axis]
        sizes[rows, axis] *= factor
        tried = Hypotheses(
            np.repeat(best.things, len(axis)),
            np.repeat(best.rotations, len(axis), 0),
            best.centres + shift @ best.rotations[0].T,
            sizes,
        )
        possible = ((sizes > LIMITS[0]) & (sizes < LIMITS[1])).all(1)
        tried = tried[np.flatnonzero(possible)]
        totals = _totals(library, views, tried)
        row = int(totals.argmax())
        if totals[row] <= top:
            break
        best, top = tried[np.array([row])], float(totals[row])
    return (top - taught) / max(1.0, taught), best.sizes[0]


def _totals(library: Library, views: Sequence[View], some: Hypotheses) -> Float:
    """Return what hypotheses explain in all views, nats, (M,)."""
    totals = np.zeros(len(some))
    for view in views:
        for row, one in enumerate(score(library, view, some, COARSER)):
            totals[row] += 0.0 if one is None else one.total
    return totals
