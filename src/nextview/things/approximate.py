"""Approximate nearest-neighbour search among many stored views, with faiss (extra "large")."""

from importlib.util import find_spec
from typing import Any

import numpy as np

from nextview.checks import extras
from nextview.types import Float32, Floats, Index

# size of a ring from which an exhaustive search takes more than 10 ms
LARGE_RING = 20_000
INDEX = "PCA64,IVF256,SQ8"  # one byte for each of 64 components, 256 cells
PROBED = 16  # cells searched per query
VIEWS_SAMPLED = 10_240  # views on which the cells are trained
VIEWS_COMPARED = 1000  # candidates of a ring that are compared exactly


def is_large(views: Float32) -> bool:
    """Whether stored views are numerous enough to be searched approximately.

    Args:
        views: stored views, (rings, N, F) float32.

    Returns:
        True if a ring has at least LARGE_RING views and faiss is installed.
    """
    return views.shape[1] >= LARGE_RING and find_spec("faiss") is not None


class NearestViews:
    """One faiss index for each ring of stored views."""

    def __init__(self, views: Float32) -> None:
        """Build the indices.

        Args:
            views: stored views, unit vectors, (rings, N, F) float32.
        """
        sample = np.random.default_rng(0).permutation(views.shape[1])[:VIEWS_SAMPLED]
        self._views = views
        self._indices = [_index(ring, sample) for ring in views]

    def similarities(self, embeddings: Floats, shares: Float32) -> Float32:
        """Cosine similarities of views with the stored views, summed over rings.

        The nearest stored views of each ring are compared exactly. All others get the lowest of
        these similarities.

        Args:
            embeddings: embeddings of the views, (B, F).
            shares: weight of each ring for each view, (B, rings).

        Returns:
            Similarities, (B, N) float32.
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
    """Train a faiss index on a sample of the views and add all views."""
    with extras():
        import faiss

    index = faiss.index_factory(views.shape[-1], INDEX, faiss.METRIC_INNER_PRODUCT)
    index.train(views[sample])
    index.add(views)
    faiss.extract_index_ivf(index).nprobe = PROBED
    return index
