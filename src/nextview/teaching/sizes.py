"""Plausibility of the sizes of taught things: detection of a wrong unit of length."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nextview.errors import DatasetError, option
from nextview.geometry.mesh import UNITS
from nextview.types import Floats

# ratio to the median of the others from which a size is implausible
ODD_SIZE = 300
# largest plausible median radius, metres: no camera goes around a larger thing
LARGEST_MEDIAN_RADIUS = 20.0
SMALLEST_RADIUS = 0.001  # smallest one, metres: the resolution of depth cameras
USUAL_RADII = (0.01, 3.0)  # range of usual radii, metres


def check_sizes(paths: Sequence[Path], radii: Floats, unit: str | None) -> None:
    """Refuse things whose sizes indicate another unit of length.

    Args:
        paths: paths of the things.
        radii: their object radii, (N,), metres; NaN if unknown.
        unit: unit of the mesh files as given; None without one.

    Raises:
        DatasetError: a thing is hundreds of times larger or smaller than most, or most are larger
            than a house or smaller than the resolution of a depth camera.
    """
    known = np.isfinite(radii)
    if not known.any():
        return
    median = float(np.median(radii[known]))
    if unit is not None and not SMALLEST_RADIUS < median < LARGEST_MEDIAN_RADIUS:
        raise DatasetError(_all_odd(paths, radii, unit, median))

    for path, times in zip(paths, radii / median, strict=True):
        if times > ODD_SIZE or times < 1 / ODD_SIZE:
            how = (
                f"{times:,.0f} times larger"
                if times > 1
                else f"{1 / times:,.0f} times smaller"
            )
            hint = f"is it in another unit? {option('any_size', True)} accepts it"
            raise DatasetError(f"{path}: is {how} than most others; {hint}")


def _all_odd(paths: Sequence[Path], radii: Floats, unit: str, median: float) -> str:
    """A sentence about things of implausible size, with the unit that makes them usual."""
    middle = int(np.nanargmin(np.abs(radii - median)))
    size = f"has a radius of {_length(float(radii[middle]))} if {option('unit', unit)} is right"
    who = (
        f"{paths[middle]}: {size}"
        if len(paths) == 1
        else f"{paths[middle]}: {size}, and half of the others are like it"
    )

    likely = []
    for other, metres in UNITS.items():
        radius = median / UNITS[unit] * metres
        if USUAL_RADII[0] <= radius <= USUAL_RADII[1]:
            likely.append(f"{option('unit', other)} ({_length(radius)})")
    hint = f"is it {' or '.join(likely)}?" if likely else "is that right?"
    return f"{who}; {hint} {option('any_size', True)} accepts it"


def _length(metres: float) -> str:
    """A length in a readable unit."""
    if metres >= 1:
        return f"{metres:.3g} m" if metres < 1000 else f"{metres / 1000:,.3g} km"
    return f"{100 * metres:.2g} cm" if metres >= 0.01 else f"{1000 * metres:.2g} mm"
