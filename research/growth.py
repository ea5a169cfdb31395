"""How a memory grows: time and memory of a view among 10 to 10,000 things, exactly and by an index of faiss.

    python -m research.growth

The things beyond the bundled YCB scans are made of these: remembered views of two poses, one turned about, mixed in a
drawn share, with a little noise. Held-out views of the scans ask.
"""

import resource
from time import perf_counter

import numpy as np

import nextview
from nextview.recognition.novelty import unit
from nextview.things.approximate import NearestViews
from nextview.things.memory import AZIMUTHS, TaughtRecogniser, by_ring, ring_shares, similarities

NOISE, VIEWS = 0.02, 100


def grown(views: np.ndarray, poses: int, rng: np.random.Generator) -> np.ndarray:
    """Remembered views, (H, rings, azimuths, F), and so many more as to be of ``poses`` resting poses."""
    found = [views[:poses]]
    while (missing := poses - sum(map(len, found))) > 0:
        a, b = rng.integers(len(views), size=(2, min(len(views), missing)))
        share = rng.uniform(0, 1, (len(a), 1, 1, 1)).astype(np.float32)
        mixed = (1 - share) * views[a] + share * np.roll(views[b], rng.integers(AZIMUTHS), 2)
        found.append(unit(mixed + NOISE * rng.standard_normal(mixed.shape, np.float32)))
    return np.concatenate(found)


def main() -> None:
    recogniser = nextview.load(models="ycb", threads=1).models.recogniser
    assert isinstance(recogniser, TaughtRecogniser)
    memory, rng = recogniser.memory, np.random.default_rng(0)
    views, poses_of_one = memory.views.astype(np.float32), len(memory.thing) / len(memory.radii)
    seen, elevations = (
        memory.held_out.reshape(-1, views.shape[-1]).astype(np.float32),
        memory.held_out_views[..., 0].ravel(),
    )
    asked = rng.choice(len(seen), VIEWS, replace=False)
    print(
        "| things | exact, ms | index, ms | the best twenty are found | index made in, s | peak, GB |\n"
        + 6 * "|---"
        + "|"
    )
    for things in (10, 100, 1_000, 10_000):
        rings = by_ring(grown(views, round(things * poses_of_one), rng))
        exact, each = [], []
        for k in asked:
            start = perf_counter()
            exact.append(similarities(rings, seen[[k]], elevations[[k]]).ravel())
            each.append(perf_counter() - start)
        row = [f"{things:,}", f"{1e3 * np.median(each):.1f}"]
        if things >= 1_000:
            start, same, each = perf_counter(), [], []
            nearest = NearestViews(rings)
            made = perf_counter() - start
            for k, true in zip(asked, exact, strict=True):
                start = perf_counter()
                found = nearest.similarities(seen[[k]], ring_shares(elevations[[k]]))[0]
                each.append(perf_counter() - start)
                best = np.argsort(-true)[:20]
                same.append(np.isclose(found[best], true[best], atol=1e-4).mean())
            row += [f"{1e3 * np.median(each):.1f}", f"{np.mean(same):.1%}", f"{made:.1f}"]
        else:
            row += ["", "", ""]
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(f"| {' | '.join([*row, f'{peak:.1f}'])} |", flush=True)


if __name__ == "__main__":
    main()
