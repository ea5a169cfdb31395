"""How a memory grows: time and memory of a view among 10 to 10,000 things, exactly and by an index
of faiss.

    python -m research.growth

The things beyond the bundled YCB scans are made of these: remembered views of two poses, one turned
about, mixed in a drawn share, with a little noise. Held-out views of the scans ask. Needs ``pip
install 'nextview[large]'``.
"""

import resource
from collections.abc import Iterator, Sequence
from time import perf_counter

from nextview.cli.exit_status import require

require("large")

import numpy as np
import tyro

import nextview
from nextview.cli.exit_status import orderly_end
from nextview.recognition.novelty import unit
from nextview.things.approximate import NearestViews
from nextview.things.memory import (
    AZIMUTHS,
    TaughtRecogniser,
    by_ring,
    ring_shares,
    similarities,
)

NOISE = 0.02  # standard deviation of what is added to each number of a mixed view
BEST = 20  # of the views that are nearest to one, how many the index has to find
INDEX_FROM = 1_000  # things, from where on there is an index
COLUMNS = (
    "things",
    "exact, ms",
    "index, ms",
    f"the best {BEST} are found",
    "index made in, s",
    "peak, GB",
)


def grown(views: np.ndarray, poses: int, rng: np.random.Generator) -> np.ndarray:
    """Remembered views, (H, rings, azimuths, F), and so many more as to be of ``poses`` resting
    poses.
    """
    found = [views[:poses]]
    while (missing := poses - sum(map(len, found))) > 0:
        a, b = rng.integers(len(views), size=(2, min(len(views), missing)))
        share = rng.uniform(0, 1, (len(a), 1, 1, 1)).astype(np.float32)
        mixed = (1 - share) * views[a] + share * np.roll(
            views[b],
            rng.integers(AZIMUTHS),
            2,
        )
        found.append(unit(mixed + NOISE * rng.standard_normal(mixed.shape, np.float32)))
    return np.concatenate(found)


def main(
    things: tuple[int, ...] = (10, 100, 1_000, 10_000),
    views: int = 100,
    seed: int = 0,
) -> None:
    """Print a table, a row for each number of things.

    Args:
        things: how many are remembered.
        views: held-out views that ask.
        seed: of all that is drawn.
    """
    recogniser = nextview.load(models="ycb", threads=1).models.recogniser
    assert isinstance(recogniser, TaughtRecogniser)
    memory = recogniser.memory
    rng = np.random.default_rng(seed)

    remembered = memory.views.astype(np.float32)
    poses_of_one = len(memory.thing) / len(memory.radii)
    held_out = memory.held_out.reshape(-1, remembered.shape[-1]).astype(np.float32)
    elevations = memory.held_out_views[..., 0].ravel()
    chosen = rng.choice(len(held_out), min(views, len(held_out)), replace=False)
    asked = [(held_out[[k]], elevations[[k]]) for k in chosen]

    print(f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|")
    for count in things:
        rings = by_ring(grown(remembered, round(count * poses_of_one), rng))
        row = [f"{count:,}", *timed(rings, asked, count >= INDEX_FROM)]
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(f"| {' | '.join([*row, f'{peak:.1f}'])} |", flush=True)


def timed(
    rings: np.ndarray,
    asked: Sequence[tuple[np.ndarray, np.ndarray]],
    by_index: bool,
) -> Iterator[str]:
    """The cells of a row: exactly, and with an index where there is to be one.

    Args:
        rings: what is remembered, (rings, H * azimuths, F).
        asked: embedding, (1, F), and elevation, (1,), of each view.
        by_index: whether an index is made.
    """
    exact = []
    seconds = []
    for embedding, elevation in asked:
        start = perf_counter()
        exact.append(similarities(rings, embedding, elevation).ravel())
        seconds.append(perf_counter() - start)
    yield f"{1e3 * np.median(seconds):.1f}"
    if not by_index:
        yield from ("", "", "")
        return

    start = perf_counter()
    nearest = NearestViews(rings)
    made = perf_counter() - start
    found_of_best = []
    seconds = []
    for (embedding, elevation), true in zip(asked, exact, strict=True):
        start = perf_counter()
        found = nearest.similarities(embedding, ring_shares(elevation))[0]
        seconds.append(perf_counter() - start)
        best = np.argsort(-true)[:BEST]
        found_of_best.append(np.isclose(found[best], true[best], atol=1e-4).mean())
    yield f"{1e3 * np.median(seconds):.1f}"
    yield f"{np.mean(found_of_best):.1%}"
    yield f"{made:.1f}"


if __name__ == "__main__":
    with orderly_end("nothing was written"):
        tyro.cli(main)
