"""How many throws of a thing end in a resting pose that is taught and shown, and how many do not.

    python benchmarks/resting_throws.py SCANS

SCANS holds scans in metres. A dropped thing rests on a face of its convex hull; a memory and the
simulated tables know at most four of these poses, see ``nextview.geometry.resting``. Printed are
the share of the throws that end in another pose, in the mean over the scans, and the largest
shares.
"""

from pathlib import Path

import numpy as np
import tyro

from nextview.geometry.mesh import load_mesh
from nextview.geometry.resting import (
    LIKELY_POSE,
    MOST_RESTING_POSES,
    _distinct_poses,
    _stable_poses,
)

SHOWN_THINGS = 5


def left_out(path: Path) -> float:
    """The share of the throws of a scan that end in none of its kept poses."""
    mesh = load_mesh(path, unit="m")
    own, *others = _distinct_poses(mesh, *_stable_poses(mesh))
    likely = sorted((p.share for p in others if p.share >= LIKELY_POSE), reverse=True)
    return 1 - own.share - sum(likely[: MOST_RESTING_POSES - 1])


def main(scans: tyro.conf.Positional[Path]) -> None:
    """Print the shares.

    Args:
        scans: folder of scans.
    """
    paths = sorted(path for path in scans.iterdir() if path.suffix == ".ply")
    shares = np.array([left_out(path) for path in paths])
    print(f"{len(paths)} scans: {shares.mean():.3f} of the throws in no kept pose")
    for index in np.argsort(-shares)[:SHOWN_THINGS]:
        print(f"{paths[index].stem}: {shares[index]:.3f}")


if __name__ == "__main__":
    tyro.cli(main)
