"""What several recognisers get wrong alike: errors that another network of the kind will not take away.

    python benchmarks/shared_errors.py PREDICTIONS.npz PREDICTIONS.npz [...]

prints Markdown: how many objects each recogniser names wrong by the sum of all views, and single views; how many of
them all do; how many get the same wrong name from all; and which names are taken for which.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nextview.benchmark.paired import of_the_same


def duplicate_groups(
    answers: NDArray[np.int64], labels: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which objects all recognisers get wrong, and which of these get one and the same wrong name, (N,) each.

    Args:
        answers: of each recogniser, (R, N).
        labels: (N,).
    """
    wrong = (answers != labels).all(0)
    return wrong, wrong & (answers == answers[0]).all(0)


def main(*paths: Path) -> None:
    """Print it."""
    tables = of_the_same(paths)
    first = tables[0]
    fused = np.stack([p.logits.sum(1).argmax(1) for p in tables])
    single = np.stack([p.logits.argmax(2).ravel() for p in tables])
    each = np.repeat(first.labels, first.logits.shape[1])
    print(f"{len(first)} objects, {len(each)} views.\n")
    print("| wrong | objects, all views summed | single views |\n|---|---|---|")
    for path, objects, views in zip(paths, fused, single, strict=True):
        print(f"| {path.stem} | {(objects != first.labels).sum()} | {(views != each).mean():.3f} |")
    (wrong, same), (wrong_views, same_views) = duplicate_groups(fused, first.labels), duplicate_groups(single, each)
    print(f"| all of them | {wrong.sum()} | {wrong_views.mean():.3f} |")
    print(f"| all, by the same name | {same.sum()} | {same_views.mean():.3f} |\n")
    print("| object | is called by all | objects |\n|---|---|---|")
    pairs = Counter((first.classes[first.labels[i]], first.classes[fused[0, i]]) for i in np.flatnonzero(same))
    for (truth, name), count in pairs.most_common():
        print(f"| {truth} | {name} | {count} |")


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    try:
        main(*map(Path, sys.argv[1:]))
    except (OSError, ValueError) as error:
        sys.exit(f"shared_errors.py: {error}")
