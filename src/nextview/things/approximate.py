"""The nearest of very many remembered views, found by faiss, which the extra "large" brings."""

from importlib.util import find_spec
from typing import Any

import numpy as np

from nextview.checks import extras
from nextview.types import Float32, Floats, Index

# views of a ring from which looking at all of them takes more than 10 ms
LARGE_RING = 20_000
INDEX = "PCA64,IVF256,SQ8"  # 64 numbers of a byte for each view, in 256 cells
PROBED = 16  # cells that are searched
VIEWS_SAMPLED = 10_240  # views from which an index learns its cells
VIEWS_COMPARED = 1000  # views of a ring that are compared exactly


def is_large(views: Float32) -> bool:
    """Whether remembered views, (rings, N, F), are searched approximately.

    They are if there are many, and faiss is installed.
    """
    return views.shape[1] >= LARGE_RING and find_spec("faiss") is not None


class NearestViews:
    """An index for each ring of remembered views, (rings, N, F) float32, unit vectors."""

    def __init__(self, views: Float32) -> None:
        sample = np.random.default_rng(0).permutation(views.shape[1])[:VIEWS_SAMPLED]
        self._views = views
        self._indices = [_index(ring, sample) for ring in views]

    def similarities(self, embeddings: Floats, shares: Float32) -> Float32:
        """Cosines of views with what is remembered, summed over rings.

        The nearest of each ring are compared exactly. All others count as the least alike of these.

        Args:
            embeddings: of the views, (B, F).
            shares: how much each ring counts for each view, (B, rings).

        Returns:
            (B, N) float32.
        """
        found = np.empty((len(embeddings), self._views.shape[1]), np.float32)
        pairs = zip(np.asarray(embeddings, np.float32), shares, strict=True)

        for row, (embedding, share) in enumerate(pairs):
            rings = np.flatnonzero(share > 0)
            near = np.concatenate(
                [
                    self._indices[ring].search(embedding[None], VIEWS_COMPARED)[1][0]
                    for ring in rings
                ]
            )
            near = np.unique(near[near >= 0])
            alike = sum(
                share[ring] * (self._views[ring, near] @ embedding) for ring in rings
            )
            found[row] = np.min(alike)
            found[row, near] = alike
        return found


def _index(views: Float32, sample: Index) -> Any:
    with extras():
        import faiss

    index = faiss.index_factory(views.shape[-1], INDEX, faiss.METRIC_INNER_PRODUCT)
    index.train(views[sample])
    index.add(views)
    faiss.extract_index_ivf(index).nprobe = PROBED
    return index
