"""Sizes of taught things: evidence of the class, and detection of a wrong unit of length."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from nextview.errors import DatasetError, MeshError, UsageError, option
from nextview.geometry.mesh import UNITS, load_mesh
from nextview.recognition.belief import SizeEvidence
from nextview.types import Floats, Index

# ratio to the median of the others from which a size is implausible
ODD_SIZE = 300
# largest plausible median radius, metres: no camera goes around a larger thing
LARGEST_MEDIAN_RADIUS = 20.0
SMALLEST_RADIUS = 0.001  # smallest one, metres: the resolution of depth cameras
USUAL_RADII = (0.01, 3.0)  # range of usual radii, metres
SIZE_ERROR = 0.05  # standard deviation of a measured log-radius


def refuse_without_unit(path: Path, up: str | None) -> None:
    """Refuse a mesh file without a unit of length; the sentence names the units that may be meant.

    Args:
        path: path of the mesh file.
        up: up axis of the file, "y" or "z"; None for that of its format.

    Raises:
        UsageError: always.
    """
    units = [option("unit", name) for name in UNITS]
    with suppress(MeshError):  # its unit is asked for first
        mesh = load_mesh(path, up)
        longest = mesh.radius * float(np.ptp(mesh.vertices, axis=0).max())
        units = _likely_units(mesh.radius, longest) or units
    raise UsageError(
        f"{path}: the unit of its lengths is missing; by its longest side, is it"
        f" {', '.join(units)}?"
    )


def check_sizes(paths: Sequence[Path], radii: Floats, unit: str | None) -> None:
    """Refuse things whose sizes indicate another unit of length.

    Args:
        paths: paths of the things.
        radii: their object radii, (N,), metres.
        unit: unit of the mesh files as given; None without one.

    Raises:
        DatasetError: a thing is hundreds of times larger or smaller than most, or most are larger
            than a house or smaller than the resolution of a depth camera.
    """
    median = float(np.median(radii))
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


def check_unit(paths: Sequence[Path], up: str | None, unit: str | None) -> None:
    """Refuse mesh files in another unit before they are taught.

    Args:
        paths: paths of some mesh files.
        up: up axis of the files, "y" or "z"; None for that of their format.
        unit: unit of their lengths.

    Raises:
        DatasetError: see ``check_sizes``.
    """
    with suppress(MeshError):  # it is left out later
        radii = [load_mesh(path, up, unit).radius for path in paths]
        check_sizes(paths, np.array(radii), unit)


def _all_odd(paths: Sequence[Path], radii: Floats, unit: str, median: float) -> str:
    """A sentence about things of implausible size, with the unit that makes them usual."""
    middle = int(np.argmin(np.abs(radii - median)))
    size = f"has a radius of {_length(float(radii[middle]))} if {option('unit', unit)} is right"
    who = (
        f"{paths[middle]}: {size}"
        if len(paths) == 1
        else f"{paths[middle]}: {size}, and half of the others are like it"
    )

    likely = _likely_units(median / UNITS[unit], median / UNITS[unit])
    hint = f"is it {' or '.join(likely)}?" if likely else "is that right?"
    return f"{who}; {hint} {option('any_size', True)} accepts it"


def _likely_units(radius: float, length: float) -> list[str]:
    """The units in which a radius is usual, as options, each with a length in it."""
    found = []
    for unit, metres in UNITS.items():
        if USUAL_RADII[0] <= radius * metres <= USUAL_RADII[1]:
            found.append(f"{option('unit', unit)} ({_length(length * metres)})")
    return found


def _length(metres: float) -> str:
    """A length in a readable unit."""
    if metres >= 1:
        return f"{metres:.3g} m" if metres < 1000 else f"{metres / 1000:,.3g} km"
    return f"{100 * metres:.2g} cm" if metres >= 0.01 else f"{1000 * metres:.2g} mm"


def size_evidence(radii: Floats, label: Index) -> SizeEvidence:
    """Likelihood of each size for the things of each class.

    Each thing of a class adds a normal distribution of the log-radius, and a wide one with a tenth
    of the weight, because half-hidden things appear smaller.

    Args:
        radii: radii of the things, metres, (T,).
        label: class of each thing, (T,) int64.

    Returns:
        The evidence from size.
    """
    low = np.log(radii.min()) - 0.7
    high = np.log(radii.max()) + 0.7
    grid = np.linspace(low, high, int((high - low) / 0.03) + 2)
    density = np.zeros((int(label.max()) + 1, len(grid)))

    for c in range(len(density)):
        own = np.log(radii[label == c])
        # The sizes in a class differ, and fewer known things require a wider distribution.
        wide = SIZE_ERROR
        if len(own) > 1:
            wide = max(SIZE_ERROR, 0.5 * own.std())
        off = (grid[:, None] - own) / wide
        density[c] = np.log(
            (0.9 * np.exp(-(off**2) / 2) + 0.1 / 4 * np.exp(-(off**2) / 32)).mean(1)
            / wide
            + 1e-9
        )
    # the best size of all classes has log-likelihood 0, so sizes only count against a class
    density -= density.max()
    # rounded, because people read cards, too
    short = np.array([float(f"{radius:.5g}") for radius in np.exp(grid)])
    return SizeEvidence.from_arrays(short, np.round(density, 3), 1.0)
