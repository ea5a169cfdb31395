"""Whether things stand: on the plane below them, or on other things.

Most things stand. So a pose that does not, or in which the thing would reach into the table, is
likely to be wrong, and so is its name.
"""

from __future__ import annotations

import numpy as np

from nextview.things.world import World
from nextview.types import Float, Index

HEIGHT_ERROR = (
    0.01  # of the distance: of the lowest point of a pose, by a camera's bias
)
CARRIED = 0.05  # share of right poses that stand on nothing that is known
STANDS_WRONG = 0.3  # share of wrong poses that stand on something
POINTS_BELOW = 64  # of a thing, that may touch what is below it
CARRIER_PIXELS = 100  # of a hypothesis in a view, that tell what is below it


def supported(world: World, rows: Index, carriers: Index) -> Float:
    """Return how much likelier right than wrong poses are to stand as hypotheses do, nats, (N,).

    Args:
        world: the world.
        rows: of the hypotheses, (N,) int64.
        carriers: rows of things that they may stand on, (K,) int64.

    Returns:
        0 where nothing is known to carry them.
    """
    found = np.zeros(len(rows))
    for k, row in enumerate(rows.tolist()):
        gaps = _gaps(world, row, carriers)
        if not gaps:
            continue

        stands = np.exp(-(np.median(gaps) ** 2) / 2)
        found[k] = np.log(
            stands * (1 - CARRIED) / STANDS_WRONG
            + (1 - stands) * CARRIED / (1 - STANDS_WRONG)
        )
    return found


def _gaps(world: World, row: int, carriers: Index) -> list[float]:
    """Return how far a hypothesis is above what carries it in each view, errors; negative below.

    Args:
        world: the world.
        row: of the hypothesis.
        carriers: rows of things that it may stand on, (K,) int64.
    """
    some = world.hypotheses
    corners = world.library.corners[some.things[row]] * some.sizes[row]
    corners = corners @ some.rotations[row].T + some.centres[row]
    gaps = []
    for view, one in zip(world.views, world.scores[row], strict=True):
        if one is None:
            continue
        cells = one.cells[one.gain > 0]
        cells = cells[:: max(1, len(cells) // CARRIER_PIXELS)]
        plane = view.points(cells) @ view.up - view.grid().height.ravel()[cells]
        plane = plane[np.isfinite(plane)]
        if not len(plane):
            continue

        away = np.linalg.norm(some.centres[row] - view.camera[:3, 3])
        error = HEIGHT_ERROR * float(away)
        gap = float((corners @ view.up).min() - np.median(plane))
        # what is not on the plane may be on another thing
        if gap > error:
            gap = min(gap, abs(_above(world, row, carriers, view.up, 3 * error)))
        gaps.append(gap / error)
    return gaps


def _above(world: World, row: int, carriers: Index, up: Float, deepest: float) -> float:
    """Return how far a hypothesis is above other things, metres; infinite above none.

    Args:
        world: the world.
        row: of the hypothesis.
        carriers: rows of the things, (K,) int64.
        up: direction against gravity, (3,).
        deepest: how far below the surface of a thing it may be, metres.
    """
    library = world.library
    one = world.hypotheses[np.array([row])]
    below = -up @ one.rotations / one.sizes
    points = library.seen_from(one.things, below, POINTS_BELOW)[0][0] * one.sizes
    points = points @ one.rotations[0].T + one.centres

    some = world.hypotheses[carriers]
    radii = [library.radii[each.things] * each.sizes.max(1) for each in (one, some)]
    near = np.linalg.norm(some.centres - one.centres, axis=1) < sum(radii)
    some = some[near]
    # a ray of a stretched thing, in its own axes
    axes = some.rotations / some.sizes[:, None]
    starts = (points + deepest * up - some.centres[:, None]) @ axes
    starts += library.centres[some.things][:, None]
    down = np.repeat(-up @ axes, len(points), 0)[:, None]
    things = np.repeat(some.things, len(points))
    depth, _ = library.caster.cast(
        things, starts.reshape(-1, 3).astype(np.float32), down.astype(np.float32)
    )
    return float(depth.min(initial=np.inf)) - deepest
